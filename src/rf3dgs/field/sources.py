"""Point sources: what reaches a receiver from single points, the transmitter and its mirror images.

A point source is a delta that moves with the receiver, which no harmonics on surfaces can follow; its arrival,
departure and delay are exact, its power has a few learned numbers (docs/theory/radiance.md). Which sources reach a
receiver is decided by geometry: every reflection falls on surface, and every leg of the way is open.
"""

import math
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from rf3dgs.core.errors import InputError
from rf3dgs.core.units import SPEED_OF_LIGHT, friis_gain
from rf3dgs.field.images import HIGHEST_ORDER, image_chain
from rf3dgs.field.rays import RAY_FIELDS, Rays
from rf3dgs.field.ways import Plan, Ways, ways_over
from rf3dgs.geometry import Patches, Planes
from rf3dgs.splats.obstacles import Obstacles

if TYPE_CHECKING:
    from scipy.spatial import KDTree

ROUNDING = 1e-5  # of a cosine in float32
MARK_PRIOR = 0.05  # weight of no deviation beside marks of weight 1 where they are
MARK_REACH, NEAREST_MARKS = 5.0, 32  # widths: what is farther, or hidden behind so many nearer ones, weighs nothing
PLANES_APART = 1e4  # m
RIPPLE = 81  # cosines from 0 to 1 at which a ripple is kept
AT_ONCE = 256  # receivers


@dataclass(frozen=True, eq=False)
class Marks:
    """Places on planes where the reflection was measured to be other than the plane's: doors and windows in walls.

    points `[M, 3]` [m], plane `[M]`, level_db `[M]`: what is added to 10 log10 Gamma. width [m]: how far one reaches.
    """

    points: Tensor
    plane: Tensor
    level_db: Tensor
    width: float

    def at(self, points: np.ndarray, plane: np.ndarray) -> np.ndarray:
        """What is added at points `[n, 3]` of planes `[n]` [dB]: the mean of near marks, drawn to 0 where few are."""
        tree, level_db = self._tree
        places = _of_planes(points, plane)
        apart, mark = tree.query(places, NEAREST_MARKS, distance_upper_bound=MARK_REACH * self.width)
        weight = np.exp(apart * apart * (-0.5 / self.width**2))  # 0 for those that are missing, infinitely far
        return (weight * level_db[mark]).sum(-1) / (weight.sum(-1) + MARK_PRIOR)

    @cached_property
    def _tree(self) -> "tuple[KDTree, np.ndarray]":
        """The marks by place and plane, and their levels with a zero behind the last, which stands for none."""
        from scipy.spatial import KDTree

        tree = KDTree(_of_planes(self.points.double().numpy(), self.plane.numpy()))
        return tree, np.append(self.level_db.double().numpy(), 0.0)

    def __getstate__(self) -> dict[str, object]:
        return {name: value for name, value in self.__dict__.items() if name != "_tree"}


def _of_planes(points: np.ndarray, plane: np.ndarray) -> np.ndarray:
    """Points `[n, 3]` [m] with a fourth coordinate `[n, 4]`, in which planes are far from each other."""
    return np.concatenate((points, PLANES_APART * plane[:, None]), -1)


