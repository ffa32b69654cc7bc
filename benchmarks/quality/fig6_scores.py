"""Scores of figure 6: how near levels are to a finer truth that was solved twice, so that its own noise is known."""

import math

import numpy as np
import torch
from torch import Tensor

from rf3dgs.core.grids import DirectionGrid
from rf3dgs.evaluation import metrics
from rf3dgs.spectra.codec import DbWindow

RESAMPLES = 2000
COLUMNS = {
    "psnr_db": ("PSNR [dB]", 2),
    "ssim": ("SSIM", 3),
    "rmse_db": ("RMSE [dB]", 2),
    "coarse_db": ("coarse RMSE [dB]", 2),
    "detail_db": ("detail RMSE [dB]", 2),
    "detail_match": ("detail match", 3),
    "sharpness": ("sharpness [dB/pixel]", 2),
}
HIGHER = ("psnr_db", "ssim", "detail_match")  # better when higher


def detail_of(level: Tensor, sigma: float) -> tuple[Tensor, Tensor]:
    """Levels `[n, row, col]` [dB] smoothed by a Gaussian of `sigma` [pixel], edges repeated, and what that removes."""
    reach = max(1, math.ceil(3.0 * sigma))
    kernel = torch.exp(-0.5 * (torch.arange(-reach, reach + 1, dtype=torch.float64) / sigma) ** 2)
    kernel = kernel / kernel.sum()
    picture = torch.nn.functional.pad(level.double()[:, None], (reach,) * 4, mode="replicate")
    picture = torch.nn.functional.conv2d(picture, kernel[None, None, :, None])
    smooth = torch.nn.functional.conv2d(picture, kernel[None, None, None, :])[:, 0]
    return smooth, level.double() - smooth


def blur_of(grid: DirectionGrid, lobe: float) -> float:
    """Standard deviation [pixel] of a Gaussian as wide as `lobe` [rad] in the middle of a pinhole."""
    assert grid.K is not None
    return float(grid.K[0, 0]) * lobe / math.sqrt(8.0 * math.log(2.0))


def scores(
    solves: tuple[Tensor, Tensor], answer: Tensor, grid: DirectionGrid, window: DbWindow, lobe: float
) -> dict[str, np.ndarray]:
    """Scores `[n]` of powers `[n, row, col]`, linear, against two `solves` of the truth; levels clipped to the window.

    The truth is the mean level of the solves. Half their difference has as much noise as that mean: its square is taken
    off every square, which makes them unbiased for an answer that shares no ray with the solves. "coarse" is what a
    Gaussian as wide as the training `lobe` [rad] leaves of the levels, "detail" what it removes. SSIM alone
    compares with the truth as it is, noise and all. "detail_match" `[n, 3]` are squares that `statistic`
    divides when it has summed them over the positions; "sharpness" [dB/pixel] is the answer's own RMS gradient.
    """
    sigma = blur_of(grid, lobe)
    first, second, level = (metrics.window_level(power, window).double() for power in (*solves, answer))
    truth, noise = 0.5 * (first + second), 0.5 * (first - second)
    (_, detail), (gap, gap_detail), (noise_smooth, noise_detail) = (
        detail_of(part, sigma) for part in (truth, level - truth, noise)
    )
    own = detail + gap_detail
    rmse = _root(_power(level - truth) - _power(noise))
    found = {
        "psnr_db": (20.0 * torch.log10(window.span_db / rmse.clamp_min(1e-30))).clamp_max(metrics.PERFECT_PSNR_DB),
        "ssim": metrics.ssim(*((part - window.floor_db) / window.span_db for part in (truth, level)), grid),
        "rmse_db": rmse,
        "coarse_db": _root(_power(gap) - _power(noise_smooth)),
        "detail_db": _root(_power(gap_detail) - _power(noise_detail)),
        "detail_match": torch.stack(
            ((own * detail).mean((-2, -1)), _power(own), _power(detail) - _power(noise_detail)), -1
        ),
        "sharpness": _slope(level).sqrt(),
    }
    return {name: value.double().numpy() for name, value in found.items()}


def truth_of(solves: tuple[Tensor, Tensor], grid: DirectionGrid, window: DbWindow, lobe: float) -> dict[str, float]:
    """What the truth of two solves has: RMS of its "detail" and of its "noise" [dB], "sharpness" [dB/pixel].

    Detail and sharpness are without the noise, 0 where they drown in it.
    """
    first, second = (metrics.window_level(power, window).double() for power in solves)
    truth, noise = 0.5 * (first + second), 0.5 * (first - second)
    detail = scores(solves, solves[1], grid, window, lobe)["detail_match"][:, 2].mean()
    slope = float((_slope(truth) - _slope(noise)).mean())
    squares = {"detail": float(detail), "noise": float(_power(noise).mean()), "sharpness": slope}
    return {name: math.sqrt(max(0.0, value)) for name, value in squares.items()}


def _power(level: Tensor) -> Tensor:
    """Mean square `[n]` of `[n, row, col]`."""
    return level.square().mean((-2, -1))


def _root(square: Tensor) -> Tensor:
    return square.clamp_min(0.0).sqrt()


def _slope(level: Tensor) -> Tensor:
    """Mean squared gradient `[n]` of levels `[n, row, col]` [dB per pixel]."""
    across, down = level[:, :-1, 1:] - level[:, :-1, :-1], level[:, 1:, :-1] - level[:, :-1, :-1]
    return (across.square() + down.square()).mean((-2, -1))


def statistic(name: str, values: np.ndarray) -> np.ndarray:
    """What a table shows `[*batch]` of a score's values `[*batch, n]`: their mean.

    Of "detail_match" `[*batch, n, 3]`, covariance and both variances, the correlation over all positions.
    """
    if name != "detail_match":
        return values.mean(-1)
    common, own, true = np.moveaxis(values.mean(-2), -1, 0)
    return common / np.sqrt(np.maximum(own * true, 1e-24))


def drawn(count: int, seed: int = 0) -> np.ndarray:
    """Positions `[RESAMPLES, count]` of the bootstrap."""
    return np.random.default_rng(seed).integers(count, size=(RESAMPLES, count))


def interval(name: str, values: np.ndarray) -> tuple[float, float, float]:
    """The statistic of a score over the positions, and its 95 % bootstrap interval."""
    low, high = np.percentile(statistic(name, values[drawn(len(values))]), (2.5, 97.5))
    return float(statistic(name, values)), float(low), float(high)


def verdict(name: str, ours: np.ndarray, theirs: np.ndarray) -> str:
    """Whether the first is "nearer" to the finer truth than the second by a score, "farther", or "same".

    Positions are resampled in pairs; the 95 % interval of the difference must leave out zero.
    """
    places = drawn(len(ours))
    mine, other = (statistic(name, values[places]) for values in (ours, theirs))
    gain = mine - other if name in HIGHER else other - mine
    low, high = np.percentile(gain, (2.5, 97.5))
    return "nearer" if low > 0 else "farther" if high < 0 else "same"
