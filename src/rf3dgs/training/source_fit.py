"""The point sources of a field, out of spectra and geometry: steps 1 to 5 of docs/theory/radiance.md, in closed form."""

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from rf3dgs.core.errors import InputError
from rf3dgs.core.frames import Pose
from rf3dgs.field.images import HIGHEST_ORDER, fold, image_chain, sequences
from rf3dgs.field.sources import PointSources, Rays
from rf3dgs.geometry import Surfaces
from rf3dgs.spectra.spectrum import Spectrum
from rf3dgs.splats.obstacles import Obstacles
from rf3dgs.training.config import SourceConfig
from rf3dgs.training.line_of_sight import fit_line_of_sight, fit_opening
from rf3dgs.training.reflection import Glints, fit_reflection, glints

PROBES = 150
PROBE_MARGIN = 0.5
ROWS_AT_ONCE = 400_000


@dataclass(frozen=True, eq=False)
class SourceFit:
    """Point sources and what they are at the training positions.

    seen `[position]`: who sees the transmitter, as the spectra tell. rays: what reaches each position. found: what the
    spectra show in the directions of the images, or None without images. plane_of `[N]`: the planes of the Gaussians,
    or None without planes.
    """

    sources: PointSources
    seen: Tensor
    rays: list[Rays]
    plane_of: Tensor | None = None
    found: Glints | None = None


def fit_sources(
    spectra: Spectrum,
    surfaces: Surfaces | None,
    obstacles: Obstacles,
    tx: Pose,
    config: SourceConfig | None = None,
) -> SourceFit:
    """The transmitter at `tx` and its images in the planes of `surfaces`, fitted to `spectra` `[position, row, col]`.

    Without `surfaces` there is the line of sight alone. `obstacles` are labelled by `surfaces.plane_of`.
    """
    config = SourceConfig() if config is None else config
    if not 0 <= config.order <= HIGHEST_ORDER:
        raise InputError(f"order must be from 0 to {HIGHEST_ORDER}; got {config.order}")
    positions = spectra.pose.position
    direct = PointSources.line_of_sight(tx.position, spectra.frequency)
    direct, seen = fit_line_of_sight(direct, spectra)
    direct = fit_opening(direct, seen, positions, obstacles)
    if surfaces is None or config.order == 0 or not len(surfaces.planes):
        return SourceFit(direct, seen, direct.rays_each(positions, obstacles, in_sight=seen))
    probes = torch.cat((positions, _probes(positions, config.seed)))
    sources = with_images(direct, surfaces, probes, replace(config, order=1))
    rays = sources.rays_each(positions, obstacles, in_sight=seen)
    found = glints(sources, rays, spectra)
    sources = replace(sources, reflection=fit_reflection(found, len(surfaces.planes)))
    sources = with_images(sources, surfaces, probes, config)
    sources = _strongest(sources, probes, obstacles, spectra, config)
    rays = sources.rays_each(positions, obstacles, in_sight=seen)
    return SourceFit(sources, seen, rays, surfaces.plane_of, glints(sources, rays, spectra))


def with_images(sources: PointSources, surfaces: Surfaces, probes: Tensor, config: SourceConfig) -> PointSources:
    """The sources with all images up to `config.order` that reach one of the `probes` `[n, 3]` over surface."""
    planes, patches = surfaces.planes, surfaces.patches
    areas = patches.areas
    order = areas.argsort(descending=True, stable=True)[: config.planes]
    third = order[: config.largest] if config.order >= 3 else None
    rows = sequences(len(order), min(config.order, 2))
    rows = torch.where(rows >= 0, order[rows.clamp_min(0)], -1)
    if third is not None:
        extra = sequences(len(third), 0, third=torch.arange(len(third)))[1:]
        rows = torch.cat((rows, third[extra]))
    reflection = sources.reflection
    if len(reflection) != len(planes):
        reflection = fit_reflection(_nothing(), len(planes))
    whole = replace(sources, planes=planes, patches=patches, reflection=reflection, sequence=rows)
    kept = [torch.zeros(1, dtype=torch.long)]
    for chunk in torch.arange(1, len(rows)).split(max(1, ROWS_AT_ONCE // len(probes))):
        part = replace(whole, sequence=torch.cat((rows[:1], rows[chunk])))
        reached = part.folded(probes)[1].any(0)[1:]
        kept.append(chunk[reached])
    return replace(whole, sequence=rows[torch.cat(kept)])


def _nothing() -> Glints:
    empty, number = torch.zeros(0, dtype=torch.float64), torch.zeros(0, dtype=torch.long)
    flag = torch.zeros(0, dtype=torch.bool)
    return Glints(number, number, number, empty, empty, empty, flag, flag)


def _probes(positions: Tensor, seed: int) -> Tensor:
    """Receivers `[PROBES, 3]` drawn evenly in the box of the positions, a little widened."""
    low, high = positions.amin(0) - PROBE_MARGIN, positions.amax(0) + PROBE_MARGIN
    return low + (high - low) * torch.rand(PROBES, 3, generator=torch.Generator().manual_seed(seed))


def _strongest(
    sources: PointSources, probes: Tensor, obstacles: Obstacles, spectra: Spectrum, config: SourceConfig
) -> PointSources:
    """The sources that somewhere come within `config.least_db` of the strongest peak, at most `config.most`."""
    best = torch.zeros(len(sources))
    floor = 10 ** (-config.least_db / 10)
    peak = spectra.power.amax((-2, -1)).median()
    for number, rays in enumerate(sources.rays_each(probes, obstacles)):
        if not len(rays):
            continue
        top = spectra.power[number].max() if number < len(spectra) else torch.maximum(rays.power.max(), 0.01 * peak)
        best.index_reduce_(0, rays.index, rays.power / top, "amax")
    order = best[1:].argsort(descending=True, stable=True)[: config.most] + 1
    kept = order[best[order] > floor].sort().values
    return replace(sources, sequence=sources.sequence[torch.cat((torch.zeros(1, dtype=torch.long), kept))])
