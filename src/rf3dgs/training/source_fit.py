"""The point sources of a field, out of spectra and geometry, in closed form: see docs/theory/radiance.md."""

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from rf3dgs.core.errors import InputError
from rf3dgs.core.frames import Pose
from rf3dgs.field.images import HIGHEST_ORDER
from rf3dgs.field.moving import with_images as images_among
from rf3dgs.field.rays import Rays
from rf3dgs.field.sources import PointSources
from rf3dgs.geometry import Patches, Planes, Surfaces
from rf3dgs.spectra.spectrum import Spectrum
from rf3dgs.splats.gaussians import Gaussians
from rf3dgs.splats.obstacles import Obstacles
from rf3dgs.training.config import SourceConfig
from rf3dgs.training.consolidation import consolidated, oblique_planes, squared, walls_whole, with_skins
from rf3dgs.training.levels import TOLD_BY, fit_levels
from rf3dgs.training.line_of_sight import fit_line_of_sight, fit_opening
from rf3dgs.training.marks import Paint
from rf3dgs.training.reflection import DIELECTRIC, Glints, fit_reflection, glints, silent_planes, silent_sources
from rf3dgs.training.small_planes import flat_pieces, outlined, standing, with_both_faces
from rf3dgs.training.timed_mirrors import timed_mirrors, with_timed
from rf3dgs.training.virtual import Peaks, completed, find_mirrors, peaks_of, refined_planes, with_mirrors

PROBES = 150
PROBE_MARGIN = 0.5
GATES = (0.6, 0.5, 0.4, 0.3, 0.2, 0.1, 0.05)  # of transmittance
USUAL, USUAL_OF_MESHES = 0.5, 0.1  # what passes beside outlines
OF_MESHES = 0.9  # of the Gaussians of a mesh have one and the same opacity
WORTH_A_CHANGE = 0.01  # share of what was looked at that another threshold must tell better
UNTIMED = 5  # times as much is asked where no delay says whether a peak is the reflection
SIGHT_WEIGHT = 3


@dataclass(frozen=True, eq=False)
class SourceFit:
    """Point sources and what they are at the training positions.

    seen `[position]`: who sees the transmitter, as the spectra tell. rays: what reaches each position. obstacles: the
    Gaussians as they stop rays, labelled by plane where there are planes, without what stands in ways that were seen to
    be open. found: what the spectra show in the directions of the images, or None without images.
    """

    sources: PointSources
    seen: Tensor
    rays: list[Rays]
    obstacles: Obstacles
    found: Glints | None = None


def fit_sources(
    spectra: Spectrum,
    surfaces: Surfaces | None,
    obstacles: Obstacles,
    tx: Pose,
    config: SourceConfig | None = None,
    *,
    geometry: Gaussians | None = None,
) -> SourceFit:
    """The transmitter at `tx` and its images in the planes of `surfaces`, fitted to `spectra` `[position, row, col]`.

    Without `surfaces` there is the line of sight alone. Their pieces of large planes are made one, and mirrors that
    they lack are added; the result says which Gaussians of `obstacles` belong to which plane. `geometry`, the same
    Gaussians with colours, shows where the material of a plane changes.
    """
    config = SourceConfig() if config is None else config
    if not 0 <= config.order <= HIGHEST_ORDER:
        raise InputError(f"order must be from 0 to {HIGHEST_ORDER}; got {config.order}")
    positions = spectra.pose.position
    direct = PointSources.line_of_sight(tx.position, spectra.frequency)
    direct, seen = fit_line_of_sight(direct, spectra)
    direct = fit_opening(direct, seen, positions, obstacles)
    if surfaces is None or config.order == 0 or not len(surfaces.planes):
        obstacles = replace(obstacles, labels=None).cleared(tx.position.expand_as(positions), positions, seen)
        return SourceFit(direct, seen, direct.rays_each(positions, obstacles, in_sight=seen), obstacles)
    probes = torch.cat((positions, _probes(positions, config.seed)))
    peaks = peaks_of(spectra)
    site, timed = _placed(direct, surfaces, obstacles, spectra, peaks, config)
    site = replace(site, sources=with_images(site.sources, probes, replace(config, order=1)))
    by_bearings = replace(config, complete=config.complete and not timed)
    if by_bearings.refine or by_bearings.complete:
        site = _told_by_bearings(site, spectra, peaks, seen, probes, by_bearings)
    site = _opened(site, spectra, seen)
    paint = None if geometry is None else Paint.of(geometry, site.surfaces.plane_of)
    sources, found = _levelled(site, spectra, seen, probes, paint, config)
    if config.order > TOLD_BY:
        sources = with_images(sources, probes, config)
    sources = _strongest(sources, probes, site.obstacles, spectra, config)
    looked = glints(sources, sources.rays_each(positions, site.obstacles, in_sight=seen), spectra)
    dark = silent_sources(looked, sources.reflection, sources.order)
    sources = replace(sources, sequence=sources.sequence[~dark])
    return SourceFit(sources, seen, sources.rays_each(positions, site.obstacles, in_sight=seen), site.obstacles, found)


