"""What figures 1 and 6 are made of: paths of the lobby, who trains and who judges, Gaussians, answers that are kept.

Whatever is slow is written into the folder of the figure as soon as it is made, under a name that holds a digest of all
that decides it; a second run finds it. The version of the code is not part of the digest: after a change remove the
folder `kept`.
"""

import argparse
import hashlib
import io
import json
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from benchmarks.quality.methods.method import SCALES, Method, Scale, Task
from rf3dgs.channel.io import PathsReader
from rf3dgs.channel.paths import Paths
from rf3dgs.core.errors import InputError
from rf3dgs.core.files import write_whole
from rf3dgs.core.frames import Pose
from rf3dgs.core.grids import DirectionGrid
from rf3dgs.core.progress import Console
from rf3dgs.data.split import split_positions
from rf3dgs.data.stream import stream_spectra
from rf3dgs.evaluation.protocol import Predictor, refuse_leak
from rf3dgs.propagation.config import ReceiverConfig, TraceConfig
from rf3dgs.propagation.sites.lobby import lobby
from rf3dgs.propagation.sites.presets import preset_of
from rf3dgs.propagation.sites.scene import Scene, without_looks
from rf3dgs.spectra.codec import DbWindow, window_of
from rf3dgs.spectra.spectrum import Spectrum
from rf3dgs.splats.gaussians import Gaussians
from rf3dgs.splats.ply import read_ply, write_ply
from rf3dgs.splats.surface import sample_mesh
from rf3dgs.training.checkpoint import fingerprint
from rf3dgs.training.config import VisualConfig

PRESET = "diffuse"  # the paper's surfaces, for any number of receivers
RANGE_DB = 80.0  # between the ends of the window that is trained and judged in
FOV_DEG = 90.0
YAWS = tuple(math.radians(yaw) for yaw in (0.0, 90.0, 180.0, 270.0))
SAME_PLACE = 1e-3  # m
VISUAL = {
    "laptop": VisualConfig(steps=3000, max_count=50_000, ssim_weight=0.05, degree=1),
    "paper": VisualConfig(max_count=200_000),
}
MESH = 6_000
"""Gaussians on the lobby's surfaces at the scale "smoke", which has no time for photographs."""


@dataclass(frozen=True)
class Size:
    """What a scale costs."""

    receivers: int
    """How many are traced where no paths are given."""
    rays: int
    """Rays of a receiver."""
    training: int
    """Positions that are trained on; fewer where there are fewer."""


def scene() -> Scene:
    """The lobby with the paper's surfaces."""
    return preset_of(PRESET).applied(lobby())[0]


