"""Normals of Gaussians: the shortest axis, smoothed by neighbours where they are round, turned to the free side."""

import numpy as np
import torch
from torch import Tensor

from rf3dgs.splats.gaussians import Gaussians
from rf3dgs.splats.surface import normals

NEIGHBOURS = 12
OWN = 4.0  # how many neighbours a perfectly flat Gaussian's own axis outweighs
NEAREST_VIEWS = 5


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


def turned_to(normals: Tensor, points: Tensor, viewpoints: Tensor) -> Tensor:
    """The normals `[point, 3]` with the sign that faces the viewpoints `[view, 3]` nearest to each point `[point, 3]`.

    The nearest views vote with the cosine of their directions.
    """
    from scipy.spatial import KDTree

    count = min(NEAREST_VIEWS, len(viewpoints))
    near = KDTree(viewpoints.numpy()).query(points.numpy(), k=count)[1]
    near = torch.from_numpy(np.asarray(near).reshape(len(points), count))
    towards = torch.nn.functional.normalize(viewpoints[near] - points[:, None], dim=-1)
    facing = (towards * normals[:, None]).sum((-1, -2))
    return torch.where(facing[:, None] < 0, -normals, normals)
