"""Floor plans: rooms as polygons with walls, doors and windows, and the mesh that they stand for.

Coordinates are metres, z up; a room's corners may run either way round. `geometry.plan_file` reads plans from files.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import torch
from torch import Tensor

from rf3dgs.core.errors import InputError

LARGEST = 2000.0  # [m]
COLOURS = {
    "concrete": (0.6, 0.6, 0.58),
    "plasterboard": (0.85, 0.84, 0.8),
    "wood": (0.55, 0.38, 0.22),
    "glass": (0.6, 0.75, 0.85),
    "metal": (0.7, 0.7, 0.72),
    "brick": (0.6, 0.35, 0.25),
    "ceiling_board": (0.9, 0.9, 0.88),
    "floorboard": (0.5, 0.42, 0.32),
}
GREY = (0.5, 0.5, 0.5)
Corner = tuple[float, float]


@dataclass(frozen=True)
class Opening:
    """A door, window or passage in a wall: from `left` to `right` along it, from `foot` to `head` above the floor [m].

    `wall` counts a room's walls from 0, wall k running from corner k to the next. Without a `material` it is open.
    """

    wall: int
    left: float
    right: float
    foot: float
    head: float
    material: str | None = None


@dataclass(frozen=True)
class Room:
    """A room: `corners` (x, y) [m] one after another, its floor at `base` and its ceiling `height` above it [m].

    `floor`, `ceiling` and `walls` are names of materials; an empty name leaves floor or ceiling out.
    """

    name: str
    corners: tuple[tuple[float, float], ...]
    height: float
    base: float = 0.0
    floor: str = "concrete"
    ceiling: str = "ceiling_board"
    walls: str = "plasterboard"
    openings: tuple[Opening, ...] = ()


@dataclass(frozen=True, eq=False)
class PlanMesh:
    """The surfaces of a plan: vertices `[vertex, 3]` [m], faces `[face, 3]` with normals into the rooms.

    surface `[face]` numbers the surfaces: one for each floor, ceiling, wall, door and window, named in `names` and made
    of `materials`. colours `[face, 3]` are sRGB, 0 to 1.
    """

    vertices: Tensor
    faces: Tensor
    surface: Tensor
    names: tuple[str, ...]
    materials: tuple[str, ...]
    colours: Tensor


def plan_mesh(rooms: tuple[Room, ...]) -> PlanMesh:
    """The mesh of all rooms; raises InputError, naming the room, for one that cannot be built."""
    vertices: list[Tensor] = []
    faces: list[Tensor] = []
    surface: list[Tensor] = []
    names: list[str] = []
    materials: list[str] = []

    def add(name: str, material: str, corners: Tensor, triangles: Tensor) -> None:
        faces.append(triangles + sum(len(part) for part in vertices))
        vertices.append(corners)
        surface.append(torch.full((len(triangles),), len(names)))
        names.append(name)
        materials.append(material)

    for room in rooms:
        check_room(room)
        ring = torch.tensor(room.corners, dtype=torch.float64)
        ring = ring if _area(ring) > 0 else ring.flip(0)
        turned = _area(torch.tensor(room.corners, dtype=torch.float64)) < 0
        flat = _triangles(ring)
        for what, material, z, order in (
            ("floor", room.floor, room.base, flat),
            ("ceiling", room.ceiling, room.base + room.height, flat.flip(1)),
        ):
            if material:
                add(f"{room.name}/{what}", material, torch.cat((ring, ring.new_full((len(ring), 1), z)), 1), order)
        count = len(room.corners)
        for wall in range(count):
            start, end = (torch.tensor(room.corners[(wall + step) % count], dtype=torch.float64) for step in (0, 1))
            mine = [opening for opening in room.openings if opening.wall == wall]
            rest = _wall_rectangles(float((end - start).norm()), room, mine)
            pieces = [(f"{room.name}/wall-{wall}", room.walls, rest)]
            for number, opening in enumerate(mine):
                if opening.material:
                    spans = [(opening.left, opening.right, opening.foot, opening.head)]
                    pieces.append((f"{room.name}/wall-{wall}-opening-{number}", opening.material, spans))
            for name, material, spans in pieces:
                if spans:
                    add(name, material, *_upright(start, end, room.base, spans, flip=turned))
    if not vertices:
        raise InputError("a floor plan needs at least one room; got none")
    number = torch.cat(surface)
    shade = torch.tensor([COLOURS.get(material, GREY) for material in materials])
    return PlanMesh(
        torch.cat(vertices).float(), torch.cat(faces), number, tuple(names), tuple(materials), shade[number]
    )


def check_room(room: Room) -> None:
    """Raises InputError, naming the room, for one that nobody could build."""
    ring = torch.tensor(room.corners, dtype=torch.float64)
    where = f"room {room.name!r}"
    if len(room.corners) < 3 or abs(_area(ring)) < 0.01:
        raise InputError(f"{where} needs three or more corners around an area; got {list(room.corners)[:6]}")
    if not (0.1 <= room.height <= 500) or float(ring.abs().max()) > LARGEST:
        raise InputError(f"{where}: height must be 0.1 to 500 m and corners within {LARGEST:g} m; are these metres?")
    sides = torch.linalg.vector_norm(ring.roll(-1, 0) - ring, dim=-1)
    if float(sides.min()) < 1e-3:
        raise InputError(f"{where} has the same corner twice in a row; name each corner once")
    if _crosses(room.corners):
        raise InputError(f"{where} has walls that cross; list its corners one after another around it")
    for opening in room.openings:
        what = f"{where}, the opening from {opening.left:g} to {opening.right:g} m"
        if not 0 <= opening.wall < len(room.corners):
            raise InputError(f"{what}: wall must be 0 to {len(room.corners) - 1}; got {opening.wall}")
        long, high = float(sides[opening.wall]), room.height
        if not (0 <= opening.left < opening.right <= long + 1e-6 and 0 <= opening.foot < opening.head <= high + 1e-6):
            raise InputError(f"{what} must lie in its wall, {long:.2f} m long and {high:.2f} m high")
    for first in room.openings:
        for second in room.openings:
            if first is not second and first.wall == second.wall and _overlap(first, second):
                raise InputError(f"{where} has two openings over one another in wall {first.wall}; part them")


def _overlap(first: Opening, second: Opening) -> bool:
    across = min(first.right, second.right) - max(first.left, second.left)
    return across > 1e-6 and min(first.head, second.head) - max(first.foot, second.foot) > 1e-6


def _wall_rectangles(length: float, room: Room, openings: list[Opening]) -> list[tuple[float, float, float, float]]:
    """What openings leave of a wall, as rectangles (left, right, foot, head) [m]."""
    sides = [min(value, length) for opening in openings for value in (opening.left, opening.right)]
    result = []
    for left, right in pairwise(sorted({0.0, length, *sides})):
        if right - left < 1e-6:
            continue
        middle, foot = (left + right) / 2, 0.0
        for low, high in sorted((o.foot, o.head) for o in openings if o.left < middle < o.right):
            result.append((left, right, foot, low))
            foot = high
        result.append((left, right, foot, room.height))
    return [piece for piece in result if piece[3] - piece[2] > 1e-6]


def _upright(
    start: Tensor, end: Tensor, base: float, spans: list[tuple[float, float, float, float]], *, flip: bool
) -> tuple[Tensor, Tensor]:
    """Rectangles of a wall as a mesh whose normals point to the left of the way from `start` to `end`."""
    along = (end - start) / torch.linalg.vector_norm(end - start)
    corners, faces = [], []
    for number, (left, right, foot, head) in enumerate(spans):
        for share, z in ((left, foot), (right, foot), (right, head), (left, head)):
            corners.append([*(start + share * along).tolist(), base + z])
        first = 4 * number
        faces += [[first, first + 2, first + 1], [first, first + 3, first + 2]]
    triangles = torch.tensor(faces)
    return torch.tensor(corners, dtype=torch.float64), triangles.flip(1) if flip else triangles


def _area(ring: Tensor) -> float:
    """Signed area [m^2] of a polygon `[corner, 2]`, positive when it runs anticlockwise."""
    after = ring.roll(-1, 0)
    return 0.5 * float((ring[:, 0] * after[:, 1] - ring[:, 1] * after[:, 0]).sum())


def _turn(a: Corner, b: Corner, c: Corner) -> float:
    return (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])


def _crosses(ring: Sequence[Corner]) -> bool:
    """Whether two sides that are not neighbours meet."""
    count = len(ring)
    for i in range(count):
        a, b = ring[i], ring[(i + 1) % count]
        for j in range(i + 2, count - (i == 0)):
            c, d = ring[j], ring[(j + 1) % count]
            astride = _turn(a, b, c) * _turn(a, b, d) <= 0 and _turn(c, d, a) * _turn(c, d, b) <= 0
            apart = any(max(a[k], b[k]) < min(c[k], d[k]) or max(c[k], d[k]) < min(a[k], b[k]) for k in (0, 1))
            if astride and not apart:
                return True
    return False


def _triangles(ring: Tensor) -> Tensor:
    """Triangles `[face, 3]` of a simple anticlockwise polygon, by cutting ears."""
    points: list[Corner] = [(x, y) for x, y in ring.tolist()]
    left, faces = list(range(len(points))), []
    while len(left) > 3:
        corners = [(left[k - 1], left[k], left[(k + 1) % len(left)]) for k in range(len(left))]
        place = next((k for k, corner in enumerate(corners) if _is_ear(points, corner, left)), None)
        if place is None:  # corners in one line are left
            turns = [abs(_turn(*(points[k] for k in corner))) for corner in corners]
            place = turns.index(min(turns))
        else:
            faces.append(corners[place])
        left.pop(place)
    return torch.tensor([*faces, left])


def _is_ear(ring: list[Corner], corner: tuple[int, int, int], left: list[int]) -> bool:
    a, b, c = (ring[k] for k in corner)
    others = [ring[k] for k in left if k not in corner]
    inside = any(min(_turn(a, b, p), _turn(b, c, p), _turn(c, a, p)) > -1e-12 for p in others)
    return _turn(a, b, c) > 1e-12 and not inside
