"""What echoes say about geometry: where planes lie exactly, how far they reach, and what is free space."""

import math
from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from rf3dgs.geometry import Patches, Planes
from rf3dgs.geometry.patches import plane_axes, surface_points
from rf3dgs.training.echoes import Echoes

REACH = 0.3  # echoes this far off a plane are asked about it [m]
PRIOR, PRIOR_DEG = 0.10, 2.0  # how far geometry's planes may be off, one standard deviation [m], [deg]
SPREAD = 0.05  # of echoes about their plane, one standard deviation [m]
REGION = 0.3  # echoes in one square of a plane of this size are one witness [m]
LEAST_WITNESSES = 8
STEPS = 12
HULL, FULL = 5.0, 0.25  # planes of this much surface [m^2], which is this share of their hull, reach over the hull
BOUND, STRAY = 2.0, 0.02  # surface of a plane that bounds the site [m^2], and share of what may be behind it
FIRM = 5  # cells; narrower bits of a large plane's surface do not count for its hull
GAP = 0.5  # of other planes, gaps up to twice this are closed [m]
STEEP = 0.7  # cosine; planes less steep to each other have no edge
JOIN = 1.0  # how far from an edge the surface of two planes may end that meet in it [m]
CROSSINGS = 3  # legs through a square of 30 cm without an echo that open a plane
VOXEL = 0.15  # [m]
SHORT = 0.25  # of a leg's ends that proves nothing [m]
PASSED, PASSED_OVER_HIT = 4, 5.0


def refined_by_echoes(planes: Planes, patches: Patches, echoes: Echoes) -> tuple[Planes, Tensor]:
    """The planes moved to where the echoes off them lie, and by how many witnesses `[plane]`; few of them move nothing.

    Robust least squares (Cauchy's weights) over an offset and two tilts about the middle, drawn to the given plane by
    10 cm and 2 degrees. A witness is the echoes in one square of 30 cm; an echo belongs to the nearest plane that has
    surface there, at most 30 cm away.
    """
    owner = owner_of(planes, patches, echoes.points, REACH)
    normals, offsets = planes.normals.clone(), planes.offsets.clone()
    witnesses = torch.zeros(len(planes), dtype=torch.long)
    axes = plane_axes(planes.normals)
    for plane in range(len(planes)):
        mine = echoes.points[owner == plane].double()
        square = torch.unique(torch.floor(mine.float() @ axes[plane].mT / REGION), dim=0, return_inverse=True)[1]
        count = torch.bincount(square)
        witnesses[plane] = len(count)
        if len(count) < LEAST_WITNESSES:
            continue
        frame = (planes.normals[plane].double(), planes.offsets[plane].double(), axes[plane].double())
        normal, offset = _settled(*frame, mine, 1 / count[square].double())
        normals[plane], offsets[plane] = normal.float(), offset.float()
    return Planes(normals, offsets), witnesses


def owner_of(planes: Planes, patches: Patches, points: Tensor, reach: float) -> Tensor:
    """The nearest plane `[point]` that has surface at points `[point, 3]` and lies within `reach` [m], -1 for none."""
    owner = torch.full((len(points),), -1)
    nearest = torch.full((len(points),), reach)
    for plane in range(len(planes)):
        away = (points @ planes.normals[plane] - planes.offsets[plane]).abs()
        near = torch.nonzero(away < nearest).squeeze(-1)
        near = near[patches.holds(points[near], torch.full_like(near, plane))]
        owner[near], nearest[near] = plane, away[near]
    return owner


def _settled(normal: Tensor, offset: Tensor, axes: Tensor, points: Tensor, weight: Tensor) -> tuple[Tensor, Tensor]:
    """Normal `[3]` and offset of the plane through points `[point, 3]`, from a plane with axes `[2, 3]` on."""
    share = weight / weight.sum()
    local = points @ axes.mT
    local = local - (share[:, None] * local).sum(0)
    away = points @ normal - offset
    columns = torch.cat((torch.ones(len(points), 1, dtype=points.dtype), local), -1)
    turn = math.radians(PRIOR_DEG)
    prior = torch.diag(torch.tensor([PRIOR, turn, turn], dtype=points.dtype) ** -2)
    shift = torch.zeros(3, dtype=points.dtype)
    for step in range(STEPS):
        width = max(SPREAD, REACH * 0.6**step)
        trust = weight / (1 + ((away - columns @ shift) / width) ** 2) / SPREAD**2
        shift = torch.linalg.solve(columns.mT @ (trust[:, None] * columns) + prior, columns.mT @ (trust * away))
    centre = (share[:, None] * points).sum(0)
    centre = centre - (centre @ normal - offset) * normal + shift[0] * normal
    turned = torch.nn.functional.normalize(normal - shift[1:] @ axes, dim=-1)
    return turned, turned @ centre


