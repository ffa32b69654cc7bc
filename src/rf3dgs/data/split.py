"""Splitting receiver positions into train, validation, test at random, and a held-out region behind a buffer."""

from collections.abc import Sequence
from typing import Literal

import numpy as np
import torch
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree
from torch import Tensor

from rf3dgs.core.errors import InputError

ROLES = ("train", "validation", "test", "region", "buffer", "unused")
SEALED_ROLES = ("test", "region")
HELD_OUT = 0.2  # share of the places that the paper's protocol tests on: 160 of 800
FRACTIONS = (0.2, 0.4, 0.6, 0.8, 1.0)  # of the other places that it trains on
HoldOut = Literal["random", "region"]
SAME_PLACE = 1e-3  # [m] closer positions are one place


def split_positions(
    positions: Tensor,
    *,
    test: float = 0.15,
    validation: float = 0.1,
    region: float = 0.15,
    buffer: float = 0.3,
    seed: int = 0,
) -> tuple[str, ...]:
    """A role for each position `[n, 3]` [m], the same for the same seed.

    "region" is the share `region` of the places inside an upright cylinder around a place drawn at random; the places
    up to `buffer` [m] around it are "buffer" and serve nothing, so that no neighbour gives the region away. Of all
    places the shares `test` and `validation` are drawn at random from the rest, and what remains is "train". Positions
    closer than 1 mm (several orientations at one place) are one place and share one role.
    """
    positions = torch.as_tensor(positions, dtype=torch.float32)
    if positions.dim() != 2 or positions.shape[-1] != 3:
        raise InputError(f"positions must be [position, 3] in metres; got {list(positions.shape)}")
    shares = {"test": test, "validation": validation, "region": region}
    for name, share in shares.items():
        if not 0.0 <= share < 1.0:
            raise InputError(f"the share {name} must lie in [0, 1); got {share}")
    if sum(shares.values()) >= 1.0 or buffer < 0.0:
        raise InputError(f"test + validation + region must stay below 1, buffer >= 0; got {shares}, buffer {buffer}")
    place, first = places_of(positions)
    count = len(first)
    centre = positions[first].double().numpy()[:, :2]
    random = np.random.default_rng(seed)
    role = np.full(count, "train", dtype=object)
    held = round(region * count)
    if held > 0:
        distance = np.linalg.norm(centre - centre[random.integers(count)], axis=1)
        radius = np.sort(distance)[held - 1]
        role[distance <= radius + buffer] = "buffer"
        role[distance <= radius] = "region"
    free = random.permutation(np.flatnonzero(role == "train"))
    tested, validated = round(test * count), round(validation * count)
    role[free[:tested]] = "test"
    role[free[tested : tested + validated]] = "validation"
    if not (role == "train").any():
        raise InputError(f"no place of {count} is left for training; lower test, validation, region or buffer")
    return tuple(str(role[index]) for index in place)


def protocol(
    positions: Tensor, *, hold_out: HoldOut = "random", fraction: float = 1.0, buffer: float = 0.3, seed: int = 0
) -> tuple[str, ...]:
    """The roles of the paper's protocol for positions `[n, 3]` [m]: a fifth of the places is held out, no validation.

    hold_out "random": the "test" is drawn at random, 160 of 800 places. "region": the places of one "region", and those
    up to `buffer` [m] around it serve nothing. Of the others the share `fraction` is "train" (`keep_fraction`).
    """
    if hold_out not in ("random", "region"):
        raise InputError(f'hold_out must be "random" or "region"; got {hold_out!r}')
    test, region = (HELD_OUT, 0.0) if hold_out == "random" else (0.0, HELD_OUT)
    roles = split_positions(positions, test=test, validation=0.0, region=region, buffer=buffer, seed=seed)
    return keep_fraction(positions, roles, fraction, seed=seed)


def keep_fraction(positions: Tensor, roles: Sequence[str], fraction: float, *, seed: int = 0) -> tuple[str, ...]:
    """The same roles with the share `fraction` of the training places kept as "train", the others "unused".

    Places that are "unused" already take part, so that any fraction may follow any other. For one seed the smaller of
    two fractions is part of the larger; all pictures of one place go the same way.
    """
    if not 0.0 < fraction <= 1.0:
        raise InputError(
            f"fraction must lie in (0, 1], the share of the training places to keep, such as 0.2; got {fraction}"
        )
    check_roles(positions, roles)
    place, first = places_of(positions)
    pool = np.array([roles[index] in ("train", "unused") for index in first], dtype=bool)
    order = np.random.default_rng((seed, 1)).permutation(np.flatnonzero(pool))
    kept = set(order[: round(fraction * len(order))].tolist())
    if not kept:
        raise InputError(f"a fraction of {fraction} of {len(order)} training places leaves none; take a larger one")
    return tuple(
        role if not pool[which] else "train" if which in kept else "unused"
        for role, which in zip(roles, place.tolist(), strict=True)
    )


def check_roles(positions: Tensor, roles: Sequence[str]) -> None:
    """Refuse unknown roles, other counts, and one place (closer than 1 mm) on two sides of the split.

    `positions` `[n, 3]` [m] with one role each; InputError names the first two positions that are torn apart.
    """
    if len(roles) != len(positions):
        raise InputError(f"expected one role per position, {len(positions)}; got {len(roles)} roles")
    unknown = sorted(set(roles) - set(ROLES))
    if unknown:
        raise InputError(f"roles must be among {', '.join(ROLES)}; got {', '.join(unknown)}")
    place, first = places_of(positions)
    for index, which in enumerate(place):
        other = int(first[which])
        if roles[index] != roles[other]:
            raise InputError(
                f"positions {other} and {index} are the same place (closer than 1 mm), but one is {roles[other]!r} and "
                f"the other {roles[index]!r}; give both one role, or the test is no test"
            )


def places_of(positions: Tensor) -> tuple[np.ndarray, np.ndarray]:
    """The place of each position `[n]`, and the first position of each place `[m]`; places are 1 mm apart or more."""
    points = torch.as_tensor(positions).double().numpy()
    pairs = KDTree(points).query_pairs(SAME_PLACE, output_type="ndarray")
    near = coo_array((np.ones(len(pairs), dtype=np.int8), (pairs[:, 0], pairs[:, 1])), shape=(len(points),) * 2)
    _, label = connected_components(near, directed=False)
    _, first, place = np.unique(label, return_index=True, return_inverse=True)
    return place, first


def every_kth(count: int, k: int) -> tuple[str, ...]:
    """Roles of `count` photos: every `k`-th is "test", the others "train"; `k` 0 keeps all for training."""
    if k < 0 or k == 1:
        raise InputError(f"every k-th photo is tested, so k must be 0 (none) or at least 2; got {k}")
    return tuple("test" if k and index % k == k - 1 else "train" for index in range(count))
