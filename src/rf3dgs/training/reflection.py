"""How much each plane reflects, from how far the images' peaks stand out of their surroundings."""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from rf3dgs.core.angles import angle_between
from rf3dgs.core.units import SPEED_OF_LIGHT, friis_gain
from rf3dgs.field.rays import Rays
from rf3dgs.field.sources import Marks, PointSources
from rf3dgs.field.transmitter import pixel_of
from rf3dgs.spectra.spectrum import Spectrum

APART_LOBES, APART_FROM_SIGHT = 0.9, 2.0
LEAST_RING = 8
HUBER_DB = 1.5
ROUNDS = 30
COMMON = (10.0, 10.0, 10.0)  # dB by which a, b and c of one plane may differ from the common ones
LOOSE = (30.0, 30.0, 30.0)  # and the common ones from DIELECTRIC
DIELECTRIC = (-6.0, -6.0, 0.0)
WIDTHS = (0.3, 0.5, 0.8)  # of marks [m]
LEAST_MARKS = 6
DOUBTFUL_DB = 6.0
WORTH_DB = 0.4
MOST_DB = 25.0
SILENT_SHARE, SILENT_LEAST = 0.3, 3


@dataclass(frozen=True, eq=False)
class Glints:
    """What was measured in the directions of images of order 1: n observations.

    position, source, plane `[n]`: which. point `[n, 3]`: where the reflection is [m]. cosine `[n]` of incidence.
    level_db `[n]`: 10 log10 of what stands out over Friis and the sources' level. limit_db `[n]`: the level of the
    surroundings in the same measure. seen `[n]`: the peak stands 3 dB over its surroundings. alone `[n]`: no other ray
    arrives beside it.
    """

    position: Tensor
    source: Tensor
    plane: Tensor
    point: Tensor
    cosine: Tensor
    level_db: Tensor
    limit_db: Tensor
    seen: Tensor
    alone: Tensor

    def __len__(self) -> int:
        return len(self.position)


