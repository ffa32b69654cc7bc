"""How far a predicted spectrum is from the true one: functions of arrays, one value per position.

Pixels of an equirectangular grid are weighted by their solid angle, so that the crowded rows at the poles count for
what they cover; pixels of pinhole pictures and of lists count alike, as in published tables. "Within the window" means
that both levels are first clipped to the window's floor and ceiling. A prediction without any power gets the worst
value that a metric has: 180 degrees for a direction, the window's floor for a level.
"""

import math
from typing import Literal

import torch
from torch import Tensor

from rf3dgs.core.angles import angle_between
from rf3dgs.core.grids import DirectionGrid
from rf3dgs.core.units import db_from_power
from rf3dgs.spectra.codec import DbWindow
from rf3dgs.spectra.peaks import find_peaks, main_peak
from rf3dgs.spectra.spectrum import Spectrum

PERFECT_PSNR_DB = 100.0
NO_DIRECTION = math.pi / 2  # [rad], the error counted where a prediction has no angle of departure


def pixel_weight(grid: DirectionGrid) -> Tensor:
    """Weights `[row, col]` that sum to 1: solid angles on an equirectangular grid, all alike on others."""
    weight = grid.solid_angle if grid.kind == "equirect" else torch.ones(grid.shape)
    return weight / weight.sum()


def window_level(power: Tensor, window: DbWindow) -> Tensor:
    """Levels [dB] of linear power, clipped to the window; same shape."""
    return db_from_power(power).clamp(window.floor_db, window.ceil_db)


def psnr(truth: Tensor, prediction: Tensor, weight: Tensor) -> Tensor:
    """Peak signal-to-noise ratio `[*batch]` [dB] of pictures `[*batch, row, col]` in [0, 1]; 100 when they are equal.

    `weight` `[row, col]` sums to 1.
    """
    error = ((truth - prediction).double() ** 2 * weight).sum((-2, -1))
    return (-10.0 * torch.log10(error.clamp_min(10.0 ** (-PERFECT_PSNR_DB / 10.0)))).float()


def ssim(truth: Tensor, prediction: Tensor, grid: DirectionGrid) -> Tensor:
    """Structural similarity `[*batch]` of pictures `[*batch, row, col]` in [0, 1]; 1 when they are equal.

    Wang et al. 2004: an 11 x 11 Gaussian window with sigma 1.5, C1 = 0.01^2, C2 = 0.03^2. Pinhole pictures are padded
    with zeros as in Gaussian splatting; on a sphere the window runs on over the seam and over the poles, and the map is
    averaged with `pixel_weight`.
    """
    offsets = torch.arange(11, dtype=torch.float64) - 5
    kernel = torch.exp(-(offsets**2) / (2 * 1.5**2))
    kernel = kernel / kernel.sum()
    batch = truth.shape[:-2]
    first, second = (padded(picture.reshape(-1, *grid.shape).double(), grid, 5) for picture in (truth, prediction))

    def blur(picture: Tensor) -> Tensor:
        picture = torch.nn.functional.conv2d(picture[:, None], kernel[None, None, :, None])
        return torch.nn.functional.conv2d(picture, kernel[None, None, None, :])[:, 0]

    mean_a, mean_b = blur(first), blur(second)
    var_a, var_b = blur(first**2) - mean_a**2, blur(second**2) - mean_b**2
    covariance = blur(first * second) - mean_a * mean_b
    c1, c2 = 0.01**2, 0.03**2
    similarity = ((2 * mean_a * mean_b + c1) * (2 * covariance + c2)) / (
        (mean_a**2 + mean_b**2 + c1) * (var_a + var_b + c2)
    )
    return (similarity * pixel_weight(grid)).sum((-2, -1)).reshape(batch).float()


