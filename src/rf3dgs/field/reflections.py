"""Reflections: what planes take from the power of ways, in decibels: laws, ripples and marks.

Formulas (5) and (6) of docs/theory/radiance.md. Everything is float64. The native core does it in one call; without the
core the specification, which is NumPy, answers itself.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import torch
from torch import Tensor

from rf3dgs.core.native import Held, native_core
from rf3dgs.core.threads import thread_count

RIPPLE = 81  # cosines from 0 to 1 at which a ripple is kept
MARK_PRIOR = 0.05  # weight of no deviation beside marks of weight 1 where they are
MARK_REACH = 5.0  # widths: what is farther weighs nothing
FEW = 256  # ways that are answered sooner than other threads wake


@dataclass(frozen=True, eq=False)
class Marks:
    """Places on planes where the reflection was measured to be other than the plane's: doors and windows in walls.

    points `[M, 3]` [m], plane `[M]`, level_db `[M]`: what is added to 10 log10 Gamma. width [m]: how far one reaches.
    """

    points: Tensor
    plane: Tensor
    level_db: Tensor
    width: float


@dataclass(frozen=True, eq=False)
class Reflections(Held):
    """What reflections at P planes leave, made once.

    laws `[P, 3]`: a, b and c of each plane. ripple `[P, RIPPLE]` [dB]. points `[M, 3]` [m] and level_db `[M]` of marks,
    sorted by plane, and there by along `[M]`, x + y + z, among which near ones are soon found; start `[P + 1]`: the
    first mark of each plane. width [m] of marks.
    """

    laws: np.ndarray
    ripple: np.ndarray
    points: np.ndarray
    along: np.ndarray
    level_db: np.ndarray
    start: np.ndarray
    width: float

    @classmethod
    def of(cls, laws: Tensor, ripple: Tensor | None, marks: Marks | None) -> "Reflections":
        """Laws `[P, 3]` and what planes deviate from them."""
        count = len(laws)
        if ripple is None:
            ripple = torch.zeros(count, RIPPLE)
        if marks is None:
            marks = Marks(torch.zeros(0, 3), torch.zeros(0, dtype=torch.long), torch.zeros(0), 1.0)
        points, plane, level_db = (_numbers(each) for each in (marks.points, marks.plane, marks.level_db))
        along = points.sum(-1)
        order = np.lexsort((along, plane))
        start = np.searchsorted(plane[order], np.arange(count + 1))
        return cls(_numbers(laws), _numbers(ripple), points[order], along[order], level_db[order], start, marks.width)

    @cached_property
    def held(self) -> Any | None:
        """The same in the native core, or None without it."""
        core = native_core()
        if core is None:
            return None
        return core.Reflections(self.laws, self.ripple, self.points, self.along, self.level_db, self.start, self.width)


def reflected_db(of: Reflections, planes: np.ndarray, cosine: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Sum `[w]` of 10 log10 Gamma over reflections at `planes` `[w, 3]`, -1 for none, in `points` `[w, 3, 3]` [m] at
    `cosine` `[w, 3]` of incidence."""
    if of.held is None:
        return reflected_reference(of, planes, cosine, points)
    sum_db = np.empty(len(planes))
    of.held.sum_db(planes, cosine, points, sum_db, 1 if len(planes) < FEW else thread_count())
    return sum_db


def reflected_reference(of: Reflections, planes: np.ndarray, cosine: np.ndarray, points: np.ndarray) -> np.ndarray:
    """The specification of `reflected_db`."""
    way, step = np.nonzero(planes >= 0)
    plane, cos = planes[way, step], cosine[way, step]
    a, b, c = of.laws[plane].T
    place = cos * (RIPPLE - 1)
    below = np.clip(place, 0, RIPPLE - 2).astype(np.int64)
    low, high = of.ripple[plane, below], of.ripple[plane, below + 1]
    level_db = a + cos * (b + cos * c) + low + (place - below) * (high - low) + _marked(of, plane, points[way, step])
    return np.bincount(way, np.minimum(level_db, 0.0), len(planes))


def _marked(of: Reflections, plane: np.ndarray, points: np.ndarray) -> np.ndarray:
    """What marks add at points `[n, 3]` of planes `[n]` [dB]: the mean of near ones, drawn to 0 where few are."""
    level_db = np.zeros(len(points))
    for number in np.unique(plane):
        own, here = slice(*of.start[number : number + 2]), np.flatnonzero(plane == number)
        apart2 = ((points[here, None] - of.points[own]) ** 2).sum(-1)
        weight = np.where(apart2 < (MARK_REACH * of.width) ** 2, np.exp(-0.5 / of.width**2 * apart2), 0.0)
        level_db[here] = weight @ of.level_db[own] / (weight.sum(-1) + MARK_PRIOR)
    return level_db


def _numbers(tensor: Tensor) -> np.ndarray:
    return tensor.detach().double().contiguous().numpy()
