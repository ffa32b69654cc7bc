"""The paper's Fig. 6: does a field show more than the spectra that it has learned from?

    python -m benchmarks.quality.fig6 --scale laptop --paths paper.paths

At held-out poses, on one pinhole, everything is compared with a finer truth: three times the rays, another lattice and
seed, and a narrower lobe. One candidate is the spectrum of training quality at that very pose, which no method ever
saw. Whoever is nearer to the finer truth shows more. The finer truth is solved twice, so that its own noise, which is
large in so narrow a lobe, is known and taken off. Writes fig6-SCALE.png, .md and .json; a second run reuses what the
first one made. docs/how-to/figures.md has the rest.
"""

import argparse
import math
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from benchmarks.quality.fig1 import OURS, SPLATS_AND_COPY, TRAINING
from benchmarks.quality.fig6_scores import COLUMNS as SCORES
from benchmarks.quality.fig6_scores import blur_of, detail_of, interval, scores, truth_of, verdict
from benchmarks.quality.methods.method import Scale
from benchmarks.quality.panel_data import (
    answered,
    held_out,
    identity_of,
    kept,
    rendered,
    show,
    small_png,
    turned,
)
from benchmarks.quality.protocol.data import window_for
from benchmarks.quality.protocol.figure import made_by, page_or_sentence, parser_of, rows_of, study_of, write_json
from benchmarks.quality.protocol.pictures import YAWS_DEG, pinholes
from benchmarks.quality.protocol.study import Study, say
from rf3dgs.channel.io import PathsReader
from rf3dgs.channel.paths import Paths
from rf3dgs.core.errors import InputError, RfError
from rf3dgs.core.files import write_whole
from rf3dgs.core.frames import Pose
from rf3dgs.core.grids import DirectionGrid
from rf3dgs.evaluation import metrics
from rf3dgs.evaluation.figures import STYLE
from rf3dgs.evaluation.pictures import colour_range, coloured
from rf3dgs.field.radio_field import RadioField
from rf3dgs.propagation.config import TraceConfig
from rf3dgs.spectra.codec import DbWindow
from rf3dgs.spectra.spectrum import Instrument, Spectrum, stack_spectra
from rf3dgs.spectra.synthesis import default_lobe


@dataclass(frozen=True)
class Fineness:
    """What a scale is judged on."""

    shown: tuple[int, int]
    """Pixels of the pinhole that everything is judged on."""
    lobe_deg: float
    """Of the finer truth."""
    judged: int
    """Held-out positions."""


SCALES: Mapping[Scale, Fineness] = {
    "smoke": Fineness((72, 48), 2.5, 2),
    "laptop": Fineness((300, 200), 1.0, 8),
    "paper": Fineness((300, 200), 1.0, 40),
}
FINER = 3  # times the rays
AGAIN = 7919  # more rays for the second solve of the finer truth: another lattice
SEED = 200_003  # of the finer truth, away from those of the paths
SAME_PLACE = 1e-3  # m
COARSE, SHARP = "training quality at that pose", "our field, points in the fine lobe"


@dataclass(frozen=True)
class Sharper:
    """A field whose point sources are drawn with a narrower `lobe` [rad] than it has learned from, the surface as is.

    Levels stay those of the field's own lobe: what comes from a surface does not change, and a point source rises by
    the ratio of the beams' solid angles.
    """

    field: RadioField
    lobe: float

    def render(self, pose: Pose, grid: DirectionGrid) -> Spectrum:
        surface = self.field.without_sources().render(pose, grid, csi=False).power
        fine = Instrument.gaussian(self.lobe)
        whole = replace(self.field, instrument=fine).render(pose, grid, csi=False)
        points = (whole.power - surface).clamp_min(0.0)
        return replace(whole, power=surface + points * (self.field.instrument.beam_solid_angle / fine.beam_solid_angle))


def finer_paths(study: Study, given: Path | None, number: int, paths: Paths, again: bool) -> Paths:
    """Paths `[path]` of the finer truth where `paths` end: traced anew, or those that stand there among the given."""
    here = Pose(paths.rx.position[None], paths.rx.orientation[None])
    if given is not None:
        with PathsReader(given) as finer:
            apart = torch.linalg.vector_norm(finer.rx.position - here.position, dim=-1)
            if float(apart.min()) > SAME_PLACE:
                raise InputError(f"{given} has no receiver where number {number} of the other paths stands; trace it")
            return finer[int(apart.argmin())]
    from rf3dgs.propagation.sionna import trace_each

    config = TraceConfig(rays=finer_rays(study) + AGAIN * again, seed=SEED + 1000 * SEED * again)
    return next(trace_each(study.scene, None, here, config, indices=[number]))[0]


