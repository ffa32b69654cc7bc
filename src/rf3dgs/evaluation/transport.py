"""How far power must be moved over the sphere to turn one angular distribution into another."""

import math

import torch
from torch import Tensor

from rf3dgs.core.angles import angle_between
from rf3dgs.core.grids import DirectionGrid
from rf3dgs.spectra.spectrum import Spectrum

SPREAD_AXES = 16


def angular_wasserstein(truth: Spectrum, prediction: Spectrum) -> Tensor:
    """Wasserstein distance `[*batch]` [rad] of the angular power of both spectra, each normalised to a total of 1.

    Shares are `p = P dOmega / sum(P dOmega)`. Along an axis a the distance is one of two distributions on a line,

        W_a = integral over t in [0, pi] of |F_p(t) - F_q(t)| dt,   F_p(t) = sum of p where angle(a, direction) <= t,

    and the answer is the largest W_a: the max-sliced distance (Deshpande et al. 2019) with the angle to the axis as
    the slice. Axes are the device's own three, 16 spread over half the sphere, and the strongest direction of either
    spectrum. Because the angle to an axis never changes faster than the direction, W_a is at most the cost of the best
    transport over the sphere (Kantorovich and Rubinstein); it equals it for two single directions, which give the
    angle between them, and for a share of the power that moves from one direction to another. pi where a spectrum has
    no power at all.
    """
    grid = truth.grid
    batch = truth.pose.batch_shape
    directions = grid.directions.reshape(-1, 3).double()
    first, second = _shares(truth.power, grid), _shares(prediction.power, grid)
    spread = _sorted_angles(directions, _spread_axes())
    distance = torch.full((len(first),), math.pi, dtype=torch.float64)
    for index, (p, q) in enumerate(zip(first, second, strict=True)):
        if not (bool(p.any()) and bool(q.any())):
            continue
        peaks = torch.stack(
            [spectrum.power.reshape(len(first), -1)[index].argmax() for spectrum in (truth, prediction)]
        )
        own = _sorted_angles(directions, directions[peaks.unique()])
        distance[index] = torch.cat([_on_lines(p - q, *angles) for angles in (spread, own)]).max()
    return distance.reshape(batch).float()


def _shares(power: Tensor, grid: DirectionGrid) -> Tensor:
    """Shares of the power `[n, pixel]` (float64) that sum to 1; zero where a spectrum has none.

    Directions of a list without solid angles count alike.
    """
    solid_angle = grid.solid_angle if bool(grid.solid_angle.any()) else torch.ones(grid.shape)
    energy = (power.double() * solid_angle).reshape(-1, grid.height * grid.width)
    return energy / energy.sum(-1, keepdim=True).clamp_min(1e-300)


def _spread_axes() -> Tensor:
    """Unit vectors `[axis, 3]` (float64): x, y, z and a spiral of equal areas; an axis and its opposite are one."""
    number = torch.arange(SPREAD_AXES, dtype=torch.float64) + 0.5
    z = number / SPREAD_AXES
    turn = number * math.pi * (1.0 + math.sqrt(5.0))
    radius = (1.0 - z**2).sqrt()
    spiral = torch.stack((radius * torch.cos(turn), radius * torch.sin(turn), z), -1)
    return torch.cat((torch.eye(3, dtype=torch.float64), spiral))


def _sorted_angles(directions: Tensor, axes: Tensor) -> tuple[Tensor, Tensor]:
    """Pixels in the order of their angle to each axis, and the steps between neighbours [rad]: `[axis, pixel]` each."""
    shape = (len(axes), *directions.shape)
    angle, order = angle_between(directions.expand(shape), axes[:, None].expand(shape)).sort(-1)
    return order, angle.diff(dim=-1)


def _on_lines(difference: Tensor, order: Tensor, step: Tensor) -> Tensor:
    """W_a `[axis]` [rad] of the difference of two distributions `[pixel]`."""
    return (difference[order].cumsum(-1)[:, :-1].abs() * step).sum(-1)
