"""Geometry out of spectra, without photographs or a plan; and geometry out of photographs, corrected by spectra."""

import math
from dataclasses import replace

import torch
from torch import Tensor

from rf3dgs.core.errors import InputError
from rf3dgs.core.frames import Pose, quaternion_from_matrix
from rf3dgs.field.rays import Rays
from rf3dgs.field.sources import PointSources
from rf3dgs.field.transmitter import estimate_transmitter
from rf3dgs.geometry import Patches, Planes, SurfaceConfig, find_surfaces, flattened
from rf3dgs.geometry.patches import CELL, plane_axes, surface_points
from rf3dgs.spectra.spectrum import Spectrum
from rf3dgs.splats.gaussians import Gaussians
from rf3dgs.splats.obstacles import Obstacles
from rf3dgs.splats.surface import ALONG
from rf3dgs.training.consolidation import PIECE_ANGLE, PIECE_DISTANCE, consolidated
from rf3dgs.training.echo_planes import (
    LEAST_WITNESSES,
    REGION,
    behind,
    bounding,
    filled,
    in_free_space,
    owner_of,
    refined_by_echoes,
    surface_cells,
)
from rf3dgs.training.echoes import Echoes, Spots, echoes_of, merged
from rf3dgs.training.line_of_sight import fit_line_of_sight
from rf3dgs.training.virtual import Mirror, find_mirrors, peaks_of

SPOT = 0.12  # cubes in which echoes are merged [m]
LEAST_ECHOES = 100
LEAST_VIEWS = 3  # that must have seen a place off the planes
ON_PLANE = 0.3  # places this near a plane are stray echoes of it [m]
OPACITY, THICKNESS = 0.98, 0.007
SEARCH = SurfaceConfig(tolerance=0.05, min_area=0.5)
OUTSIDE = 0.5  # how far beyond the receivers and what they see a site reaches, where mirrors alone are known [m]
TRUSTED = 0.2  # share of a plane's surface that echoes must speak for, where Gaussians are moved to it
APART = 0.25  # Gaussians from echoes complete those of photographs where none is this near [m]
WIDTHS = 2.0  # nor within so many standard deviations of the usual Gaussian, if that is farther


def geometry_from_spectra(spectra: Spectrum, tx: Pose | None = None, *, seed: int = 0) -> Gaussians:
    """Flat Gaussians on the surfaces that spectra `[position, row, col]` tell of, grey.

    With delay and departure: planes through echoes, without holes, and what three positions or more saw off them.
    Without: the planes whose mirror images of the transmitter are seen, as far as the site that they enclose. `tx` is
    the transmitter's pose; None takes that of the spectra, or estimates it. The same spectra and `seed` give the same
    Gaussians. Raises InputError where nothing is found.
    """
    where = _transmitter(spectra, tx)
    if spectra.delay is None or spectra.aod is None:
        return _of_mirrors(spectra, where)
    return geometry_of_echoes(echoes_of(spectra, where.position), seed=seed)


def geometry_of_echoes(echoes: Echoes, *, seed: int = 0) -> Gaussians:
    """Flat Gaussians on planes through echoes, filled, and on places off the planes that several receivers saw."""
    if len(echoes) < LEAST_ECHOES:
        raise InputError(
            f"geometry needs {LEAST_ECHOES} echoes or more of one bounce; {len(echoes.receivers)} spectra have "
            f"{len(echoes)}. Give spectra at more positions, or check the transmitter"
        )
    spots = merged(echoes, SPOT)
    planes, patches = _planes_of(echoes, spots, seed)
    if not len(planes):
        raise InputError(f"{len(echoes)} echoes lie on no common plane; give spectra at more positions, or finer ones")
    return _with_planes(planes, patches, spots, echoes)


def _planes_of(echoes: Echoes, spots: Spots, seed: int) -> tuple[Planes, Patches]:
    """The planes through echoes, which are merged in `spots`, and where they have surface."""
    rough = _flat(spots.points, spots.normals, SPOT)
    surfaces = consolidated(find_surfaces(rough, echoes.receivers, replace(SEARCH, seed=seed)), rough.means)
    if not len(surfaces.planes):
        return surfaces.planes, surfaces.patches
    planes, _ = refined_by_echoes(surfaces.planes, surfaces.patches, echoes)
    return planes, filled(planes, _moved(surfaces.patches, surfaces.planes, planes), echoes)


