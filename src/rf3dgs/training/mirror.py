"""The mirror model's radio stage: spectra and frozen geometry to a `RadioField` whose parts are laws of physics."""

import torch
from torch import Tensor

from rf3dgs.splats.gaussians import Gaussians
from rf3dgs.splats.surface import normals
from rf3dgs.splats.transmittance import segment_transmittance
from rf3dgs.training.planes import find_planes

CELL = 0.8


def simple_surfaces(geometry: Gaussians, viewpoints: Tensor) -> tuple[Tensor, Tensor]:
    """normals [N, 3] turned to the viewpoints and segment_of [N]"""
    normal = normals(geometry)
    centre = viewpoints.mean(0)
    planes = find_planes(geometry.means, 0.04, 40, torch.Generator().manual_seed(0))
    distance = (geometry.means @ planes.normals.mT - planes.offsets).abs()
    aligned = (normal @ planes.normals.mT).abs() > 0.9
    score = torch.where(aligned & (distance < 0.06), distance, torch.inf)
    best, plane = score.min(1)
    on = torch.isfinite(best)
    normal = torch.where(on[:, None], planes.normals[plane], normal)
    normal = normal * torch.where(((centre - geometry.means) * normal).sum(-1) < 0, -1.0, 1.0)[:, None]
    cellkey = torch.floor(geometry.means / 1.0).long()
    axis = normal.abs().argmax(-1)
    sign = (normal.gather(1, axis[:, None])[:, 0] > 0).long()
    side = ((planes.normals[plane] * normal).sum(-1) > 0).long()
    key = torch.cat((cellkey, (axis * 2 + sign)[:, None], torch.full((len(normal), 1), -1)), -1)
    key = torch.where(on[:, None], torch.stack((plane * 0, plane * 0, plane * 0, side, plane), -1), key)
    return normal, torch.unique(key, dim=0, return_inverse=True)[1]


def cells_of(means: Tensor, segment_of: Tensor) -> Tensor:
    """The cell of 0.8 m of each Gaussian within its segment."""
    key = torch.cat((torch.floor(means / CELL).long(), segment_of[:, None]), -1)
    return torch.unique(key, dim=0, return_inverse=True)[1]


def visibility_of(geometry: Gaussians, normal: Tensor, tx: Tensor) -> Tensor:
    start = geometry.means + 0.08 * normal
    passed = segment_transmittance(
        geometry.means, geometry.quats, geometry.scales, geometry.opacities, start, tx[None].expand_as(start), stop_short=0.05
    )
    return passed * ((tx - geometry.means) * normal).sum(-1).gt(0)
