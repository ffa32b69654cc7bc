"""Gaussians out of a mesh: flat ones that cover its faces without gaps, for sites that nobody photographed.

Each plane carries a hexagonal lattice whose rows all its triangles share, so that a wall has no seam inside. Along
creases and open edges runs a row of Gaussians of its own, narrow across the edge, so that corners are closed and
outlines sharp.
"""

import math

import torch
from torch import Tensor

from rf3dgs.core.errors import InputError
from rf3dgs.core.frames import matrix_from_quaternion, quaternion_from_matrix
from rf3dgs.splats.gaussians import Gaussians
from rf3dgs.splats.harmonics import C0, coefficient_count

ALONG = 0.7  # tangential scale / spacing: at the middle of three neighbours the transmittance is 0.03
LOOSE = 0.9  # the same on planes of only a few points, such as facets of a curved surface, where no lattice helps
ACROSS = 0.3  # scale / spacing across an edge
INSET = 0.42  # distance / spacing of an edge's row from the edge; nearer silhouettes stand out, farther creases leak
JITTER = 0.1  # largest displacement / spacing of a lattice point, against moire
SLIVER = 1e-6  # a face whose area is a smaller part of its longest side squared is left out
CREASE = math.cos(math.radians(20))  # faces that meet at a larger angle form an edge
LARGEST_COUNT = 20_000_000


def sample_mesh(
    vertices: Tensor,
    faces: Tensor,
    *,
    count: int | None = None,
    spacing: float | None = None,
    seed: int = 0,
    colours: Tensor | None = None,
    opacity: float = 0.98,
    thickness: float = 0.007,
    degree: int = 0,
) -> Gaussians:
    """Flat Gaussians on the triangles `faces` `[face, 3]` of `vertices` `[vertex, 3]` [m], evenly over the area.

    Give `spacing` [m], the distance of neighbours, or `count`, from which a spacing follows that gives this many
    within a few per cent. The third axis is the face's normal, with a scale of `thickness` [m] (at most a fifth of
    the spacing). `colours` `[face, channel]` in 0..1 become the degree-0 harmonics, mid-grey without them; higher
    ones are zero. The same `seed` gives the same Gaussians.
    """
    return sample_faces(
        *(vertices, faces),
        count=count,
        spacing=spacing,
        seed=seed,
        colours=colours,
        opacity=opacity,
        thickness=thickness,
        degree=degree,
    )[0]


