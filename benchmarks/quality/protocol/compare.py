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


def estimate(values: np.ndarray, score: Score, seed: int = 0, *, views: int = 1) -> Estimate:
    """A score of one model `[seed, picture]`; pictures where it does not apply in some seed are left out."""
    good = ~np.isnan(values).any(0)
    if not good.any():
        return NOTHING
    group = _groups(good, views)
    values = values[:, good]
    return _with_interval(score.of(values.reshape(-1)), _resampled((values,), group, score, seed)[0], group)


def difference(model: np.ndarray, baseline: np.ndarray, score: Score, seed: int = 0, *, views: int = 1) -> Difference:
    """A model against another, both `[seed, picture]` with the same seeds and pictures in the same order."""
    if model.shape != baseline.shape:
        raise ValueError(f"both need the same seeds and positions; got {model.shape} and {baseline.shape}")
    good = ~(np.isnan(model) | np.isnan(baseline)).any(0)
    if not good.any() or not len(model):
        return Difference(NOTHING, "unknown", 0, 0)
    group = _groups(good, views)
    model, baseline = model[:, good], baseline[:, good]
    value = score.of(model.reshape(-1)) - score.of(baseline.reshape(-1))
    of_model, of_baseline = _resampled((model, baseline), group, score, seed)
    found = _with_interval(value, of_model - of_baseline, group)
    return Difference(found, _verdict(found, score), int(group.max()) + 1, len(model))


def in_common(cells: Mapping[str, Mapping[int, Mapping[str, np.ndarray]]], names: Sequence[str]) -> list[int]:
    """The seeds for which every one of these models has a cell."""
    return sorted(set.intersection(*(set(cells.get(name, {})) for name in names))) if names else []


def _verdict(found: Estimate, score: Score) -> Verdict:
    if math.isnan(found.low):
        return "unknown"
    if found.low <= 0.0 <= found.high:
        return "same"
    return "better" if (found.high < 0.0) == (score.better == "lower") else "worse"


def _groups(good: np.ndarray, views: int) -> np.ndarray:
    """The number of the position of each picture that is left, counted without gaps."""
    return np.unique(np.flatnonzero(good) // views, return_inverse=True)[1]


def _with_interval(value: float, draws: np.ndarray, group: np.ndarray) -> Estimate:
    if group.max() < 1:
        return Estimate(value, math.nan, math.nan)
    low, high = np.percentile(draws, LEVELS)
    return Estimate(value, float(low), float(high))


def _resampled(values: Sequence[np.ndarray], group: np.ndarray, score: Score, seed: int) -> list[np.ndarray]:
    """The score `[resample]` of each matrix `[seed, picture]`, all under the same resamples of seeds and positions."""
    seeds, positions = len(values[0]), int(group.max()) + 1
    random = np.random.default_rng((seed, seeds, positions))
    rows = random.integers(0, seeds, (RESAMPLES, seeds))
    columns = random.integers(0, positions, (RESAMPLES, positions))
    if score.statistic in ("mean", "within_1"):
        of_rows, of_columns = _counts(rows, seeds), _counts(columns, positions)[:, group]
        of_columns /= of_columns.sum(1, keepdims=True)
        unit = 100.0 if score.statistic == "within_1" else 1.0
        parts = [value <= 1.0 if score.statistic == "within_1" else value for value in values]
        return [unit * np.einsum("rs,sp,rp->r", of_rows, part, of_columns, optimize=True) for part in parts]
    if len(group) == positions:
        return [score.over(value[rows[:, :, None], columns[:, None]].reshape(RESAMPLES, -1)) for value in values]
    members = [np.flatnonzero(group == position) for position in range(positions)]
    index = [np.concatenate([members[position] for position in drawn]) for drawn in columns]
    return [
        np.array([score.over(value[row][:, some].reshape(-1)) for row, some in zip(rows, index, strict=True)])
        for value in values
    ]


def _counts(index: np.ndarray, size: int) -> np.ndarray:
    """How large a share `[resample, size]` of each resample every entry is."""
    counts = np.zeros((len(index), size))
    np.add.at(counts, (np.arange(len(index))[:, None], index), 1.0 / index.shape[1])
    return counts
