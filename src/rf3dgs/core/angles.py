"""Angles: zenith in [0, pi] from +z, azimuth in (-pi, pi] from +x towards +y [rad]."""

import torch
from torch import Tensor


def direction_of(zenith: Tensor, azimuth: Tensor) -> Tensor:
    """Unit vectors `[*batch, 3]` of zenith and azimuth `[*batch]` [rad]."""
    sin_zenith = torch.sin(zenith)
    return torch.stack((sin_zenith * torch.cos(azimuth), sin_zenith * torch.sin(azimuth), torch.cos(zenith)), -1)


def angles_of(direction: Tensor) -> tuple[Tensor, Tensor]:
    """Zenith and azimuth `[*batch]` [rad] of vectors `[*batch, 3]`, which need not have unit length."""
    horizontal = torch.linalg.vector_norm(direction[..., :2], dim=-1)
    zenith = torch.atan2(horizontal, direction[..., 2])
    azimuth = torch.atan2(direction[..., 1], direction[..., 0])
    return zenith, azimuth


def angle_between(first: Tensor, second: Tensor) -> Tensor:
    """Angle [rad] between vectors `[*batch, 3]`; exact also for nearly equal ones, where arccos loses its digits."""
    cross = torch.linalg.vector_norm(torch.linalg.cross(first, second, dim=-1), dim=-1)
    return torch.atan2(cross, (first * second).sum(-1))
