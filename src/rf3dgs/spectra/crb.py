"""Cramer-Rao bound: the smallest deviation with which any unbiased estimator reads paths off a sounding.

Seven unknowns per path: log-amplitude and phase of the gain at the carrier, delay, zenith and azimuth at both ends. Not
bounded here: a common delay offset, which adds its own uncertainty to all delays alike.
"""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from rf3dgs.channel.arrays import PlanarArray
from rf3dgs.channel.paths import Paths
from rf3dgs.channel.patterns import field_pattern
from rf3dgs.channel.response import coefficients, delay_phase, manifold
from rf3dgs.channel.sounding import Sounding, device_directions, elements_of, seen
from rf3dgs.core.angles import angles_of, direction_of
from rf3dgs.core.errors import InputError
from rf3dgs.core.frames import Pose

UNKNOWNS = ("log_amplitude", "phase", "delay", "aoa_zenith", "aoa_azimuth", "aod_zenith", "aod_azimuth")


@dataclass(frozen=True, eq=False)
class Bound:
    """Standard deviations `[*batch, path]`, float64; infinite where a sounding does not tell the quantity.

    log_amplitude: relative, of |a|. phase [rad] of the gain at the carrier. delay [s]. Angles [rad], world frame.
    """

    log_amplitude: Tensor
    phase: Tensor
    delay: Tensor
    aoa_zenith: Tensor
    aoa_azimuth: Tensor
    aod_zenith: Tensor
    aod_azimuth: Tensor


def cramer_rao(paths: Paths, sounding: Sounding) -> Bound:
    """The bound for `paths` `[*batch, path]`, all unknown together, as measured by `sounding` with its noise.

    Of `sounding` the arrays, fields of view, poses, offsets and noise power count, its responses do not. An array of
    one row does not tell the zenith in its own frame, one of one column not the azimuth: these are taken as known and
    have an infinite bound. Paths that are not valid or out of view have infinite bounds and disturb nobody.
    InputError where the noise power is unknown.
    """
    noise = sounding.noise_power
    if not isinstance(noise, Tensor):
        raise InputError("the bound needs the noise power; the sounding's is unknown (None), give an estimate")
    if paths.coeff.shape[:-1] != sounding.response.shape[:-3]:
        raise InputError(
            f"paths and sounding must have the same receivers; got {list(paths.coeff.shape[:-1])} and "
            f"{list(sounding.response.shape[:-3])}"
        )
    batch, count = paths.coeff.shape[:-1], paths.coeff.shape[-1]
    rows, soundings = paths.flat(), sounding.flat()
    noise = noise.reshape(-1)
    found = [_bound_of(rows[index], soundings[index], float(noise[index])) for index in range(len(rows.rx))]
    columns = torch.stack(found).reshape(*batch, len(UNKNOWNS), count).unbind(-2)
    return Bound(*columns)


def fisher_information(paths: Paths, sounding: Sounding, noise_power: float = 1.0) -> Tensor:
    """Fisher information `[7 path, 7 path]`, float64, of the paths of one receiver: (2 / noise) Re(D^H D).

    D is the derivative of all responses with respect to `UNKNOWNS` of every path, path by path, angles in the devices'
    own frames. Each column is a product of one factor per array and one over frequency, so that D itself is never made.
    """
    arrival, departure = device_directions(paths)
    count = paths.coeff.shape[-1]
    offsets = sounding.offsets
    wave = delay_phase(paths.delay, offsets)
    slope = -2j * math.pi * offsets * wave
    a, a_zenith, a_azimuth = _slopes(sounding.array_rx, arrival)
    b, b_zenith, b_azimuth = _slopes(sounding.array_tx, departure)
    factors = (
        (a, a, a, a_zenith, a_azimuth, a, a),
        (b, b, b, b, b, b_zenith, b_azimuth),
        (wave, wave, slope, wave, wave, wave, wave),
    )
    gain = coefficients(paths)[:, None] * torch.tensor([1, 1j, 1, 1, 1, 1, 1])
    gram = gain.reshape(-1, 1).conj() * gain.reshape(1, -1)
    for factor in factors:
        columns = torch.stack(factor, 1).reshape(count * len(UNKNOWNS), -1)
        gram = gram * (columns.conj() @ columns.mT)
    return (2.0 / noise_power) * gram.real