def glints(sources: PointSources, rays: list[Rays], spectra: Spectrum) -> Glints:
    """The observations of all rays of order 1 at the positions of `spectra` `[position, row, col]`."""
    rows, points = [], [torch.zeros(0, 3)]
    for position, one in enumerate(rays):
        if not len(one):
            continue
        spectrum = spectra[position]
        power, ring = ray_powers(spectrum, one.arrival)
        free = friis_gain(one.delay * SPEED_OF_LIGHT, sources.frequency) * 10 ** (sources.level_db / 10)
        apart = angle_between(one.arrival[:, None], one.arrival[None]) + torch.pi * torch.eye(len(one))
        lobes = torch.where(one.order == 0, APART_FROM_SIGHT, APART_LOBES)
        crowded = (apart < lobes * spectrum.instrument.lobe) & (power > 0.25 * power[:, None])
        for ray in torch.nonzero((one.order == 1) & torch.isfinite(ring)).squeeze(-1).tolist():
            plane = int(sources.sequence[one.index[ray], 0])
            leg = torch.nn.functional.normalize(one.points[ray, 0] - sources.tx, dim=-1)
            cosine = float((leg * sources.planes.normals[plane]).sum().abs())
            level, limit = float(power[ray] / free[ray]), float(ring[ray] / free[ray])
            seen, alone = level > limit, not bool(crowded[ray].any())
            points.append(one.points[ray, :1])
            rows.append((position, int(one.index[ray]), plane, cosine, level, limit, seen, alone))
    table = torch.tensor([[float(value) for value in row] for row in rows], dtype=torch.float64).reshape(-1, 8)
    position, source, plane, cosine, level, limit, seen, alone = table.unbind(-1)

    def decibels(value: Tensor) -> Tensor:
        return 10 * torch.log10(value.clamp_min(1e-12))

    numbers = (position.long(), source.long(), plane.long(), torch.cat(points), cosine)
    return Glints(*numbers, decibels(level), decibels(limit), seen > 0, alone > 0)


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

    Huber's regression in dB, in which a peak that is not seen says only that it is weaker than its surroundings. Planes
    are drawn to common values, so that one of few observations keeps near them.
    """
    use = found.alone
    plane, cosine = found.plane[use], found.cosine[use]
    seen, level, limit = found.seen[use], found.level_db[use], found.limit_db[use]
    design = torch.stack((torch.ones_like(cosine), cosine, cosine * cosine), -1)
    common = torch.tensor(DIELECTRIC, dtype=torch.float64)
    own = common.repeat(count, 1)
    if not len(plane):
        return own.float()
    stiff = 1 / torch.tensor(COMMON, dtype=torch.float64) ** 2
    loose = 1 / torch.tensor(LOOSE, dtype=torch.float64) ** 2
    for _ in range(ROUNDS):
        predicted = (design * own[plane]).sum(-1)
        target = torch.where(seen, level, torch.minimum(limit, predicted))
        miss = target - predicted
        weight = (HUBER_DB / miss.abs().clamp_min(HUBER_DB)) / HUBER_DB**2
        weighted = design * weight[:, None]
        left = torch.zeros(count, 3, 3, dtype=torch.float64)
        left.index_add_(0, plane, weighted[:, :, None] * design[:, None, :])
        right = torch.zeros(count, 3, dtype=torch.float64).index_add_(0, plane, weighted * target[:, None])
        own = torch.linalg.solve(left + torch.diag(stiff), right + stiff * common)
        heard = torch.bincount(plane, minlength=count) > 0
        start = torch.tensor(DIELECTRIC, dtype=torch.float64)
        common = (stiff * own[heard].sum(0) + loose * start) / (stiff * int(heard.sum()) + loose)
    return own.clamp(-200, 200).float()


def fit_marks(found: Glints, reflection: Tensor) -> Marks | None:
    """Where planes reflect otherwise than `reflection` `[P, 3]` says, or None where that predicts no plane better.

    Every isolated peak marks the place of its reflection with what it deviates, but for deep losses that hardly stand
    over their surroundings. A plane has marks if each is told better by the others of the plane than by none; the
    width is the one that tells them best.
    """
    design = torch.stack((torch.ones_like(found.cosine), found.cosine, found.cosine**2), -1)
    predicted = (design * reflection[found.plane].double()).sum(-1).clamp_max(0.0)
    miss = found.level_db - predicted
    doubtful = (miss < -DOUBTFUL_DB) & (found.level_db < found.limit_db + DOUBTFUL_DB)
    use = found.alone & found.seen & ~doubtful
    points, plane, level_db = found.point[use], found.plane[use], miss[use].clamp(-MOST_DB, MOST_DB).float()
    best, most = None, 0.0
    for width in WIDTHS:
        marks = Marks(points, plane, level_db, width)
        others = torch.from_numpy(marks.at(points.double().numpy(), plane.numpy(), leave_out=True)).float()
        gained = level_db.abs() - (level_db - others).abs()
        count = torch.bincount(plane, minlength=len(reflection))
        mean = torch.zeros(len(reflection)).index_add_(0, plane, gained) / count.clamp_min(1)
        worth = (count >= LEAST_MARKS) & (mean > WORTH_DB)
        total = float((mean * count)[worth].sum())
        if total > most:
            kept = worth[plane]
            best, most = Marks(points[kept], plane[kept], level_db[kept], width), total
    return best


def silent_planes(found: Glints, count: int) -> Tensor:
    """True `[count]` for planes whose images were looked for and mostly not seen."""
    asked = torch.bincount(found.plane[found.alone], minlength=count)
    heard = torch.bincount(found.plane[found.alone & found.seen], minlength=count)
    return (asked >= SILENT_LEAST) & (heard < SILENT_SHARE * asked)
