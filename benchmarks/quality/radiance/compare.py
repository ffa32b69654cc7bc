"""What can be said about two models from the same positions: paired differences, resampled over positions and seeds.

Scores of one cell of the table are matrices `[seed, position]`: every seed drew its own training positions and was
judged by the same held-out ones. Errors at one position are alike across seeds, and errors of one seed across
positions, so both are resampled with replacement, each as a whole (a two-way cluster bootstrap). That is on the safe
side: it counts the noise of a single score twice. With one seed positions alone are resampled, and what is said holds
for those training positions. Intervals cover 95 %; nothing is corrected for there being many of them.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from rf3dgs.evaluation.scores import SCORE, Score
from rf3dgs.evaluation.table import Estimate

RESAMPLES = 2000
LEVELS = (2.5, 97.5)
Verdict = Literal["better", "worse", "same", "unknown"]

PEAK_MEAN = Score("peak_mean", "Main peak (mean)", "deg", "lower", "peak_deg", "mean", 2, "Mean of that angle.")
ROWS: tuple[Score, ...] = (
    SCORE["peak_median"],
    PEAK_MEAN,
    SCORE["peak_p90"],
    SCORE["peak_within_1"],
    SCORE["distinct_within_1"],
    SCORE["beam_loss_peak"],
    SCORE["beam_loss_eigen"],
    SCORE["path_gain"],
    SCORE["rmse_db"],
    SCORE["mae_db"],
    SCORE["delay"],
    SCORE["departure"],
    SCORE["delay_spread"],
)
"""The rows of the table."""
MUST_WIN = (PEAK_MEAN, SCORE["beam_loss_peak"], SCORE["beam_loss_eigen"], SCORE["path_gain"])
MUST_NOT_LOSE = (SCORE["rmse_db"], SCORE["mae_db"], SCORE["delay"], SCORE["departure"])
"""What verdicts are about: means, so that a difference of scores is the mean of paired differences."""


@dataclass(frozen=True)
class Difference:
    """A model's score minus a baseline's, with its interval, over so many positions and seeds in common."""

    estimate: Estimate
    verdict: Verdict
    positions: int
    seeds: int


NOTHING = Estimate(math.nan, math.nan, math.nan)


def estimate(values: np.ndarray, score: Score, seed: int = 0) -> Estimate:
    """A score of one model `[seed, position]`; positions where it does not apply in some seed are left out."""
    values = values[:, ~np.isnan(values).any(0)]
    if not values.size:
        return NOTHING
    return _with_interval(score.of(values.reshape(-1)), _resampled((values,), score, seed)[0], values.shape)


def difference(model: np.ndarray, baseline: np.ndarray, score: Score, seed: int = 0) -> Difference:
    """A model against a baseline, both `[seed, position]` with the same seeds and positions in the same order."""
    if model.shape != baseline.shape:
        raise ValueError(f"both need the same seeds and positions; got {model.shape} and {baseline.shape}")
    good = ~(np.isnan(model) | np.isnan(baseline)).any(0)
    model, baseline = model[:, good], baseline[:, good]
    if not model.size:
        return Difference(NOTHING, "unknown", 0, 0)
    value = score.of(model.reshape(-1)) - score.of(baseline.reshape(-1))
    of_model, of_baseline = _resampled((model, baseline), score, seed)
    found = _with_interval(value, of_model - of_baseline, model.shape)
    return Difference(found, _verdict(found, score), model.shape[1], model.shape[0])


def in_common(cells: Mapping[str, Mapping[int, Mapping[str, np.ndarray]]], names: Sequence[str]) -> list[int]:
    """The seeds for which every one of these models has a cell."""
    return sorted(set.intersection(*(set(cells.get(name, {})) for name in names))) if names else []


def _verdict(found: Estimate, score: Score) -> Verdict:
    if math.isnan(found.low):
        return "unknown"
    if found.low <= 0.0 <= found.high:
        return "same"
    return "better" if (found.high < 0.0) == (score.better == "lower") else "worse"


def _with_interval(value: float, draws: np.ndarray, shape: tuple[int, ...]) -> Estimate:
    if shape[1] < 2:
        return Estimate(value, math.nan, math.nan)
    low, high = np.percentile(draws, LEVELS)
    return Estimate(value, float(low), float(high))


def _resampled(values: Sequence[np.ndarray], score: Score, seed: int) -> list[np.ndarray]:
    """The score `[resample]` of each matrix `[seed, position]`, all under the same resamples."""
    seeds, positions = values[0].shape
    random = np.random.default_rng((seed, seeds, positions))
    rows = random.integers(0, seeds, (RESAMPLES, seeds))
    columns = random.integers(0, positions, (RESAMPLES, positions))
    if score.statistic in ("mean", "within_1"):
        of_rows, of_columns = _counts(rows, seeds), _counts(columns, positions)
        unit = 100.0 if score.statistic == "within_1" else 1.0
        parts = [value <= 1.0 if score.statistic == "within_1" else value for value in values]
        return [unit * np.einsum("rs,sp,rp->r", of_rows, part, of_columns, optimize=True) for part in parts]
    return [score.over(value[rows[:, :, None], columns[:, None]].reshape(RESAMPLES, -1)) for value in values]


def _counts(index: np.ndarray, size: int) -> np.ndarray:
    """How large a share `[resample, size]` of each resample every entry is."""
    counts = np.zeros((len(index), size))
    np.add.at(counts, (np.arange(len(index))[:, None], index), 1.0 / index.shape[1])
    return counts