def _bound_of(paths: Paths, sounding: Sounding, noise: float) -> Tensor:
    """Deviations `[7, path]` for one receiver."""
    arrival, departure = device_directions(paths)
    visible = paths.valid & (paths.path_gain > 0)
    visible &= seen(sounding.array_rx, sounding.fov_rx, arrival) & seen(sounding.array_tx, sounding.fov_tx, departure)
    told = torch.tensor(
        [True, True, len(sounding.offsets) > 1, *told_by(sounding.array_rx), *told_by(sounding.array_tx)]
    )
    free = (visible[:, None] & told).reshape(-1)
    covariance = torch.zeros(len(free), len(free), dtype=torch.float64)
    if bool(free.any()):
        information = fisher_information(paths, sounding, 1.0)[free][:, free]
        index = torch.nonzero(free).squeeze(-1)
        covariance[index[:, None], index] = noise * _inverse(information)
    blocks = torch.diagonal(covariance.reshape(len(visible), 7, len(visible), 7), dim1=0, dim2=2).movedim(-1, 0)
    deviation = torch.full((7, len(visible)), torch.inf, dtype=torch.float64)
    for unknown in range(3):
        if bool(told[unknown]):
            deviation[unknown] = blocks[:, unknown, unknown].sqrt()
    for first, directions, pose in ((3, arrival, paths.rx), (5, departure, paths.tx)):
        pair = blocks[:, first : first + 2, first : first + 2]
        deviation[first : first + 2] = _in_world(pair, directions, pose, told[first : first + 2])
    deviation[:, ~visible] = torch.inf
    return deviation


def told_by(array: PlanarArray | None) -> tuple[bool, bool]:
    """Whether an array tells zenith and azimuth in its own frame: it takes two rows, or two columns."""
    return (False, False) if array is None else (array.rows > 1, array.cols > 1)


def _inverse(information: Tensor) -> Tensor:
    """Inverse after scaling to a unit diagonal; infinite where two paths cannot be told apart."""
    scale = information.diagonal().rsqrt()
    inverse, failed = torch.linalg.inv_ex(information * scale[:, None] * scale)
    if int(failed) or not bool((inverse.diagonal() > 0).all()):
        return torch.full_like(information, torch.inf)
    return inverse * scale[:, None] * scale


def _in_world(pair: Tensor, directions: Tensor, pose: Pose, told: Tensor) -> Tensor:
    """World-frame deviations `[2, path]` from the covariance `[path, 2, 2]` of the device's zenith and azimuth."""
    turn = pose.world_from_device.double()
    _, zenith_axis, azimuth_axis = _frame(*angles_of(directions))
    columns = torch.stack((zenith_axis, azimuth_axis), -1)
    zenith, azimuth = angles_of(directions @ turn.mT)
    _, world_zenith, world_azimuth = _frame(zenith, azimuth)
    scale = world_azimuth.square().sum(-1, keepdim=True).clamp_min(1e-300)
    jacobian = torch.stack((world_zenith, world_azimuth / scale), -2) @ (turn @ columns)
    deviation = (jacobian @ pair @ jacobian.mT).diagonal(dim1=-2, dim2=-1).sqrt()
    lost = (jacobian.abs() > 1e-5)[:, :, ~told].any(-1)
    return torch.where(lost, torch.inf, deviation).mT


def _frame(zenith: Tensor, azimuth: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Direction and its derivatives with respect to zenith and azimuth, each `[path, 3]`."""
    flat = torch.stack((-torch.sin(azimuth), torch.cos(azimuth), torch.zeros_like(azimuth)), -1)
    down = direction_of(zenith + 0.5 * math.pi, azimuth)
    return direction_of(zenith, azimuth), down, flat * torch.sin(zenith)[..., None]


def _slopes(array: PlanarArray | None, directions: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Manifold and its derivatives with respect to the device's zenith and azimuth, each `[path, element]`."""
    if array is None:
        a = torch.ones(len(directions), elements_of(array), dtype=torch.complex128)
        return a, torch.zeros_like(a), torch.zeros_like(a)
    zenith, azimuth = angles_of(directions)
    _, down, flat = _frame(zenith, azimuth)
    a = manifold(array, directions)
    waves = 2j * math.pi * array.positions
    with torch.enable_grad():
        angles = (zenith.detach().requires_grad_(), azimuth.detach().requires_grad_())
        level = field_pattern(array.pattern, direction_of(*angles)).clamp_min(1e-150).log().sum()
        slopes = torch.autograd.grad(level, angles, allow_unused=True) if level.requires_grad else (None, None)
    tilt, turn = (torch.zeros_like(zenith) if slope is None else slope for slope in slopes)
    along = down.to(torch.complex128) @ waves.mT, flat.to(torch.complex128) @ waves.mT
    return a, a * (along[0] + tilt[:, None]), a * (along[1] + turn[:, None])
