"""How much a field loses when things move, and what a minute of training with a few new spectra restores.

    python -m benchmarks.quality.radiance.aging --positions 40 --new 10 20

A field and lookups are made of spectra from before, and judged where things have moved; then again with spectra of some
of the positions measured anew. Geometry stays that from before. Other words are those of the table.
docs/how-to/radiance-table.md has what came out.
"""

import argparse
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import torch

from benchmarks.quality.methods import methods_of
from benchmarks.quality.methods.method import Method, Task
from benchmarks.quality.protocol.cells import Truth
from benchmarks.quality.protocol.scenes import BEFORE
from benchmarks.quality.protocol.study import say
from benchmarks.quality.radiance.__main__ import Run, asked
from rf3dgs.core.errors import RfError
from rf3dgs.evaluation.protocol import Predictor
from rf3dgs.evaluation.scores import SCORE
from rf3dgs.field.radio_field import RadioField
from rf3dgs.spectra.spectrum import Spectrum, stack_spectra
from rf3dgs.training.refine import refine_field

SAME_PLACE = 1e-3  # m
COLUMNS = ("peak_within_1", "beam_loss_eigen", "rmse_db", "path_gain", "delay", "departure")


@dataclass(frozen=True)
class Attempt:
    """A row of the table: what is judged, by which judge ("before" or "now"), and the making of it."""

    name: str
    judge: str
    make: Callable[[], Predictor]


def attempts(
    model: Method, before: Spectrum, new: Sequence[Spectrum], made: Callable[[Method, Spectrum], Predictor]
) -> Iterator[Attempt]:
    """The attempts with spectra `before` and each of the `new` sets; `made` trains a model or fills a lookup."""
    lookups = methods_of(("nearest", "idw4"))
    kept: dict[str, Predictor] = {}

    def stale(one: Method) -> Predictor:
        if one.name not in kept:
            kept[one.name] = made(one, before)
        return kept[one.name]

    def refined(some: Spectrum) -> Predictor:
        field = stale(model)
        assert isinstance(field, RadioField)
        return refine_field(field, some)

    for judge in ("before", "now"):
        for one in (model, *lookups):
            yield Attempt(f"{one.name} of before", judge, lambda one=one: stale(one))
    for some in new:
        count = len(some)
        both = updated(before, some)
        yield Attempt(f"{model.name} refined by {count} new", "now", lambda some=some: refined(some))
        for one in (model, *lookups):
            yield Attempt(f"{one.name} of {count} new", "now", lambda one=one, some=some: made(one, some))
            yield Attempt(f"{one.name} of before and {count} new", "now", lambda one=one, both=both: made(one, both))


def updated(before: Spectrum, new: Spectrum) -> Spectrum:
    """Spectra from before with those of `new`, which take the place of what was measured there before."""
    apart = torch.cdist(before.pose.position.double(), new.pose.position.double()).amin(1)
    kept = before[apart > SAME_PLACE]
    return stack_spectra([part[index] for part in (kept, new) for index in range(len(part))])


def main(words: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scene", choices=BEFORE, default="lobby-moved")
    parser.add_argument("--model", default="mirror", help="a field, or NAME=BASE,SETTING=VALUE")
    parser.add_argument("--positions", type=int, default=40, help="training positions from before")
    parser.add_argument("--new", nargs="+", type=int, default=[10, 20], help="how many of them are measured anew")
    parser.add_argument("--seed", type=int, default=0)
    own, rest = parser.parse_known_args(words)
    try:
        wish = asked(["--scene", own.scene, *rest])
        run, seed = Run(wish), own.seed
        study = run.study(wish.preset[0])
        now, then = study.data, run.study(wish.preset[0], BEFORE[own.scene]).data
        window, geometry = then.window(), study.geometry(seed)

        def made(model: Method, train: Spectrum) -> Predictor:
            return model.made(Task(train, window, seed, "paper", geometry))

        new = [now.training(count, seed) for count in own.new]
        judges = {"before": then, "now": now}
        truths = {
            (judge, holdout): Truth.of(data.judged(wish.judge, holdout, run.reason()), window)
            for judge, data in judges.items()
            for holdout in wish.holdout
        }
        print(f"{'':34}{'judged':>8}{'CPU [s]':>9}  " + "   ".join(wish.holdout), flush=True)
        for one in attempts(methods_of([own.model])[0], then.training(own.positions, seed), new, made):
            start = time.process_time()
            predictor = one.make()
            spent = time.process_time() - start
            judges = [truths[one.judge, holdout] for holdout in wish.holdout]
            rows = [truth.scored(truth.drawn(predictor)) for truth in judges]
            texts = [
                " / ".join(SCORE[key].text(SCORE[key].of(row[SCORE[key].column])) for key in COLUMNS) for row in rows
            ]
            print(f"{one.name:34}{one.judge:>8}{spent:9.1f}  " + "   ".join(texts), flush=True)
    except RfError as error:
        say(f"aging: {error}")
        return 2
    print("\n" + " / ".join(f"{SCORE[key].label} [{SCORE[key].unit}]" for key in COLUMNS))
    return 0


if __name__ == "__main__":
    sys.exit(main())
