"""Small planes of photographs made fit for mirrors: boards of two faces, flat pieces alone, outlined, on their feet."""

from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from rf3dgs.geometry import Patches, Planes, Surfaces
from rf3dgs.geometry.patches import closed, connected, rim, surface_points, widened
from rf3dgs.splats.obstacles import Obstacles
from rf3dgs.training.consolidation import PIECE_ANGLE, SKIN_ANGLE

THROUGH = 0.2  # m to both sides of a plane, within which its Gaussians stand
OUTSIDE = 2  # cells by which an outline may lie outside
SOLID = 0.2  # of a ray; Gaussians reach over an edge, and a mirror that is none costs more than one that is missing
BESIDE = 0.03  # m off the rest of its plane, from which a piece is another thing's
NARROW = 0.16  # m on either side for four fifths of a strip, of one of 40 cm: photographs make such of round columns
BENT, BOW = 0.6, 0.015  # 1 / m and m: what is rounder, and bulges more, is no mirror
FEWEST = 12  # Gaussians that tell whether a piece is flat
THIN, APART = 0.05, 3.5  # m between two faces, and how many median deviations of each
HALF = 0.5  # of the cells of one face must have the other one across
DEEPEST = 0.3  # m between the faces of a board
FOOT, STEEP = 0.3, 0.5  # m between a board and what it stands on, and least square of the sine of their angle


def with_both_faces(surfaces: Surfaces, obstacles: Obstacles) -> Surfaces:
    """The surfaces with the two faces of boards apart, each facing outwards.

    What is a decimetre thick comes out of photographs as one plane in its middle, or as two that face the same way, and
    the image in a mirror that stands 6 cm off is 12 cm off. Gaussians before and behind a small plane, up to 15 cm, are
    of two faces where their heights fall into two, 5 cm apart and 3.5 median deviations of either, and half of one
    face has the other one across. Those behind become a plane of their own that faces the other way; both stand where
    their Gaussians do. Planes keep their numbers, new ones follow.
    """
    planes, patches, plane_of = surfaces.planes, surfaces.patches, surfaces.plane_of.clone()
    points, normals, offsets = surface_points(planes, patches), list(planes.normals), list(planes.offsets)
    large = torch.cat((patches.large, torch.zeros(1, dtype=torch.bool)))  # the last for the label -1
    free = (obstacles.opacities >= obstacles.min_opacity) & ~large[plane_of]
    for plane in range(len(planes)):
        if bool(large[plane]) or not len(points[plane]):
            continue
        near = (obstacles.means @ normals[plane] - offsets[plane]).abs() < DEEPEST / 2
        near &= free & ((surfaces.normals @ normals[plane]).abs() > SKIN_ANGLE)
        own = torch.nonzero(near).squeeze(-1)
        own = own[patches.holds(obstacles.means[own], torch.full_like(own, plane))]
        height = obstacles.means[own] @ normals[plane]
        behind = _lower(height)
        if behind is None:
            continue
        faces = [_beside(points[plane], obstacles.means[own[side]], patches.cell) for side in (~behind, behind)]
        if int((faces[0] & faces[1]).sum()) < HALF * min(int(face.sum()) for face in faces):
            continue
        plane_of[own] = torch.where(behind, len(normals), plane)
        offsets[plane] = height[~behind].median()
        offsets.append(-height[behind].median())
        normals.append(-normals[plane])
        points.append(points[plane][faces[1]])
        points[plane] = points[plane][faces[0]]
    _turn_outwards(normals, offsets, points, large[:-1], patches.cell)
    both = Planes(torch.stack(normals), torch.stack(offsets)) if normals else planes
    return replace(surfaces, planes=both, patches=Patches.of(both, points, patches.cell), plane_of=plane_of)


