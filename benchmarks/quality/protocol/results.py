"""The cells of a run put together: scores of every model in every cell, and what they cost.

Two models of one place and seed are refused where they were trained on or judged by other views.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from benchmarks.quality.protocol.cells import Key, Values, values_of
from benchmarks.quality.protocol.compare import Difference, difference, estimate, in_common
from rf3dgs.core.errors import DataError
from rf3dgs.evaluation.scores import Score
from rf3dgs.evaluation.table import Estimate

LOOKUPS = ("nearest", "idw4", "idw8")
"""What every model is judged against."""


@dataclass(frozen=True, order=True)
class Place:
    """A cell of the table apart from model and seed."""

    scene: str
    preset: str
    holdout: str
    count: int
    draw: str = "uniform"


@dataclass(eq=False)
class Results:
    """What was read: scores by place, model and seed, second solves by place without a count, and facts of cells.

    models: in the order of the columns. judge and geometry: of all of them. wanted: the seeds that were asked for.
    against: the models that others are judged against.
    """

    models: Sequence[str]
    judge: str
    geometry: str
    wanted: Sequence[int]
    against: Sequence[str] = (*LOOKUPS, "paper")
    values: dict[Place, dict[str, dict[int, Values]]] = field(default_factory=dict)
    seconds: dict[tuple[str, str, str], Values] = field(default_factory=dict)
    facts: list[dict[str, Any]] = field(default_factory=list)
    views: int = 1
    saw: dict[tuple[Place, int], tuple[str, Any]] = field(default_factory=dict)

    def add(self, key: Key, cell: Mapping[str, Any]) -> None:
        place = Place(key.scene, key.preset, key.holdout, key.count, key.draw)
        first, seen = self.saw.setdefault((place, key.seed), (key.model, cell["saw"]))
        if seen != cell["saw"]:
            raise DataError(
                f"{key.model} and {first} saw other views ({key.holdout}, {key.count} positions, seed {key.seed}), so "
                "they cannot be compared; make both cells anew"
            )
        self.views = cell["views"]
        self.values.setdefault(place, {}).setdefault(key.model, {})[key.seed] = values_of(cell)
        self.facts.append({name: value for name, value in cell.items() if name not in ("values", "identity")})

    def add_second(self, key: Key, cell: Mapping[str, Any]) -> None:
        self.seconds[key.scene, key.preset, key.holdout] = values_of(cell)

    @property
    def places(self) -> list[Place]:
        return sorted(self.values)

    @property
    def subjects(self) -> list[str]:
        """The models that are judged against others: all but lookups."""
        return [name for name in self.models if name not in LOOKUPS]

    def baselines(self, subject: str) -> list[str]:
        """What a model is judged against; a baseline that is no lookup itself, against lookups alone."""
        against = LOOKUPS if subject in self.against else self.against
        return [name for name in self.models if name in against]

    def seeds(self, place: Place, *models: str) -> list[int]:
        return in_common(self.values.get(place, {}), models)

    def matrix(self, place: Place, model: str, column: str, seeds: Sequence[int]) -> np.ndarray:
        """Scores `[seed, position]`."""
        return np.stack([self.values[place][model][seed][column] for seed in seeds])

    def positions(self, place: Place) -> int:
        counts = (len(v["rmse_db"]) for of in self.values[place].values() for v in of.values())
        return max(counts, default=0) // self.views

    def estimate(self, place: Place, model: str, score: Score) -> Estimate | None:
        """A score over all seeds that there are; None without any."""
        seeds = self.seeds(place, model)
        return estimate(self.matrix(place, model, score.column, seeds), score, views=self.views) if seeds else None

    def second(self, place: Place, score: Score) -> Estimate | None:
        """The score of the second solve of some of the positions."""
        values = self.seconds.get((place.scene, place.preset, place.holdout))
        return None if values is None else estimate(values[score.column][None], score, views=self.views)

    def difference(self, place: Place, subject: str, baseline: str, score: Score) -> Difference | None:
        """A model against another over the seeds in common; None without any."""
        seeds = self.seeds(place, subject, baseline)
        if not seeds:
            return None
        one, other = (self.matrix(place, name, score.column, seeds) for name in (subject, baseline))
        return difference(one, other, score, views=self.views)

    def verdict(self, place: Place, subject: str, baseline: str, score: Score) -> str:
        found = self.difference(place, subject, baseline, score)
        return "missing" if found is None else found.verdict