def options_of(
    name: str, extra: Callable[[argparse.ArgumentParser], None], words: Sequence[str] | None, text: str | None
):
    """The command line that both figures share, and what `extra` adds to it."""
    parser = argparse.ArgumentParser(
        prog=f"python -m benchmarks.quality.{name}",
        description=text,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--scale", choices=SCALES, default="laptop", help="how much it may cost")
    parser.add_argument("--out", type=Path, required=True, help=f"the folder of {name}.png, .json and what is kept")
    parser.add_argument("--paths", type=Path, help="what rf3dgs trace wrote; traced into OUT/paths unless given")
    parser.add_argument("--geometry", type=Path, help="a .ply file of Gaussians; made unless given")
    parser.add_argument("--training", type=int, help="positions to train on; the scale's number unless given")
    parser.add_argument("--seed", type=int, default=0, help="of the split, the training positions and the fits")
    extra(parser)
    return parser.parse_args(words)


def paths_at(given: Path | None, out: Path, size: Size) -> Path:
    """The folder of paths: the given one, or one traced into `out`; a killed run goes on."""
    if given is not None:
        return given
    from rf3dgs.propagation.jobs.job import run_job
    from rf3dgs.propagation.jobs.trace_job import TraceJob
    from rf3dgs.propagation.sites.receivers import receivers_of

    site, config = preset_of(PRESET).applied(lobby(), TraceConfig(rays=size.rays))
    job = TraceJob(
        scene=without_looks(site),
        tx=site.tx,
        rx=receivers_of(site, ReceiverConfig(count=size.receivers)),
        frequency=site.frequency,
        config=config,
        rule={"site": "lobby"},
    )
    run_job(job, out / "paths", progress=Console())
    return out / "paths"


def positions_of(reader: PathsReader, training: int, seed: int) -> tuple[list[int], list[int]]:
    """Numbers of the receivers that are trained on, and of those that judge: `Dataset.split`'s validation positions.

    The sealed test and region of that split are not looked at.
    """
    roles = np.array(split_positions(reader.rx.position, seed=seed))
    pool, judged = np.flatnonzero(roles == "train"), np.flatnonzero(roles == "validation")
    if not len(judged):
        raise InputError(f"{len(roles)} receivers leave none for validation; trace at least 10")
    chosen = np.random.default_rng((seed, 1)).permutation(pool)[:training]
    refuse_leak(reader.rx.position[chosen], reader.rx.position[judged])
    return sorted(int(number) for number in chosen), [int(number) for number in judged]


class Some:
    """The receivers `numbers` of many paths."""

    def __init__(self, paths: PathsReader, numbers: Sequence[int]) -> None:
        self.paths, self.numbers = paths, numbers

    def __len__(self) -> int:
        return len(self.numbers)

    def __getitem__(self, index: int, /) -> Paths:
        return self.paths[self.numbers[index]]


def training_spectra(
    paths: Some, pictures_of: Callable[[Paths, int], Spectrum], folder: Path, settings: Mapping[str, Any]
) -> Spectrum:
    """The pictures that `pictures_of(paths, seed)` makes of each receiver, stored in `folder` and found there again."""
    meta = {"generator": "benchmarks.quality", "seed": 0}
    return stream_spectra(
        paths,
        lambda number, one: pictures_of(one, 4 * paths.numbers[number]),
        folder,
        settings=settings,
        meta=meta,
        progress=Console(),
    )


def window_for(spectra: Spectrum) -> DbWindow:
    """The window of spectra, its floor at most 80 dB below its ceiling."""
    found = window_of(spectra)
    return DbWindow(max(found.floor_db, found.ceil_db - RANGE_DB), found.ceil_db)


def geometry_at(given: Path | None, out: Path, scale: Scale) -> Gaussians:
    """The given Gaussians; else the visual stage's on the shipped photographs, at "smoke" those of the lobby's mesh."""
    path = out / f"geometry-{scale}.ply" if given is None else given
    if given is None and not path.exists():
        if scale == "smoke":
            vertices, faces, colours = lobby().mesh(None)
            made = sample_mesh(vertices, faces, count=MESH, colours=colours)
        else:
            from rf3dgs.cli.facts import open_dataset
            from rf3dgs.training.visual import fit_geometry

            made = fit_geometry(open_dataset("lobby").train.photos, VISUAL[scale], progress=Console())
        write_ply(path, made)
    return read_ply(path)


def kept(folder: Path, name: str, identity: Mapping[str, Any], make: Callable[[], Tensor]) -> Tensor:
    """The array that `make` makes, float32, from `folder` where it was made before from the same `identity` (JSON)."""
    digest = hashlib.sha256(json.dumps(identity, sort_keys=True).encode()).hexdigest()[:16]
    path = folder / f"{name.replace(' ', '-')}-{digest}.npy"
    if not path.exists():
        content = io.BytesIO()
        np.save(content, make().float().numpy(), allow_pickle=False)
        folder.mkdir(parents=True, exist_ok=True)
        write_whole(path, content.getvalue())
    return torch.from_numpy(np.load(path, allow_pickle=False))


def identity_of(task: Task, poses: Pose, grid: DirectionGrid) -> dict[str, Any]:
    """What decides how any method answers at `poses` on `grid` after it has learned from `task`."""
    given = () if task.geometry is None else task.geometry.tensors().values()
    spectra = task.spectra
    learned = (spectra.power, spectra.pose.position, spectra.pose.orientation, spectra.grid.directions)
    return {
        "task": fingerprint([*learned, *given]),
        "instrument": spectra.instrument.name,
        "window": [task.window.floor_db, task.window.ceil_db],
        "seed": task.seed,
        "scale": task.scale,
        "asked": fingerprint([poses.position, poses.orientation, grid.directions]),
    }


def answered(
    method: Method, task: Task, poses: Pose, grid: DirectionGrid, folder: Path, trained: Callable[[], Predictor]
) -> Tensor:
    """Power `[n, row, col]` that a method predicts at `poses` `[n]`; `trained` is asked only where it is not kept."""
    identity = identity_of(task, poses, grid) | {"method": method.name, "settings": dict(method.settings(task))}
    return kept(folder / "kept", method.name, identity, lambda: rendered(trained(), poses, grid))


def rendered(predictor: Predictor, poses: Pose, grid: DirectionGrid) -> Tensor:
    """Power `[n, row, col]` that a predictor answers with at `poses` `[n]`."""
    with torch.no_grad():
        return torch.stack([predictor.render(poses[index], grid).power for index in range(len(poses))])


def like(truth: Spectrum, power: Tensor) -> Spectrum:
    """A prediction of `truth` that has power alone."""
    return replace(truth, power=power, delay=None, aod=None, floor=None, noise=None)


def table_text(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """A Markdown table."""
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def small_png(figure) -> bytes:
    """A matplotlib figure as PNG bytes, packed as small as they go."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from PIL import Image

    FigureCanvasAgg(figure)
    whole, small = io.BytesIO(), io.BytesIO()
    figure.savefig(whole, format="png")
    picture = Image.open(io.BytesIO(whole.getvalue())).convert("RGB")
    picture.save(small, "PNG", optimize=True)
    return small.getvalue()


def show(axis, picture: np.ndarray, title: str) -> None:
    """A uint8 `[row, col, 3]` picture without axes."""
    axis.imshow(picture, interpolation="nearest")
    axis.set_title(title)
    axis.set_xticks([])
    axis.set_yticks([])
    axis.grid(False)
