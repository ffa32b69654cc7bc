"""The paper's Fig. 6: does a field show more than the spectra that it has learned from?

    python -m benchmarks.quality.fig6 --scale smoke|laptop|paper --out out/fig6

At held-out poses, on one pinhole, everything is compared with a finer truth: three times the rays, another lattice and
seed, and a lobe of 1 degree. One candidate is the spectrum of training quality at that very pose, which no method ever
saw. Whoever is nearer to the finer truth shows more. The finer truth is solved twice, so that its own noise, which is
large in so narrow a lobe, is known and taken off. Writes fig6.png, fig6.md and fig6.json; a second run reuses what
the first one made. docs/how-to/figures.md has the rest.
"""

import json
import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from benchmarks.quality.fig1 import COLUMNS, OURS
from benchmarks.quality.fig6_scores import COLUMNS as SCORES
from benchmarks.quality.fig6_scores import blur_of, detail_of, interval, scores, truth_of, verdict
from benchmarks.quality.methods.method import Task
from benchmarks.quality.panel_data import (
    FOV_DEG,
    SAME_PLACE,
    YAWS,
    Size,
    Some,
    answered,
    geometry_at,
    identity_of,
    kept,
    options_of,
    paths_at,
    positions_of,
    rendered,
    scene,
    show,
    small_png,
    table_text,
    training_spectra,
    window_for,
)
from rf3dgs.channel.io import PathsReader
from rf3dgs.channel.paths import Paths
from rf3dgs.core.errors import InputError
from rf3dgs.core.files import write_whole
from rf3dgs.core.frames import Pose
from rf3dgs.core.grids import DirectionGrid, equirect_grid, pinhole_grid
from rf3dgs.evaluation import metrics
from rf3dgs.evaluation.figures import STYLE
from rf3dgs.evaluation.pictures import colour_range, coloured
from rf3dgs.field.radio_field import RadioField
from rf3dgs.propagation.config import TraceConfig
from rf3dgs.spectra.codec import DbWindow
from rf3dgs.spectra.scan import spectrum_of
from rf3dgs.spectra.spectrum import Instrument, Spectrum, stack_spectra
from rf3dgs.spectra.synthesis import default_lobe
from rf3dgs.spectra.yaws import at_yaws


@dataclass(frozen=True)
class Fineness:
    """What a scale learns from, and what it is judged on."""

    size: Size
    sphere: tuple[int, int] | None
    """Pixels of the training spheres; None for the paper's four pinholes of 300x200 a position."""
    shown: tuple[int, int]
    """Pixels of the pinhole that everything is judged on."""
    lobe_deg: float
    """Of the finer truth."""
    judged: int
    """Held-out positions."""


SCALES = {
    "smoke": Fineness(Size(16, 20_000, 6), (72, 36), (72, 48), 2.5, 2),
    "laptop": Fineness(Size(120, 300_000, 40), (180, 90), (300, 200), 1.0, 8),
    "paper": Fineness(Size(800, 300_000, 640), None, (300, 200), 1.0, 80),
}
FINER = 3  # times the rays
AGAIN = 7919  # more rays for the second solve of the finer truth: another lattice
SEED = 200_003  # of the finer truth, away from those of the paths
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


def finer_paths(given: Path | None, reader: PathsReader, number: int, again: bool, size: Size) -> Paths:
    """Paths `[path]` of the finer truth at a receiver: traced anew, or those that stand there among the given ones."""
    here = reader.rx[number : number + 1]
    if given is not None:
        with PathsReader(given) as finer:
            apart = torch.linalg.vector_norm(finer.rx.position - here.position, dim=-1)
            if float(apart.min()) > SAME_PLACE:
                raise InputError(f"{given} has no receiver where number {number} of the other paths stands; trace it")
            return finer[int(apart.argmin())]
    from rf3dgs.propagation.sionna import trace_each

    config = TraceConfig(rays=FINER * size.rays + AGAIN * again, seed=SEED + 1000 * SEED * again)
    return next(trace_each(scene(), None, here, config, indices=[number]))[0]


def turned(paths: Paths, yaw: float, grid: DirectionGrid, lobe: float) -> Spectrum:
    """The ideal spectrum `[1, row, col]` of a receiver that turned by `yaw` [rad]."""
    return spectrum_of(at_yaws(paths, [yaw]), None, grid, lobe=lobe)


def training_pictures(how: Fineness) -> tuple[Callable[[Paths, int], Spectrum], float]:
    """What makes the training pictures of one receiver, and their lobe [rad]."""
    grid = pinhole_grid(300, 200, FOV_DEG) if how.sphere is None else equirect_grid(*how.sphere)
    lobe = default_lobe(grid)
    if how.sphere is None:
        return lambda paths, seed: spectrum_of(at_yaws(paths, YAWS), None, grid, lobe=lobe), lobe
    return lambda paths, seed: spectrum_of(paths, None, grid, lobe=lobe), lobe


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


