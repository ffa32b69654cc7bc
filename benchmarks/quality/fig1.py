"""The paper's Fig. 1: one held-out view as photograph, as true spectrum, and as each method reconstructs it.

    python -m benchmarks.quality.fig1 --scale laptop --paths paper.paths

Two groups of spectra, each learned by each method on its own: (b) ideal ones, (c) MVDR pictures of an 8x8 patch array.
Writes fig1-SCALE.png, .md (the numbers) and .json (the numbers and all that they were made from). A second run reuses
what the first one made. docs/how-to/figures.md has the rest.
"""

import argparse
import math
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from benchmarks.quality.methods import known
from benchmarks.quality.methods.method import Method, Scale, Task
from benchmarks.quality.panel_data import answered, held_out, like, show, small_png, turned
from benchmarks.quality.protocol.figure import made_by, page_or_sentence, parser_of, rows_of, study_of, write_json
from benchmarks.quality.protocol.pictures import YAWS_DEG
from benchmarks.quality.protocol.study import Study, say
from rf3dgs.channel.arrays import PlanarArray
from rf3dgs.channel.paths import Paths
from rf3dgs.core.errors import MissingDependencyError, RfError
from rf3dgs.core.files import write_whole
from rf3dgs.core.frames import Pose
from rf3dgs.core.grids import Camera, DirectionGrid
from rf3dgs.core.units import db_from_power
from rf3dgs.evaluation import metrics
from rf3dgs.evaluation.baselines.lookup import NearestNeighbour
from rf3dgs.evaluation.figures import STYLE
from rf3dgs.evaluation.pictures import colour_range, photo_picture, spectrum_picture
from rf3dgs.evaluation.protocol import Predictor
from rf3dgs.field.radio_field import RadioField
from rf3dgs.field.waves import seen_by_array
from rf3dgs.propagation.config import PhotoConfig
from rf3dgs.propagation.sites.scene import Scene
from rf3dgs.spectra.codec import DbWindow
from rf3dgs.spectra.config import Method as SpectrumMethod
from rf3dgs.spectra.spectrum import Spectrum
from rf3dgs.spectra.synthesis import default_lobe
from rf3dgs.splats.gaussians import Gaussians
from rf3dgs.training.config import RadioConfig
from rf3dgs.training.photographs import render_photo
from rf3dgs.training.radio import fit_radio

TRAINING: Mapping[Scale, int] = {"smoke": 6, "laptop": 40, "paper": 160}
"""Training positions."""
SHOWN: Mapping[Scale, tuple[int, int]] = {"smoke": (72, 48), "laptop": (300, 200), "paper": (300, 200)}
"""Columns and rows of a panel."""
PAPER_STEPS = {"smoke": 20, "laptop": 1000, "paper": 10_000}
GROUPS: Mapping[SpectrumMethod, str] = {"ideal": "(b) ideal", "capon": "(c) MVDR, 8x8 patch"}


@dataclass(frozen=True)
class AsSeen:
    """A field of narrow lobes as the array that it was learned from sees it."""

    field: RadioField
    array: PlanarArray
    method: str

    def render(self, pose: Pose, grid: DirectionGrid) -> Spectrum:
        return seen_by_array(self.field, pose, self.array, grid, method=self.method)


def our_settings(task: Task) -> RadioConfig:
    """The mirror model, with the floor that everything is judged with."""
    return RadioConfig(seed=task.seed, floor_db=task.window.floor_db if task.spectra.instrument.array is None else None)


def our_field(task: Task) -> Predictor:
    """The mirror model; of pictures of an array it answers with such pictures."""
    assert task.geometry is not None
    field = _fitted(task, our_settings(task))
    array = task.spectra.instrument.array
    return field if array is None else AsSeen(field, array, task.spectra.method)


def paper_settings(task: Task) -> RadioConfig:
    """The published recipe with the steps of the scale."""
    return RadioConfig.preset("paper", steps=PAPER_STEPS[task.scale], seed=task.seed)


def _fitted(task: Task, config: RadioConfig) -> RadioField:
    assert task.geometry is not None
    return fit_radio(task.geometry, task.spectra, config)


OURS = Method("our field", our_field, ("geometry",), lambda task: asdict(our_settings(task)))
PAPER = Method(
    "paper's model",
    lambda task: _fitted(task, paper_settings(task)),
    ("geometry",),
    lambda task: asdict(paper_settings(task)),
)
NEAREST = Method("nearest neighbour", lambda task: NearestNeighbour(task.spectra))
SPLATS_AND_COPY = (OURS, PAPER, NEAREST)
NERF2 = replace(known()["nerf2-db"], name="NeRF2, dB target")
COLUMNS: tuple[Method, ...] = (*SPLATS_AND_COPY, NERF2)
"""The columns after the truth; any `Method` may be put here."""