def padded(
    picture: Tensor, grid: DirectionGrid, margin: int, *, edge: Literal["constant", "replicate"] = "constant"
) -> Tensor:
    """`[n, row, col]` with `margin` more pixels on every side: around the sphere; of others zeros or the edge's own."""
    if grid.kind != "equirect":
        return torch.nn.functional.pad(picture[None], (margin,) * 4, mode=edge)[0]
    height, width = grid.shape
    rows = torch.arange(-margin, height + margin)
    over_pole = (rows < 0) | (rows >= height)
    rows = torch.where(rows < 0, -rows - 1, torch.where(rows >= height, 2 * height - 1 - rows, rows)).clamp(
        0, height - 1
    )
    cols = torch.arange(-margin, width + margin) + over_pole[:, None] * (width // 2)
    return picture[:, rows[:, None], cols % width]


def rmse_db(truth: Tensor, prediction: Tensor, window: DbWindow, weight: Tensor) -> Tensor:
    """Root mean square difference `[*batch]` [dB] of linear powers `[*batch, row, col]`, both clipped to the window."""
    difference = window_level(truth, window) - window_level(prediction, window)
    return (difference**2 * weight).sum((-2, -1)).sqrt()


def mae_db(truth: Tensor, prediction: Tensor, window: DbWindow, weight: Tensor) -> Tensor:
    """Mean absolute difference `[*batch]` [dB] of linear powers `[*batch, row, col]`, both clipped to the window."""
    difference = window_level(truth, window) - window_level(prediction, window)
    return (difference.abs() * weight).sum((-2, -1))


def peak_error(truth: Spectrum, prediction: Spectrum) -> Tensor:
    """Angle `[*batch]` [rad] between the main peaks of both spectra; pi where the prediction has no power at all."""
    empty = ~(prediction.power.amax((-2, -1)) > 0)
    shape = (*empty.shape, 3)
    error = angle_between(peak_direction(truth).expand(shape), peak_direction(prediction).expand(shape))
    return torch.where(empty, torch.full_like(error, math.pi), error)


def peak_direction(spectrum: Spectrum) -> Tensor:
    """World direction `[*batch, 3]` of the main peak; of an empty spectrum the device's forward axis."""
    empty = ~(spectrum.power.amax((-2, -1)) > 0)
    forward = spectrum.pose.world_from_device[..., :, 0]
    if bool(empty.all()):
        return forward
    if not spectrum.pose.batch_shape:
        return main_peak(spectrum)
    direction = forward.clone()
    direction[~empty] = main_peak(spectrum[~empty])
    return direction


def is_distinct(truth: Spectrum, *, lead_db: float = 1.0) -> Tensor:
    """True `[*batch]` where the strongest peak leads the second by at least `lead_db`, at least one lobe apart."""
    distinct = []
    for power in truth.power.reshape(-1, *truth.grid.shape):
        _, value = find_peaks(power, truth.grid, count=2, separation=truth.instrument.lobe)
        lead = math.inf if len(value) < 2 else float(db_from_power(value[0]) - db_from_power(value[1]))
        distinct.append(lead >= lead_db)
    return torch.tensor(distinct, dtype=torch.bool).reshape(truth.pose.batch_shape)


def path_gain_error(truth: Spectrum, prediction: Spectrum) -> Tensor:
    """Absolute difference `[*batch]` [dB] of the path gains (sum of power times solid angle over the beam's own)."""
    return (db_from_power(truth.path_gain) - db_from_power(prediction.path_gain)).abs()


def delay_error(truth: Spectrum, prediction: Spectrum, window: DbWindow) -> Tensor:
    """Mean absolute delay difference `[*batch]` [s] over the directions that a path reaches; NaN when one has no delay.

    A path reaches a direction where the true power is at or above the window's floor. Those directions count by
    `pixel_weight`, not by their power: otherwise the line of sight would be all that is scored.
    """
    if truth.delay is None or prediction.delay is None:
        return torch.full(truth.pose.batch_shape, math.nan)
    difference = (truth.delay.double() - prediction.delay.double()).abs()
    return _over_reached(difference, truth, window).float()


def departure_error(truth: Spectrum, prediction: Spectrum, window: DbWindow) -> Tensor:
    """Mean angle `[*batch]` [rad] between the angles of departure over the directions that a path reaches.

    The same directions and weights as `delay_error`. Where the prediction has no departure direction (a zero vector) 90
    degrees count, what a blind guess would miss by. NaN when one of the spectra has no angles of departure.
    """
    if truth.aod is None or prediction.aod is None:
        return torch.full(truth.pose.batch_shape, math.nan)
    error = angle_between(truth.aod, prediction.aod)
    blank = torch.linalg.vector_norm(prediction.aod, dim=-1) < 1e-6
    return _over_reached(torch.where(blank, torch.full_like(error, NO_DIRECTION), error), truth, window)


def _over_reached(error: Tensor, truth: Spectrum, window: DbWindow) -> Tensor:
    reached = (truth.gain_db >= window.floor_db) * pixel_weight(truth.grid)
    mean = (error * reached).sum((-2, -1)) / reached.sum((-2, -1)).clamp_min(1e-12)
    return torch.where(reached.sum((-2, -1)) > 0, mean, torch.full_like(mean, math.nan))


def delay_spread(spectrum: Spectrum) -> Tensor:
    """RMS delay spread `[*batch]` [s]: the standard deviation of the delay over directions, weighted by their power
    times solid angle. NaN without delays; the spread inside one lobe is not seen.
    """
    if spectrum.delay is None:
        return torch.full(spectrum.pose.batch_shape, math.nan)
    weight = spectrum.power.double() * spectrum.grid.solid_angle
    total = weight.sum((-2, -1)).clamp_min(1e-300)
    delay = spectrum.delay.double()
    mean = (weight * delay).sum((-2, -1)) / total
    return ((weight * (delay - mean[..., None, None]) ** 2).sum((-2, -1)) / total).sqrt().float()


def delay_spread_error(truth: Spectrum, prediction: Spectrum) -> Tensor:
    """Absolute difference `[*batch]` [s] of the RMS delay spreads."""
    return (delay_spread(truth) - delay_spread(prediction)).abs()
