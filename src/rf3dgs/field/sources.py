"""Point sources: what reaches a receiver from single points, the transmitter and its mirror images.

A point source is a delta that moves with the receiver, which no harmonics on surfaces can follow; its arrival,
departure and delay are exact, its power has a few learned numbers (docs/theory/radiance.md). Which sources reach a
receiver is decided by geometry: every reflection falls on surface, and every leg of the way is open.
"""

import math
from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor

from rf3dgs.core.angles import angle_between
from rf3dgs.core.errors import InputError
from rf3dgs.core.units import SPEED_OF_LIGHT, friis_gain
from rf3dgs.field.images import HIGHEST_ORDER, Folded, Plan, fold, image_chain, plan_of
from rf3dgs.geometry import Patches, Planes
from rf3dgs.geometry.patches import CELL
from rf3dgs.spectra.spectrum import Instrument
from rf3dgs.splats.obstacles import Obstacles

MARK_PRIOR = 0.05  # weight of no deviation beside marks of weight 1 where they are
FARTHEST_LOBES = 6.2  # where a lobe's kernel is zero in float32


@dataclass(frozen=True, eq=False)
class Rays:
    """What arrives at one receiver from k point sources, in the order of the sources.

    index `[k]`: rows of `PointSources.sequence`. power `[k]`: path gains, linear. arrival, departure `[k, 3]`: unit
    vectors from the receiver and from the transmitter. delay `[k]` [s]. order `[k]`: number of reflections. points
    `[k, 3, 3]`: where they happen [m], the receiver beyond the last.
    """

    index: Tensor
    power: Tensor
    arrival: Tensor
    departure: Tensor
    delay: Tensor
    order: Tensor
    points: Tensor

    def __len__(self) -> int:
        return len(self.index)

    def only(self, chosen: Tensor) -> "Rays":
        """Some of the rays: `chosen` is a mask `[k]` or a list of places."""
        names = ("index", "power", "arrival", "departure", "delay", "order", "points")
        return Rays(*(getattr(self, name)[chosen] for name in names))

    def shares(self, directions: Tensor, instrument: Instrument) -> tuple[Tensor, Tensor, Tensor]:
        """What an instrument sees of each ray: place in the flattened picture `[n]`, ray `[n]` and power `[n]`.

        directions `[*shape, 3]`: unit vectors of the pixels in the world; pairs of no power are left out.
        """
        flat = directions.reshape(-1, 3)
        reach = math.cos(min(math.pi, FARTHEST_LOBES * instrument.lobe))
        place, ray = torch.nonzero(flat @ self.arrival.mT >= reach - 1e-6, as_tuple=True)
        kernel = instrument.kernel(angle_between(flat[place], self.arrival[ray]))
        return place, ray, kernel * self.power[ray]

    def picture(self, directions: Tensor, instrument: Instrument) -> Tensor:
        """Power `[*shape]`, linear, that the instrument sees along world directions `[*shape, 3]`."""
        place, _, share = self.shares(directions, instrument)
        picture = share.new_zeros(directions[..., 0].numel()).index_add_(0, place, share)
        return picture.reshape(directions.shape[:-1])


@dataclass(frozen=True, eq=False)
class Marks:
    """Places on planes where the reflection was measured to be other than the plane's: doors and windows in walls.

    points `[M, 3]` [m], plane `[M]`, level_db `[M]`: what is added to 10 log10 Gamma. width [m]: how far one reaches.
    """

    points: Tensor
    plane: Tensor
    level_db: Tensor
    width: float

    def at(self, points: Tensor, plane: Tensor, *, leave_out: bool = False) -> Tensor:
        """What is added at points `[n, 3]` of planes `[n]` [dB]: the mean of near marks, drawn to 0 where few are.

        With `leave_out` the points are those of the marks, and each is told by the others alone.
        """
        weight = torch.exp(torch.cdist(points, self.points).square() * (-0.5 / self.width**2))
        weight = weight * (plane[:, None] == self.plane)
        if leave_out:
            weight.fill_diagonal_(0.0)
        return (weight @ self.level_db) / (weight.sum(-1) + MARK_PRIOR)


@dataclass(frozen=True, eq=False)
class Reach:
    """Patches whose every cell beside an occupied one, corners too, is filled: one look-up answers `Patches.holds`.

    axes `[P, 2, 3]`, low `[P, 2]` in cells, shape `[P, 2]`, start `[P]` of each plane in cells `[cell]`.
    """

    axes: Tensor
    low: Tensor
    shape: Tensor
    start: Tensor
    cells: Tensor

    @classmethod
    def of(cls, patches: Patches) -> "Reach":
        """The same surface, widened by a cell."""
        shape, cells = patches.shape + 2, []
        for plane in range(len(patches)):
            grid = torch.nn.functional.pad(patches.grid(plane).float(), (2, 2, 2, 2))
            cells.append(torch.nn.functional.max_pool2d(grid[None, None], 3, stride=1)[0, 0].flatten() > 0)
        sizes = shape.prod(-1)
        joined = torch.cat(cells) if cells else patches.cells
        return cls(patches.axes / CELL, patches.low / CELL - 1.0, shape, sizes.cumsum(0) - sizes, joined)

    def holds(self, points: Tensor, plane: Tensor) -> Tensor:
        """True `[n]` where points `[n, 3]` [m] lie on or within a cell of the surface of their `plane` `[n]`."""
        cell = ((self.axes[plane] * points[:, None]).sum(-1) - self.low[plane]).floor().long()
        shape = self.shape[plane]
        inside = ((cell >= 0) & (cell < shape)).all(-1)
        place = self.start[plane] + cell[:, 0] * shape[:, 1] + cell[:, 1]
        return inside & self.cells[torch.where(inside, place, 0)]


