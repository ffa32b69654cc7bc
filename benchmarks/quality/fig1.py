"""The paper's Fig. 1: one held-out view as photograph, as true spectrum, and as each method reconstructs it.

    python -m benchmarks.quality.fig1 --scale smoke|laptop|paper --out out/fig1

Two groups of spectra, each learned by each method on its own: (b) ideal ones, (c) MVDR pictures of an 8x8 patch array.
Writes fig1.png, fig1.md (the numbers) and fig1.json (the numbers and all that they were made from). A second run reuses
what the first one made. docs/how-to/figures.md has the rest.
"""

import json
import math
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from benchmarks.quality.methods.method import Method, Task
from benchmarks.quality.panel_data import (
    FOV_DEG,
    YAWS,
    Size,
    Some,
    answered,
    geometry_at,
    like,
    options_of,
    paths_at,
    positions_of,
    scene,
    show,
    small_png,
    table_text,
    training_spectra,
    window_for,
)
from rf3dgs.channel.arrays import PlanarArray, planar_array
from rf3dgs.channel.io import PathsReader
from rf3dgs.channel.paths import Paths
from rf3dgs.core.errors import MissingDependencyError
from rf3dgs.core.files import write_whole
from rf3dgs.core.frames import Pose
from rf3dgs.core.grids import Camera, DirectionGrid, pinhole_grid
from rf3dgs.core.units import db_from_power
from rf3dgs.evaluation import metrics
from rf3dgs.evaluation.baselines.lookup import NearestNeighbour
from rf3dgs.evaluation.figures import STYLE
from rf3dgs.evaluation.pictures import colour_range, photo_picture, spectrum_picture
from rf3dgs.evaluation.protocol import Predictor
from rf3dgs.field.radio_field import RadioField
from rf3dgs.field.waves import seen_by_array
from rf3dgs.propagation.config import PhotoConfig
from rf3dgs.spectra.codec import DbWindow
from rf3dgs.spectra.scan import spectrum_of
from rf3dgs.spectra.spectrum import Spectrum, stack_spectra
from rf3dgs.spectra.synthesis import default_lobe
from rf3dgs.spectra.yaws import at_yaws
from rf3dgs.splats.gaussians import Gaussians
from rf3dgs.training.config import RadioConfig
from rf3dgs.training.photographs import render_photo
from rf3dgs.training.radio import fit_radio

SIZES = {
    "smoke": (Size(16, 20_000, 6), (36, 24), (72, 48)),
    "laptop": (Size(120, 300_000, 40), (75, 50), (300, 200)),
    "paper": (Size(800, 300_000, 640), (300, 200), (300, 200)),
}
"""What is traced and learned, the pixels of a training picture, and those of a panel."""
PAPER_STEPS = {"smoke": 20, "laptop": 1000, "paper": 10_000}
GROUPS = {"ideal": "(b) ideal", "capon": "(c) MVDR, 8x8 patch"}


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
COLUMNS: tuple[Method, ...] = (OURS, PAPER, NEAREST)
"""The columns after the truth; any `Method` may be put here."""


@dataclass(frozen=True)
class Group:
    """One row of the figure: the truth `[1, row, col]`, what each column answers, and the window of the scores."""

    title: str
    truth: Spectrum
    answers: dict[str, Spectrum]
    window: DbWindow


def pictures_of(group: str, size: tuple[int, int], lobe: float) -> Callable[[Paths, int], Spectrum]:
    """What makes the pictures `[yaw, row, col]` of one receiver that turns to every one of `YAWS`."""
    grid, array = pinhole_grid(*size, FOV_DEG), planar_array(8, 8, "patch")

    def pictures(paths: Paths, seed: int) -> Spectrum:
        turned = at_yaws(paths, YAWS)
        if group == "ideal":
            return spectrum_of(turned, None, grid, lobe=lobe)
        return spectrum_of(turned, array, grid, method="capon", seed=seed)

    return pictures


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


