"""Laws of the statistics, on scores whose truth is known: what was planted is found, equals are not told apart."""

import math

import numpy as np
import pytest
from benchmarks.quality.protocol import compare
from benchmarks.quality.protocol.compare import MUST_WIN, PEAK_MEAN, difference, estimate, in_common

from rf3dgs.evaluation.scores import SCORE

LOSS = SCORE["beam_loss_eigen"]


def scores(seed: int, *, seeds: int = 3, positions: int = 100, gain: float = 0.0, of_seed: float = 0.0) -> np.ndarray:
    """Errors that share what is hard about a position, `of_seed` being how far training sets scatter."""
    shared = np.random.default_rng(0).gamma(2.0, 1.0, positions)
    random = np.random.default_rng(seed)
    return shared + random.normal(0, 0.5, (seeds, positions)) + random.normal(0, of_seed, (seeds, 1)) - gain


def test_a_planted_improvement_is_found_although_positions_scatter_much_more():
    worse, better = scores(1), scores(2, gain=0.3)
    found = difference(better, worse, LOSS)
    assert found.verdict == "better"
    assert found.estimate.low < -0.3 < found.estimate.high
    assert worse.std() > 4 * 0.3
    assert difference(worse, better, LOSS).verdict == "worse"


def test_a_share_is_better_where_it_is_higher():
    near, far = np.full((3, 40), 0.5), np.full((3, 40), 0.5)
    far[:, ::4] = 5.0
    found = difference(near, far, SCORE["peak_within_1"])
    assert found.verdict == "better"
    assert found.estimate.value == pytest.approx(25.0)


def test_equal_methods_are_told_apart_no_oftener_than_the_level_says(monkeypatch):
    monkeypatch.setattr(compare, "RESAMPLES", 500)
    # 200 pairs of equal methods; the two-way bootstrap is on the safe side, so 5 % is an upper bound. With p = 0.05
    # more than 20 of 200 come by chance in 0.1 % of runs.
    told = [difference(scores(2 * k), scores(2 * k + 1), LOSS).verdict != "same" for k in range(200)]
    assert sum(told) <= 20


def test_an_improvement_that_one_lucky_seed_makes_is_not_significant():
    baseline = scores(1, positions=400)
    model = baseline.copy()
    model[1] -= 1.0
    assert difference(model[1:2], baseline[1:2], LOSS).verdict == "better"
    assert difference(model, baseline, LOSS).verdict == "same"


def test_the_interval_of_a_mean_covers_the_truth_about_as_often_as_it_says(monkeypatch):
    monkeypatch.setattr(compare, "RESAMPLES", 500)
    inside = 0
    for k in range(200):
        values = np.random.default_rng(k).normal(1.0, 1.0, (1, 100))
        found = estimate(values, LOSS)
        inside += found.low <= 1.0 <= found.high
    assert 180 <= inside <= 199  # 190 expected; 180 is 3.2 standard deviations below


def test_identical_scores_differ_by_nothing():
    found = difference(scores(3), scores(3), PEAK_MEAN)
    assert (found.estimate.value, found.estimate.low, found.estimate.high) == (0.0, 0.0, 0.0)
    assert found.verdict == "same"


def test_the_mean_of_resamples_is_the_mean_of_the_scores():
    values = scores(4)
    found = estimate(values, PEAK_MEAN)
    assert found.value == pytest.approx(values.mean())
    assert found.low < found.value < found.high


@pytest.mark.parametrize("key", ["peak_median", "peak_p90"])
def test_the_fast_way_of_means_agrees_with_gathering_every_resample(key):
    # The median goes through the gathered resamples, the mean through counts. Symmetric scores have both at one place:
    # the intervals of median and mean overlap, and the median's is the wider one (by sqrt(pi / 2) for a normal law).
    values = np.random.default_rng(5).normal(0, 1, (1, 200))
    mean, other = estimate(values, PEAK_MEAN), estimate(values, SCORE[key])
    assert other.low < other.value < other.high
    if key == "peak_median":
        assert max(mean.low, other.low) < min(mean.high, other.high)
        assert other.high - other.low > mean.high - mean.low


def test_positions_without_a_score_are_left_out_in_pairs():
    model, baseline = scores(1), scores(2)
    model[0, 3] = math.nan
    baseline[2, 5] = math.nan
    found = difference(model, baseline, LOSS)
    assert found.positions == 98
    keep = [k for k in range(100) if k not in (3, 5)]
    assert found.estimate.value == pytest.approx(model[:, keep].mean() - baseline[:, keep].mean())


def test_nothing_to_compare_is_unknown():
    empty = np.full((2, 4), math.nan)
    assert difference(empty, empty, LOSS).verdict == "unknown"
    assert math.isnan(estimate(empty, LOSS).value)
    assert difference(np.ones((1, 1)), np.zeros((1, 1)), LOSS).verdict == "unknown"


def test_other_positions_are_refused():
    with pytest.raises(ValueError, match="same seeds and positions"):
        difference(np.ones((1, 4)), np.ones((1, 5)), LOSS)


def test_verdicts_are_about_means_or_shares():
    assert {score.statistic for score in MUST_WIN} == {"mean"}


def test_seeds_in_common_are_those_that_every_model_has():
    cells = {"a": {0: {}, 1: {}, 2: {}}, "b": {1: {}, 2: {}}}
    assert in_common(cells, ["a", "b"]) == [1, 2]
    assert in_common(cells, ["a", "c"]) == []
