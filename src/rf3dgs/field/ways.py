"""Ways: broken lines from the transmitter over mirrors to receivers, for one receiver or many at a time.

The straight line from the receiver to an image of the transmitter, folded back at the planes, is the only candidate for
a mirror path along a sequence of planes. Candidates are dropped as soon as they fail: first those whose image and
receiver stand on one side of the last plane, then, from reflection to reflection, those that miss a plane's surface.
What is left is a list of ways, so that the work goes with the candidates that live and not with receivers times
sources. Everything is float64. The native core does it in one call; without the core the specification, which is
NumPy, answers itself. What stands in the way is asked elsewhere.
"""

from dataclasses import dataclass, fields
from functools import cached_property
from typing import Any

import numpy as np
import torch
from torch import Tensor

from rf3dgs.core.native import Held, native_core
from rf3dgs.core.threads import thread_count
from rf3dgs.field.images import HIGHEST_ORDER
from rf3dgs.geometry import Patches
from rf3dgs.geometry.patches import closed

NEAREST = 1e-6  # share of a leg below which an end lies on the plane itself
SHORTEST = 1e-3  # m: nearer sources count as that far
LEAST = 1e-12  # m: a leg that falls less towards a plane runs along it
FEW = 128  # receivers that are answered sooner than other threads wake


@dataclass(frozen=True, eq=False)
class Ways:
    """Ways to receivers `place` `[w]` from sources `source` `[w]`, sorted by receiver and source.

    points `[w, 3, 3]`: where each plane of the sequence is met [m], the receiver beyond the last. cosine `[w, 3]`: of
    the angle of incidence, 1 beyond the last. distance `[w]`: whole length [m]. arrival, departure `[w, 3]`: unit
    vectors from the receiver to the last point and from the transmitter to the first.
    """

    place: np.ndarray
    source: np.ndarray
    points: np.ndarray
    cosine: np.ndarray
    distance: np.ndarray
    arrival: np.ndarray
    departure: np.ndarray

    def __len__(self) -> int:
        return len(self.place)

    def only(self, chosen: np.ndarray) -> "Ways":
        """Some of the ways: `chosen` is a mask `[w]`."""
        rows = np.flatnonzero(chosen)
        return Ways(*(getattr(self, field.name).take(rows, 0) for field in fields(self)))


@dataclass(frozen=True, eq=False)
class Reach:
    """Patches without gaps, for one look-up a point: where ways may be reflected.

    axes `[P, 2, 3]` in cells, low `[P, 2]` in cells, last `[P, 2]` row and column, wide `[P]` and start `[P]` of each
    plane in cells `[cell]`. The outermost cells of a plane are empty, and stand for all beyond.
    """

    axes: np.ndarray
    low: np.ndarray
    last: np.ndarray
    wide: np.ndarray
    start: np.ndarray
    cells: np.ndarray

    @classmethod
    def of(cls, patches: Patches) -> "Reach":
        """The same surface with its gaps closed, up to two cells wide; its outline stays."""
        cells = []
        for plane in range(len(patches)):
            cells.append(torch.nn.functional.pad(closed(patches.grid(plane)), (2, 2, 2, 2)).flatten())
        shape = patches.shape.numpy() + 4
        sizes = shape.prod(-1)
        joined = torch.cat(cells) if cells else patches.cells
        axes, low = _doubles(patches.axes) / patches.cell, _doubles(patches.low) / patches.cell - 2.0
        return cls(axes, low, shape - 1.0, shape[:, 1], sizes.cumsum() - sizes, joined.numpy())

    def holds(self, points: np.ndarray, plane: np.ndarray) -> np.ndarray:
        """True `[n]` where points `[n, 3]` [m] lie on the surface of their `plane` `[n]`."""
        local = np.einsum("nij,nj->ni", self.axes[plane], points) - self.low[plane]
        cell = np.minimum(np.maximum(local, 0.0), self.last[plane]).astype(np.int64)
        return self.cells[self.start[plane] + cell[:, 0] * self.wide[plane] + cell[:, 1]]