def filled(planes: Planes, patches: Patches, echoes: Echoes) -> Patches:
    """The patches without holes: large planes reach over the hull of their surface, gaps of others close up to 1 m.

    Shadows of what stands before a wall are holes in its echoes and not in the wall. Large planes that all receivers
    have in front of them reach to the edges in which they meet. Where waves crossed a plane there is no surface.
    """
    large, numbers = patches.areas >= HULL, bounding(planes, patches, echoes)
    points = [_closed(planes, patches, plane, [] if large[plane] else None) for plane in range(len(planes))]
    for plane in 2 * numbers:  # twice, for edges with what has only now grown to its own
        edges = [_edge(planes, plane, other, points[other]) for other in numbers if other != plane]
        points[plane] = _closed(planes, patches, plane, edges)
    return _opened(planes, patches, Patches.of(planes, points, patches.cell), echoes)


def bounding(planes: Planes, patches: Patches, echoes: Echoes) -> list[int]:
    """The planes of some size behind which lie neither receivers nor transmitter nor, but for one in fifty, echoes.

    Echoes behind a plane must be fewer than those on it, too: a few places in a corner make a plane that cuts it off.
    """
    ends = torch.cat((echoes.receivers, echoes.tx[None]))
    ahead = ends @ planes.normals.mT - planes.offsets
    side = ahead.mean(0).sign()
    beyond = ((echoes.points @ planes.normals.mT - planes.offsets) * side < -REACH).sum(0)
    owner = owner_of(planes, patches, echoes.points, REACH)
    own = torch.bincount(owner[owner >= 0], minlength=len(planes))
    alone = ((ahead * side < 0).double().mean(0) <= STRAY) & (beyond <= STRAY * len(echoes)) & (beyond < own)
    return torch.nonzero((patches.areas >= BOUND) & alone).squeeze(-1).tolist()


def behind(points: Tensor, planes: Planes, patches: Patches, echoes: Echoes) -> Tensor:
    """True `[point]` where points `[point, 3]` [m] lie behind the surface of a plane that bounds the site."""
    result = torch.zeros(len(points), dtype=torch.bool)
    for plane in bounding(planes, patches, echoes):
        height = points @ planes.normals[plane] - planes.offsets[plane]
        inside = float(echoes.receivers.mean(0) @ planes.normals[plane] - planes.offsets[plane])
        beyond = torch.nonzero(height * inside < 0).squeeze(-1)
        result[beyond] |= patches.holds(points[beyond], torch.full_like(beyond, plane))
    return result


def _closed(planes: Planes, patches: Patches, plane: int, edges: Sequence[Tensor] | None = None) -> Tensor:
    """Middles of cells `[cell, 3]` [m] of a plane without gaps.

    With `edges`, points `[point, 3]` [m] that it reaches, all over the hull of those and of its firm surface; where
    the list is empty only if that is not mostly unseen.
    """
    from scipy.ndimage import binary_closing, binary_opening

    margin = round(GAP / patches.cell)
    steps = torch.arange(-margin, margin + 1.0)
    disc = (torch.cartesian_prod(steps, steps).norm(dim=-1) <= margin).reshape(len(steps), -1).numpy()
    padded = torch.nn.functional.pad(patches.grid(plane), (margin,) * 4).numpy()
    cells = torch.nonzero(torch.from_numpy(binary_closing(padded, disc))) - margin
    if edges is not None and len(cells):
        firm = torch.nonzero(torch.from_numpy(binary_opening(padded, np.ones((FIRM, FIRM))))) - margin
        reached = [
            ((part @ patches.axes[plane].mT - patches.low[plane]) / patches.cell).floor().long() for part in edges
        ]
        whole = _hull(torch.cat((firm if len(firm) else cells, *reached)))
        if edges or len(cells) >= FULL * len(whole):
            cells = torch.unique(torch.cat((cells, whole)), dim=0)
    local = patches.low[plane] + (cells + 0.5) * patches.cell
    return local @ patches.axes[plane] + planes.offsets[plane] * planes.normals[plane]


def _edge(planes: Planes, plane: int, other: int, cells: Tensor) -> Tensor:
    """Cells `[cell, 3]` [m] of an `other` plane that end near a plane, moved along theirs into the edge of both."""
    normal, along = planes.normals[plane], planes.normals[other]
    cosine = float(normal @ along)
    if abs(cosine) > STEEP:
        return cells[:0]
    height = cells @ normal - planes.offsets[plane]
    near = height.abs() < JOIN
    return cells[near] - (height[near] / (1 - cosine**2))[:, None] * (normal - cosine * along)