def _turn_outwards(
    normals: list[Tensor], offsets: list[Tensor], points: Sequence[Tensor], large: Tensor, cell: float
) -> None:
    """Turn those of the planes that are not `large` `[plane]` which lie behind such another and face the same way."""
    for plane in range(len(large)):
        for other in range(len(large)):
            behind = float(offsets[other] - offsets[plane])
            small = len(points[plane]) and not bool(large[plane] | large[other])
            if not small or not BESIDE < behind < DEEPEST or float(normals[plane] @ normals[other]) < PIECE_ANGLE:
                continue
            across = _beside(points[plane], points[other] - behind * normals[other], cell)
            if float(across.float().mean()) > HALF:
                normals[plane], offsets[plane] = -normals[plane], -offsets[plane]
                break


def _lower(height: Tensor) -> Tensor | None:
    """Which of `height` `[n]` [m] are of the lower of two faces; None where there is one, or too few to tell."""
    if len(height) < 2 * FEWEST:
        return None
    ordered = height.double().sort().values
    count = torch.arange(1, len(ordered))
    below, total = ordered.cumsum(0)[:-1], ordered.sum()
    between = count * (len(ordered) - count) * (below / count - (total - below) / (len(ordered) - count)).square()
    at = int(between[FEWEST - 1 : len(between) - FEWEST + 1].argmax()) + FEWEST  # Otsu's threshold
    low, high = ordered[:at], ordered[at:]
    spread = max(float((part - part.median()).abs().median()) for part in (low, high))
    apart = float(high.median() - low.median())
    return height <= ordered[at - 1] if apart > max(THIN, APART * spread) else None


def _beside(cells: Tensor, points: Tensor, cell: float) -> Tensor:
    """Which middles of `cells` `[n, 3]` [m] have one of `points` `[m, 3]` within two widths of a `cell` [m]."""
    return torch.cdist(cells, points).amin(1) < 2 * cell if len(points) else torch.zeros(len(cells), dtype=torch.bool)


def flat_pieces(surfaces: Surfaces, obstacles: Obstacles) -> Surfaces:
    """The surfaces whose small planes are without pieces that are round or stand beside the others.

    A column's front lies within centimetres of a board's far behind it, and passes for more of the same plane. A piece
    is what hangs together but for gaps of a cell. It goes if its Gaussians, by a parabola through their heights over
    the plane, bend with a radius under 1.7 m and by 1.5 cm, or if their median is 3 cm off that of the largest piece
    which does not; where the plane itself lies is not asked.
    """
    planes, patches, plane_of = surfaces.planes, surfaces.patches, surfaces.plane_of.clone()
    points = surface_points(planes, patches)
    for plane in torch.nonzero(~patches.large).squeeze(-1).tolist():
        grid = patches.grid(plane)
        own = torch.nonzero((plane_of == plane) & (obstacles.opacities >= obstacles.min_opacity)).squeeze(-1)
        if not len(own):
            continue
        means, pieces = obstacles.means[own], connected(grid, 1)
        row, column = patches.cell_of(means, torch.full_like(own, plane)).unbind(-1)
        piece_of = pieces[row.clamp(0, len(grid) - 1), column.clamp(0, grid.shape[1] - 1)]
        gone = _not_flat(means @ patches.axes[plane].mT, means @ planes.normals[plane], piece_of)
        plane_of[own[torch.isin(piece_of, gone)]] = -1
        points[plane] = points[plane][~torch.isin(pieces[grid], gone)]
    return replace(surfaces, patches=Patches.of(planes, points, patches.cell), plane_of=plane_of)


def _not_flat(place: Tensor, height: Tensor, piece_of: Tensor) -> Tensor:
    """The pieces of a plane that are not flat parts of it, by Gaussians at `place` `[n, 2]`, `height` `[n]` [m] in
    pieces `piece_of` `[n]`, 0 for none. Of few Gaussians nothing is said."""
    numbers, counts = piece_of[piece_of > 0].unique(return_counts=True)
    told = numbers[counts >= FEWEST][counts[counts >= FEWEST].argsort(descending=True, stable=True)]
    gone, level = [], None
    for piece in told.tolist():
        inside = piece_of == piece
        median = float(height[inside].median())
        bad = _is_narrow(place[inside]) or _is_round(place[inside], height[inside])
        if bad or (level is not None and abs(median - level) > BESIDE):
            gone.append(piece)
        elif level is None:
            level = median
    return torch.tensor(gone, dtype=piece_of.dtype)


