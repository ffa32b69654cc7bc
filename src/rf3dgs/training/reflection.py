"""How much each plane reflects, from how far the images' peaks stand out of their surroundings."""

import math
from dataclasses import dataclass, fields

import torch
from torch import Tensor

from rf3dgs.core.angles import angle_between
from rf3dgs.core.threads import on_threads
from rf3dgs.core.units import SPEED_OF_LIGHT, friis_gain
from rf3dgs.field.images import HIGHEST_ORDER
from rf3dgs.field.rays import Rays
from rf3dgs.field.sources import PointSources
from rf3dgs.field.transmitter import pixel_of
from rf3dgs.spectra.spectrum import Spectrum

APART_LOBES, APART_FROM_SIGHT = 0.9, 2.0
HIDING_DB = 10.0  # by which one of two waves that arrive as one must be stronger, to be taken for both
LEAST_RING = 8
HUBER_DB = 1.5
ROUNDS = 30
COMMON = (10.0, 10.0, 10.0)  # dB by which a, b and c of one plane may differ from the common ones
LOOSE = (30.0, 30.0, 30.0)  # and the common ones from DIELECTRIC
DIELECTRIC = (-6.0, -6.0, 0.0)
SILENT_SHARE, SILENT_LEAST = 0.3, 3
BESIDE = 0.5  # m
DUE_DB = 3.0  # over what a peak must exceed to be seen
LATE = 1e-9  # s; a wall that stands 10 cm off delays its reflection by less


@dataclass(frozen=True, eq=False)
class Glints:
    """What was measured in the directions of images: n observations.

    position, source `[n]`: which. plane `[n, 3]`: the mirrors from the transmitter on, -1 beyond the last. point
    `[n, 3, 3]`: where the reflections are [m]. cosine `[n, 3]` of incidence. departure `[n, 3]`: unit vectors from the
    transmitter. level_db `[n]`: 10 log10 of what stands out over Friis and the sources' level. limit_db `[n]`: what in
    the same measure a peak must exceed to be seen: the level of the surroundings, or of another wave that arrives
    there. seen `[n]`: the peak stands 3 dB over its surroundings, and at the time of its way where the spectra have
    delays. alone `[n]`: no other ray arrives beside it. timed `[n]`: there are delays.
    """

    position: Tensor
    source: Tensor
    plane: Tensor
    point: Tensor
    cosine: Tensor
    departure: Tensor
    level_db: Tensor
    limit_db: Tensor
    seen: Tensor
    alone: Tensor
    timed: Tensor

    def __len__(self) -> int:
        return len(self.position)

    @property
    def order(self) -> Tensor:
        """Number of reflections `[n]`."""
        return (self.plane >= 0).sum(-1)

    def only(self, chosen: Tensor) -> "Glints":
        """Some of them, by a mask or list."""
        return Glints(*(getattr(self, field.name)[chosen] for field in fields(self)))


def glints(sources: PointSources, rays: list[Rays], spectra: Spectrum) -> Glints:
    """The observations of all rays that were reflected at the positions of `spectra` `[position, row, col]`.

    Of waves that arrive as one those that by their laws are much the weaker ones are not looked for: a transmitter
    beside a wall sends every reflection twice, and what is seen is the one that did not go over that wall.
    """

    def at(position: int) -> list[Tensor]:
        one, spectrum = rays[position], spectra[position]
        one = one.only(~outshone(one, APART_LOBES * spectrum.instrument.lobe))
        power, ring = ray_powers(spectrum, one.arrival)
        free = friis_gain(one.delay * SPEED_OF_LIGHT, sources.frequency) * 10 ** (sources.level_db / 10)
        apart = angle_between(one.arrival[:, None], one.arrival[None]) + torch.pi * torch.eye(len(one))
        lobes = torch.where(one.order == 0, APART_FROM_SIGHT, APART_LOBES)
        crowded = ((apart < lobes * spectrum.instrument.lobe) & (power > 0.25 * power[:, None])).any(-1)
        timely = on_time(spectrum, one)
        limit = torch.where(timely, ring, torch.maximum(power, ring))
        kept = (one.order > 0) & torch.isfinite(ring)
        plane = sources.sequence[one.index]
        stops = torch.cat((sources.tx.expand(len(one), 1, 3), one.points), 1)
        legs = torch.nn.functional.normalize(stops[:, 1:] - stops[:, :-1], dim=-1)
        cosine = (legs * sources.planes.normals[plane.clamp_min(0)]).sum(-1).abs().double()
        columns = (torch.full_like(one.index, position), one.index, plane, one.points, cosine, one.departure)
        timed = torch.full_like(crowded, spectrum.delay is not None)
        levels = (_decibels(power / free), _decibels(limit / free), (power > ring) & timely, ~crowded, timed)
        return [column[kept] for column in (*columns, *levels)]

    parts = on_threads(at, [position for position, one in enumerate(rays) if len(one)])
    if not parts:
        none, count = torch.zeros(0), torch.zeros(0, dtype=torch.long)
        rows, level = torch.zeros(0, 3), torch.zeros(0, dtype=torch.float64)
        columns = (count, count, rows.long(), torch.zeros(0, 3, 3), rows.double(), rows)
        return Glints(*columns, level, level, *(none > 0,) * 3)
    return Glints(*(torch.cat(column) for column in zip(*parts, strict=True)))


