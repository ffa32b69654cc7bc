"""What is asked of a model, checked: to beat every baseline, and to reach the targets at 40 positions."""

import math
from collections.abc import Iterator
from dataclasses import dataclass

from benchmarks.quality.protocol.compare import MUST_NOT_LOSE, MUST_WIN
from benchmarks.quality.protocol.results import Place, Results
from rf3dgs.evaluation.scores import SCORE, Score
from rf3dgs.evaluation.table import Estimate

AT = 40
"""Training positions at which the targets hold."""
REGION_FACTOR = 1.5
"""In an unseen region errors may be this many times larger."""


@dataclass(frozen=True)
class Target:
    """An error of at most `most`, in an unseen region of at most `region` (else `most` times the factor)."""

    score: Score
    most: float
    region: float | None = None

    def limit(self, holdout: str) -> float:
        return self.most if holdout == "random" else self.region or REGION_FACTOR * self.most


TARGETS = (
    Target(SCORE["peak_median"], 0.5),
    Target(SCORE["beam_loss_eigen"], 0.4),
    Target(SCORE["path_gain"], 0.6),
    Target(SCORE["delay"], 4.0),
    Target(SCORE["departure"], 14.0, 20.0),
)
WITHIN = 95.0
"""Percent of distinct peaks within 1 degree; in a region the others may be 1.5 times as many."""
NOISE_FACTOR = {"mesh": 1.2}
"""How many times the difference of two solves the RMSE may be; 1.35 for geometry from photographs."""


@dataclass(frozen=True)
class Check:
    """One line: which demand (1 or 2), where, what came out, and whether it is met."""

    demand: int
    place: Place
    passed: bool
    text: str

    def line(self) -> str:
        where = f"{self.place.preset} {self.place.holdout} {self.place.count}"
        return f"{'pass' if self.passed else 'FAIL'} {self.demand} {where:24} {self.text}"


def checks(results: Results, subject: str) -> list[Check]:
    """Every check of one model over all places of a run."""
    places = results.places
    found = [check for place in places for check in beats_baselines(results, place, subject)]
    return found + [check for place in places if place.count == AT for check in reaches(results, place, subject)]


def beats_baselines(results: Results, place: Place, subject: str) -> Iterator[Check]:
    """Better than every baseline in mean peak error, both beam losses and path gain, and worse in nothing else."""
    short = [seed for seed in results.wanted if seed not in results.seeds(place, subject)]
    if short:
        yield Check(1, place, False, f"{subject}: no cell for seed {', '.join(map(str, short))}")
    for scores, wanted in ((MUST_WIN, ("better",)), (MUST_NOT_LOSE, ("better", "same"))):
        for score in scores:
            verdicts = {name: results.verdict(place, subject, name, score) for name in results.baselines(subject)}
            wrong = [f"{name} ({verdict})" for name, verdict in verdicts.items() if verdict not in wanted]
            demand = "better than" if wanted == ("better",) else "safe from"
            text = f"not {demand} {', '.join(wrong)}" if wrong else f"{demand} {', '.join(verdicts) or 'nothing'}"
            yield Check(1, place, bool(verdicts) and not wrong, f"{score.label}: {text}")


def reaches(results: Results, place: Place, subject: str) -> Iterator[Check]:
    """The targets at 40 positions."""
    for target in TARGETS:
        limit = target.limit(place.holdout)
        yield _at_most(place, target.score, results.estimate(place, subject, target.score), limit)
    score, found = SCORE["distinct_within_1"], results.estimate(place, subject, SCORE["distinct_within_1"])
    least = WITHIN if place.holdout == "random" else 100.0 - REGION_FACTOR * (100.0 - WITHIN)
    passed = found is not None and found.value >= least
    yield Check(2, place, passed, f"{score.label}: {_number(found, score)} % >= {least:g} %")
    yield _noise(results, place, subject)


def _noise(results: Results, place: Place, subject: str) -> Check:
    score = SCORE["rmse_db"]
    found, noise = results.estimate(place, subject, score), results.second(place, score)
    factor = NOISE_FACTOR.get(results.geometry, 1.35) * (1.0 if place.holdout == "random" else REGION_FACTOR)
    if noise is None or math.isnan(noise.value):
        return Check(2, place, False, f"{score.label}: no second solve to compare with")
    text = f"{score.label}: {_number(found, score)} dB <= {factor:g} x {noise.value:.2f} dB of two solves"
    return Check(2, place, found is not None and found.value <= factor * noise.value, text)


def _at_most(place: Place, score: Score, found: Estimate | None, limit: float) -> Check:
    passed = found is not None and found.value <= limit
    return Check(2, place, passed, f"{score.label}: {_number(found, score)} <= {limit:g} {score.unit}")


def _number(found: Estimate | None, score: Score) -> str:
    if found is None or math.isnan(found.value):
        return "missing"
    return f"{score.text(found.value)} [{score.text(found.low)}, {score.text(found.high)}]"