def corrected(geometry: Gaussians, spectra: Spectrum, tx: Pose | None = None, *, seed: int = 0) -> Gaussians:
    """Gaussians of photographs, corrected by what echoes in `spectra` `[position, row, col]` tell.

    Planes move to where their echoes lie, and what is near them and along them goes flat onto them. Other Gaussians are
    left out in places that waves were seen to cross and behind what bounds the site. Surfaces that only echoes tell of
    are added, in planes of the geometry where they lie on one. With fewer than 100 echoes, or without planes, nothing
    changes. Raises InputError for spectra without delay or departure.
    """
    geometry = geometry.detach()
    echoes = echoes_of(spectra, _transmitter(spectra, tx).position)
    if len(echoes) < LEAST_ECHOES:
        return geometry
    spots = merged(echoes, SPOT)
    walls, extents = _planes_of(echoes, spots, seed)
    surfaces = consolidated(find_surfaces(geometry, echoes.receivers, SurfaceConfig(seed=seed)), geometry.means)
    if not len(walls) or not len(surfaces.planes):
        return geometry
    planes, witnesses = refined_by_echoes(surfaces.planes, surfaces.patches, echoes)
    trusted = witnesses * REGION**2 > TRUSTED * surfaces.patches.areas
    trusted &= witnesses >= LEAST_WITNESSES
    moved = flattened(geometry, surfaces, planes, trusted)
    walls, extents = _onto_known(walls, extents, _chosen(planes, surfaces.planes, trusted), surfaces.patches.areas)
    loose = ~torch.cat((trusted, trusted.new_zeros(1)))[surfaces.plane_of]  # -1, off the planes, is the last one
    haze = loose & (in_free_space(moved.means, echoes) | behind(moved.means, walls, extents, echoes))
    kept = Gaussians(**{name: part[~haze] for name, part in moved.tensors().items()})
    return completed_by(kept, _with_planes(walls, extents, spots, echoes))


def _chosen(first: Planes, other: Planes, chosen: Tensor) -> Planes:
    """The `first` planes where `chosen` `[plane]`, the `other` ones elsewhere."""
    normals = torch.where(chosen[:, None], first.normals, other.normals)
    return Planes(normals, torch.where(chosen, first.offsets, other.offsets))


def _onto_known(walls: Planes, extents: Patches, planes: Planes, areas: Tensor) -> tuple[Planes, Patches]:
    """Walls that echoes tell of, those that lie on one of the `planes` of the geometry moved into it with their cells.

    A few echoes near each other say that there is a wall, and not well how it is turned. `areas` `[plane]` [m^2]: of
    several planes a wall lies on the largest.
    """
    normals, offsets = walls.normals.clone(), walls.offsets.clone()
    for wall, cells in enumerate(surface_points(walls, extents)):
        if not len(cells):
            continue
        alike = torch.nonzero((planes.normals @ walls.normals[wall]).abs() > PIECE_ANGLE).squeeze(-1)
        for plane in alike[areas[alike].argsort(descending=True, stable=True)].tolist():
            if float((cells @ planes.normals[plane] - planes.offsets[plane]).abs().median()) < PIECE_DISTANCE:
                normals[wall], offsets[wall] = planes.normals[plane], planes.offsets[plane]
                break
    known = Planes(normals, offsets)
    return known, _moved(extents, walls, known)


def completed_by(geometry: Gaussians, other: Gaussians) -> Gaussians:
    """The Gaussians, and those of `other` that no opaque one is near."""
    from scipy.spatial import KDTree

    solid = geometry.opacities >= SEARCH.min_opacity
    opaque = geometry.means[solid]
    if not len(opaque):
        return other
    apart = max(APART, WIDTHS * float(geometry.scales[solid].amax(-1).median()))
    alone = torch.from_numpy(KDTree(opaque.numpy()).query(other.means.numpy())[0] > apart)
    sh = torch.zeros(int(alone.sum()), geometry.sh.shape[1], geometry.channels)
    parts = {name: part[alone] for name, part in other.tensors().items()} | {"sh": sh}
    return Gaussians.join((geometry, Gaussians(**parts)))


