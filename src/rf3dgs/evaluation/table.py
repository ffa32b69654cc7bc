"""`Evaluation`: methods x metrics with every position's value kept, and what can honestly be said about them."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from rf3dgs.core.errors import InputError
from rf3dgs.evaluation.scores import SCORE, SCORES, Score

FIELD = "field"
CEILING = "second solve"
RESAMPLES = 1000


@dataclass(frozen=True)
class Estimate:
    """A statistic and its 95 % bootstrap interval over positions."""

    value: float
    low: float
    high: float


@dataclass(frozen=True)
class Comparison:
    """The field against one baseline on one score."""

    score: Score
    baseline: str
    field_value: float
    baseline_value: float
    clear: bool
    """True when the paired bootstrap of the difference keeps its sign in 95 % of the resamples."""

    @property
    def is_win(self) -> bool:
        """True when the field's number is the better one."""
        gap = self.field_value - self.baseline_value
        return gap > 0 if self.score.better == "higher" else gap < 0

    @property
    def is_tie(self) -> bool:
        """True when both numbers are equal as shown."""
        return self.score.text(self.field_value) == self.score.text(self.baseline_value)

    def sentence(self) -> str:
        """For people: who is ahead on what, by which numbers."""
        verb = "equals" if self.is_tie else "beats" if self.is_win else "loses to"
        unit = f" {self.score.unit}" if self.score.unit else ""
        doubt = "" if self.clear or self.is_tie else ", within the uncertainty of these positions"
        numbers = f"{self.score.text(self.field_value)} against {self.score.text(self.baseline_value)}{unit}"
        return f"{self.score.label}: the field {verb} {self.baseline} ({numbers}{doubt})."


