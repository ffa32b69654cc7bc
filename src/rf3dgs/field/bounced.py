"""What surfaces get from the surfaces that the transmitter lights: one bounce, up to a factor that all share.

    I_c = sum_g a_g L_g(v) cos_g cos_c T / d^2

over lit Gaussians g of area a_g, seen from cell c in the direction v at the distance d, with the cosines at both ends
and the transmittance T between them. L_g is the lit part of the mirror model (`field.lit`). Some hundred Gaussians
stand for all, drawn evenly by what they send out. Delay and departure of this light are known with it.
"""

import torch
from torch import Tensor

from rf3dgs.core.units import SPEED_OF_LIGHT
from rf3dgs.field.lit import LitSurface, incidence
from rf3dgs.field.radiance import NANOSECOND
from rf3dgs.splats.obstacles import Obstacles

EMITTERS = 300
NEAREST = 0.3  # m; what stands nearer counts as that far: an emitter stands for its neighbours
LIFT = 0.05  # m off both surfaces
ROOM = 0.3  # of the median: what comes by more bounces, to everyone


def shift_of(got: Tensor) -> Tensor:
    """How far the ambient level of each cell `[C]` [dB] lies over a level that all share, where one bounce brings it
    `got` `[C]`; more bounces bring as much to all."""
    return 10 * torch.log10((got + ROOM * got.median()).clamp_min(1e-30))


def bounced(surface: LitSurface, obstacles: Obstacles) -> Tensor:
    """I of the module's page, and I times delay [ns] from the transmitter to the cell and times departure vector,
    `[C, 5]`, at the middle Gaussian of each cell; `obstacles` are the surface's own Gaussians."""
    middle = middles(surface)
    means, normals = surface.means[middle], surface.normals[middle]
    labels = None if obstacles.labels is None else obstacles.labels[middle]
    distance, cosine, mirrored = incidence(surface.means, surface.normals, surface.tx)
    law = surface.laws[surface.segment_of]
    sent = surface.visibility * 10 ** (law[:, 0] / 10) * torch.exp(law[:, 1] * cosine) / distance**2
    area = surface.scales.sort(-1).values[:, 1:].prod(-1) * surface.opacities
    chosen, weight = _drawn((sent * area / (law[:, 2] + 1)).double(), surface.cell_of)
    total = torch.zeros(len(middle), 5)
    light = SPEED_OF_LIGHT * NANOSECOND
    for one, share in zip(chosen.tolist(), weight.tolist(), strict=True):
        way = means - surface.means[one]
        far = torch.linalg.vector_norm(way, dim=-1).clamp_min(NEAREST)
        way = way / far[:, None]
        leaves = (way * surface.normals[one]).sum(-1).clamp_min(0.0)
        arrives = -(way * normals).sum(-1).clamp_max(0.0)
        lobe = (0.5 + 0.5 * (way * mirrored[one]).sum(-1)).clamp_min(1e-6) ** law[one, 2]
        power = share * (law[one, 2] + 1) * lobe * leaves * arrives / far.square()
        reached = torch.nonzero(power > 0).squeeze(-1)
        start = (surface.means[one] + LIFT * surface.normals[one]).expand(len(reached), 3)
        passed = obstacles.transmittance(
            start,
            means[reached] + LIFT * normals[reached],
            skip_start=None if obstacles.labels is None else obstacles.labels[one].expand(len(reached)),
            skip_end=None if labels is None else labels[reached],
        )
        late = (distance[one] + far[reached]) / light
        left = torch.nn.functional.normalize(surface.means[one] - surface.tx, dim=-1).expand(len(reached), 3)
        known = torch.cat((torch.ones(len(reached), 1), late[:, None], left), -1)
        total[reached] += (power[reached] * passed)[:, None] * known
    return total


def middles(surface: LitSurface) -> Tensor:
    """The Gaussian `[C]` nearest to the mean of each cell's."""
    cells, order = len(surface.cell_sh), surface.cell_of
    count = torch.bincount(order, minlength=cells)
    centre = torch.zeros(cells, 3).index_add_(0, order, surface.means) / count.clamp_min(1)[:, None]
    away = torch.linalg.vector_norm(surface.means - centre[order], dim=-1)
    nearest = away.argsort(stable=True)
    nearest = nearest[order[nearest].argsort(stable=True)]  # by cell, and in each the nearest first
    first = count.cumsum(0) - count
    return nearest[first.clamp_max(len(nearest) - 1)]


def _drawn(power: Tensor, group: Tensor) -> tuple[Tensor, Tensor]:
    """Which `EMITTERS` Gaussians stand for all that send `power` `[N]`, evenly along their `group`, and how much."""
    total = power.sum()
    if float(total) <= 0:
        return torch.zeros(0, dtype=torch.long), torch.zeros(0)
    order = group.argsort(stable=True)
    upto = power[order].cumsum(0) / total
    place = (torch.arange(EMITTERS, dtype=power.dtype) + 0.5) / EMITTERS
    return order[torch.searchsorted(upto, place).clamp_max(len(order) - 1)], (total / EMITTERS).expand(EMITTERS)