def main(words: Sequence[str] | None = None) -> int:
    """Make the figure; returns 0."""

    def extra(parser) -> None:
        parser.add_argument("--truth", type=Path, help="paths of the finer truth; traced unless given")
        parser.add_argument("--judged", type=int, help="held-out positions; the scale's number unless given")
        parser.add_argument("--view", type=int, default=0, help="which of them is drawn")

    options = options_of("fig6", extra, words, __doc__)
    out: Path = options.out
    out.mkdir(parents=True, exist_ok=True)
    started, how = time.process_time(), SCALES[options.scale]
    fine, grid = math.radians(how.lobe_deg), pinhole_grid(*how.shown, FOV_DEG)
    pictures_of, lobe = training_pictures(how)
    rise = Instrument.gaussian(lobe).beam_solid_angle / Instrument.gaussian(fine).beam_solid_angle
    geometry = geometry_at(options.geometry, out, options.scale)
    with PathsReader(paths_at(options.paths, out, how.size)) as reader:
        training, judged = positions_of(reader, options.training or how.size.training, options.seed)
        judged = judged[: options.judged or how.judged]
        settings = {"sphere": how.sphere and list(how.sphere), "lobe": lobe}
        folder = out / f"spectra-{options.scale}-{options.seed}-{len(training)}"
        spectra = training_spectra(Some(reader, training), pictures_of, folder, settings)
        yaws = [YAWS[place % len(YAWS)] for place in range(len(judged))]
        coarse = stack_spectra(
            [turned(reader[number], yaw, grid, lobe) for number, yaw in zip(judged, yaws, strict=True)]
        )

        def finer(again: bool) -> Tensor:
            """Powers `[n, row, col]` of the finer truth, in levels of the training lobe; kept one by one."""
            rows = []
            for number, yaw in zip(judged, yaws, strict=True):
                identity = {
                    "paths": str(options.truth or "traced"),
                    "at": reader.rx.position[number].tolist(),
                    "yaw": yaw,
                    "lobe": fine,
                    "grid": list(how.shown),
                    "rays": FINER * how.size.rays,
                }
                rows.append(
                    kept(
                        out / "kept",
                        "finer truth again" if again else "finer truth",
                        identity,
                        lambda number=number, yaw=yaw: (
                            turned(finer_paths(options.truth, reader, number, again, how.size), yaw, grid, fine).power
                        ),
                    )
                )
            return torch.cat(rows) * rise

        solves = finer(again=False), finer(again=True)
    truth = (solves[0] + solves[1]) / 2
    task = Task(spectra, window_for(spectra), options.seed, options.scale, geometry)
    answers = {COARSE: coarse.power}
    for method in COLUMNS:
        trained = cache(lambda method=method: method.made(task))
        answers[method.name] = answered(method, task, coarse.pose, grid, out, trained)
        if method is OURS:
            identity = identity_of(task, coarse.pose, grid) | {"settings": dict(OURS.settings(task)), "lobe": fine}

            def sharper(trained=trained) -> Tensor:
                return rendered(Sharper(trained(), fine), coarse.pose, grid)

            answers[SHARP] = kept(out / "kept", SHARP, identity, sharper)
    window = window_for(replace(coarse, power=truth))
    found = {name: scores(solves, power, grid, window, lobe) for name, power in answers.items()}
    against = {
        name: {score: verdict(score, values[score], found[COARSE][score]) for score in SCORES if score != "sharpness"}
        for name, values in found.items()
        if name != COARSE
    }
    view = options.view % len(judged)
    shown = {name: power[view] for name, power in answers.items()}
    colours = colour_range([replace(coarse[view], power=truth[view])])
    picture = draw((solves[0][view], solves[1][view]), shown, colours, blur_of(grid, lobe))
    write_whole(out / "fig6.png", picture)
    facts = {
        "scale": options.scale,
        "seed": options.seed,
        "training": training,
        "judged": judged,
        "lobe_deg": {"training": math.degrees(lobe), "truth": how.lobe_deg},
        "window": [window.floor_db, window.ceil_db],
        "finer truth": truth_of(solves, grid, window, lobe),
        "scores": {
            name: {score: values.tolist() for score, values in column.items()} for name, column in found.items()
        },
        "against training quality": against,
    }
    write_whole(out / "fig6.json", (json.dumps(facts, indent=1) + "\n").encode())
    true = truth_of(solves, grid, window, lobe)
    said = (
        f"The finer truth has {true['detail']:.2f} dB of detail (RMS), a sharpness of {true['sharpness']:.2f} dB/pixel "
        f"and {true['noise']:.2f} dB of noise, which is taken off, but not from SSIM."
    )
    text = f"{_table(found, against)}\n\n{said}"
    write_whole(out / "fig6.md", (text + "\n").encode())
    print(text)
    print(f"{len(training)} training positions, {len(judged)} judged; {time.process_time() - started:.0f} s of CPU")
    return 0


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
    return table_text(("against the finer truth", *(label for label, _ in SCORES.values())), rows)


if __name__ == "__main__":
    main()