@dataclass(frozen=True)
class Group:
    """One row of the figure: the truth `[1, row, col]`, what each column answers, and the window of the scores."""

    title: str
    truth: Spectrum
    answers: dict[str, Spectrum]
    window: DbWindow


def truth_of(study: Study, number: int, paths: Paths, yaw: int, shown: tuple[int, int]) -> Spectrum:
    """What receiver `number` sees `[1, row, col]` in one of its views, as the study's pictures but in more pixels."""
    seen = study.config.pictures
    finer = replace(seen, size=shown, yaws_deg=seen.yaws_deg[yaw : yaw + 1])
    if seen.method == "ideal":
        return turned(paths, math.radians(finer.yaws_deg[0]), finer.grid, default_lobe(seen.grid))
    return finer.of(number, paths)


def scores(truth: Spectrum, answer: Spectrum, window: DbWindow) -> dict[str, float]:
    """PSNR [dB], SSIM, RMSE [dB] in the window and main-peak error [deg] of one view `[1, row, col]`."""
    weight = metrics.pixel_weight(truth.grid)
    pictures = window.encode(truth.power), window.encode(answer.power)
    return {
        "psnr_db": float(metrics.psnr(*pictures, weight)),
        "ssim": float(metrics.ssim(*pictures, truth.grid)),
        "rmse_db": float(metrics.rmse_db(truth.power, answer.power, window, weight)),
        "peak_deg": math.degrees(float(metrics.peak_error(truth, answer))),
    }


def photograph(kind: str, site: Scene, pose: Pose, grid: DirectionGrid, geometry: Gaussians) -> tuple[np.ndarray, str]:
    """The twin's photograph uint8 `[row, col, 3]` at a pinhole, and what it is; without Mitsuba, the Gaussians'."""
    camera = Camera.of(pose, grid)
    if kind != "gaussians":
        try:
            from rf3dgs.propagation.photographer import render_photos

            return next(render_photos(site, [camera], PhotoConfig())), "(a) digital twin"
        except MissingDependencyError:
            if kind == "twin":
                raise
    if geometry.channels != 3:
        return np.full((*grid.shape, 3), 200, dtype=np.uint8), "(a) no photograph"
    return photo_picture(render_photo(geometry, camera)), "(a) Gaussians of photographs"


def peak_pixel(spectrum: Spectrum) -> tuple[float, float] | None:
    """Where the main peak of one view `[1, row, col]` lies in an image of it (x, y); None where there is no power."""
    if not bool(spectrum.power.amax() > 0):
        return None
    pixel, _ = spectrum.grid.pixel_of(spectrum.pose.to_device(metrics.peak_direction(spectrum)))
    x, y = (pixel[0] - 0.5).tolist()
    return x, y


def draw(photo: tuple[np.ndarray, str], groups: Sequence[Group]) -> bytes:
    """The figure as PNG bytes: a white cross at the true main peak, a red ring at the answer's, an arrow between."""
    import matplotlib as mpl
    from matplotlib.figure import Figure

    count = 2 + len(groups[0].answers)
    with mpl.rc_context({**STYLE, "font.size": 8, "axes.titlesize": 8}):
        figure = Figure(figsize=(2.55 * count, 2.25 * len(groups)), dpi=100, layout="constrained")
        axes = figure.subplots(len(groups), count, squeeze=False)
        show(axes[0, 0], *photo)
        for axis in axes[1:, 0]:
            axis.axis("off")
        for row, group in zip(axes, groups, strict=True):
            colours = colour_range([group.truth])
            span = f"{colours.floor_db:.0f} to {colours.ceil_db:.0f} dB"
            true = peak_pixel(group.truth)
            show(row[1], spectrum_picture(group.truth[0], colours), f"{group.title}: truth, {span}")
            _mark(row[1], true, None)
            for axis, (name, answer) in zip(row[2:], group.answers.items(), strict=True):
                show(axis, spectrum_picture(answer[0], colours), name)
                _mark(axis, true, peak_pixel(answer))
                found = scores(group.truth, answer, group.window)
                axis.set_xlabel(
                    f"PSNR {found['psnr_db']:.1f} dB, RMSE {found['rmse_db']:.1f} dB, peak {found['peak_deg']:.1f} deg"
                )
        return small_png(figure)