def sample_faces(
    vertices: Tensor,
    faces: Tensor,
    *,
    count: int | None = None,
    spacing: float | None = None,
    seed: int = 0,
    colours: Tensor | None = None,
    opacity: float = 0.98,
    thickness: float = 0.007,
    degree: int = 0,
) -> tuple[Gaussians, Tensor]:
    """What `sample_mesh` makes, and the face `[gaussian]` on which each Gaussian lies."""
    vertices = torch.as_tensor(vertices, dtype=torch.float64)
    faces = torch.as_tensor(faces, dtype=torch.long)
    if vertices.dim() != 2 or vertices.shape[1] != 3 or not bool(torch.isfinite(vertices).all()):
        raise InputError(f"vertices must be finite and [vertex, 3] in metres; got {list(vertices.shape)}")
    if faces.dim() != 2 or faces.shape[1] != 3 or bool(((faces < 0) | (faces >= len(vertices))).any()):
        raise InputError(f"faces must be [face, 3] indices of the {len(vertices)} vertices; got {list(faces.shape)}")
    if (count is None) == (spacing is None):
        raise InputError("sample_mesh needs either count or spacing, not both and not neither")
    if (count is not None and count < 1) or (spacing is not None and not spacing > 0):
        raise InputError(f"count and spacing must be positive; got count={count}, spacing={spacing}")
    shade = torch.full((len(faces), 3), 0.5) if colours is None else torch.as_tensor(colours, dtype=torch.float32)
    if shade.dim() != 2 or len(shade) != len(faces):
        raise InputError(f"colours must be [face, channel] for {len(faces)} faces; got {list(shade.shape)}")

    corners = vertices[faces]
    normal = torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0], dim=-1)
    area = 0.5 * torch.linalg.vector_norm(normal, dim=-1)
    longest = torch.linalg.vector_norm(corners - corners.roll(-1, 1), dim=-1).amax(-1)
    real = ((area > 1e-10) & (area > SLIVER * longest**2)).nonzero().squeeze(-1)
    if len(real) == 0:
        raise InputError("the mesh has no face with an area; check the units (metres) and the indices of its faces")
    normal = torch.nn.functional.normalize(normal[real], dim=-1)
    corners = corners[real]
    edges, plane = _edges(corners, normal), _planes(corners, normal)
    total = float(area.sum())
    step = math.sqrt(2 / math.sqrt(3) * total / count) if count is not None else float(spacing or 0.0)
    means, axes, face, is_edge = _sample(corners, normal, edges, plane, _affordable(step, total), seed)
    for _ in range(4):
        if count is None or abs(len(means) - count) <= 0.005 * count:
            break
        step *= math.sqrt(max(len(means), 1) / count)
        means, axes, face, is_edge = _sample(corners, normal, edges, plane, _affordable(step, total), seed)
    if len(means) == 0:
        raise InputError(f"no Gaussian fits on the mesh at a spacing of {step:.3g} m; ask for more or space closer")

    scales = torch.full((len(means), 3), ALONG * step)
    scales[is_edge, 1] = ACROSS * step
    of_plane = torch.zeros(int(plane.max()) + 1, dtype=area.dtype).index_add_(0, plane, area[real])
    loose = (of_plane[plane] < 4 * step**2)[face] & ~is_edge
    scales[loose, :2] = LOOSE * step
    scales[:, 2] = min(thickness, 0.2 * step)
    sh = torch.zeros(len(means), coefficient_count(degree), shade.shape[1])
    sh[:, 0] = (shade[real[face]] - 0.5) / C0
    logit = math.log(opacity / (1 - opacity))
    gaussians = Gaussians(means, quaternion_from_matrix(axes), scales.log(), torch.full((len(means),), logit), sh)
    return gaussians, real[face]


def normals(gaussians: Gaussians) -> Tensor:
    """Unit vectors `[gaussian, 3]` along each Gaussian's shortest axis; the sign is the stored axis's own.

    Gaussians of `sample_mesh` keep the side of their face's normal.
    """
    axes = matrix_from_quaternion(gaussians.quats)
    shortest = gaussians.log_scales.argmin(-1)[:, None, None].expand(-1, 3, 1)
    return axes.gather(-1, shortest).squeeze(-1)


def _affordable(step: float, area: float) -> float:
    """The spacing itself, when it does not ask for more Gaussians than a mistake in the units would."""
    if area / step**2 > LARGEST_COUNT:
        raise InputError(
            f"{area:.3g} m^2 at a spacing of {step:.3g} m need over {LARGEST_COUNT} Gaussians; space wider"
        )
    return step