@dataclass(frozen=True, eq=False)
class Plan(Held):
    """What folding asks of K sources over P planes, made once.

    chain `[K, 4, 3]`: the transmitter and its images [m]; sequence `[K, 3]` and order `[K]` as in `PointSources`;
    normals `[P, 3]`, offsets `[P]`; reach: where the planes have surface, None for everywhere. last `[K]`: the plane
    that a wave meets last, -1 for none; side `[K]`: the signed distance [m] of the last image from it.
    """

    chain: np.ndarray
    sequence: np.ndarray
    order: np.ndarray
    normals: np.ndarray
    offsets: np.ndarray
    reach: Reach | None
    last: np.ndarray
    side: np.ndarray

    @classmethod
    def of(cls, chain: Tensor, sequence: Tensor, normals: Tensor, offsets: Tensor, patches: Patches | None) -> "Plan":
        """The plan of images `[K, 4, 3]` and sequences `[K, 3]` over planes `[P, 3]` and `[P]`."""
        images, rows = _doubles(chain), sequence.numpy()
        order = (rows >= 0).sum(-1)
        last = np.where(order > 0, rows[np.arange(len(rows)), order - 1], -1)
        one = np.array([[0.0, 0.0, 0.0]])  # a plane of no direction behind the others, for sources without any
        n, d = np.concatenate((_doubles(normals), one)), np.concatenate((_doubles(offsets), [-1.0]))
        side = np.where(order > 0, _dot(images[:, -1], n[last]) - d[last], -1.0)
        return cls(images, rows, order, n, d, None if patches is None else Reach.of(patches), last, side)

    @cached_property
    def held(self) -> Any | None:
        """The plan in the native core, or None without it."""
        core, reach = native_core(), self.reach
        if core is None:
            return None
        own = (self.chain, self.sequence, self.order, self.last, self.side, self.normals, self.offsets)
        where = (None,) * 6
        if reach is not None:
            where = (reach.axes, reach.low, reach.last, reach.wide, reach.start, reach.cells)
        return core.WayPlan(*(None if each is None else np.ascontiguousarray(each) for each in (*own, *where)))


def ways_over(plan: Plan, receivers: np.ndarray, asked: np.ndarray | None = None) -> Ways:
    """All ways of a plan to receivers `[n, 3]` [m] whose every point lies between its neighbours and on surface.

    `asked` `[K]`, where given, is False for sources that are left out.
    """
    if plan.held is None:
        return ways_reference(plan, receivers, asked)
    threads = 1 if len(receivers) < FEW else thread_count()
    return Ways(*plan.held.fold(np.ascontiguousarray(receivers), asked, threads))


def ways_reference(plan: Plan, receivers: np.ndarray, asked: np.ndarray | None = None) -> Ways:
    """The specification of `ways_over`."""
    height = receivers @ plan.normals.T - plan.offsets
    facing = height[:, plan.last] * plan.side < 0.0
    place, source = np.nonzero(facing if asked is None else facing & asked)
    here = receivers[place]
    points, cosine = np.repeat(here[:, None], HIGHEST_ORDER, 1), np.ones((len(place), HIGHEST_ORDER))
    for step in reversed(range(int(plan.order.max()))):
        rows = np.flatnonzero(plan.order[source] > step)
        origin, plane = here[rows], plan.sequence[source[rows], step]
        normal, leg = plan.normals[plane], plan.chain[source[rows], step + 1] - origin
        fall = _dot(leg, normal)
        fall[np.abs(fall) < LEAST] = LEAST
        share = (plan.offsets[plane] - _dot(origin, normal)) / fall
        met = origin + share[:, None] * leg
        good = (share > NEAREST) & (share < 1.0 - NEAREST)
        if plan.reach is not None:
            good &= plan.reach.holds(met, plane)
        here[rows], points[rows, step] = met, met
        cosine[rows, step] = np.minimum(np.abs(fall) / np.maximum(np.sqrt(_dot(leg, leg)), 1e-9), 1.0)
        if not good.all():
            kept = np.ones(len(place), dtype=bool)
            kept[rows] = good
            kept = np.flatnonzero(kept)
            place, source, here, points, cosine = place[kept], source[kept], here[kept], points[kept], cosine[kept]
    line, out = plan.chain[source, -1] - receivers[place], here - plan.chain[0, 0]
    distance = np.maximum(np.sqrt(_dot(line, line)), SHORTEST)
    start = np.maximum(np.sqrt(_dot(out, out)), 1e-9)
    return Ways(place, source, points, cosine, distance, line / distance[:, None], out / start[:, None])


def _dot(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    return np.einsum("ni,ni->n", first, second)


def _doubles(tensor: Tensor) -> np.ndarray:
    return tensor.detach().double().numpy()