def photograph(kind: str, pose: Pose, grid: DirectionGrid, geometry: Gaussians) -> tuple[np.ndarray, str]:
    """The twin's photograph uint8 `[row, col, 3]` at a pinhole, and what it is; without Mitsuba, the Gaussians'."""
    camera = Camera.of(pose, grid)
    if kind != "gaussians":
        try:
            from rf3dgs.propagation.photographer import render_photos

            return next(render_photos(scene(), [camera], PhotoConfig())), "(a) digital twin"
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


def main(words: Sequence[str] | None = None) -> int:
    """Make the figure; returns 0."""

    def extra(parser) -> None:
        parser.add_argument("--view", type=int, default=0, help="which of the validation positions is shown")
        parser.add_argument("--photo", choices=("auto", "twin", "gaussians"), default="auto", help="what (a) is")

    options = options_of("fig1", extra, words, __doc__)
    out: Path = options.out
    out.mkdir(parents=True, exist_ok=True)
    started = time.process_time()
    size, small, shown = SIZES[options.scale]
    lobe, grid = default_lobe(pinhole_grid(*small, FOV_DEG)), pinhole_grid(*shown, FOV_DEG)
    geometry = geometry_at(options.geometry, out, options.scale)
    with PathsReader(paths_at(options.paths, out, size)) as reader:
        training, judged = positions_of(reader, options.training or size.training, options.seed)
        number = judged[options.view % len(judged)]
        views = {group: pictures_of(group, shown, lobe)(reader[number], 4 * number) for group in GROUPS}
        yaw = int(views["ideal"].power.amax((-2, -1)).argmax())
        pose = views["ideal"].pose[yaw]
        groups = []
        for group, title in GROUPS.items():
            settings = {"group": group, "size": list(small), "lobe": lobe}
            folder = out / f"{group}-{options.scale}-{options.seed}-{len(training)}"
            spectra = training_spectra(Some(reader, training), pictures_of(group, small, lobe), folder, settings)
            task = Task(spectra, window_for(spectra), options.seed, options.scale, geometry)
            truth = stack_spectra([views[group][yaw]])
            answers = {
                method.name: like(
                    truth,
                    answered(method, task, truth.pose, grid, out, lambda method=method, task=task: method.made(task)),
                )
                for method in COLUMNS
            }
            groups.append(Group(title, truth, answers, task.window))
    write_whole(out / "fig1.png", draw(photograph(options.photo, pose, grid, geometry), groups))
    found = {
        group.title: {name: scores(group.truth, answer, group.window) for name, answer in group.answers.items()}
        for group in groups
    }
    facts = {
        "scale": options.scale,
        "seed": options.seed,
        "training": training,
        "view": number,
        "yaw_deg": math.degrees(YAWS[yaw]),
        "position": pose.position.tolist(),
        "lobe_deg": math.degrees(lobe),
        "windows": {group.title: [group.window.floor_db, group.window.ceil_db] for group in groups},
        "true peak [dB]": {group.title: float(db_from_power(group.truth.power.amax())) for group in groups},
        "scores": found,
    }
    write_whole(out / "fig1.json", (json.dumps(facts, indent=1) + "\n").encode())
    rows = [
        [title, name, f"{s['psnr_db']:.2f}", f"{s['ssim']:.3f}", f"{s['rmse_db']:.2f}", f"{s['peak_deg']:.2f}"]
        for title, column in found.items()
        for name, s in column.items()
    ]
    text = table_text(("group", "column", "PSNR [dB]", "SSIM", "RMSE [dB]", "main peak [deg]"), rows)
    write_whole(out / "fig1.md", (text + "\n").encode())
    print(text)
    place = ", ".join(f"{value:.2f}" for value in pose.position.tolist())
    print(f"{len(training)} training positions; receiver {number} at ({place}), yaw {math.degrees(YAWS[yaw]):.0f} deg")
    print(f"{out / 'fig1.png'}; {time.process_time() - started:.0f} s of CPU")
    return 0


if __name__ == "__main__":
    main()