def finer_rays(study: Study) -> int:
    """Rays of the finer truth."""
    return FINER * (study.config.rays or TraceConfig().rays)


def finer_truth(
    study: Study, given: Path | None, numbers: Sequence[int], paths: Sequence[Paths], again: bool
) -> Tensor:
    """Powers `[n, row, col]` of the finer truth at each receiver, in its own lobe; kept one by one."""
    how = SCALES[study.config.scale]
    grid, lobe = pinholes(*how.shown).grid, math.radians(how.lobe_deg)
    rows = []
    for number, one, yaw in zip(numbers, paths, yaws_of(numbers), strict=True):
        identity = {
            "paths": str(given or "traced"),
            "at": one.rx.position.tolist(),
            "yaw": yaw,
            "lobe": lobe,
            "grid": list(how.shown),
            "rays": finer_rays(study),
        }

        def solved(number=number, one=one, yaw=yaw) -> Tensor:
            return turned(finer_paths(study, given, number, one, again), yaw, grid, lobe).power

        name = "finer truth again" if again else "finer truth"
        rows.append(kept(study.config.out / "kept", name, identity, solved))
    return torch.cat(rows)


def yaws_of(numbers: Sequence[int]) -> list[float]:
    """Where each of some receivers looks [rad]: along the four yaws in turn."""
    return [math.radians(YAWS_DEG[place % len(YAWS_DEG)]) for place in range(len(numbers))]