def _sample(
    corners: Tensor, normal: Tensor, edges: tuple[Tensor, Tensor], plane: Tensor, step: float, seed: int
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Points `[point, 3]`, axes `[point, 3, 3]` (columns), faces `[point]` and who lies on an edge's row `[point]`."""
    generator = torch.Generator().manual_seed(seed)
    inside, face = _lattice(corners, normal, plane, step, generator)
    far = _distance_to_edges(inside, face, corners, edges) > 0.5 * (INSET + ALONG) * step
    inside, face = inside[far], face[far]
    rows, row_axes, row_face = _edge_rows(corners, normal, edges, step, generator)
    means = torch.cat((inside, rows))
    axes = torch.cat((_plane_axes(normal)[face], row_axes))
    return means, axes, torch.cat((face, row_face)), torch.arange(len(means)) >= len(inside)


def _plane_axes(normal: Tensor) -> Tensor:
    """Rotations `[face, 3, 3]` whose columns are a horizontal tangent, the other tangent and the normal.

    Rounding makes all triangles of a plane agree although their normals differ in the last digits.
    """
    normal = torch.nn.functional.normalize(normal.mul(1e6).round().div(1e6) + 0.0, dim=-1)
    up = normal.new_tensor([0.0, 0.0, 1.0]).expand_as(normal)
    level = torch.linalg.cross(up, normal, dim=-1)
    length = torch.linalg.vector_norm(level, dim=-1, keepdim=True)
    level = torch.where(length > 1e-3, level / length.clamp_min(1e-3), normal.new_tensor([1.0, 0.0, 0.0]))
    other = torch.nn.functional.normalize(torch.linalg.cross(normal, level, dim=-1), dim=-1)
    return torch.stack((torch.linalg.cross(other, normal, dim=-1), other, normal), -1)


def _planes(corners: Tensor, normal: Tensor) -> Tensor:
    """Numbers `[face]` that triangles of one plane, facing the same side, have in common."""
    offset = (corners[:, 0] * normal).sum(-1, keepdim=True)
    return _number(torch.cat((normal, offset), -1).mul(1e4).round())


def _number(rows: Tensor) -> Tensor:
    """Numbers `[row]` from 0 without gaps, the same for equal rows of `[row, column]`; quicker than `unique(dim=0)`."""
    number = torch.zeros(len(rows), dtype=torch.long)
    for column in rows.unbind(1):
        part = torch.unique(column, return_inverse=True)[1]
        number = torch.unique(number * (int(part.max()) + 1) + part, return_inverse=True)[1]
    return number


def _lattice(
    corners: Tensor, normal: Tensor, plane: Tensor, step: float, generator: torch.Generator
) -> tuple[Tensor, Tensor]:
    """Points of a hexagonal lattice inside each triangle, found row by row, and the triangle of each.

    Every plane has its own random phase, so that the many planes of a curved surface are sampled evenly on average.
    """
    axes = _plane_axes(normal)
    height = 0.5 * math.sqrt(3) * step
    local = corners @ axes
    shift = torch.rand(int(plane.max()) + 1, 2, generator=generator, dtype=torch.float64)[plane]
    x, y = local[..., 0] / step - shift[:, :1], local[..., 1] / height - shift[:, 1:]
    first, last = y.amin(-1).ceil().long(), y.amax(-1).ceil().long()
    face, row = _runs(first, last - first)
    odd = 0.5 * (row % 2)

    x0, y0 = x[face], y[face]
    x1, y1 = x0.roll(-1, -1), y0.roll(-1, -1)
    level = row[:, None].double()
    crossed = (torch.minimum(y0, y1) <= level) & (level <= torch.maximum(y0, y1)) & (y0 != y1)
    along = x0 + (x1 - x0) * (level - y0) / torch.where(y0 == y1, 1.0, y1 - y0)
    left = torch.where(crossed, along, math.inf).amin(-1) - odd
    right = torch.where(crossed, along, -math.inf).amax(-1) - odd
    empty = ~(left < right)
    begin = torch.where(empty, 0.0, left).ceil().long()
    length = torch.where(empty, 0.0, right).ceil().long() - begin
    which, column = _runs(begin, length)
    face = face[which]
    u = (column + odd[which] + shift[face, 0]) * step
    v = (row[which] + shift[face, 1]) * height
    jitter = (2 * torch.rand(len(u), 2, generator=generator, dtype=torch.float64) - 1) * (JITTER * step)
    moved = torch.stack((u + jitter[:, 0], v + jitter[:, 1]), -1)
    flat = local[face]
    keeps = _in_triangle(moved, flat[..., :2])
    point = torch.where(keeps[:, None], moved, torch.stack((u, v), -1))
    point = torch.cat((point, flat[:, 0, 2:]), -1)
    return (axes[face] @ point[..., None]).squeeze(-1), face


def _runs(begin: Tensor, length: Tensor) -> tuple[Tensor, Tensor]:
    """For runs `begin, begin + 1, ...` of the given lengths: the run of each number, and the number."""
    run = torch.repeat_interleave(torch.arange(len(begin)), length)
    before = torch.cumsum(length, 0) - length
    return run, begin[run] + torch.arange(len(run)) - before[run]


def _in_triangle(point: Tensor, corner: Tensor) -> Tensor:
    """True where `[point, 2]` lies in the counter-clockwise triangle `[point, 3, 2]`."""
    side = corner.roll(-1, 1) - corner
    offset = point[:, None] - corner
    return (side[..., 0] * offset[..., 1] - side[..., 1] * offset[..., 0] >= 0).all(-1)


def _edges(corners: Tensor, normal: Tensor) -> tuple[Tensor, Tensor]:
    """Creases and open edges as pairs (face, side): side k runs from corner k to the next one.

    Corners in one place count as one vertex, so that meshes with a vertex for each face work as well.
    """
    vertex = _number(corners.reshape(-1, 3).mul(1e5).round()).reshape(-1, 3)
    group = _number(torch.stack((vertex, vertex.roll(-1, 1)), -1).sort(-1).values.reshape(-1, 2))
    users = torch.bincount(group)
    owner = torch.repeat_interleave(torch.arange(len(corners)), 3)
    mean = torch.zeros(len(users), 3, dtype=normal.dtype).index_add_(0, group, normal[owner])
    agreement = (mean[group] * normal[owner]).sum(-1) / users[group]
    smooth = (users[group] == 2) & (agreement > 0.5 * (1 + CREASE))
    chosen = (~smooth).nonzero().squeeze(-1)
    return chosen // 3, chosen % 3


def _distance_to_edges(point: Tensor, face: Tensor, corners: Tensor, edges: tuple[Tensor, Tensor]) -> Tensor:
    """Distance `[point]` [m] to the nearest crease or open edge of the point's own triangle."""
    sharp = torch.zeros(len(corners), 3, dtype=torch.bool)
    sharp[edges] = True
    nearest = torch.full((len(point),), math.inf, dtype=point.dtype)
    for side in range(3):
        start, end = corners[face, side], corners[face, (side + 1) % 3]
        along = torch.nn.functional.normalize(end - start, dim=-1)
        distance = torch.linalg.vector_norm(torch.linalg.cross(point - start, along, dim=-1), dim=-1)
        nearest = torch.where(sharp[face, side], torch.minimum(nearest, distance), nearest)
    return nearest


def _edge_rows(
    corners: Tensor, normal: Tensor, edges: tuple[Tensor, Tensor], step: float, generator: torch.Generator
) -> tuple[Tensor, Tensor, Tensor]:
    """Points a little inside each edge, about `step` apart, their axes (along, inwards, normal) and their faces.

    Edges shorter than the step get a point with the probability that keeps the density.
    """
    face, side = edges
    start, end = corners[face, side], corners[face, (side + 1) % 3]
    length = torch.linalg.vector_norm(end - start, dim=-1)
    chance = torch.rand(len(face), generator=generator, dtype=torch.float64)
    number = torch.where(length >= step, (length / step).ceil(), (chance < length / step).double()).long()
    which, index = _runs(torch.zeros_like(number), number)
    along = torch.nn.functional.normalize(end - start, dim=-1)
    inwards = torch.nn.functional.normalize(torch.linalg.cross(normal[face], along, dim=-1), dim=-1)
    apex = corners[face, (side + 2) % 3]
    depth = ((apex - start) * inwards).sum(-1)
    inset = torch.minimum(depth / 3, torch.full_like(depth, INSET * step))
    share = (index + 0.5) / number[which]
    point = start[which] + share[:, None] * (end - start)[which] + inset[which, None] * inwards[which]
    axes = torch.stack((along, inwards, normal[face]), -1)
    return point, axes[which], face[which]
