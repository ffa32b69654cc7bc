"""The scores of a table: which per-position value, which statistic, which unit, and which direction is better."""

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np

Statistic = Literal["mean", "median", "p90", "within_1"]


@dataclass(frozen=True)
class Score:
    """One row of the table."""

    key: str
    """Unique name."""
    label: str
    """Name for people."""
    unit: str
    """Unit of the shown number; empty for a pure number."""
    better: Literal["lower", "higher"]
    """Which way is good."""
    column: str
    """The per-position values that it sums up."""
    statistic: Statistic
    """How it sums them up; "within_1" is the share [%] of values of at most 1."""
    digits: int
    """Decimals shown."""
    meaning: str
    """One sentence for the report."""

    def of(self, values: np.ndarray) -> float:
        """The statistic of per-position values, ignoring NaN; NaN when nothing is left."""
        values = values[~np.isnan(values)]
        return float(self.over(values)) if len(values) else math.nan

    def over(self, values: np.ndarray) -> np.ndarray:
        """The statistic `[*batch]` over the last axis of `[*batch, n]`, which has no NaN."""
        if self.statistic == "median":
            return np.median(values, -1)
        if self.statistic == "p90":
            return np.percentile(values, 90, -1)
        return 100.0 * np.mean(values <= 1.0, -1) if self.statistic == "within_1" else np.mean(values, -1)

    def text(self, value: float) -> str:
        """The number as shown, or "n/a"."""
        return "n/a" if math.isnan(value) else f"{value:.{self.digits}f}"


_PEAK = "angle between the strongest predicted and the strongest true direction"
_DISTINCT = "the same on views whose strongest true peak leads the second by at least 1 dB"

SCORES = (
    Score("peak_median", "Main peak (median)", "deg", "lower", "peak_deg", "median", 2, f"Median {_PEAK}."),
    Score("peak_p90", "Main peak (P90)", "deg", "lower", "peak_deg", "p90", 1, f"90th percentile of the {_PEAK}."),
    Score("peak_within_1", "Main peak within 1 deg", "%", "higher", "peak_deg", "within_1", 0, "Share of positions."),
    Score(
        "distinct_median",
        "Distinct peak (median)",
        "deg",
        "lower",
        "distinct_deg",
        "median",
        2,
        f"Median: {_DISTINCT}.",
    ),
    Score("distinct_p90", "Distinct peak (P90)", "deg", "lower", "distinct_deg", "p90", 1, f"P90: {_DISTINCT}."),
    Score("distinct_within_1", "Distinct peak within 1 deg", "%", "higher", "distinct_deg", "within_1", 0, "Share."),
    Score(
        *("beam_loss_peak", "Beam loss (steered to peak)", "dB", "lower", "beam_loss_peak_db", "mean", 2),
        "Power lost by a beam steered to the predicted main peak instead of the true one, on the true covariance.",
    ),
    Score(
        *("beam_loss_eigen", "Beam loss (eigenbeam)", "dB", "lower", "beam_loss_eigen_db", "mean", 2),
        "Power lost by the principal eigenvector of the predicted covariance on the true one, mean of the panels.",
    ),
    Score(
        *("rmse_db", "RMSE in the window", "dB", "lower", "rmse_db", "mean", 2),
        "Root mean square level error, both levels clipped to the window; mean over positions.",
    ),
    Score(
        *("mae_db", "MAE in the window", "dB", "lower", "mae_db", "mean", 2),
        "Mean absolute level error, both levels clipped to the window.",
    ),
    Score(
        *("path_gain", "Path gain", "dB", "lower", "path_gain_db", "mean", 2),
        "Absolute error of the total received power.",
    ),
    Score(
        *("delay", "Delay", "ns", "lower", "delay_ns", "mean", 2),
        "Mean absolute delay error over the directions whose true power is above the window's floor.",
    ),
    Score(
        *("departure", "Angle of departure", "deg", "lower", "departure_deg", "mean", 1),
        "Mean angle between the departure directions, over the same directions as the delay.",
    ),
    Score(
        *("delay_spread", "RMS delay spread", "ns", "lower", "delay_spread_ns", "mean", 2),
        "Absolute error of the power-weighted standard deviation of the delay.",
    ),
    Score(
        *("wasserstein", "Angular Wasserstein", "deg", "lower", "wasserstein_deg", "mean", 2),
        "How far power must move over the sphere, on average, to make the predicted spectrum the true one's shape.",
    ),
    Score(
        *("psnr", "PSNR", "dB", "higher", "psnr_db", "mean", 2),
        "Of the window's picture, pixels weighted by solid angle on a sphere.",
    ),
    Score(
        *("ssim", "SSIM", "", "higher", "ssim", "mean", 3),
        "11 x 11 Gaussian window on the window's picture, weighted by solid angle on a sphere.",
    ),
    Score(
        *("flip", "FLIP", "", "lower", "flip", "mean", 3),
        "Difference of the window's pictures to an eye that flips between them, weighted by solid angle on a sphere.",
    ),
    Score(
        *("lpips", "LPIPS", "", "lower", "lpips", "mean", 3),
        "On the window's picture; needs the network's and the heads' weights from the user (RF3DGS_LPIPS).",
    ),
)
SCORE = {score.key: score for score in SCORES}
