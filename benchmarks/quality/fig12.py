"""The paper's Fig. 12: delay and angle of departure, as its pictures and in nanoseconds and degrees.

    python -m benchmarks.quality.fig12 --scale smoke|laptop|paper --page docs/how-to/figures-12.md

Our field, the published recipe with the paper's encoding, the same recipe with a unit vector and a delay over range
(`vector`), nearest neighbour and inverse distance, trained on the same positions. "second solve" is the truth traced
again, of --again positions of each hold-out. Writes fig12.png, fig12.json and, with --page, tables.
docs/how-to/figures-12.md explains.
"""

import argparse
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.quality.csi_pictures import PHYSICAL, PUBLISHED, csi_scores
from benchmarks.quality.methods import methods_of
from benchmarks.quality.methods.field import field
from benchmarks.quality.methods.method import Method, Scale
from benchmarks.quality.protocol.cells import SECOND, Extra, Key, Truth
from benchmarks.quality.protocol.figure import (
    cpu_hours,
    made_by,
    page_or_sentence,
    parser_of,
    rows_of,
    study_of,
    told,
    write_json,
)
from benchmarks.quality.protocol.kept import kept_beside, kept_pictures
from benchmarks.quality.protocol.panels import panels
from benchmarks.quality.protocol.results import Place, Results
from benchmarks.quality.protocol.study import Study
from rf3dgs.core.files import write_whole
from rf3dgs.evaluation.pictures import delay_picture, departure_pictures, spectrum_picture
from rf3dgs.evaluation.scores import Score
from rf3dgs.evaluation.table import Estimate
from rf3dgs.spectra.codec import PaperEncoding
from rf3dgs.spectra.spectrum import Spectrum

NAME = "fig12"
COUNT: Mapping[Scale, int] = {"smoke": 6, "laptop": 80, "paper": 80}
STEPS: Mapping[Scale, int] = {"smoke": 40, "laptop": 3_000, "paper": 10_000}
PAPER_LPIPS = "AoD 0.395, delay 0.382; 84.64 % less LPIPS of gain than NeRF2"


def methods_at(scale: Scale) -> list[Method]:
    """What is compared."""
    recipe = {"preset": "paper", "steps": STEPS[scale]}
    return [
        field("mirror", "mirror"),
        field("published", "paper", recipe),
        field("vector", "paper", recipe | {"encoding": "vector"}),
        *methods_of(["nearest", "idw4"]),
    ]


def study_for(wish: argparse.Namespace) -> Study:
    """The study whose cells have the scores of delay and departure."""
    data = study_of(wish, NAME).data
    pool = data.dataset.train.spectra
    assert pool is not None
    encoding = PaperEncoding(data.window(), PaperEncoding.of(pool).delay_span)
    return study_of(wish, NAME, extra=Extra(NAME, partial(csi_scores, encoding=encoding)), keep=4)


def estimates(results: Results, place: Place, scores: Sequence[Score]) -> dict[str, dict[str, Estimate]]:
    """Scores by model and key."""
    found: dict[str, dict[str, Estimate]] = {}
    for name in (*results.models, SECOND):
        for score in scores:
            one = results.second(place, score) if name == SECOND else results.estimate(place, name, score)
            if one is not None:
                found.setdefault(name, {})[score.key] = one
    return found


def table_of(found: Mapping[str, Mapping[str, Estimate]], scores: Sequence[Score]) -> str:
    """Models by scores in Markdown, with half the width of their intervals."""

    def text(score: Score, one: Estimate) -> str:
        if np.isnan(one.value):
            return "-"
        half = 0.5 * (one.high - one.low)
        return score.text(one.value) + ("" if np.isnan(half) else f" ± {half:.{score.digits}f}")

    head = ["model", *(f"{score.label}{f' [{score.unit}]' if score.unit else ''}" for score in scores)]
    return rows_of(head, [[name, *(text(score, of[score.key]) for score in scores)] for name, of in found.items()])


def draw(study: Study, results: Results, truth: Truth) -> bytes:
    """fig12.png: gain, delay and departure of one view of the first position at random."""
    view, window = int(truth.spectra.path_gain[: truth.views].argmax()), truth.window
    columns: dict[str, Spectrum] = {"truth": truth.spectra[view]}
    for fact in results.facts:
        key = Key(**fact["key"])
        if key.holdout == "random" and key.model != "idw4":
            kept = kept_pictures(kept_beside(key.path(study.config.cells)), truth.spectra)
            columns[key.model] = kept[view]
    delay, gain = truth.spectra.delay, truth.spectra.gain_db
    assert delay is not None
    longest = float(delay[view][gain[view] >= window.floor_db].max())
    each = [
        (spectrum_picture(one, window), delay_picture(one, window, longest=longest), *departure_pictures(one, window))
        for one in columns.values()
    ]
    names = ("gain", f"delay, 0 to {1e9 * longest:.0f} ns", "AoD azimuth", "AoD zenith")
    return panels([[pictures[row] for pictures in each] for row in range(len(names))], [*columns], names)


def as_json(of: Mapping[str, Mapping[str, Mapping[str, Estimate]]], made: str) -> dict[str, Any]:
    """Every score with its interval, by hold-out, model and key."""
    numbers = {
        place: {
            model: {key: [one.value, one.low, one.high] for key, one in scores.items() if not np.isnan(one.value)}
            for model, scores in models.items()
        }
        for place, models in of.items()
    }
    return {"figure": NAME, "made": made, "scores": numbers}


def main(words: Sequence[str] | None = None) -> int:
    return told(NAME, partial(figure, words))


def figure(words: Sequence[str] | None) -> int:
    parser = parser_of(__doc__, NAME)
    parser.add_argument("--count", type=int, help="training positions; 6 or 80 by the scale")
    parser.add_argument("--seed", type=int, default=0, help="draws the training positions")
    parser.add_argument("--again", type=int, default=0, help="positions of each hold-out traced again, for the ceiling")
    wish = parser.parse_args(words)
    count = COUNT[wish.scale] if wish.count is None else wish.count
    study, methods = study_for(wish), methods_at(wish.scale)
    results = Results([one.name for one in methods], study.config.judge, study.config.geometry, [wish.seed])
    study.add(results, methods, count, wish.seed)
    if wish.again:
        study.add_second(results, wish.again)
    found = {place.holdout: estimates(results, place, (*PUBLISHED, *PHYSICAL)) for place in results.places}
    truth = study.truth("random")
    judged = len(truth.spectra) // truth.views
    more = {"positions": f"{count} trained on and {judged} of each hold-out judged"}
    more["CPU hours of fits and rendering"] = cpu_hours(results.facts)
    made = made_by(NAME, [wish.seed], words, **more)
    parts = []
    for holdout, of in found.items():
        parts.append(f"Hold-out `{holdout}`, the paper's pictures:\n\n{table_of(of, PUBLISHED)}")
        parts.append(f"Hold-out `{holdout}`, errors over the pixels that a path reaches:\n\n{table_of(of, PHYSICAL)}")
    text = "\n\n".join([*parts, f"LPIPS in the paper: {PAPER_LPIPS}. Here it needs `RF3DGS_LPIPS`.", made])
    print(text)
    folder: Path = wish.pictures or wish.out
    folder.mkdir(parents=True, exist_ok=True)
    write_whole(folder / "fig12.png", draw(study, results, truth))
    write_json(wish.out / f"{NAME}.json", as_json(found, made))
    return page_or_sentence(wish.page, NAME, text)


if __name__ == "__main__":
    raise SystemExit(main())