def _opened(planes: Planes, seen: Patches, whole: Patches, echoes: Echoes) -> Patches:
    """The patches `whole` without the cells that three legs or more crossed and that have no echo, as `seen` tells."""
    start, end = legs_of(echoes)
    points = []
    for plane, cells in enumerate(surface_points(planes, whole)):
        normal, offset = planes.normals[plane], planes.offsets[plane]
        before, after = start @ normal - offset, end @ normal - offset
        cross = (before * after < 0) & (torch.minimum(before.abs(), after.abs()) > REACH)
        share = (before[cross] / (before[cross] - after[cross]))[:, None]
        if len(cells) and bool(cross.any()):
            which = torch.zeros(int(cross.sum()), dtype=torch.long)
            places = start[cross] + share * (end[cross] - start[cross])
            alone = Patches.of(Planes(normal[None], offset[None]), [cells], whole.cell)
            cell = alone.cell_of(places, which)
            inside = ((cell >= 0) & (cell < alone.shape[0])).all(-1)
            count = torch.zeros(tuple(alone.shape[0].tolist()))
            count.index_put_(tuple(cell[inside].T), torch.ones(int(inside.sum())), accumulate=True)
            count = 9 * torch.nn.functional.avg_pool2d(count[None, None], 3, stride=1, padding=1)[0, 0]
            own = alone.cell_of(cells, torch.zeros(len(cells), dtype=torch.long))
            crossed = count[own[:, 0], own[:, 1]] > CROSSINGS - 0.5
            cells = cells[~crossed | seen.holds(cells, torch.full((len(cells),), plane))]
        points.append(cells)
    return Patches.of(planes, points, whole.cell)


def legs_of(echoes: Echoes) -> tuple[Tensor, Tensor]:
    """Start and end `[leg, 3]` [m] of the ways from receivers and transmitter to the echoes."""
    ends = torch.cat((echoes.receivers[echoes.view], echoes.tx.expand_as(echoes.points)))
    return ends, echoes.points.repeat(2, 1)


def _hull(cells: Tensor) -> Tensor:
    """The cells `[cell, 2]` (row, column) in the convex hull of some; these themselves where they lie in one line."""
    from scipy.spatial import ConvexHull, QhullError

    try:
        sides = torch.from_numpy(ConvexHull(cells.numpy()).equations)
    except QhullError:
        return cells
    low, high = cells.amin(0).tolist(), cells.amax(0).tolist()
    every = torch.cartesian_prod(*(torch.arange(first, last + 1) for first, last in zip(low, high, strict=True)))
    return every[(every.double() @ sides[:, :2].mT + sides[:, 2] < 1e-6).all(-1)]


def in_free_space(points: Tensor, echoes: Echoes) -> Tensor:
    """True `[point]` where points `[point, 3]` [m] lie in cubes that waves to and from echoes crossed, four or more,
    and five times as many as have an echo in the cube.
    """
    ends, bounce = legs_of(echoes)
    low = torch.minimum(ends.amin(0), torch.minimum(bounce.amin(0), points.amin(0))) - 2 * VOXEL
    high = torch.maximum(ends.amax(0), torch.maximum(bounce.amax(0), points.amax(0))) + 2 * VOXEL
    shape = ((high - low) / VOXEL).long() + 1
    if int(shape.prod()) > 50_000_000:
        return torch.zeros(len(points), dtype=torch.bool)

    def cube(places: Tensor) -> Tensor:
        cell = ((places - low) / VOXEL).long()
        return (cell[..., 0] * shape[1] + cell[..., 1]) * shape[2] + cell[..., 2]

    passed = torch.zeros(int(shape.prod()))
    for start, end in zip(ends.split(20_000), bounce.split(20_000), strict=True):
        length = torch.linalg.vector_norm(end - start, dim=-1)
        steps = torch.arange(SHORT, float(length.max()), VOXEL)
        inside = steps < length[:, None] - SHORT
        leg, step = torch.nonzero(inside, as_tuple=True)
        way = start[leg] + (steps[step] / length[leg])[:, None] * (end[leg] - start[leg])
        passed += torch.bincount(cube(way), minlength=len(passed))
    hit = torch.bincount(cube(echoes.points), minlength=len(passed))
    own = cube(points)
    return (passed[own] >= PASSED) & (passed[own] > PASSED_OVER_HIT * hit[own])


def surface_cells(planes: Planes, patches: Patches) -> tuple[Tensor, Tensor]:
    """The middles `[cell, 3]` [m] of all cells that are surface, and the plane `[cell]` of each."""
    points = surface_points(planes, patches)
    if not points:
        return torch.zeros(0, 3), torch.zeros(0, dtype=torch.long)
    return torch.cat(points), torch.repeat_interleave(torch.arange(len(points)), torch.tensor([*map(len, points)]))
