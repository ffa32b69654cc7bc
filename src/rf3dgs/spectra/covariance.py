"""Spatial covariance of the element responses: what array spectra are computed from."""

import math

import torch
from torch import Tensor

from rf3dgs.channel.arrays import PlanarArray, ofdm
from rf3dgs.channel.paths import Paths
from rf3dgs.channel.patterns import power_pattern
from rf3dgs.channel.response import coefficients, phasors
from rf3dgs.core.errors import InputError
from rf3dgs.core.frames import Pose
from rf3dgs.spectra.responses import responses
from rf3dgs.spectra.spectrum import Spectrum
from rf3dgs.spectra.steering import from_lags
from rf3dgs.spectra.synthesis import pose_for

AT_ONCE = 2**13  # paths whose phasors stay in the cache


def covariance_of(
    paths: Paths,
    array: PlanarArray,
    *,
    pose: Pose | None = None,
    snapshots: int | None = None,
    bandwidth: float = 2e9,
    taps: tuple[float, float] | None = None,
    snr_db: float | None = None,
    seed: int = 0,
) -> Tensor:
    """Covariance R `[*batch, element, element]`, complex128, of the array's responses x. Paper eqs. 5 and 9.

    snapshots None: uncorrelated paths, R = sum_p |a_p|^2 a(r_p) a(r_p)^H. Otherwise R is the mean of x x^H over so many
    frequencies across `bandwidth` [Hz], x(f) = sum_p a_p a(r_p) e^{-j 2 pi (f_c + f) tau_p}: coherent, as a receiver
    measures it. `taps` (first, last) [s]: only the delay taps in this window count, see `delay_taps`; all taps together
    give what all frequencies give. snr_db: adds complex white noise, relative to the mean power of the elements; with
    snapshots None its expectation, otherwise one draw from `seed`. `pose` (default: the receivers') turns the array.
    """
    if snapshots is not None and snapshots < 1:
        raise InputError(f"snapshots must be at least 1, or None for uncorrelated paths; got {snapshots}")
    if snapshots is None and taps is not None:
        raise InputError("delay taps are made of coherent responses; give snapshots, such as 256, with taps")
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
            x = _responses(one, array, turn, snapshots, bandwidth)
            if snr_db is not None:
                power = _noise_power(x @ x.mH / snapshots, snr_db)
                x = x + power.sqrt() * torch.randn(x.shape, dtype=x.dtype, generator=generator)
            if taps is not None:
                x = delay_taps(x, bandwidth, taps)
            covariance = x @ x.mH / snapshots
        result.append(covariance)
    return torch.stack(result).reshape(*batch, array.count, array.count)


def covariance_of_snapshots(x: Tensor) -> Tensor:
    """Covariance `[*batch, element, element]`, complex128, of measured responses x `[*batch, element, snapshot]`.

    The mean of x x^H over snapshots: frequencies, delay taps or times. InputError for values that are not finite.
    """
    if x.dim() < 2 or x.shape[-1] < 1:
        raise InputError(f"responses must be [*batch, element, snapshot] with a snapshot; got {list(x.shape)}")
    x = x.to(torch.complex128)
    if not bool(torch.isfinite(torch.view_as_real(x)).all()):
        raise InputError("responses have NaN or infinite values; remove those snapshots")
    return x @ x.mH / x.shape[-1]


def delay_taps(x: Tensor, bandwidth: float, window: tuple[float, float] | None = None) -> Tensor:
    """Responses x `[*batch, element, frequency]`, as of `ofdm`, as delay taps `[*batch, element, tap]`.

    A unitary transform: K frequencies become K taps, 1 / bandwidth apart, that repeat after K / bandwidth; their x x^H
    adds up to the same. A path that falls between taps leaks into all others, 1 / distance in amplitude. `window`
    (first, last) [s]: only these taps. InputError when it holds none.
    """
    count = x.shape[-1]
    x = torch.fft.ifft(torch.fft.ifftshift(x.to(torch.complex128), dim=-1), dim=-1) * math.sqrt(count)
    if window is None:
        return x
    return x[..., _taps_within(count, bandwidth, window)]


def tap_count(snapshots: int, bandwidth: float, window: tuple[float, float]) -> int:
    """How many of the delay taps of `snapshots` frequencies over `bandwidth` [Hz] a window (first, last) [s] keeps."""
    return int(_taps_within(snapshots, bandwidth, window).sum())


def _taps_within(count: int, bandwidth: float, window: tuple[float, float]) -> Tensor:
    first, last = window
    delay = torch.arange(count, dtype=torch.float64) / bandwidth
    chosen = (delay >= first) & (delay <= last)
    if not bool(chosen.any()):
        raise InputError(
            f"no delay tap lies between {first:g} and {last:g} s; there are {count}, from 0 to {float(delay[-1]):g} s, "
            f"{1 / bandwidth:g} s apart"
        )
    return chosen


def covariance_of_spectrum(spectrum: Spectrum, array: PlanarArray) -> Tensor:
    """Covariance `[*batch, element, element]`, complex128, that a spectrum implies for `array` at the same pose.

    R = sum over pixels of P dOmega a a^H / beam solid angle: every pixel is an uncorrelated plane wave.
    """
    directions = spectrum.grid.directions.reshape(-1, 3)
    weight = (spectrum.power * spectrum.grid.solid_angle).double() / spectrum.instrument.beam_solid_angle
    batch = spectrum.power.shape[:-2]
    rows = [plane_waves(row, directions, array) for row in weight.reshape(-1, len(directions))]
    return torch.stack(rows).reshape(*batch, array.count, array.count)


def plane_waves(power: Tensor, directions: Tensor, array: PlanarArray) -> Tensor:
    """sum_p power_p a(r_p) a(r_p)^H `[element, element]`, complex128, of uncorrelated waves `[n]` from `[n, 3]`.

    Entries depend only on how many rows and columns two elements are apart, so these lags are summed, not the entries.
    """
    lags = torch.zeros(2 * array.rows - 1, array.cols, dtype=torch.complex128)
    seen = power.double() * power_pattern(array.pattern, directions).double()
    for first in range(0, len(seen), AT_ONCE):
        part = slice(first, first + AT_ONCE)
        _, y, z = directions[part].double().unbind(-1)
        columns = phasors(array.horizontal * y, 0.0, array.cols) * seen[part]
        rows = phasors(-array.vertical * z, 0.0, array.rows)
        lags[array.rows - 1 :] += rows @ columns.mT
        lags[: array.rows - 1] += (rows[1:] @ columns.mH).conj().flip(0)
    return from_lags(lags, array)


def _noise_power(covariance: Tensor, snr_db: float) -> Tensor:
    return covariance.diagonal().real.mean() * 10.0 ** (-snr_db / 10.0)


def _uncorrelated(paths: Paths, array: PlanarArray, world_from_device: Tensor) -> Tensor:
    return plane_waves(paths.path_gain, paths.aoa @ world_from_device, array)


def _responses(paths: Paths, array: PlanarArray, world_from_device: Tensor, snapshots: int, bandwidth: float) -> Tensor:
    ofdm(bandwidth, snapshots)  # refuses a bandwidth that is none
    return responses(coefficients(paths), paths.delay, paths.aoa @ world_from_device, array, snapshots, bandwidth)
