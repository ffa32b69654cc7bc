"""Point sources: what reaches a receiver from single points, the transmitter and its mirror images.

A point source is a delta that moves with the receiver, which no harmonics on surfaces can follow; its arrival,
departure and delay are exact, its power has a few learned numbers (docs/theory/radiance.md). Which sources reach a
receiver is decided by geometry: every reflection falls on surface, and every leg of the way is open.
"""

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from torch import Tensor

from rf3dgs.core.errors import InputError
from rf3dgs.core.units import SPEED_OF_LIGHT, friis_gain
from rf3dgs.field.images import HIGHEST_ORDER, image_chain
from rf3dgs.field.polarisation import Slabs, kept_db
from rf3dgs.field.rays import RAY_FIELDS, Rays
from rf3dgs.field.reflections import RIPPLE, Marks, Reflections, reflected_db
from rf3dgs.field.ways import Plan, Ways, ways_over
from rf3dgs.geometry import Patches, Planes
from rf3dgs.splats.obstacles import Obstacles

ROUNDING = 1e-5  # of a cosine in float32
AT_ONCE = 256  # receivers


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
    10 log10 Gamma [dB] at cosines of incidence from 0 to 1, evenly spaced, or None. slabs `[P, 3]`: relative
    permittivity, conductivity [S/m] and thickness [m] of each plane, which tell what it does to polarisation (not its
    level), or None where all are like metal.
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
    slabs: Tensor | None = None

    def __post_init__(self) -> None:
        count = len(self.planes)
        if self.ripple is not None and self.ripple.shape != (count, RIPPLE):
            raise InputError(f"ripple must be [{count}, {RIPPLE}], a row a plane; got {list(self.ripple.shape)}")
        if self.slabs is not None and self.slabs.shape != (count, 3):
            raise InputError(f"slabs must be [{count}, 3], a row a plane; got {list(self.slabs.shape)}")
        if self.slabs is not None and not bool(((self.slabs >= 0) & (self.slabs[:, :1] >= 1)).all()):
            raise InputError(
                "slabs must have relative permittivities of 1 or more, and no negative conductivities [S/m] and "
                f"thicknesses [m]; got {self.slabs.amin(0).tolist()} at least"
            )
        if self.tx.shape != (3,):
            raise InputError(f"tx must be three coordinates in metres; got {list(self.tx.shape)}")
        if self.reflection.shape != (count, 3):
            raise InputError(f"reflection must be [{count}, 3], a row a plane; got {list(self.reflection.shape)}")
        if self.marks is not None and bool(((self.marks.plane < 0) | (self.marks.plane >= count)).any()):
            raise InputError(f"marks must be on planes below {count}; got {self.marks.plane.unique().tolist()}")
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
        planes = self.plan.sequence[ways.source]
        level_db = self.level_db + self.reflected_db(planes, ways.cosine, ways.points, ways.departure)
        return friis_gain(ways.distance, self.frequency) * 10.0 ** (level_db / 10.0)

    def reflected_db(
        self, planes: np.ndarray, cosine: np.ndarray, points: np.ndarray, departure: np.ndarray
    ) -> np.ndarray:
        """10 log10 of K prod Gamma `[w]` of ways that leave along `departure` `[w, 3]` and are reflected by `planes`
        `[w, 3]`, -1 for none, in `points` `[w, 3, 3]` at `cosine` `[w, 3]` of incidence."""
        level_db = reflected_db(self._reflections, planes, cosine, points)
        return level_db if self._slabs is None else level_db + kept_db(self._slabs, planes, cosine, departure)

    @cached_property
    def _slabs(self) -> Slabs | None:
        return None if self.slabs is None else Slabs.of(self.planes.normals, self.slabs, self.frequency)

    @cached_property
    def _reflections(self) -> Reflections:
        return Reflections.of(self.reflection, self.ripple, self.marks)

    def transmittance(self, ways: Ways, receivers: np.ndarray, obstacles: Obstacles) -> np.ndarray:
        """Share `[w]` that passes on ways to `receivers` `[n, 3]` [m].

        That of the leg which lets least pass: one that a column cuts closes the way, however free the others are.
        Gaussians of the planes that a leg joins do not stand in its way.
        """
        longest = int(self.plan.order.max())
        stops = np.empty((len(ways), longest + 2, 3), dtype=np.float32)
        stops[:, 0], stops[:, -1] = self.plan.chain[0, 0], receivers[ways.place]
        stops[:, 1:-1] = ways.points[:, :longest]
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
