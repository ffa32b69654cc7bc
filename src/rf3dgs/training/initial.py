"""Where the visual stage begins: the box the scene may fill, and Gaussians in it, swept or random."""

import dataclasses
import math
from collections.abc import Sequence

import torch
from torch import Tensor

from rf3dgs.core.grids import Camera
from rf3dgs.splats.gaussians import Gaussians
from rf3dgs.training.loop import random_at
from rf3dgs.training.sweep import Surfaces, swept_surfaces

BOX_MARGIN = 0.25
SMALLEST_EXTENT = 0.1
SWEPT_OPACITY = 0.7
SWEPT_SCALE = 0.8
SWEPT_LARGEST = 0.02
FLATNESS = 0.2
LEAST_SWEPT = 100


def camera_box(cameras: Sequence[Camera]) -> tuple[list[float], list[float]]:
    """Lowest and highest corner [m] of the cameras' box, widened on all sides by a quarter of its diagonal.

    For photographs taken from within a room this reaches beyond the walls; a single camera gets 4 m each way.
    """
    centres = torch.stack([camera.position for camera in cameras])
    low, high = centres.amin(0), centres.amax(0)
    diagonal = float(torch.linalg.vector_norm(high - low))
    margin = BOX_MARGIN * diagonal if diagonal > SMALLEST_EXTENT else 4.0
    return (low - margin).tolist(), (high + margin).tolist()


def views_of(points: Tensor, cameras: Sequence[Camera]) -> Tensor:
    """How many cameras have each point `[point, 3]` in their picture `[point]`; nothing hides anything."""
    counts = torch.zeros(len(points), dtype=torch.int64)
    for camera in cameras:
        x, y, z = (points @ camera.viewmat[:3, :3].mT + camera.viewmat[:3, 3]).unbind(-1)
        column = camera.K[0, 0] * x + camera.K[0, 2] * z
        row = camera.K[1, 1] * y + camera.K[1, 2] * z
        counts += (z > 0.2) & (column > 0) & (column < camera.width * z) & (row > 0) & (row < camera.height * z)
    return counts


def random_start(
    cameras: Sequence[Camera], count: int, low: Sequence[float], high: Sequence[float], *, degree: int, seed: int
) -> Gaussians:
    """At most `count` random Gaussians in a box [m], only where at least two cameras (or the only one) look."""
    needed = min(2, len(cameras))
    trial = Gaussians.random(4096, low, high, degree=degree, seed=seed)
    share = float((views_of(trial.means, cameras) >= needed).float().mean())
    drawn = Gaussians.random(int(count / max(share, 0.05)), low, high, degree=degree, seed=seed + 1)
    kept = torch.nonzero(views_of(drawn.means, cameras) >= needed).flatten()[:count]
    return drawn.subset(kept) if len(kept) else drawn.subset(torch.arange(min(count, len(drawn))))


def swept_start(
    cameras: Sequence[Camera],
    pictures: Sequence[Tensor],
    count: int,
    low: Sequence[float],
    high: Sequence[float],
    *,
    degree: int,
    seed: int,
) -> tuple[Gaussians, list[Tensor]]:
    """At most `count` flattened Gaussians on surfaces that a plane sweep finds in the box [m], and the depth maps.

    `pictures` are bytes `[row, col, 3]`. Where the sweep finds fewer than a hundred points, all are random and there
    are no depth maps. A depth map `[row, col]` [m, along the optical axis], smaller than its picture, is 0 where the
    depth is not known.
    """
    box = torch.tensor([list(low), list(high)], dtype=torch.float32)
    far = farthest(cameras, low, high)
    generator = random_at(seed, 0, "sweep")
    views, known = swept_surfaces(cameras, pictures, far, generator)
    known = [
        mask & ((view.world > box[0]) & (view.world < box[1])).all(-1) for view, mask in zip(views, known, strict=True)
    ]
    found = Surfaces.of(views, known)
    if len(found.points) < LEAST_SWEPT:
        return random_start(cameras, count, low, high, degree=degree, seed=seed), []
    depths = [torch.where(mask, view.depth, 0.0) for view, mask in zip(views, known, strict=True)]
    return pieces_of(found.thinned(count, generator), far, degree=degree), depths


def farthest(cameras: Sequence[Camera], low: Sequence[float], high: Sequence[float]) -> float:
    """How far [m] any camera is from any corner of a box."""
    box = torch.tensor([list(low), list(high)], dtype=torch.float32)
    corners = torch.stack([(camera.position - box).abs().amax(0) for camera in cameras])
    return float(torch.linalg.vector_norm(corners, dim=-1).max())


def pieces_of(found: Surfaces, far: float, *, degree: int) -> Gaussians:
    """Flattened Gaussians on the points of surfaces, two or more, that were swept down to `far` [m]."""
    swept = Gaussians.from_points(found.points, found.colours, degree=degree, opacity=SWEPT_OPACITY)
    scales = swept.log_scales.clone()
    scales += math.log(SWEPT_SCALE)
    scales = scales.clamp_max(math.log(SWEPT_LARGEST * far))
    scales[:, 2] += math.log(FLATNESS)
    return dataclasses.replace(swept, log_scales=scales, quats=upright(found.normals))


def upright(normals: Tensor) -> Tensor:
    """Rotations `[point, 4]` (wxyz) that turn the z axis to unit `normals` `[point, 3]`."""
    x, y, z = torch.where(normals[:, 2:] < 0, -normals, normals).unbind(-1)
    return torch.nn.functional.normalize(torch.stack((1 + z, -y, x, torch.zeros_like(z)), -1), dim=-1)
