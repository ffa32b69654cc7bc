"""Point sources for a part of the training positions, when the others are left out to learn a field's uncertainty."""

from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from rf3dgs.field.lit import LitSurface
from rf3dgs.field.radio_field import RadioField
from rf3dgs.field.sources import PointSources
from rf3dgs.geometry import find_surfaces
from rf3dgs.spectra.spectrum import Spectrum
from rf3dgs.splats.gaussians import Gaussians
from rf3dgs.splats.obstacles import Obstacles
from rf3dgs.training.lit_views import LitView, Observations, lit_views, observe
from rf3dgs.training.source_fit import fit_sources

SAME_COSINE, SAME_OFFSET = 0.9986, 0.2  # planes within 3 degrees and 20 cm [m] are one


def with_sources(
    field: RadioField,
    views: Sequence[LitView],
    observed: Observations,
    geometry: Gaussians,
    spectra: Spectrum,
    places: list[int],
) -> tuple[RadioField, list[LitView], Observations]:
    """The same with point sources that were fitted without `places`, which they would otherwise give away."""
    kept = torch.tensor([place for place in range(len(spectra)) if place not in places])
    surfaces = find_surfaces(geometry, spectra.pose.position[kept])
    surface = field.surface
    assert isinstance(surface, LitSurface)
    obstacles = Obstacles(surface.means, surface.quats, surface.scales, field.solidity, surfaces.plane_of)
    found = fit_sources(spectra[kept], surfaces, obstacles, field.tx)
    every, mine = list(views), lit_views(spectra[kept], found.rays)
    for place, view in zip(kept.tolist(), mine, strict=True):
        every[place] = view
    told = observe(geometry, mine, unit=surface.unit, backend=field.backend)
    told = replace(told, view=kept[told.view], receivers=observed.receivers)
    told = replace(told, level_db=told.level_db.clamp_min(float(observed.level_db.min())))
    return replace(field, sources=found.sources, plane_of=found.plane_of), every, told


def as_known(source_db: Tensor, ours: PointSources, theirs: PointSources) -> Tensor:
    """Errors `[P' + 1]` of ways over `their` planes, out of those `[P + 1]` of `ours`; typical for new planes."""
    cosine = theirs.planes.normals @ ours.planes.normals.mT
    apart = (theirs.planes.offsets[:, None] - cosine.sign() * ours.planes.offsets).abs()
    apart = torch.where(cosine.abs() > SAME_COSINE, apart, torch.inf)
    typical = source_db.square().mean().sqrt().expand(len(apart), 1)
    table = torch.cat((source_db[:-1].expand(len(apart), -1), typical), -1)
    apart = torch.cat((apart, torch.full((len(apart), 1), SAME_OFFSET)), -1)
    return torch.cat((table.gather(1, apart.argmin(-1, keepdim=True))[:, 0], source_db[-1:]))