@dataclass(frozen=True, eq=False)
class Evaluation:
    """Per-position values of every method on one hold-out.

    holdout: its name. values: method -> column -> `[n]`, NaN where a value does not apply; "field" is the predictor,
    "nearest" and "inverse distance" the baselines, "second solve" the ceiling. positions `[n, 3]` [m]. window: floor
    and ceiling [dB]. seed: of the bootstrap.
    """

    holdout: str
    values: Mapping[str, Mapping[str, np.ndarray]]
    positions: np.ndarray
    window: tuple[float, float]
    seed: int = 0

    def __len__(self) -> int:
        return len(self.positions)

    @property
    def methods(self) -> tuple[str, ...]:
        return tuple(self.values)

    @property
    def baselines(self) -> tuple[str, ...]:
        """The methods that the field must beat."""
        return tuple(name for name in self.values if name not in (FIELD, CEILING))

    def _resamples(self, count: int) -> np.ndarray:
        """Indices `[resample, count]` of a bootstrap, the same for all methods, so that differences are paired."""
        return np.random.default_rng((self.seed, count)).integers(0, count, (RESAMPLES, count))

    def column(self, method: str, column: str) -> np.ndarray:
        """The per-position values `[n]` of one method."""
        if method not in self.values:
            raise InputError(f"there is no method {method!r}; this evaluation has {', '.join(self.methods)}")
        return self.values[method][column]

    def value(self, method: str, key: str) -> float:
        """One number of the table; NaN when not available."""
        score = SCORE[key]
        return score.of(self.column(method, score.column))

    def estimate(self, method: str, key: str) -> Estimate:
        """One number with its 95 % bootstrap interval; the interval is NaN with fewer than two positions."""
        score = SCORE[key]
        values = self.column(method, score.column)
        values = values[~np.isnan(values)]
        if len(values) < 2:
            return Estimate(score.of(values), math.nan, math.nan)
        draws = score.over(values[self._resamples(len(values))])
        low, high = np.percentile(draws, (2.5, 97.5))
        return Estimate(score.of(values), float(low), float(high))

    def best(self, key: str) -> tuple[str, ...]:
        """The methods with the best number as shown, the ceiling left out; none when all show the same."""
        score = SCORE[key]
        values = {name: self.value(name, key) for name in (FIELD, *self.baselines)}
        values = {name: value for name, value in values.items() if not math.isnan(value)}
        if len({score.text(value) for value in values.values()}) < 2:
            return ()
        top = max(values.values()) if score.better == "higher" else min(values.values())
        return tuple(name for name, value in values.items() if score.text(value) == score.text(top))

    @cached_property
    def comparisons(self) -> tuple[Comparison, ...]:
        """The field against every baseline on every score that both have."""
        return tuple(
            comparison
            for score in SCORES
            for baseline in self.baselines
            if (comparison := self._compare(score, baseline)) is not None
        )

    def _compare(self, score: Score, baseline: str) -> Comparison | None:
        field, other = self.column(FIELD, score.column), self.column(baseline, score.column)
        both = ~np.isnan(field) & ~np.isnan(other)
        if not both.any():
            return None
        index = self._resamples(int(both.sum()))
        low, high = np.percentile(score.over(field[both][index]) - score.over(other[both][index]), (2.5, 97.5))
        clear = bool(both.sum() > 1 and (low > 0 or high < 0))
        return Comparison(score, baseline, score.of(field), score.of(other), clear)

    @property
    def wins(self) -> tuple[Comparison, ...]:
        """Where the field's number is better than a baseline's."""
        return tuple(item for item in self.comparisons if item.is_win and not item.is_tie)

    @property
    def losses(self) -> tuple[Comparison, ...]:
        """Where the field's number is worse than a baseline's."""
        return tuple(item for item in self.comparisons if not item.is_win and not item.is_tie)

    def summary(self) -> str:
        """One honest sentence: on how many scores the field is ahead of every baseline, and where it is not."""
        if not self.comparisons:
            return f"{self.holdout}: {len(self)} positions, no baseline to compare with."
        keys = list(dict.fromkeys(item.score.key for item in self.comparisons))
        lost = list(dict.fromkeys(item.score.label for item in self.losses))
        tied = [SCORE[key].label for key in keys if SCORE[key].label not in lost and self._tied(key)]
        ahead = len(keys) - len(lost) - len(tied)
        text = f"{self.holdout}: at {len(self)} positions the field is ahead of every baseline "
        text += f"on {ahead} of {len(keys)} scores"
        text += f"; it loses on {_listed(lost)}" if lost else "; it loses on none"
        return text + (f"; it ties on {_listed(tied)}." if tied else ".")

    def _tied(self, key: str) -> bool:
        return any(item.is_tie for item in self.comparisons if item.score.key == key)

    def as_dict(self) -> dict:
        """Plain values for JSON: the table with intervals and every position's values (None for NaN)."""
        table = {}
        for name in self.methods:
            rows = {score.key: self.estimate(name, score.key) for score in SCORES}
            table[name] = {key: {k: _plain(v) for k, v in vars(row).items()} for key, row in rows.items()}
        columns = {n: {c: [_plain(v) for v in values] for c, values in m.items()} for n, m in self.values.items()}
        return {
            "holdout": self.holdout,
            "window_db": list(self.window),
            "positions_m": self.positions.tolist(),
            "table": table,
            "values": columns,
        }

    def __str__(self) -> str:
        return format_table({self.holdout: self})


def format_table(evaluations: Mapping[str, Evaluation]) -> str:
    """The tables for a terminal, at most 80 columns; `*` marks the best, the second solve is the ceiling."""
    short = {FIELD: "field", "nearest": "nearest", "inverse distance": "inv.dist.", CEILING: "2nd solve"}
    lines: list[str] = []
    for name, evaluation in evaluations.items():
        shown = [method for method in evaluation.methods][:4]
        lines += [] if not lines else [""]
        lines.append(f"Hold-out: {name} ({len(evaluation)} positions)"[:80])
        lines.append(f"{'':34}{'best':>6}" + "".join(f"{short.get(method, method)[:9]:>10}" for method in shown))
        for score in SCORES:
            best = evaluation.best(score.key)
            label = f"{score.label} [{score.unit}]" if score.unit else score.label
            line = f"{label[:34]:34}{'low' if score.better == 'lower' else 'high':>6}"
            for method in shown:
                text = score.text(evaluation.value(method, score.key))
                line += f"{text + ('*' if method in best else ' '):>10}"
            lines.append(line.rstrip())
        lines.append("")
        lines += _wrapped(evaluation.summary())
    return "\n".join(lines)


def _listed(names: list[str]) -> str:
    return ", ".join(name[0].lower() + name[1:] if name[1:2].islower() else name for name in names)


def _wrapped(text: str, width: int = 80) -> list[str]:
    import textwrap

    return textwrap.wrap(text, width)


def _plain(value: float) -> float | None:
    return None if math.isnan(value) else float(value)
