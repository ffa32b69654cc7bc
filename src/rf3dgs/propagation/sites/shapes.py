"""Triangle meshes of plain things: rectangles, boxes, prisms, walls with openings.

Texture coordinates (u, v) are in metres here, u along the surface and v downwards from the top; whoever owns the
texture divides them by its size.
"""

import math
from collections.abc import Sequence
from itertools import pairwise

import torch
from torch import Tensor

Mesh = tuple[Tensor, Tensor, Tensor]  # vertices [V, 3] [m], faces [F, 3], uv [V, 2] [m]
Vector = Sequence[float]


def quad(corner: Vector, along: Vector, down: Vector, uv: Vector = (0.0, 0.0)) -> Mesh:
    """A rectangle from its top left `corner`, the edge `along` the top and the edge `down`; `uv` at the corner."""
    p, a, d = (torch.tensor(value, dtype=torch.float32) for value in (corner, along, down))
    width, height = float(a.norm()), float(d.norm())
    vertices = torch.stack((p, p + a, p + a + d, p + d))
    u, v = uv
    coordinates = torch.tensor([[u, v], [u + width, v], [u + width, v + height], [u, v + height]])
    return vertices, torch.tensor([[0, 2, 1], [0, 3, 2]]), coordinates


def join(meshes: Sequence[Mesh]) -> Mesh:
    """Several meshes as one."""
    vertices, faces, coordinates, start = [], [], [], 0
    for mesh in meshes:
        vertices.append(mesh[0])
        faces.append(mesh[1] + start)
        coordinates.append(mesh[2])
        start += len(mesh[0])
    return torch.cat(vertices), torch.cat(faces), torch.cat(coordinates)


def box(low: Vector, high: Vector) -> Mesh:
    """A closed axis-aligned box, normals outwards, u continuing around its four sides."""
    (x0, y0, z0), (x1, y1, z1) = low, high
    w, d, h = x1 - x0, y1 - y0, z1 - z0
    return join(
        (
            quad((x0, y0, z1), (w, 0, 0), (0, 0, -h)),
            quad((x1, y0, z1), (0, d, 0), (0, 0, -h), (w, 0)),
            quad((x1, y1, z1), (-w, 0, 0), (0, 0, -h), (w + d, 0)),
            quad((x0, y1, z1), (0, -d, 0), (0, 0, -h), (2 * w + d, 0)),
            quad((x0, y1, z1), (w, 0, 0), (0, -d, 0)),
            quad((x0, y0, z0), (w, 0, 0), (0, d, 0)),
        )
    )


def prism(
    centre: Vector, radius: float, low: float, high: float, sides: int, *, top_radius: float | None = None
) -> Mesh:
    """A closed upright prism (a frustum when `top_radius` differs) of `sides` faces around `centre` (x, y)."""
    top = radius if top_radius is None else top_radius
    height = high - low

    def ring(index: int, r: float, z: float) -> tuple[float, float, float]:
        angle = 2 * math.pi * (index + 0.5) / sides
        return centre[0] + r * math.cos(angle), centre[1] + r * math.sin(angle), z

    meshes = []
    edge = 2 * radius * math.sin(math.pi / sides)
    for i in range(sides):
        corners = torch.tensor(
            [ring(i, top, high), ring(i + 1, top, high), ring(i + 1, radius, low), ring(i, radius, low)]
        )
        u = torch.tensor([[i * edge, 0], [(i + 1) * edge, 0], [(i + 1) * edge, height], [i * edge, height]])
        meshes.append((corners, torch.tensor([[0, 2, 1], [0, 3, 2]]), u))
    for z, r, order in ((high, top, (0, 1, 2)), (low, radius, (0, 2, 1))):
        rim = torch.tensor([ring(i, r, z) for i in range(sides)])
        middle = torch.tensor([[centre[0], centre[1], z]])
        faces = torch.tensor([[0, 1 + i, 1 + (i + 1) % sides] for i in range(sides)])[:, list(order)]
        vertices = torch.cat((middle, rim))
        meshes.append((vertices, faces, vertices[:, :2] - vertices[:1, :2]))
    return join(meshes)


def rod(start: Vector, end: Vector, radius: float, sides: int, *, end_radius: float | None = None) -> Mesh:
    """A closed round bar of `sides` faces from `start` to `end`, a cone's stump when `end_radius` differs."""
    a, b = (torch.tensor(value, dtype=torch.float64) for value in (start, end))
    length = float((b - a).norm())
    axis = (b - a) / length
    aside = torch.eye(3, dtype=torch.float64)[int(axis.abs().argmin())]
    x = torch.nn.functional.normalize(torch.linalg.cross(aside, axis), dim=-1)
    turn = torch.stack((x, torch.linalg.cross(axis, x), axis), -1)
    vertices, faces, uv = prism((0.0, 0.0), radius, 0.0, length, sides, top_radius=end_radius)
    return (a + vertices.double() @ turn.mT).float(), faces, uv


def turned(mesh: Mesh, place: Vector, heading: float) -> Mesh:
    """The mesh turned about its z axis by `heading` [rad] and moved to `place`."""
    c, s = math.cos(heading), math.sin(heading)
    turn = torch.tensor([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    return mesh[0] @ turn.mT + torch.tensor(place, dtype=torch.float32), mesh[1], mesh[2]


def ball(centre: Vector, radii: Vector, *, around: int = 10, rows: int = 6) -> Mesh:
    """A closed ellipsoid of `around` x `rows` facets."""
    vertices, uv, faces = [], [], []
    for row in range(rows + 1):
        zenith = math.pi * row / rows
        for col in range(around + 1):
            azimuth = 2 * math.pi * (col % around) / around
            unit = (math.sin(zenith) * math.cos(azimuth), math.sin(zenith) * math.sin(azimuth), math.cos(zenith))
            vertices.append([c + r * n for c, r, n in zip(centre, radii, unit, strict=True)])
            uv.append([col * 2 * math.pi * radii[0] / around, row * math.pi * radii[2] / rows])
    for row in range(rows):
        for col in range(around):
            a = row * (around + 1) + col
            b = a + around + 1
            if row > 0:
                faces.append([a, b, a + 1])
            if row < rows - 1:
                faces.append([a + 1, b, b + 1])
    return torch.tensor(vertices, dtype=torch.float32), torch.tensor(faces), torch.tensor(uv, dtype=torch.float32)


def wall(
    corner: Vector, along: Vector, height: float, openings: Sequence[tuple[float, float, float, float]] = ()
) -> Mesh:
    """An upright wall seen from inside, from its top left `corner`, with rectangular holes.

    `along` is the unit direction times the length [m]; each opening is (left, right, bottom, top) in metres along the
    wall and above its foot. The rest is cut into rectangles along the openings' edges.
    """
    direction = torch.tensor(along, dtype=torch.float64)
    length = float(direction.norm())
    direction = direction / length
    top = torch.tensor(corner, dtype=torch.float64)
    columns = sorted({0.0, length, *(edge for opening in openings for edge in opening[:2])})
    meshes = []
    for left, right in pairwise(columns):
        middle = (left + right) / 2
        holes = sorted((o[2], o[3]) for o in openings if o[0] <= middle <= o[1])
        foot = 0.0
        spans = []
        for low, high in holes:
            spans.append((foot, low))
            foot = high
        spans.append((foot, height))
        for low, high in spans:
            if high - low > 1e-6:
                start = (top + direction * left).tolist()
                start[2] = corner[2] - height + high
                edge = (direction * (right - left)).tolist()
                meshes.append(quad(start, edge, (0, 0, low - high), (left, height - high)))
    return join(meshes)