def outshone(rays: Rays, within: float) -> Tensor:
    """True `[k]` for rays beside which, `within` so many radians, a ray arrives that by its law is far stronger."""
    apart = angle_between(rays.arrival[:, None], rays.arrival[None])
    return ((apart < within) & (rays.power > 10 ** (HIDING_DB / 10) * rays.power[:, None])).any(-1)


def _decibels(value: Tensor) -> Tensor:
    return 10 * torch.log10(value.double().clamp_min(1e-12))


def on_time(one: Spectrum, rays: Rays) -> Tensor:
    """True `[k]` for rays at whose arrival a spectrum `[row, col]` has the delay of their way, within `LATE`.

    The delay there is the mean over half a lobe, weighted by power. Spectra without delays contradict no ray.
    """
    if one.delay is None:
        return torch.ones(len(rays), dtype=torch.bool)
    reach = max(0.5 * one.instrument.lobe, 0.75 * pixel_of(one))
    cosine = rays.arrival @ one.directions.reshape(-1, 3).mT
    pixel = torch.nonzero((cosine > math.cos(2 * reach)).any(0)).squeeze(-1)
    angle = torch.acos(cosine[:, pixel].clamp(-1, 1))
    weight = torch.where(angle < reach, one.heard.reshape(-1)[pixel] * one.instrument.kernel(angle), 0.0)
    total = weight.sum(-1).clamp_min(1e-30)
    return ((weight @ one.delay.reshape(-1)[pixel]) / total - rays.delay).abs() < LATE


def ray_powers(one: Spectrum, arrival: Tensor) -> tuple[Tensor, Tensor]:
    """Powers `[k]` of beams along `arrival` `[k, 3]` (world) in a spectrum `[row, col]`, and the levels around them.

    All beams are solved for together, by least squares of relative errors without negative powers, so that the skirt of
    a strong one is not taken for a weak one beside it. The level around is the median of the ring of 2 to 4 lobes, but
    for pixels beside other beams; NaN where the instrument does not look there.
    """
    lobe = one.instrument.lobe
    directions, seen = one.directions.reshape(-1, 3), one.heard.reshape(-1).double()
    angle = torch.acos((arrival @ directions.mT).clamp(-1, 1))
    angle = torch.where(one.looked.reshape(-1), angle, torch.inf)
    close = angle < 1.5 * lobe
    taken = close.sum(0)
    rings = []
    for row in range(len(arrival)):
        ring = (angle[row] > 2 * lobe) & (angle[row] < 4 * lobe)
        clear = ring & (taken == 0)
        values = seen[clear if int(clear.sum()) >= LEAST_RING else ring]
        rings.append(float(values.median()) if len(values) else math.nan)
    ring = torch.tensor(rings, dtype=torch.float64)
    known = torch.isfinite(ring)
    pixel = torch.nonzero((angle[known] < max(0.75 * lobe, 0.75 * pixel_of(one))).any(0)).squeeze(-1)
    nearest = torch.where(known[:, None], angle[:, pixel], torch.inf).argmin(0)
    base = ring[nearest]
    design = one.instrument.kernel(angle[:, pixel]).double().mT
    weight = 1 / (seen[pixel] + base).clamp_min(1e-30)
    matrix, target = design * weight[:, None], (seen[pixel] - base) * weight
    size = torch.linalg.vector_norm(matrix, dim=0).clamp_min(1e-30)  # columns of size 1: the ridge asks no level
    matrix = matrix / size
    free = known.clone()
    power = torch.zeros_like(ring)
    for _ in range(len(arrival)):
        part = matrix[:, free]
        normal = part.mT @ part + 1e-9 * torch.eye(part.shape[1], dtype=torch.float64)
        found = torch.linalg.solve(normal, part.mT @ target)
        power = torch.zeros_like(ring)
        power[free] = found / size[free]
        if bool((found >= 0).all()):
            break
        free = free & (power > 0)
    return power.clamp_min(0.0), ring


