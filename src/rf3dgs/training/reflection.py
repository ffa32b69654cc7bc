"""How much each plane reflects, from how far the images' peaks stand out of their surroundings."""

from dataclasses import dataclass

import torch
from torch import Tensor

from rf3dgs.core.angles import angle_between
from rf3dgs.core.units import SPEED_OF_LIGHT, friis_gain
from rf3dgs.field.sources import PointSources, Rays
from rf3dgs.spectra.spectrum import Spectrum
from rf3dgs.training.line_of_sight import standing_out

APART_LOBES = 2.0
HUBER_DB = 1.5
ROUNDS = 30
COMMON = (10.0, 10.0, 10.0)  # dB by which a, b and c of one plane may differ from the common ones
LOOSE = (30.0, 30.0, 30.0)  # and the common ones from DIELECTRIC
DIELECTRIC = (-6.0, -6.0, 0.0)
LEAST_DB = -60.0


@dataclass(frozen=True, eq=False)
class Glints:
    """What was measured in the directions of images of order 1: n observations.

    position, source, plane `[n]`: which. cosine `[n]` of incidence. level_db `[n]`: 10 log10 of what stands out over
    Friis and the sources' level. limit_db `[n]`: the level of the surroundings in the same measure, under which nothing
    is seen. seen `[n]`: the peak stands 3 dB over its surroundings. alone `[n]`: no other ray arrives beside it.
    """

    position: Tensor
    source: Tensor
    plane: Tensor
    cosine: Tensor
    level_db: Tensor
    limit_db: Tensor
    seen: Tensor
    alone: Tensor

    def __len__(self) -> int:
        return len(self.position)


def glints(sources: PointSources, rays: list[Rays], spectra: Spectrum) -> Glints:
    """The observations of all rays of order 1 at the positions of `spectra` `[position, row, col]`."""
    rows = []
    for position, one in enumerate(rays):
        spectrum = spectra[position]
        apart = APART_LOBES * spectrum.instrument.lobe
        for ray in torch.nonzero(one.order == 1).squeeze(-1).tolist():
            power, ring = standing_out(spectrum, one.arrival[ray])
            if not ring == ring:
                continue
            friis = float(friis_gain(one.delay[ray] * SPEED_OF_LIGHT, sources.frequency))
            free = friis * 10 ** (sources.level_db / 10)
            angle = angle_between(one.arrival, one.arrival[ray].expand_as(one.arrival))
            angle[ray] = torch.pi
            near = (angle < apart) & ((one.power > 0.25 * one.power[ray]) | (one.order == 0))
            plane = int(sources.sequence[one.index[ray], 0])
            leg = torch.nn.functional.normalize(one.points[ray, 0] - sources.tx, dim=-1)
            cosine = float((leg * sources.planes.normals[plane]).sum().abs())
            seen = power > ring
            rows.append((position, int(one.index[ray]), plane, cosine, power / free, ring / free, seen, not near.any()))
    table = torch.tensor([[float(value) for value in row] for row in rows], dtype=torch.float64).reshape(-1, 8)
    position, source, plane, cosine, level, limit, seen, alone = table.unbind(-1)

    def decibels(value: Tensor) -> Tensor:
        return 10 * torch.log10(value.clamp_min(1e-12))

    numbers = (position.long(), source.long(), plane.long(), cosine)
    return Glints(*numbers, decibels(level), decibels(limit), seen > 0, alone > 0)


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
