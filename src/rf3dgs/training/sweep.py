"""Surface points out of posed photographs by plane sweep: a better place to begin than random Gaussians.

For every pixel of a small copy of each photograph, depths are tried in even steps of inverse depth; the one at which
the neighbouring photographs agree best (normalised cross-correlation of windows) is kept where it is clear and where
the depth map of another photograph confirms it. Walls without texture yield no points. Collins (1996), "A space-sweep
approach to true multi-image matching".
"""

from collections.abc import Sequence

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d, grid_sample

from rf3dgs.core.grids import Camera
from rf3dgs.training.photographs import shrunk

PIXELS_ACROSS = 112
DEPTHS = 96
FINER = 4
NEAREST = 0.04
NEIGHBOURS = 3
WINDOW = 7
CORRELATION = 0.75
LEAST_CONTRAST = 0.015
AGREEMENT = 0.06


def swept_points(
    cameras: Sequence[Camera], pictures: Sequence[Tensor], far: float, count: int, generator: torch.Generator
) -> tuple[Tensor, Tensor]:
    """At most `count` points `[point, 3]` [m] on surfaces, evenly over their area, and their colours, 0 to 1.

    `pictures` are bytes `[row, col, 3]`; depths are tried from 4 % of `far` [m] to `far`.
    """
    small = [shrunk(c, p, max(1, round(c.width / PIXELS_ACROSS))) for c, p in zip(cameras, pictures, strict=True)]
    views = [camera for camera, _ in small]
    greys = [picture.mean(-1) for _, picture in small]
    inverse = torch.linspace(1 / far, 1 / (NEAREST * far), DEPTHS)
    partners = [_partners(views, index, far) for index in range(len(views))]
    depths = [_depth_map(views, greys, index, partners[index], inverse) for index in range(len(views))]
    points, colours, areas = [torch.zeros(0, 3)], [torch.zeros(0, 3)], [torch.zeros(0)]
    for index, (camera, picture) in enumerate(small):
        known = depths[index] > 0
        found = _unproject(camera, depths[index])[known]
        confirmed = torch.zeros(len(found), dtype=torch.bool)
        for other in partners[index]:
            confirmed |= _agrees(views[other], depths[other], found)
        points.append(found[confirmed])
        colours.append(picture[known][confirmed])
        areas.append(depths[index][known][confirmed].square())
    if sum(map(len, points)) == 0:
        return points[0], colours[0]
    every, colour, area = torch.cat(points), torch.cat(colours), torch.cat(areas)
    kept = (area / torch.rand(len(area), generator=generator).log().neg()).argsort(descending=True)[:count]
    return every[kept], colour[kept]


def _partners(views: Sequence[Camera], index: int, far: float) -> list[int]:
    """The views that share most with view `index`, counted over a coarse grid of depths, not from the same place."""
    depth = torch.tensor([0.1, 0.2, 0.35, 0.6])[:, None, None] * far
    probe = views[index].resized(12, 9)
    points = torch.cat([_unproject(probe, d.expand(9, 12)).reshape(-1, 3) for d in depth])
    scores = []
    for other, camera in enumerate(views):
        moved = float(torch.linalg.vector_norm(camera.position - views[index].position))
        facing = float(camera.viewmat[2, :3] @ views[index].viewmat[2, :3])
        inside = _project(camera, points)[1].float().mean()
        scores.append(float(inside) if other != index and moved > 0.01 * far and facing > 0.3 else 0.0)
    order = sorted(range(len(views)), key=lambda other: -scores[other])[:NEIGHBOURS]
    return [other for other in order if scores[other] > 0.05]


def _depth_map(
    views: Sequence[Camera], greys: Sequence[Tensor], index: int, partners: Sequence[int], inverse: Tensor
) -> Tensor:
    """Depths [m] along the optical axis `[row, col]` of one view; 0 where unclear.

    The best of all trial depths is refined by a second sweep of finer steps around it.
    """
    grey = greys[index]
    if len(partners) == 0:
        return torch.zeros_like(grey)
    score = _agreement(views, greys, index, partners, inverse[:, None, None].expand(-1, *grey.shape))
    best, layer = score.max(0)
    apart = (torch.arange(len(inverse))[:, None, None] - layer).abs() > 3
    rival = torch.where(apart, score, -1.0).amax(0)
    contrast = _window(grey[None].square()) - _window(grey[None]).square()
    step = (inverse[1] - inverse[0]) / FINER
    fine = inverse[layer] + step * torch.arange(-FINER, FINER + 1)[:, None, None]
    fine_best, fine_layer = _agreement(views, greys, index, partners, fine).max(0)
    best = torch.maximum(best, fine_best)
    clear = (best > CORRELATION) & (best - rival > 0.05) & (contrast[0] > LEAST_CONTRAST**2)
    clear &= (layer > 0) & (layer < len(inverse) - 1)
    return torch.where(clear, 1 / fine.gather(0, fine_layer[None])[0].clamp_min(1e-6), 0.0)