def fit_reflection(found: Glints, count: int) -> Tensor:
    """a, b and c `[count, 3]` of 10 log10 Gamma = a + b cos + c cos^2 of each plane, from isolated peaks.

    Huber's regression in dB, in which the reflections of a way add up. A peak of one reflection that is not seen says
    only that it is weaker than its surroundings; of more, nothing. Peaks whose reflections lie beside each other count
    together as one: a law is that of most of a plane, not of the place that most receivers look at. Planes are drawn to
    common values, so that one of few observations keeps near them.
    """
    start = torch.tensor(DIELECTRIC, dtype=torch.float64)
    used = found.only(found.alone & (found.seen | (found.order == 1)))
    if not len(used):
        return start.repeat(count, 1).float()
    design = _design(used, count)
    together = _together(used)
    common, own = start, start.repeat(count, 1)
    heard = torch.zeros(count, dtype=torch.bool).index_fill(0, used.plane[used.plane >= 0], True)
    stiff = 1 / torch.tensor(COMMON, dtype=torch.float64) ** 2
    loose = 1 / torch.tensor(LOOSE, dtype=torch.float64) ** 2
    for _ in range(ROUNDS):
        predicted = design @ own.reshape(-1)
        target = torch.where(used.seen, used.level_db, torch.minimum(used.limit_db, predicted))
        miss = target - predicted
        weight = (HUBER_DB / miss.abs().clamp_min(HUBER_DB)) / (HUBER_DB * used.order) ** 2 / together
        left = design.mT @ (weight[:, None] * design) + torch.diag(stiff.repeat(count))
        right = design.mT @ (weight * target) + (stiff * common).repeat(count)
        own = torch.linalg.solve(left, right).reshape(count, 3)
        common = (stiff * own[heard].sum(0) + loose * start) / (stiff * int(heard.sum()) + loose)
    return own.clamp(-200, 200).float()


def _together(found: Glints) -> Tensor:
    """How many single reflections `[n]` lie `BESIDE` each one on its plane, itself among them; 1 for all others."""
    number = torch.ones(len(found), dtype=torch.float64)
    single = torch.nonzero(found.order == 1).squeeze(-1)
    point, plane = found.point[single, 0], found.plane[single, 0]
    near = (torch.cdist(point, point) < BESIDE) & (plane[:, None] == plane)
    number[single] = near.sum(-1).double()
    return number


def _design(found: Glints, count: int) -> Tensor:
    """What of each plane's a, b and c is in each observation, `[n, 3 count]`."""
    cosine = found.cosine
    terms = torch.stack((torch.ones_like(cosine), cosine, cosine * cosine), -1)
    terms = torch.where((found.plane >= 0)[..., None], terms, 0.0)
    design = torch.zeros(len(found), count + 1, 3, dtype=torch.float64)
    design.scatter_add_(1, (found.plane % (count + 1))[..., None].expand(-1, -1, 3), terms)
    return design[:, :count].reshape(len(found), 3 * count)


def silent_planes(found: Glints, count: int, oblique: Tensor) -> Tensor:
    """True `[count]` for planes whose images were looked for and mostly not seen.

    An `oblique` `[count]` one must have been seen, by more positions than looked for it in vain.
    """
    single = found.only(found.alone & (found.order == 1))
    asked = torch.bincount(single.plane[:, 0], minlength=count)
    heard = torch.bincount(single.plane[single.seen, 0], minlength=count)
    return torch.where(oblique, 2 * heard <= asked, (asked >= SILENT_LEAST) & (heard < SILENT_SHARE * asked))


def law_levels(found: Glints, reflection: Tensor) -> Tensor:
    """The levels `[n]` [dB] that laws `reflection` `[P, 3]` give the observations."""
    laws = torch.cat((reflection, reflection.new_zeros(1, 3))).double()[found.plane]
    return (laws[..., 0] + found.cosine * (laws[..., 1] + found.cosine * laws[..., 2])).clamp_max(0.0).sum(-1)


def expected_db(found: Glints, sources: PointSources) -> Tensor:
    """The levels `[n]` [dB] that the observations have by all that `sources` says of its planes."""
    columns = (found.plane, found.cosine, found.point.double(), found.departure.double())
    return torch.from_numpy(sources.reflected_db(*(column.numpy() for column in columns)))


def silent_sources(found: Glints, reflection: Tensor, order: Tensor) -> Tensor:
    """True `[K]` for images of `order` `[K]` that by the laws `reflection` `[P, 3]` should stand out well and mostly
    were not seen, and for all images of an order from 2 on if its images, taken together, were not.
    """
    due = found.only(found.alone & (law_levels(found, reflection) > found.limit_db + DUE_DB))

    def silent(group: Tensor, count: int) -> Tensor:
        asked, heard = torch.bincount(group, minlength=count), torch.bincount(group[due.seen], minlength=count)
        return (asked >= SILENT_LEAST) & (heard < SILENT_SHARE * asked)

    orders = silent(due.order, HIGHEST_ORDER + 1)
    return silent(due.source, len(order)) | ((order > 1) & orders[order])