@dataclass(frozen=True, eq=False)
class _Site:
    """Point sources over the planes of the surfaces, and the obstacles, whose labels are the planes' numbers."""

    sources: PointSources
    surfaces: Surfaces
    obstacles: Obstacles

    @classmethod
    def of(cls, sources: PointSources, surfaces: Surfaces, obstacles: Obstacles) -> "_Site":
        """All three over the planes of the surfaces."""
        sources = replace(sources, planes=surfaces.planes, patches=surfaces.patches)
        return cls(sources, surfaces, replace(obstacles, labels=surfaces.plane_of))

    def over(self, planes: Planes, patches: Patches) -> "_Site":
        """The site over planes that were found; Gaussians near large ones become theirs."""
        surfaces = replace(self.surfaces, planes=planes, patches=patches)
        surfaces = replace(surfaces, plane_of=with_skins(surfaces, self.obstacles.means))
        return self.of(completed(self.sources, planes, patches), surfaces, self.obstacles)


def _placed(
    direct: PointSources,
    surfaces: Surfaces,
    obstacles: Obstacles,
    spectra: Spectrum,
    peaks: Peaks,
    config: SourceConfig,
) -> tuple[_Site, bool]:
    """The transmitter among planes that are whole, square and where delays put them; and whether any delay did.

    Planes reflect as dielectrics do, so far.
    """
    surfaces = with_both_faces(consolidated(surfaces, obstacles.means), obstacles)
    reflection = torch.tensor(DIELECTRIC).expand(len(surfaces.planes), 3)
    known = replace(direct, planes=surfaces.planes, patches=surfaces.patches, reflection=reflection)
    site = _Site.of(known, surfaces, obstacles)
    walls = surfaces.planes.normals[surfaces.patches.large]
    timed = timed_mirrors(peaks, spectra, direct.tx, walls) if config.complete else []
    if timed:
        site = site.over(*with_timed(site.sources, timed))
    surfaces = squared(site.surfaces) if config.square else site.surfaces
    return _Site.of(site.sources, flat_pieces(surfaces, site.obstacles), site.obstacles), bool(timed)


def _told_by_bearings(
    site: _Site, spectra: Spectrum, peaks: Peaks, seen: Tensor, probes: Tensor, config: SourceConfig
) -> _Site:
    """The site with its planes where peaks have their images, and with mirrors that peaks without one point to."""
    positions = spectra.pose.position

    def refined(site: _Site) -> _Site:
        rays = site.sources.rays_each(positions, site.obstacles, in_sight=seen)
        return replace(
            site, sources=replace(site.sources, planes=refined_planes(site.sources, rays, peaks, positions, config))
        )

    if config.refine:
        site = refined(site)
    if not config.complete:
        return site
    every = with_images(_fitted(site.sources, spectra, seen, site.obstacles), probes, config)
    rays = every.rays_each(positions, site.obstacles, in_sight=seen)
    mirrors = find_mirrors(every, rays, peaks, spectra, site.obstacles)
    if not mirrors:
        return site
    site = site.over(*with_mirrors(site.sources, mirrors))
    site = replace(site, sources=with_images(site.sources, probes, replace(config, order=1)))
    return refined(site)


def _opened(site: _Site, spectra: Spectrum, seen: Tensor) -> _Site:
    """The site with outlines of things, the gate, and without what stands in ways that were seen to be open."""
    sources, patches = site.sources, site.sources.patches
    assert patches is not None
    patches = standing(sources.planes, outlined(sources.planes, walls_whole(patches), site.obstacles))
    sources = _gated(replace(sources, patches=patches), spectra, seen, site.obstacles)
    return replace(site, sources=sources, obstacles=cleared_by(sources, spectra, seen, site.obstacles))


def _levelled(
    site: _Site, spectra: Spectrum, seen: Tensor, probes: Tensor, paint: Paint | None, config: SourceConfig
) -> tuple[PointSources, Glints]:
    """The sources of the orders that tell levels, with what planes reflect and their marks; and what was seen there."""
    sources, positions = site.sources, spectra.pose.position
    found = glints(sources, sources.rays_each(positions, site.obstacles, in_sight=seen), spectra)
    sources = replace(sources, reflection=fit_reflection(found, len(sources.planes)))
    assert sources.patches is not None
    silent = silent_planes(found, len(sources.planes), oblique_planes(sources.planes, sources.patches))
    sources = with_images(sources, probes, replace(config, order=min(config.order, TOLD_BY)), silent=silent)
    found = glints(sources, sources.rays_each(positions, site.obstacles, in_sight=seen), spectra)
    dark = silent_sources(found, sources.reflection, sources.order)
    found = found.only(~dark[found.source])
    return fit_levels(sources, found, paint), found