def _mark(axis, true: tuple[float, float] | None, found: tuple[float, float] | None) -> None:
    if true is not None:
        axis.plot(*true, "+", color="white", markersize=9, markeredgewidth=1.4)
    if found is not None:
        axis.plot(*found, "o", color="#e53935", markersize=9, markerfacecolor="none", markeredgewidth=1.3)
    if true is not None and found is not None and math.dist(true, found) > 4.0:
        axis.annotate("", found, true, arrowprops={"arrowstyle": "->", "color": "#e53935", "linewidth": 1.0})


def made(wish: argparse.Namespace) -> tuple[bytes, dict[str, Any]]:
    """The figure as PNG bytes, and its numbers."""
    studies = {group: study_of(wish, "fig1", method=group, holdouts=("random",)) for group in GROUPS}
    ideal, count = studies["ideal"], wish.training or TRAINING[wish.scale]
    numbers, paths, spectra = held_out(ideal, ideal.config.judged)
    place = wish.view % len(numbers)
    yaw = int(spectra.power[place * ideal.data.views :][: ideal.data.views].amax((-2, -1)).argmax())
    groups = []
    for group, study in studies.items():
        task = study.task(count, wish.seed)
        truth = truth_of(study, numbers[place], paths[place], yaw, SHOWN[wish.scale])
        answers = {}
        for method in COLUMNS:
            say(f"{group}: {method.name}")
            power = answered(method, task, truth.pose, truth.grid, study.config.out, lambda m=method, t=task: m.made(t))
            answers[method.name] = like(truth, power)
        groups.append(Group(GROUPS[group], truth, answers, task.window))
    first = groups[0].truth
    photo = photograph(wish.photo, ideal.scene, first.pose[0], first.grid, ideal.geometry(wish.seed))
    return draw(photo, groups), {
        "scale": wish.scale,
        "seed": wish.seed,
        "training": ideal.data.split.training(count, wish.seed).tolist(),
        "view": numbers[place],
        "yaw_deg": YAWS_DEG[yaw],
        "position": first.pose.position[0].tolist(),
        "lobe_deg": math.degrees(default_lobe(ideal.config.pictures.grid)),
        "windows": {group.title: [group.window.floor_db, group.window.ceil_db] for group in groups},
        "true peak [dB]": {group.title: float(db_from_power(group.truth.power.amax())) for group in groups},
        "scores": {
            group.title: {name: scores(group.truth, answer, group.window) for name, answer in group.answers.items()}
            for group in groups
        },
    }


def main(words: Sequence[str] | None = None) -> int:
    """Make the figure; the exit status."""
    parser = parser_of(__doc__, "fig1")
    parser.add_argument("--training", type=int, help="training positions; the scale's number when missing")
    parser.add_argument("--view", type=int, default=0, help="which of the held-out positions is shown")
    parser.add_argument("--photo", choices=("auto", "twin", "gaussians"), default="auto", help="what (a) is")
    parser.add_argument("--seed", type=int, default=0, help="of the training positions and the fits")
    wish, started = parser.parse_args(words), time.process_time()
    try:
        picture, facts = made(wish)
    except RfError as error:
        say(f"fig1: {error}")
        return 2
    rows = [
        [title, name, f"{s['psnr_db']:.2f}", f"{s['ssim']:.3f}", f"{s['rmse_db']:.2f}", f"{s['peak_deg']:.2f}"]
        for title, column in facts["scores"].items()
        for name, s in column.items()
    ]
    place = ", ".join(f"{value:.2f}" for value in facts["position"])
    parts = [
        rows_of(("group", "column", "PSNR [dB]", "SSIM", "RMSE [dB]", "main peak [deg]"), rows),
        f"{len(facts['training'])} training positions; receiver {facts['view']} at ({place}), yaw "
        f"{facts['yaw_deg']:.0f} degrees; {time.process_time() - started:.0f} s of CPU time.",
        made_by("fig1", [wish.seed], words),
    ]
    text, name = "\n\n".join(parts), f"fig1-{wish.scale}"
    write_whole((wish.pictures or wish.out) / f"{name}.png", picture)
    write_json(wish.out / f"{name}.json", facts)
    write_whole(wish.out / f"{name}.md", (text + "\n").encode())
    print(text)
    return page_or_sentence(wish.page, "fig1", text)


if __name__ == "__main__":
    sys.exit(main())