def draw(solves: tuple[Tensor, Tensor], answers: Mapping[str, Tensor], window: DbWindow, sigma: float) -> bytes:
    """One view `[row, col]` of each as PNG bytes; below, the ninth of it in which both solves have most detail alike.

    sigma [pixel]: what is finer than such a Gaussian counts as detail.
    """
    import matplotlib as mpl
    from matplotlib.figure import Figure

    truth = (solves[0] + solves[1]) / 2
    height, width = truth.shape
    (_, first), (_, second) = (detail_of(metrics.window_level(power, window)[None], sigma) for power in solves)
    alike = torch.nn.functional.avg_pool2d(first * second, (height // 3, width // 3), 1)[0]
    row, col = divmod(int(alike.argmax()), alike.shape[1])
    panels = {"finer truth": truth} | dict(answers)
    with mpl.rc_context({**STYLE, "font.size": 8, "axes.titlesize": 8}):
        figure = Figure(figsize=(2.3 * len(panels), 3.4), dpi=100, layout="constrained")
        axes = figure.subplots(2, len(panels))
        for (above, below), (name, power) in zip(axes.T, panels.items(), strict=True):
            picture = coloured(window.encode(power).numpy())
            show(above, picture, name)
            frame = (np.array([0, 1, 1, 0, 0]) * (width // 3), np.array([0, 0, 1, 1, 0]) * (height // 3))
            above.plot(col + frame[0], row + frame[1], color="white", linewidth=0.8)
            show(below, picture[row : row + height // 3, col : col + width // 3], "")
        return small_png(figure)


def made(wish: argparse.Namespace) -> tuple[bytes, dict[str, Any], str]:
    """The figure as PNG bytes, its numbers, and the table."""
    how, study = SCALES[wish.scale], study_of(wish, "fig6", holdouts=("random",))
    grid, fine = pinholes(*how.shown).grid, math.radians(how.lobe_deg)
    lobe = default_lobe(study.config.pictures.grid)
    rise = Instrument.gaussian(lobe).beam_solid_angle / Instrument.gaussian(fine).beam_solid_angle
    count, folder = wish.training or TRAINING[wish.scale], study.config.out
    numbers, paths, _ = held_out(study, wish.judged or how.judged)
    task = study.task(count, wish.seed)
    coarse = stack_spectra([turned(one, yaw, grid, lobe) for one, yaw in zip(paths, yaws_of(numbers), strict=True)])
    first, second = (finer_truth(study, wish.truth, numbers, paths, again) * rise for again in (False, True))
    solves, truth = (first, second), (first + second) / 2
    answers = {COARSE: coarse.power}
    for method in SPLATS_AND_COPY:
        say(method.name)
        trained = cache(lambda method=method: method.made(task))
        answers[method.name] = answered(method, task, coarse.pose, grid, folder, trained)
        if method is OURS:
            identity = identity_of(task, coarse.pose, grid) | {"settings": dict(OURS.settings(task)), "lobe": fine}

            def sharper(trained=trained) -> Tensor:
                return rendered(Sharper(trained(), fine), coarse.pose, grid)

            answers[SHARP] = kept(folder / "kept", SHARP, identity, sharper)
    window = window_for(replace(coarse, power=truth))
    found = {name: scores(solves, power, grid, window, lobe) for name, power in answers.items()}
    against = {
        name: {score: verdict(score, values[score], found[COARSE][score]) for score in SCORES if score != "sharpness"}
        for name, values in found.items()
        if name != COARSE
    }
    view = wish.view % len(numbers)
    colours = colour_range([replace(coarse[view], power=truth[view])])
    shown = {name: power[view] for name, power in answers.items()}
    picture = draw((first[view], second[view]), shown, colours, blur_of(grid, lobe))
    true = truth_of(solves, grid, window, lobe)
    said = (
        f"The finer truth has {true['detail']:.2f} dB of detail (RMS), a sharpness of {true['sharpness']:.2f} dB/pixel "
        f"and {true['noise']:.2f} dB of noise, which is taken off, but not from SSIM."
    )
    facts = {
        "scale": wish.scale,
        "seed": wish.seed,
        "training": study.data.split.training(count, wish.seed).tolist(),
        "judged": numbers,
        "lobe_deg": {"training": math.degrees(lobe), "truth": how.lobe_deg},
        "window": [window.floor_db, window.ceil_db],
        "finer truth": true,
        "scores": {
            name: {score: values.tolist() for score, values in column.items()} for name, column in found.items()
        },
        "against training quality": against,
    }
    return picture, facts, f"{_table(found, against)}\n\n{said}"


def main(words: Sequence[str] | None = None) -> int:
    """Make the figure; the exit status."""
    parser = parser_of(__doc__, "fig6")
    parser.add_argument("--training", type=int, help="training positions; the scale's number when missing")
    parser.add_argument("--truth", type=Path, help="paths of the finer truth; traced when missing")
    parser.add_argument("--judged", type=int, help="held-out positions; the scale's number when missing")
    parser.add_argument("--view", type=int, default=0, help="which of them is drawn")
    parser.add_argument("--seed", type=int, default=0, help="of the training positions and the fits")
    wish, started = parser.parse_args(words), time.process_time()
    try:
        picture, facts, table = made(wish)
    except RfError as error:
        say(f"fig6: {error}")
        return 2
    counts = f"{len(facts['training'])} training positions, {len(facts['judged'])} judged"
    parts = [
        table,
        f"{counts}; lobe {facts['lobe_deg']['training']:.1f} degrees, of the finer truth "
        f"{facts['lobe_deg']['truth']:g}; {time.process_time() - started:.0f} s of CPU time.",
        made_by("fig6", [wish.seed], words),
    ]
    text, name = "\n\n".join(parts), f"fig6-{wish.scale}"
    write_whole((wish.pictures or wish.out) / f"{name}.png", picture)
    write_json(wish.out / f"{name}.json", facts)
    write_whole(wish.out / f"{name}.md", (text + "\n").encode())
    print(text)
    return page_or_sentence(wish.page, "fig6", text)


def _table(found: Mapping[str, Mapping[str, np.ndarray]], against: Mapping[str, Mapping[str, str]]) -> str:
    """Means with 95 % intervals over positions; in brackets, whether nearer to the truth than training quality is."""
    rows = []
    for name, values in found.items():
        row = [name]
        for score, (_, digits) in SCORES.items():
            mean, low, high = interval(score, values[score])
            said = f" ({against[name][score]})" if score in against.get(name, {}) else ""
            row.append(f"{mean:.{digits}f} [{low:.{digits}f}, {high:.{digits}f}]{said}")
        rows.append(row)
    return rows_of(("against the finer truth", *(label for label, _ in SCORES.values())), rows)


if __name__ == "__main__":
    sys.exit(main())