def with_images(
    sources: PointSources, probes: Tensor, config: SourceConfig, *, silent: Tensor | None = None
) -> PointSources:
    """The sources with all images up to `config.order` that reach one of the `probes` `[n, 3]` over surface.

    Planes that are `silent` `[P]` mirror nothing.
    """
    if silent is not None:
        sources = replace(sources, mirrors=~silent)
    return images_among(sources, probes, order=config.order, planes=config.planes, largest=config.largest)


def _fitted(sources: PointSources, spectra: Spectrum, seen: Tensor, obstacles: Obstacles) -> PointSources:
    """The sources with what each plane reflects."""
    rays = sources.rays_each(spectra.pose.position, obstacles, in_sight=seen)
    return replace(sources, reflection=fit_reflection(glints(sources, rays, spectra), len(sources.planes)))


def cleared_by(sources: PointSources, spectra: Spectrum, seen: Tensor, obstacles: Obstacles) -> Obstacles:
    """The obstacles without what stands in ways that the spectra show to be open, lines of sight and single mirrors,
    unless ways that they show to be closed need it.
    """
    positions = spectra.pose.position
    ways = [sources.candidates(position, obstacles)[0] for position in positions]
    looked = glints(sources, ways, spectra)
    looked = looked.only(looked.alone & (looked.order == 1))
    receiver, mirror, plane = positions[looked.position], looked.point[:, 0], looked.plane[:, 0]
    nothing, straight = torch.full_like(plane, -1), torch.full((len(positions),), -1)
    return obstacles.cleared(
        torch.cat((sources.tx.expand_as(mirror), mirror, sources.tx.expand_as(positions))),
        torch.cat((mirror, receiver, positions)),
        torch.cat((looked.seen, looked.seen, seen)),
        skip_start=torch.cat((nothing, plane, straight)),
        skip_end=torch.cat((plane, nothing, straight)),
    )


def _gated(sources: PointSources, spectra: Spectrum, seen: Tensor, obstacles: Obstacles) -> PointSources:
    """The sources with the threshold that agrees best with who sees the transmitter, and which reflections shine.

    Outlines of photographs ask for 0.4 to 0.7, which 40 positions do not tell apart, those of Gaussians sampled on a
    mesh for 0.1: 2 cm beside an edge 0.2 passes. What asks for another must say so clearly. A way that is open and
    should not be counts twice: it misleads a beam, where one that is missing only costs its own power. The line of
    sight counts thrice. Peaks without a delay prove less, and mirrors found by them are less sure: their ways stay
    closed rather than open.
    """
    ways = [sources.candidates(position, obstacles) for position in spectra.pose.position]
    looked = glints(sources, [rays for rays, _ in ways], spectra)
    passed = torch.zeros(len(spectra), len(sources))
    for place, (rays, share) in enumerate(ways):
        passed[place, rays.index] = share
    gates = torch.tensor(GATES)[:, None]
    wrong = SIGHT_WEIGHT * ((passed[:, 0] > gates) != seen).sum(-1)
    shone = passed[looked.position, looked.source][looked.alone]
    glints_seen = looked.seen[looked.alone]
    wrong = wrong + 2 * ((shone > gates) & ~glints_seen).sum(-1) + ((shone <= gates) & glints_seen).sum(-1)
    proof = WORTH_A_CHANGE * (UNTIMED if spectra.delay is None else 1)
    worth = proof * (SIGHT_WEIGHT * len(seen) + len(shone))
    _, alike = obstacles.opacities.unique(return_counts=True)
    sampled = bool((alike > OF_MESHES * len(obstacles.opacities)).any()) and spectra.delay is not None
    usual, best = GATES.index(USUAL_OF_MESHES if sampled else USUAL), int(wrong.argmin())
    return replace(sources, open_above=GATES[best if int(wrong[best]) < int(wrong[usual]) - worth else usual])


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
        best = torch.maximum(best, torch.zeros_like(best).index_put((rays.index,), rays.power / top))
    order = best[1:].argsort(descending=True, stable=True)[: config.most] + 1
    kept = order[best[order] > floor].sort().values
    return replace(sources, sequence=sources.sequence[torch.cat((torch.zeros(1, dtype=torch.long), kept))])
