"""Segments: connected pieces of planes, and of everything else pieces of near neighbours with like normals."""

import math

import numpy as np
import torch
from torch import Tensor

from rf3dgs.geometry.config import SurfaceConfig
from rf3dgs.geometry.patches import CELL, Patches

SMALL = 12  # smaller pieces off the planes join the segment that most of their neighbours have


def segments_of(
    points: Tensor, normals: Tensor, plane_of: Tensor, patches: Patches, neighbours: Tensor, config: SurfaceConfig
) -> Tensor:
    """Segment `[gaussian]` of each Gaussian, from 0 without gaps: on planes by patch, elsewhere by growing.

    `neighbours` `[gaussian, k]` are indices of the nearest Gaussians, the first of them the Gaussian itself.
    """
    segment = _on_planes(points, plane_of, patches)
    free = plane_of < 0
    if bool(free.any()):
        grown = _grown(points, normals, free, neighbours, config, config.link * patches.cell / CELL)
        segment = torch.where(free, int(segment.max()) + 1 + grown, segment)
    segment = torch.unique(segment, return_inverse=True)[1]
    segment = _joined(segment, free, neighbours)
    return torch.unique(segment, return_inverse=True)[1]


def _on_planes(points: Tensor, plane_of: Tensor, patches: Patches) -> Tensor:
    """A number `[gaussian]` for each connected piece of each plane's cells; -1 off the planes."""
    from scipy.ndimage import label

    segment, first = torch.full_like(plane_of, -1), 0
    for plane in range(len(patches)):
        chosen = (plane_of == plane).nonzero().squeeze(-1)
        if not len(chosen):
            continue
        grid = patches.grid(plane)
        pieces = np.asarray(label(grid.numpy(), structure=np.ones((3, 3)))[0])  # type: ignore[index]
        cell = patches.cell_of(points[chosen], plane_of[chosen])
        cell = torch.minimum(cell.clamp_min(0), torch.tensor(grid.shape) - 1)
        piece = torch.from_numpy(pieces).long()[cell[:, 0], cell[:, 1]]
        segment[chosen] = first + piece
        first += int(pieces.max()) + 1
    return segment


def _grown(
    points: Tensor, normals: Tensor, free: Tensor, neighbours: Tensor, config: SurfaceConfig, link: float
) -> Tensor:
    """Connected components `[gaussian]` among free Gaussians, linked by distance (at most `link` [m]) and angle."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    start = torch.arange(len(points))[:, None].expand_as(neighbours)
    near = torch.linalg.vector_norm(points[neighbours] - points[:, None], dim=-1) < link
    alike = (normals[neighbours] * normals[:, None]).sum(-1) > math.cos(math.radians(config.link_angle_deg))
    linked = near & alike & free[neighbours] & free[:, None]
    rows, columns = start[linked].numpy(), neighbours[linked].numpy()
    graph = coo_matrix((np.ones(len(rows), dtype=np.int8), (rows, columns)), shape=(len(points), len(points)))
    return torch.from_numpy(connected_components(graph, directed=False)[1].astype(np.int64))


def _joined(segment: Tensor, free: Tensor, neighbours: Tensor) -> Tensor:
    """Small pieces off the planes take the segment of the nearest neighbour that is in a large one, if there is one."""
    for _ in range(4):
        size = torch.bincount(segment)
        small = free & (size[segment] < SMALL)
        large = ~small[neighbours]
        first = large.long().argmax(1)
        other = segment[neighbours.gather(1, first[:, None]).squeeze(1)]
        segment = torch.where(small & large.any(1), other, segment)
    return segment
