"""What figures 1 and 6 need beside a study: paths of single receivers, and answers on other grids, which are kept.

Answers are written into a folder as soon as they are made, under a name that holds a digest of all that decides them; a
second run finds them. The version of the code is not part of the digest: after a change remove the folder `kept`.
"""

import hashlib
import io
import json
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from benchmarks.quality.methods.method import Method, Task
from benchmarks.quality.protocol.study import Study
from rf3dgs.channel.io import PathsReader
from rf3dgs.channel.paths import Paths
from rf3dgs.core.files import write_whole
from rf3dgs.core.frames import Pose
from rf3dgs.core.grids import DirectionGrid
from rf3dgs.evaluation.protocol import Predictor, refuse_leak
from rf3dgs.spectra.scan import spectrum_of
from rf3dgs.spectra.spectrum import Spectrum
from rf3dgs.spectra.yaws import at_yaws
from rf3dgs.training.checkpoint import fingerprint


def held_out(study: Study, most: int | None = None) -> tuple[list[int], list[Paths], Spectrum]:
    """Of the first `most` held-out receivers, drawn at random: numbers, paths, and pictures `[n x views, row, col]`.

    The reading of sealed ones is logged.
    """
    config, data = study.config, study.data
    spectra = data.judged(config.judge, "random", config.reason(), most)
    numbers = [int(number) for number in data.split.part(config.judge, "random")[:most]]
    with PathsReader(study.traced) as reader:
        return numbers, [reader[number] for number in numbers], spectra


def turned(paths: Paths, yaw: float, grid: DirectionGrid, lobe: float) -> Spectrum:
    """The ideal spectrum `[1, row, col]` of a receiver that turned by `yaw` [rad]."""
    return spectrum_of(at_yaws(paths, [yaw]), None, grid, lobe=lobe)


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
    """Power `[n, row, col]` that a method predicts at `poses` `[n]`; `trained` is asked only where it is not kept.

    Raises where a pose stands at a training position.
    """
    refuse_leak(task.spectra.pose.position, poses.position)
    identity = identity_of(task, poses, grid) | {"method": method.name, "settings": dict(method.settings(task))}
    return kept(folder / "kept", method.name, identity, lambda: rendered(trained(), poses, grid))


def rendered(predictor: Predictor, poses: Pose, grid: DirectionGrid) -> Tensor:
    """Power `[n, row, col]` that a predictor answers with at `poses` `[n]`."""
    with torch.no_grad():
        return torch.stack([predictor.render(poses[index], grid).power for index in range(len(poses))])


def like(truth: Spectrum, power: Tensor) -> Spectrum:
    """A prediction of `truth` that has power alone."""
    return replace(truth, power=power, delay=None, aod=None, floor=None, noise=None)


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