def _is_narrow(place: Tensor) -> bool:
    """Whether Gaussians at `place` `[n, 2]` [m] stand in a strip: most of them within `NARROW` of its middle."""
    return bool(((place - place.median(0).values).abs().quantile(0.8, 0) < NARROW).any())


def _is_round(place: Tensor, height: Tensor) -> bool:
    """Whether Gaussians at `place` `[n, 2]`, `height` `[n]` [m] over a plane lie on a thing round along either axis."""
    u, v = (place - place.median(0).values).double().unbind(-1)
    terms = torch.stack((torch.ones_like(u), u, v, u * u, u * v, v * v), -1)
    found = torch.linalg.lstsq(terms, height.double()[:, None], driver="gelsd").solution[:, 0]
    bend = 2 * found[[3, 5]].abs()
    half = torch.stack((u.abs().quantile(0.8), v.abs().quantile(0.8)))
    return bool(((bend > BENT) & (0.5 * bend * half.square() > BOW)).any())


def outlined(planes: Planes, patches: Patches, obstacles: Obstacles) -> Patches:
    """The patches without cells at the outlines of small planes through whose middle Gaussians let pass over `SOLID`.

    Cells are found by what a Gaussian may cover, so that surface has no gaps; outlines then lie up to two cells
    outside. That matters where a way passes beside a thing; large planes end at others. Surface far from where
    Gaussians stand, as that of mirrors which photographs did not show, stays.
    """
    points = surface_points(planes, patches)
    for plane in torch.nonzero(~patches.large).squeeze(-1).tolist():
        middles, through = points[plane], THROUGH * planes.normals[plane]
        kept = patches.grid(plane)
        solid = torch.zeros_like(kept)
        solid[kept] = obstacles.transmittance(middles - through, middles + through, stop_short=0.0) < SOLID
        spilled = ~solid & widened(solid, OUTSIDE)
        for _ in range(OUTSIDE):
            kept = kept & ~(spilled & rim(closed(kept)))
        points[plane] = middles[kept[patches.grid(plane)]]
    return Patches.of(planes, points, patches.cell)


def standing(planes: Planes, patches: Patches) -> Patches:
    """The patches with small planes down to the floor, or up to any large plane that they nearly reach.

    In the edge between two surfaces photographs show neither well, and echoes are of both; what ends `FOOT` before a
    large plane's surface mostly stands on it. A board and the floor mirror together right there.
    """
    points, large = surface_points(planes, patches), patches.large
    grounds = torch.nonzero(large).squeeze(-1).tolist()
    steps = torch.arange(0.0, 1.5 * FOOT, patches.cell)
    for plane in torch.nonzero(~large).squeeze(-1).tolist():
        cells, normal = points[plane], planes.normals[plane]
        for ground in grounds:
            slope = planes.normals[ground] - (planes.normals[ground] @ normal) * normal
            if not len(cells) or float(slope @ slope) < STEEP:
                continue
            height = cells @ planes.normals[ground] - planes.offsets[ground]
            near = torch.nonzero(height.abs() < FOOT).squeeze(-1)
            near = near[patches.holds(cells[near], torch.full_like(near, ground))]
            way = height[near] / (slope @ slope)
            along = steps[:, None] * way.sign() * slope.norm().reciprocal()
            added = cells[near] - along[..., None] * slope
            points[plane] = torch.cat((points[plane], added[along.abs() < way.abs()]))
    return Patches.of(planes, points, patches.cell)
