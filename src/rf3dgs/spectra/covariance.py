"""Spatial covariance of the element responses: what array spectra are computed from."""

import math

import torch
from torch import Tensor

from rf3dgs.channel.arrays import PlanarArray, ofdm
from rf3dgs.channel.binning import bin_diffuse
from rf3dgs.channel.paths import Paths
from rf3dgs.channel.response import coefficients, delay_phase, manifold
from rf3dgs.core.errors import InputError
from rf3dgs.core.frames import Pose
from rf3dgs.spectra.spectrum import Spectrum
from rf3dgs.spectra.synthesis import pose_for

AT_ONCE = 2**22  # complex numbers of an intermediate result
FEW = 4_096  # up to so many paths coherent sums are made in complex128, beyond in complex64 (-140 dB of the strongest)
MANY = 65_536  # more paths of one receiver than this are merged first


def covariance_of(
    paths: Paths,
    array: PlanarArray,
    *,
    pose: Pose | None = None,
    snapshots: int | None = None,
    bandwidth: float = 2e9,
    snr_db: float | None = None,
    seed: int = 0,
) -> Tensor:
    """Covariance R `[*batch, element, element]`, complex128, of the array's responses x. Paper eqs. 5 and 9.

    snapshots None: uncorrelated paths, R = sum_p |a_p|^2 a(r_p) a(r_p)^H. Otherwise R is the mean of x x^H over so many
    frequencies across `bandwidth` [Hz], x(f) = sum_p a_p a(r_p) e^{-j 2 pi (f_c + f) tau_p}: coherent, as a receiver
    measures it. Where a receiver has more than 65,536 paths of known `kind`, diffuse ones are first merged by arrival
    (1 degree) and, for snapshots, by delay (half a resolution cell); each then has one pseudo-random phase.
    snr_db: adds complex white noise n, relative to the mean power of the elements; with snapshots None its expectation,
    otherwise one draw from `seed`. `pose` (default: the receivers') turns the array.
    """
    if snapshots is not None and snapshots < 1:
        raise InputError(f"snapshots must be at least 1, or None for uncorrelated paths; got {snapshots}")
    batch = paths.coeff.shape[:-1]
    pose = pose_for(paths, pose)
    rows = paths.flat()
    world_from_device = pose.world_from_device.reshape(-1, 3, 3)
    generator = torch.Generator().manual_seed(seed)
    result = []
    for index in range(len(rows.rx)):
        one, turn = rows[index], world_from_device[index]
        if snapshots is None:
            covariance = _uncorrelated(one, array, turn)
            if snr_db is not None:
                covariance = covariance + _noise_power(covariance, snr_db) * torch.eye(array.count)
        else:
            x = _responses(one, array, turn, ofdm(bandwidth, snapshots))
            if snr_db is not None:
                power = _noise_power(x @ x.mH / snapshots, snr_db)
                x = x + power.sqrt() * torch.randn(x.shape, dtype=x.dtype, generator=generator)
            covariance = x @ x.mH / snapshots
        result.append(covariance)
    return torch.stack(result).reshape(*batch, array.count, array.count)


def covariance_of_spectrum(spectrum: Spectrum, array: PlanarArray) -> Tensor:
    """Covariance `[*batch, element, element]`, complex128, that a spectrum implies for `array` at the same pose.

    R = sum over pixels of P dOmega a a^H / beam solid angle: every pixel is an uncorrelated plane wave.
    """
    directions = spectrum.grid.directions.reshape(-1, 3).double()
    weight = (spectrum.power * spectrum.grid.solid_angle).double() / spectrum.instrument.beam_solid_angle
    steering = manifold(array, directions)
    batch = spectrum.power.shape[:-2]
    rows = [(steering.mT * row) @ steering.conj() for row in weight.reshape(-1, len(directions))]
    return torch.stack(rows).reshape(*batch, array.count, array.count)


def _merged(paths: Paths, delay_step: float) -> Paths:
    if int(paths.count) <= MANY or paths.kind is None:
        return paths
    return bin_diffuse(paths, cell=math.radians(1.0), delay_step=delay_step)


def _noise_power(covariance: Tensor, snr_db: float) -> Tensor:
    return covariance.diagonal().real.mean() * 10.0 ** (-snr_db / 10.0)


def _uncorrelated(paths: Paths, array: PlanarArray, world_from_device: Tensor) -> Tensor:
    paths = _merged(paths, 1.0)
    covariance = torch.zeros(array.count, array.count, dtype=torch.complex128)
    gain, directions = paths.path_gain, paths.aoa @ world_from_device
    arriving = torch.nonzero(gain > 0).squeeze(-1)
    for part in arriving.split(max(1, AT_ONCE // array.count)):
        amplitude = manifold(array, directions[part].double()) * gain[part].double().sqrt()[:, None]
        covariance += amplitude.mT @ amplitude.conj()
    return covariance


def _responses(paths: Paths, array: PlanarArray, world_from_device: Tensor, offsets: Tensor) -> Tensor:
    """Element responses x `[element, snapshot]`."""
    paths = _merged(paths, 0.5 / max(float(offsets[-1] - offsets[0]), 1.0))
    x = torch.zeros(array.count, len(offsets), dtype=torch.complex128)
    coeff, directions = coefficients(paths), paths.aoa @ world_from_device
    arriving = torch.nonzero(coeff != 0).squeeze(-1)
    precision = torch.complex64 if len(arriving) > FEW else torch.complex128
    for part in arriving.split(max(1, AT_ONCE // (array.count + len(offsets)))):
        steering = manifold(array, directions[part].double()) * coeff[part][:, None]
        x += steering.to(precision).mT @ delay_phase(paths.delay[part], offsets).to(precision)
    return x