def _transmitter(spectra: Spectrum, tx: Pose | None) -> Pose:
    where = spectra.tx if tx is None else tx
    return estimate_transmitter(spectra) if where is None else where


def _with_planes(planes: Planes, patches: Patches, spots: Spots, echoes: Echoes) -> Gaussians:
    """Gaussians in every cell of the planes, and on spots off the planes that several views saw.

    But for the planes that bound the site, nothing stands where waves were seen to cross.
    """
    cells, plane = surface_cells(planes, patches)
    bounds = torch.tensor(bounding(planes, patches, echoes), dtype=torch.long)
    held = torch.isin(plane, bounds) | ~in_free_space(cells, echoes)
    walls = _flat(cells[held], planes.normals[plane[held]], patches.cell)
    off = (owner_of(planes, patches, spots.points, ON_PLANE) < 0) & (spots.views >= LEAST_VIEWS)
    off &= ~in_free_space(spots.points, echoes)
    return Gaussians.join((walls, _flat(spots.points[off], spots.normals[off], SPOT)))


def _moved(patches: Patches, before: Planes, after: Planes) -> Patches:
    """The patches of planes that were moved: each cell goes along the new normal."""
    return Patches.of(after, surface_points(before, patches), patches.cell)


def _flat(points: Tensor, normals: Tensor, spacing: float) -> Gaussians:
    """Flat grey Gaussians at points `[n, 3]` [m] with unit normals `[n, 3]`, which cover a lattice of that spacing."""
    axes = plane_axes(normals)
    third = torch.linalg.cross(axes[:, 0], axes[:, 1], dim=-1)
    quats = quaternion_from_matrix(torch.stack((axes[:, 0], axes[:, 1], third), -1))
    scales = torch.tensor([ALONG * spacing, ALONG * spacing, THICKNESS]).log().repeat(len(points), 1)
    logit = torch.full((len(points),), math.log(OPACITY / (1 - OPACITY)))
    return Gaussians(points, quats, scales, logit, torch.zeros(len(points), 1, 3))


def _of_mirrors(spectra: Spectrum, tx: Pose) -> Gaussians:
    """Gaussians all over the planes whose images of the transmitter peaks of the spectra point to."""
    none = Obstacles(torch.zeros(0, 3), torch.zeros(0, 4), torch.zeros(0, 3), torch.zeros(0))
    sources, seen = fit_line_of_sight(PointSources.line_of_sight(tx.position, spectra.frequency), spectra)
    positions = spectra.pose.position
    rays: list[Rays] = sources.rays_each(positions, none, in_sight=seen)
    mirrors = find_mirrors(sources, rays, peaks_of(spectra), spectra, none)
    if not mirrors:
        raise InputError(
            f"{len(spectra)} spectra without delay and departure show no mirror image of the transmitter; give spectra "
            "at more positions, or with delay and departure"
        )
    return _box(mirrors, torch.cat((positions, tx.position[None], *(one.points for one in mirrors))))


def _box(mirrors: list[Mirror], inside: Tensor) -> Gaussians:
    """Gaussians in the cells of the mirrors' planes that lie in the site of points `inside` `[n, 3]` [m].

    The site is their upright box and what of it lies on the free side of all mirrors.
    """
    planes = Planes(torch.stack([one.normal for one in mirrors]), torch.stack([one.offset for one in mirrors]))
    low, high = inside.amin(0) - OUTSIDE, inside.amax(0) + OUTSIDE
    reach = float(torch.linalg.vector_norm(high - low))
    steps = torch.arange(-reach, reach, CELL)
    parts = []
    for number, one in enumerate(mirrors):
        axes = plane_axes(one.normal[None])[0]
        cells = one.points.mean(0) + torch.cartesian_prod(steps, steps) @ axes
        cells = cells[((cells >= low) & (cells <= high)).all(-1)]
        others = torch.arange(len(mirrors)) != number
        ahead = cells @ planes.normals[others].mT > planes.offsets[others] - CELL
        cells = cells[ahead.all(-1)]
        parts.append(_flat(cells, one.normal.expand(len(cells), 3), CELL))
    return Gaussians.join(parts)
