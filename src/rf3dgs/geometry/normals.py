"""Normals of Gaussians: the shortest axis, smoothed by neighbours where they are round, turned to the free side."""

import math
from dataclasses import replace

import torch
from torch import Tensor

from rf3dgs.core.frames import Pose
from rf3dgs.core.grids import equirect_grid, view_of
from rf3dgs.splats.compositing import Compositing
from rf3dgs.splats.draw import draw
from rf3dgs.splats.gaussians import Gaussians
from rf3dgs.splats.surface import normals

OWN = 4.0  # how many neighbours a perfectly flat Gaussian's own axis outweighs
MOST_VIEWS = 16
ROWS = 64  # of the panoramas that say what a viewpoint sees
BEHIND = 0.15  # a Gaussian this far behind what is drawn is still seen [m]


def flatness(gaussians: Gaussians) -> Tensor:
    """How flat each Gaussian is `[gaussian]`: 0 for a ball or a needle, 1 for a sheet; (middle - shortest) / middle."""
    scales = gaussians.scales.sort(-1).values
    return 1.0 - scales[:, 0] / scales[:, 1].clamp_min(1e-9)


def mass(gaussians: Gaussians) -> Tensor:
    """How much surface each Gaussian covers `[gaussian]` [m^2]: opacity times the area of its one-sigma ellipse."""
    scales = gaussians.scales.sort(-1).values
    return torch.pi * gaussians.opacities * scales[:, 1] * scales[:, 2]


def smooth_normals(gaussians: Gaussians, neighbours: Tensor) -> Tensor:
    """Unit normals `[gaussian, 3]`, of either sign: the main axis of n n^T summed over a Gaussian and its neighbours.

    `neighbours` `[gaussian, k]` are indices of the nearest Gaussians. Each n counts by flatness and opacity, the
    Gaussian's own `OWN` times.
    """
    own = normals(gaussians).double()
    weight = (flatness(gaussians).square() * gaussians.opacities).double().clamp_min(1e-6)
    outer = weight[:, None, None] * own[:, :, None] * own[:, None, :]
    total = OWN * outer + outer[neighbours].sum(1)
    return torch.linalg.eigh(total).eigenvectors[..., 2].float()


def turned_to(normals: Tensor, gaussians: Gaussians, viewpoints: Tensor) -> Tensor:
    """The normals `[gaussian, 3]` with the sign that faces the viewpoints `[view, 3]` from which a Gaussian is seen.

    Each view votes with the cosine of its direction over its distance, where nothing more than `BEHIND` [m] in front of
    the Gaussian is drawn from there. Those that no view sees turn to the nearest views.
    """
    votes, near = torch.zeros(len(normals)), torch.zeros(len(normals))
    for viewpoint in spread_views(viewpoints, MOST_VIEWS):
        away = viewpoint - gaussians.means
        distance = torch.linalg.vector_norm(away, dim=-1).clamp_min(1e-6)
        facing = (away * normals).sum(-1) / distance.square()
        seen = distance < _depth_towards(gaussians, viewpoint, -away / distance[:, None]) + BEHIND
        votes += torch.where(seen, facing, 0.0)
        near += facing / distance.square()
    return torch.where((torch.where(votes != 0, votes, near) < 0)[:, None], -normals, normals)


def spread_views(viewpoints: Tensor, most: int) -> Tensor:
    """At most `most` of the viewpoints `[view, 3]`, each as far as possible from those before it."""
    chosen = [0]
    distance = torch.linalg.vector_norm(viewpoints - viewpoints[0], dim=-1)
    while len(chosen) < min(most, len(viewpoints)) and float(distance.max()) > 0:
        chosen.append(int(distance.argmax()))
        distance = torch.minimum(distance, torch.linalg.vector_norm(viewpoints - viewpoints[chosen[-1]], dim=-1))
    return viewpoints[chosen]


def depth_all_round(gaussians: Gaussians, viewpoint: Tensor, height: int = ROWS) -> tuple[Tensor, Tensor]:
    """Distance [m] of what is drawn from `viewpoint` `[3]` and its weight (0 to 1), both `[row, col]` of a panorama."""
    view = view_of(Pose(viewpoint), equirect_grid(2 * height, height))
    bare = replace(gaussians, sh=gaussians.sh[:, :1, :1])
    raster = draw(bare, view, depth=True, compositing=Compositing(depth_gate=0.3, normalise=True))
    return raster.values[..., -1], raster.weight


def _depth_towards(gaussians: Gaussians, viewpoint: Tensor, directions: Tensor) -> Tensor:
    """Drawn distance [m] from `viewpoint` along unit `directions` `[direction, 3]`."""
    depth, _ = depth_all_round(gaussians, viewpoint)
    zenith = directions[:, 2].clamp(-1, 1).acos()
    azimuth = torch.atan2(directions[:, 1], directions[:, 0])
    row = (zenith / math.pi * ROWS).long().clamp(0, ROWS - 1)
    col = ((math.pi - azimuth) / math.pi * ROWS).long().clamp(0, 2 * ROWS - 1)
    return depth[row, col]