def _agreement(
    views: Sequence[Camera], greys: Sequence[Tensor], index: int, partners: Sequence[int], inverse: Tensor
) -> Tensor:
    """Correlation with the two best of the partners, -1 to 1, at inverse depths `[layer, row, col]` [1/m]."""
    camera, grey = views[index], greys[index]
    layers = _unproject(camera, 1 / inverse.clamp_min(1e-6))
    mean = _window(grey[None])
    spread = (_window(grey[None].square()) - mean.square()).clamp_min(0.0)
    scores = []
    for other in partners:
        pixel, inside = _project(views[other], layers.reshape(-1, 3))
        size = torch.tensor([views[other].width, views[other].height])
        where = (2 * pixel / size - 1).reshape(1, -1, camera.width, 2)
        seen = grid_sample(greys[other][None, None], where, align_corners=False)[0, 0].reshape(layers.shape[:3])
        there = inside.float().reshape(layers.shape[:3])
        other_mean = _window(seen)
        covariance = _window(seen * grey) - other_mean * mean
        other_spread = (_window(seen.square()) - other_mean.square()).clamp_min(0.0)
        score = covariance * torch.rsqrt(spread * other_spread + 1e-8)
        scores.append(torch.where(_window(there) > 0.95, score, -1.0))
    return torch.stack(scores).sort(0, descending=True).values[:2].mean(0)


def _window(maps: Tensor) -> Tensor:
    """Means over square windows of `[map, row, col]`."""
    half = WINDOW // 2
    rows = avg_pool2d(maps[:, None], (WINDOW, 1), 1, (half, 0), count_include_pad=False)
    return avg_pool2d(rows, (1, WINDOW), 1, (0, half), count_include_pad=False)[:, 0]


def _unproject(camera: Camera, depth: Tensor) -> Tensor:
    """World points `[row, col, 3]` of a depth map `[row, col]` [m] along the optical axis."""
    row, col = torch.meshgrid(torch.arange(camera.height) + 0.5, torch.arange(camera.width) + 0.5, indexing="ij")
    x = (col - camera.K[0, 2]) / camera.K[0, 0]
    y = (row - camera.K[1, 2]) / camera.K[1, 1]
    return torch.stack((x, y, torch.ones_like(x)), -1) * depth[..., None] @ camera.viewmat[:3, :3] + camera.position


def _project(camera: Camera, points: Tensor) -> tuple[Tensor, Tensor]:
    """Pixel coordinates `[point, 2]` of world points, and who is inside the picture."""
    x, y, z = (points @ camera.viewmat[:3, :3].mT + camera.viewmat[:3, 3]).unbind(-1)
    ahead = z > 1e-3
    z = torch.where(ahead, z, 1.0)
    pixel = torch.stack((camera.K[0, 0] * x / z + camera.K[0, 2], camera.K[1, 1] * y / z + camera.K[1, 2]), -1)
    inside = ahead & (pixel >= 0).all(-1) & (pixel < torch.tensor([camera.width, camera.height])).all(-1)
    return torch.where(inside[:, None], pixel, -1e3), inside


def _agrees(camera: Camera, depth: Tensor, points: Tensor) -> Tensor:
    """Whether the depth map `[row, col]` of `camera` has each point `[point, 3]` at its depth."""
    pixel, inside = _project(camera, points)
    col, row = pixel.long().clamp_min(0).unbind(-1)
    there = depth[row.clamp_max(camera.height - 1), col.clamp_max(camera.width - 1)]
    z = points @ camera.viewmat[2, :3] + camera.viewmat[2, 3]
    return inside & (there > 0) & ((there - z).abs() < AGREEMENT * z)
