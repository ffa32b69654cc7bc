"""Which positions serve what: a sealed test, at random and in a region, each with a validation part of its own."""

from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch
from torch import Tensor

from rf3dgs.core.errors import InputError
from rf3dgs.data.split import places_of, protocol

HOLDOUTS = ("random", "region")
JUDGES = ("validation", "test")
PARTS = {
    ("validation", "random"): "validation",
    ("validation", "region"): "validation region",
    ("test", "random"): "test",
    ("test", "region"): "region",
}
STORED = {"pool": "train", "validation region": "validation"}  # what a dataset calls them; the others are called alike


Draw = Literal["uniform", "clustered"]
CLUSTERS = 4


@dataclass(frozen=True)
class SplitConfig:
    """How many positions each part has."""

    test: int = 100
    """Sealed positions drawn at random."""
    region: int = 100
    """Sealed positions of one region."""
    validation: int = 40
    """Positions drawn at random that settings are chosen by."""
    near: int = 40
    """Positions of a second region, beside the sealed one, that settings for unseen regions are chosen by."""
    buffer: float = 0.3
    """Positions this close [m] to either region serve nothing."""
    seed: int = 0
    """Decides where the regions lie and who is drawn."""


@dataclass(frozen=True)
class Split:
    """A part's name for each position, "pool" being what training positions are drawn from, "buffer" nothing."""

    names: tuple[str, ...]
    config: "SplitConfig | None" = None

    def where(self, name: str) -> np.ndarray:
        """The positions `[n]` of one part, in ascending order."""
        return np.flatnonzero(np.array(self.names) == name)

    def part(self, judge: str, holdout: str) -> np.ndarray:
        """The positions `[n]` that judge a hold-out: "validation" or, sealed, "test"."""
        return self.where(PARTS[judge, holdout])

    def training(self, count: int, seed: int, draw: Draw = "uniform", ground: np.ndarray | None = None) -> np.ndarray:
        """`count` positions of the pool in ascending order; of one seed the fewer are among the more.

        "clustered": those nearest to four of them drawn at random, with all positions `ground` `[n, 2]` [m].
        """
        pool = self.where("pool")
        if not 1 <= count <= len(pool):
            raise InputError(
                f"{count} training positions were asked for and {len(pool)} are left beside the held-out ones; "
                "trace more receivers, or hold out fewer"
            )
        order = np.random.default_rng((seed, 1)).permutation(pool)
        if draw == "clustered":
            assert ground is not None
            away = np.linalg.norm(ground[pool][:, None] - ground[order[:CLUSTERS]], axis=-1).min(1)
            order = pool[np.argsort(away, kind="stable")]
        return np.sort(order[:count])

    @property
    def roles(self) -> tuple[str, ...]:
        """What a `Dataset` calls the parts, so that it seals the test."""
        return tuple(STORED.get(name, name) for name in self.names)


def split_of(positions: Tensor, config: SplitConfig | None = None) -> Split:
    """The parts of positions `[n, 3]` [m], seen from above; the same ones for the same seed.

    The sealed region is an upright cylinder round a position drawn at random. The validation region is the nearest
    other cylinder that touches neither it nor the buffer round it, and has a buffer of its own. The random parts are
    drawn from what is left. Training positions, whatever the hold-out, come from the pool, so that no cell learns from
    or is tuned on a sealed position.
    """
    config = SplitConfig() if config is None else config
    counts = {"test": config.test, "region": config.region, "validation": config.validation, "near": config.near}
    if min(counts.values()) < 1 or config.buffer < 0:
        raise InputError(f"every part needs a position and the buffer at least 0 m; got {counts}, {config.buffer} m")
    positions = torch.as_tensor(positions)
    if len(places_of(positions)[1]) < len(positions):
        raise InputError("two receivers stand at one place (closer than 1 mm); draw every position once")
    wanted = sum(counts.values())
    if len(positions) <= wanted:
        raise InputError(f"{wanted} positions are held out and there are {len(positions)}; trace more receivers")
    ground, random = positions.double().numpy()[:, :2], np.random.default_rng(config.seed)
    names = np.full(len(ground), "pool", dtype=object)
    away = np.linalg.norm(ground - ground[random.integers(len(ground))], axis=1)
    radius = np.sort(away)[config.region - 1]
    edge = radius + config.buffer
    names[away <= edge] = "buffer"
    names[away <= radius] = "region"
    centre, reach = _beside(ground, away, edge, config)
    apart = np.linalg.norm(ground - ground[centre], axis=1)
    names[(apart <= reach + config.buffer) & (names == "pool")] = "buffer"
    names[apart <= reach] = "validation region"
    free = random.permutation(np.flatnonzero(names == "pool"))
    if len(free) <= config.test + config.validation:
        raise InputError(
            f"{len(free)} positions are left outside the regions, of which {config.test} + {config.validation} are to "
            "be held out; trace more receivers, or make the regions or the buffer smaller"
        )
    names[free[: config.test]] = "test"
    names[free[config.test : config.test + config.validation]] = "validation"
    return Split(tuple(str(name) for name in names), config)


def paper_split(positions: Tensor, seed: int = 0) -> Split:
    """The paper's parts of positions `[n, 3]`: a fifth at random is the test, the others are the pool."""
    return Split(tuple("pool" if role == "train" else role for role in protocol(positions, seed=seed)))


def _beside(ground: np.ndarray, away: np.ndarray, edge: float, config: SplitConfig) -> tuple[int, float]:
    """The centre and radius of the validation region: the nearest that stays outside `edge` round the sealed one."""
    outside = np.flatnonzero(away > edge)
    for centre in outside[np.argsort(away[outside], kind="stable")]:
        reach = np.sort(np.linalg.norm(ground[outside] - ground[centre], axis=1))[config.near - 1 : config.near]
        if len(reach) and away[centre] - reach[0] > edge:
            return int(centre), float(reach[0])
    raise InputError(
        f"no validation region of {config.near} positions fits beside the sealed one of {config.region}; make one "
        "of them smaller, or trace more receivers"
    )