@dataclass(frozen=True, eq=False)
class PointSources:
    """The transmitter and its images in planes, all point sources of a field.

    tx `[3]`: the transmitter [m]. frequency [Hz]. level_db: power over Friis' free-space gain of isotropic antennas,
    of the line of sight and of all images. planes: P planes; patches: where they have surface, or None for everywhere.
    reflection `[P, 3]`: a, b and c of 10 log10 Gamma = a + b cos + c cos^2 at the angle of incidence, at most 0 dB.
    sequence `[K, 3]`: the planes of each source in the order from the transmitter, -1 beyond the last; the first row is
    the line of sight, all -1. open_above: the transmittance of a way above which it is open. marks: where planes
    reflect otherwise, or None. mirrors `[P]`: False for planes that were found to mirror nothing, or None where nobody
    knows; it decides in which planes images are sought for another transmitter.
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

    def __post_init__(self) -> None:
        count = len(self.planes)
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
        return plan_of(self.chain, self.planes.normals, self.planes.offsets, self.sequence)

    @cached_property
    def reach(self) -> Reach | None:
        """Where the planes have surface, prepared to be asked fast; None for everywhere."""
        return None if self.patches is None else Reach.of(self.patches)

    def folded(self, receivers: Tensor) -> tuple[Folded, Tensor]:
        """The broken lines to receivers `[*batch, 3]`, and where all their points lie on surface `[*batch, K]`."""
        lines = fold(self.plan, receivers)
        good = lines.possible
        if self.reach is not None:
            for step in range(len(self.plan.steps)):
                plane = self.sequence[:, step]
                asked = torch.nonzero(good & (plane >= 0), as_tuple=True)
                good[asked] = self.reach.holds(lines.points[..., step, :][asked], plane[asked[-1]])
        return lines, good

    def gain(self, source: Tensor, distance: Tensor, cosine: Tensor, points: Tensor) -> Tensor:
        """Path gain `[n]`, linear, of open ways of `distance` `[n]` [m].

        They are reflected at `cosine` `[n, 3]` of incidence in `points` `[n, 3, 3]`.
        """
        level_db = self.level_db + self.reflection_db(source, cosine, points)
        return friis_gain(distance, self.frequency) * 10.0 ** (level_db / 10.0)

    def reflection_db(self, source: Tensor, cosine: Tensor, points: Tensor) -> Tensor:
        """Sum `[n]` of 10 log10 Gamma over the reflections of ways as in `gain`."""
        planes = self.sequence[source]
        way, step = torch.nonzero(planes >= 0, as_tuple=True)
        if not len(way):
            return cosine.new_zeros(len(source))
        plane, cos = planes[way, step], cosine[way, step]
        a, b, c = self.reflection[plane].unbind(-1)
        level_db = a + b * cos + c * cos * cos
        if self.marks is not None:
            level_db = level_db + self.marks.at(points[way, step], plane)
        return cosine.new_zeros(len(source)).index_add_(0, way, level_db.clamp_max(0.0).to(cosine.dtype))

    def transmittance(self, source: Tensor, points: Tensor, receivers: Tensor, obstacles: Obstacles) -> Tensor:
        """Share `[n]` that passes on the ways from the transmitter over `points` `[n, 3, 3]` to `receivers` `[n, 3]`.

        The product over the legs of a way; Gaussians of the planes that a leg joins do not stand in its way.
        """
        longest = len(self.plan.steps)
        none = torch.full((len(source), 1), -1)
        stops = torch.cat((self.tx.expand(len(source), 1, 3), points[:, :longest], receivers[:, None]), 1)
        labels = torch.cat((none, self.sequence[source, :longest], none), 1)
        known = obstacles.labels is not None
        passed = obstacles.transmittance(  # legs beyond the last go from the receiver to itself, and are free
            stops[:, :-1].reshape(-1, 3),
            stops[:, 1:].reshape(-1, 3),
            skip_start=labels[:, :-1].reshape(-1) if known else None,
            skip_end=labels[:, 1:].reshape(-1) if known else None,
        )
        return passed.reshape(-1, longest + 1).prod(-1)

    def rays(self, receiver: Tensor, obstacles: Obstacles) -> Rays:
        """What reaches a receiver at `receiver` `[3]` [m]."""
        return self.rays_each(receiver[None], obstacles)[0]

    def rays_each(self, receivers: Tensor, obstacles: Obstacles, *, in_sight: Tensor | None = None) -> list[Rays]:
        """What reaches each of the receivers `[n, 3]` [m]; `in_sight` `[n]` decides the line of sight where given."""
        lines, good = self.folded(receivers)
        place, source = torch.nonzero(good, as_tuple=True)
        points = lines.points[place, source]
        open_way = self.transmittance(source, points, receivers[place], obstacles) > self.open_above
        if in_sight is not None:
            open_way = torch.where(source == 0, in_sight[place], open_way)
        place, source, points = place[open_way], source[open_way], points[open_way]
        distance, cosine = lines.distance[place, source], lines.cosine[place, source]
        rays = Rays(
            source,
            self.gain(source, distance, cosine, points),
            lines.arrival[place, source],
            lines.departure[place, source],
            distance / SPEED_OF_LIGHT,
            self.order[source],
            points,
        )
        if len(receivers) == 1:
            return [rays]
        return [rays.only(place == number) for number in range(len(receivers))]

    def sees(self, receivers: Tensor, obstacles: Obstacles) -> Tensor:
        """True `[*batch]` where the line of sight to receivers `[*batch, 3]` is open."""
        flat = receivers.reshape(-1, 3)
        passed = obstacles.transmittance(self.tx.expand_as(flat), flat)
        return (passed > self.open_above).reshape(receivers.shape[:-1])
