"""Where the visual stage begins: the box the scene may fill, and Gaussians in it, swept or random."""

from collections.abc import Sequence

import torch
from torch import Tensor

from rf3dgs.core.grids import Camera
from rf3dgs.splats.gaussians import Gaussians
from rf3dgs.training.loop import random_at
from rf3dgs.training.sweep import swept_points

BOX_MARGIN = 0.25
SMALLEST_EXTENT = 0.1
SWEPT_SHARE = 0.85
SWEPT_OPACITY = 0.3
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
) -> Gaussians:
    """At most `count` Gaussians: 85 % on surfaces that a plane sweep finds in the box [m], the others random in it.

    `pictures` are bytes `[row, col, 3]`. Where the sweep finds fewer than a hundred points, all are random.
    """
    box = torch.tensor([list(low), list(high)], dtype=torch.float32)
    corners = torch.stack([(camera.position - box).abs().amax(0) for camera in cameras])
    far = float(torch.linalg.vector_norm(corners, dim=-1).max())
    points, colours = swept_points(cameras, pictures, far, int(SWEPT_SHARE * count), random_at(seed, 0, "sweep"))
    inside = ((points > box[0]) & (points < box[1])).all(-1)
    if int(inside.sum()) < LEAST_SWEPT:
        return random_start(cameras, count, low, high, degree=degree, seed=seed)
    swept = Gaussians.from_points(points[inside], colours[inside], degree=degree, opacity=SWEPT_OPACITY)
    others = max(1, int((1 - SWEPT_SHARE) * count))
    return Gaussians.join([swept, random_start(cameras, others, low, high, degree=degree, seed=seed)])