@dataclass(frozen=True, eq=False)
class PointSources:
    """The transmitter and its images in planes, all point sources of a field.

    tx `[3]`: the transmitter [m]. frequency [Hz]. level_db: power over Friis' free-space gain of isotropic antennas,
    of the line of sight and of all images. planes: P planes; patches: where they have surface, or None for everywhere.
    reflection `[P, 3]`: a, b and c of 10 log10 Gamma = a + b cos + c cos^2 at the angle of incidence, at most 0 dB.
    sequence `[K, 3]`: the planes of each source in the order from the transmitter, -1 beyond the last; the first row is
    the line of sight, all -1. open_above: the transmittance of a leg above which a way is open. marks: where planes
    reflect otherwise, or None. mirrors `[P]`: False for planes that were found to mirror nothing, or None where nobody
    knows; it decides in which planes images are sought for another transmitter. ripple `[P, RIPPLE]`: what is added to
    10 log10 Gamma [dB] at cosines of incidence from 0 to 1, evenly spaced, or None.
    """

    tx: Tensor
    frequency: float
    planes: Planes
    patches: Patches | None
    sequence: Tensor
    reflection: Tensor
    level_db: float = 0.0
    open_above: float = 0.1
    marks: Marks | None = None
    mirrors: Tensor | None = None
    ripple: Tensor | None = None

    def __post_init__(self) -> None:
        count = len(self.planes)
        if self.ripple is not None and self.ripple.shape != (count, RIPPLE):
            raise InputError(f"ripple must be [{count}, {RIPPLE}], a row a plane; got {list(self.ripple.shape)}")
        if self.tx.shape != (3,):
            raise InputError(f"tx must be three coordinates in metres; got {list(self.tx.shape)}")
        if self.reflection.shape != (count, 3):
            raise InputError(f"reflection must be [{count}, 3], a row a plane; got {list(self.reflection.shape)}")
        if self.mirrors is not None and self.mirrors.shape != (count,):
            raise InputError(f"mirrors must be [{count}], one for each plane; got {list(self.mirrors.shape)}")
        rows = self.sequence
        if rows.dim() != 2 or rows.shape[1:] != (HIGHEST_ORDER,) or not len(rows) or bool((rows[0] >= 0).any()):
            raise InputError(
                f"sequence must be [source, {HIGHEST_ORDER}] with the line of sight, all -1, first; "
                f"got {list(rows.shape)}"
            )
        if bool(((rows < -1) | (rows >= count)).any()) or bool(((rows[:, 1:] >= 0) & (rows[:, :-1] < 0)).any()):
            raise InputError(f"sequence must name planes below {count} without gaps; -1 stands beyond the last")

    @classmethod
    def line_of_sight(
        cls, tx: Tensor, frequency: float, *, level_db: float = 0.0, open_above: float = 0.1
    ) -> "PointSources":
        """The transmitter alone, at `tx` `[3]` [m] and `frequency` [Hz]."""
        none = Planes(torch.zeros(0, 3), torch.zeros(0))
        row = torch.full((1, HIGHEST_ORDER), -1)
        return cls(tx, frequency, none, None, row, torch.zeros(0, 3), level_db, open_above)

    def __len__(self) -> int:
        return len(self.sequence)

    @cached_property
    def chain(self) -> Tensor:
        """The transmitter's images `[K, 4, 3]` [m] after 0 to 3 reflections of each sequence."""
        return image_chain(self.tx, self.planes.normals, self.planes.offsets, self.sequence)

    @property
    def positions(self) -> Tensor:
        """Where the sources seem to stand `[K, 3]` [m]."""
        return self.chain[:, -1]

    @cached_property
    def order(self) -> Tensor:
        """Number of reflections `[K]`."""
        return (self.sequence >= 0).sum(-1)

    @cached_property
    def plan(self) -> Plan:
        """What folding asks of the sources."""
        return Plan.of(self.chain, self.sequence, self.planes.normals, self.planes.offsets, self.patches)

    def reaching(self, receivers: Tensor) -> Tensor:
        """True `[K]` for sources with a way over surface, open or not, to one of the receivers `[n, 3]` [m]."""
        found = torch.zeros(len(self), dtype=torch.bool)
        for part in _positions(receivers):
            found[torch.from_numpy(ways_over(self.plan, part).source)] = True
        return found

    def gain(self, ways: Ways) -> np.ndarray:
        """Path gain `[w]`, linear, of open ways."""
        level_db = self.level_db + self.reflection_db(ways.source, ways.cosine, ways.points)
        return friis_gain(ways.distance, self.frequency) * 10.0 ** (level_db / 10.0)

    def reflection_db(self, source: np.ndarray, cosine: np.ndarray, points: np.ndarray) -> np.ndarray:
        """Sum `[w]` of 10 log10 Gamma over reflections in `points` `[w, 3, 3]` at `cosine` `[w, 3]` of incidence."""
        planes = self.plan.sequence[source]
        laws = self._reflection[planes]  # -1 is the row behind the planes
        level_db = laws[..., 0] + cosine * (laws[..., 1] + cosine * laws[..., 2])
        if self.ripple is not None:
            place = cosine * (RIPPLE - 1)
            below = np.minimum(place.astype(np.int64), RIPPLE - 2)
            low, high = self._ripple[planes, below], self._ripple[planes, below + 1]
            level_db += low + (place - below) * (high - low)
        if self.marks is not None:
            way, step = np.nonzero(planes >= 0)
            level_db[way, step] += self.marks.at(points[way, step], planes[way, step])
        return np.minimum(level_db, 0.0).sum(-1)

    @cached_property
    def _reflection(self) -> np.ndarray:
        """`reflection` and a row `[P + 1, 3]` that changes nothing, for no plane."""
        return torch.cat((self.reflection, self.reflection.new_zeros(1, 3))).double().numpy()

    @cached_property
    def _ripple(self) -> np.ndarray:
        """`ripple` and a row `[P + 1, RIPPLE]` of zeros, for no plane."""
        assert self.ripple is not None
        return torch.cat((self.ripple, self.ripple.new_zeros(1, RIPPLE))).double().numpy()

    def transmittance(self, ways: Ways, receivers: np.ndarray, obstacles: Obstacles) -> np.ndarray:
        """Share `[w]` that passes on ways to `receivers` `[n, 3]` [m].

        That of the leg which lets least pass: one that a column cuts closes the way, however free the others are.
        Gaussians of the planes that a leg joins do not stand in its way.
        """
        longest = int(self.plan.order.max())
        first = np.broadcast_to(self.plan.chain[0, 0], (len(ways), 1, 3))
        stops = np.concatenate((first, ways.points[:, :longest], receivers[ways.place, None]), 1, dtype=np.float32)
        labels = np.full((len(ways), longest + 2), -1)
        labels[:, 1:-1] = self.plan.sequence[ways.source, :longest]
        known = obstacles.labels is not None
        passed = obstacles.transmittance(  # legs beyond the last go from the receiver to itself, and are free
            torch.from_numpy(stops[:, :-1].reshape(-1, 3)),
            torch.from_numpy(stops[:, 1:].reshape(-1, 3)),
            skip_start=torch.from_numpy(labels[:, :-1].reshape(-1)) if known else None,
            skip_end=torch.from_numpy(labels[:, 1:].reshape(-1)) if known else None,
        )
        return passed.numpy().reshape(-1, longest + 1).min(-1)

    def rays(self, receiver: Tensor, obstacles: Obstacles, *, within: tuple[Tensor, float] | None = None) -> Rays:
        """What reaches a receiver at `receiver` `[3]` [m].

        `within`, a direction `[3]` of the world and an angle [rad] about it, leaves out what arrives from elsewhere.
        """
        (part,) = _positions(receiver[None])
        ways = ways_over(self.plan, part, None if within is None else self._towards(part[0], *within))
        return self._rays_of(ways.only(self.transmittance(ways, part, obstacles) > self.open_above))

    def _towards(self, receiver: np.ndarray, direction: Tensor, angle: float) -> np.ndarray:
        """True `[K]` for sources that a receiver `[3]` sees within `angle` [rad] of a unit vector `[3]`."""
        line = self.plan.chain[:, -1] - receiver
        return line @ direction.double().numpy() >= (math.cos(angle) - ROUNDING) * np.sqrt((line * line).sum(-1))

    def rays_each(self, receivers: Tensor, obstacles: Obstacles, *, in_sight: Tensor | None = None) -> list[Rays]:
        """What reaches each of the receivers `[n, 3]` [m]; `in_sight` `[n]` decides the line of sight where given."""
        place, rays = self.arrivals(receivers, obstacles, in_sight=in_sight)
        counts = torch.bincount(place, minlength=len(receivers)).tolist()
        parts = zip(*(getattr(rays, name).split(counts) for name in RAY_FIELDS), strict=True)
        return [Rays(*part) for part in parts]

    def arrivals(
        self, receivers: Tensor, obstacles: Obstacles, *, in_sight: Tensor | None = None
    ) -> tuple[Tensor, Rays]:
        """What reaches any of the receivers `[n, 3]` [m], in their order, and which receiver `[k]` each ray reaches.

        `in_sight` `[n]` decides the line of sight where given.
        """
        seen = None if in_sight is None else in_sight.numpy()
        found, start = [], 0
        for part in _positions(receivers):
            ways = ways_over(self.plan, part)
            open_way = self.transmittance(ways, part, obstacles) > self.open_above
            if seen is not None:
                open_way = np.where(ways.source == 0, seen[start:][ways.place], open_way)
            ways = ways.only(open_way)
            found.append((torch.from_numpy(ways.place + start), self._rays_of(ways)))
            start += len(part)
        if len(found) == 1:
            return found[0]
        places, parts = zip(*found, strict=True)
        return torch.cat(places), Rays(*(torch.cat([getattr(part, name) for part in parts]) for name in RAY_FIELDS))

    def candidates(self, receiver: Tensor, obstacles: Obstacles) -> tuple[Rays, Tensor]:
        """All ways over surface to a receiver `[3]` [m], open or not, and the share `[k]` that each lets pass."""
        (part,) = _positions(receiver[None])
        ways = ways_over(self.plan, part)
        return self._rays_of(ways), _tensor(self.transmittance(ways, part, obstacles))

    def _rays_of(self, ways: Ways) -> Rays:
        values = (self.gain(ways), ways.arrival, ways.departure, ways.distance / SPEED_OF_LIGHT)
        power, arrival, departure, delay = (_tensor(value) for value in values)
        order = torch.from_numpy(self.plan.order[ways.source])
        return Rays(torch.from_numpy(ways.source), power, arrival, departure, delay, order, _tensor(ways.points))

    def sees(self, receivers: Tensor, obstacles: Obstacles) -> Tensor:
        """True `[*batch]` where the line of sight to receivers `[*batch, 3]` is open."""
        flat = receivers.reshape(-1, 3)
        passed = obstacles.transmittance(self.tx.expand_as(flat), flat)
        return (passed > self.open_above).reshape(receivers.shape[:-1])


def _positions(receivers: Tensor) -> list[np.ndarray]:
    """Receivers `[n, 3]` as float64, in parts whose ways fit a cache; one part where there are none."""
    every = receivers.detach().double().numpy()
    return [every[start : start + AT_ONCE] for start in range(0, max(1, len(every)), AT_ONCE)]


def _tensor(values: np.ndarray) -> Tensor:
    return torch.from_numpy(values.astype(np.float32))
