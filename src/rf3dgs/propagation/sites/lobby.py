"""The built-in site: a furnished lobby of 14 m x 15 m x 3.5 m at 60 GHz, described once for radio and for light."""

from typing import Literal

import numpy as np

from rf3dgs.core.errors import InputError
from rf3dgs.core.frames import Pose
from rf3dgs.propagation.sites import textures as paint
from rf3dgs.propagation.sites.lobby_extras import people_of
from rf3dgs.propagation.sites.lobby_parts import DOORS, ENTRANCE, HEIGHT, LENGTH, LIFTS, WIDTH, WINDOWS, lobby_object
from rf3dgs.propagation.sites.scene import Scene, SceneObject
from rf3dgs.propagation.sites.shapes import ball, box, join, prism, quad, wall

Detail = Literal["plain", "full"]


def lobby(detail: Detail = "plain", people: int = 0) -> Scene:
    """The lobby: origin in the floor's south-west corner, x east, y north, z up; transmitter high in that corner.

    detail: "plain" is what the shipped dataset was made from; "full" adds frames, fittings, lamps' rims, more furniture
    and plants of leaves. people: how many persons stand and walk there, up to eight.
    """
    if detail not in ("plain", "full"):
        raise InputError(f'detail must be "plain" or "full"; got {detail!r}')
    objects = [*_shell(), *_openings(), *_lights(), *_columns(), *_furniture(), *_plants(), *_signs()]
    if detail == "full":
        from rf3dgs.propagation.sites.lobby_detail import fixtures
        from rf3dgs.propagation.sites.lobby_furniture import furnishings

        kept = (item for item in objects if not item.name.startswith("plant-"))
        objects = [*kept, *fixtures(), *furnishings()]
    objects += people_of(people)
    return Scene(
        name="lobby",
        objects=tuple(objects),
        tx=Pose.look_at((0.6, 0.8, 2.6), (7.5, 8.0, 1.2)),
        bounds=((0.0, 0.0, 0.0), (WIDTH, LENGTH, HEIGHT)),
        rx_bounds=((0.5, 0.5, 1.0), (WIDTH - 0.5, LENGTH - 0.5, 2.0)),
        camera_bounds=((0.7, 0.7, 0.9), (WIDTH - 0.7, LENGTH - 0.7, 2.3)),
        frequency=60e9,
        exposure=1.7,
    )


def _shell() -> list[SceneObject]:
    """Floor, ceiling and the four walls; distances along a wall run to the right for someone inside who faces it."""
    floor = paint.tiles(
        WIDTH, LENGTH, ((0.50, 0.46, 0.40), (0.74, 0.70, 0.63)), (0.6, 0.6), 1, joint=(0.30, 0.28, 0.26), gap=0.02
    )
    rug = paint.tiles(
        4.0, 3.0, ((0.50, 0.14, 0.14), (0.68, 0.24, 0.16)), (0.5, 0.5), 2, joint=(0.85, 0.72, 0.45), gap=0.03
    )
    density = paint.DENSITY
    row, col = round(6.6 * density), round(5.2 * density)
    floor[row : row + rug.shape[0], col : col + rug.shape[1]] = rug
    board = (0.94, 0.94, 0.91)
    ceiling = paint.tiles(
        WIDTH, LENGTH, ((0.84, 0.85, 0.82), board), (0.6, 0.6), 3, joint=(0.55, 0.56, 0.56), gap=0.016
    )
    ceiling *= 1 + 0.05 * paint.noise(ceiling.shape[0], ceiling.shape[1], 4, coarse=60)[..., None]
    south = paint.tiles(
        WIDTH, HEIGHT, ((0.80, 0.72, 0.52), (0.90, 0.84, 0.68)), (1.0, 0.7), 5, joint=(0.55, 0.46, 0.32), gap=0.015
    )
    for index, left in enumerate((0.8, 2.6, 4.2, 9.0, 10.8, 12.4)):
        paint.poster(south, WIDTH, left, 1.0, (1.0, 1.4), 20 + index)
    west = paint.speckled(LENGTH, HEIGHT, (0.60, 0.72, 0.76), 6, strength=0.10)
    west[round(2.9 * density) :] *= np.array([0.62, 0.60, 0.62])
    east = paint.tiles(
        LENGTH, HEIGHT, ((0.52, 0.24, 0.18), (0.74, 0.42, 0.30)), (0.40, 0.14), 7, joint=(0.74, 0.70, 0.64), shift=0.5
    )
    for index, left in enumerate((1.0, 5.5, 8.0, 12.2)):
        paint.poster(east, LENGTH, left, 0.9, (1.4, 1.1), 30 + index)
    north = paint.tiles(
        WIDTH, HEIGHT, ((0.46, 0.30, 0.17), (0.66, 0.46, 0.28)), (0.35, 3.5), 8, joint=(0.22, 0.14, 0.08), strength=0.12
    )
    for index, left in enumerate((5.4, 8.6, 11.4)):
        paint.poster(north, WIDTH, left, 0.7, (1.9, 1.5), 40 + index)
    return [
        lobby_object(
            "floor", quad((0, LENGTH, 0), (WIDTH, 0, 0), (0, -LENGTH, 0)), "floorboard", floor, (WIDTH, LENGTH)
        ),
        lobby_object(
            "ceiling", quad((0, 0, HEIGHT), (WIDTH, 0, 0), (0, LENGTH, 0)), "ceiling_board", ceiling, (WIDTH, LENGTH)
        ),
        lobby_object(
            "wall-south",
            wall((WIDTH, 0, HEIGHT), (-WIDTH, 0, 0), HEIGHT, [ENTRANCE]),
            "plasterboard",
            south,
            (WIDTH, HEIGHT),
        ),
        lobby_object(
            "wall-west", wall((0, 0, HEIGHT), (0, LENGTH, 0), HEIGHT, WINDOWS), "plasterboard", west, (LENGTH, HEIGHT)
        ),
        lobby_object(
            "wall-east",
            wall((WIDTH, LENGTH, HEIGHT), (0, -LENGTH, 0), HEIGHT, DOORS),
            "concrete",
            east,
            (LENGTH, HEIGHT),
        ),
        lobby_object(
            "wall-north", wall((0, LENGTH, HEIGHT), (WIDTH, 0, 0), HEIGHT, LIFTS), "wood", north, (WIDTH, HEIGHT)
        ),
    ]


def _openings() -> list[SceneObject]:
    """What fills the walls' openings: windows, the glazed entrance, two doors, two lifts."""
    objects = []
    for number, (left, right, foot, head) in enumerate(WINDOWS, 1):
        size = (right - left, head - foot)
        mesh = quad((0, left, head), (0, size[0], 0), (0, 0, -size[1]))
        objects.append(
            lobby_object(f"window-{number}", mesh, "glass", paint.outdoors(*size, 50 + number), size, glow=0.9)
        )
    left, right, foot, head = ENTRANCE
    size = (right - left, head - foot)
    mesh = quad((WIDTH - left, 0, head), (-size[0], 0, 0), (0, 0, -size[1]))
    objects.append(lobby_object("entrance", mesh, "glass", paint.outdoors(*size, 60), size, glow=0.7))
    for number, (left, right, foot, head) in enumerate(DOORS, 1):
        size = (right - left, head - foot)
        mesh = quad((WIDTH, LENGTH - left, head), (0, -size[0], 0), (0, 0, -size[1]))
        objects.append(
            lobby_object(f"door-{number}", mesh, "wood", paint.door(*size, (0.55, 0.36, 0.20), 62 + number), size)
        )
    for number, (left, right, foot, head) in enumerate(LIFTS, 1):
        size = (right - left, head - foot)
        mesh = quad((left, LENGTH, head), (size[0], 0, 0), (0, 0, -size[1]))
        objects.append(lobby_object(f"lift-{number}", mesh, "metal", paint.lift(*size, 66 + number), size))
    return objects


def _lights() -> list[SceneObject]:
    """Eight luminous panels just below the ceiling."""
    objects = []
    shade = paint.speckled(1.8, 0.6, (0.97, 0.97, 0.95), 70, strength=0.01)
    for number in range(8):
        x, y = (3.5, 10.5)[number % 2], 1.9 + 3.75 * (number // 2)
        mesh = quad((x - 0.9, y - 0.3, HEIGHT - 0.02), (1.8, 0, 0), (0, 0.6, 0))
        objects.append(lobby_object(f"light-{number + 1}", mesh, "plasterboard", shade, (1.8, 0.6), glow=20.0))
    return objects


def _columns() -> list[SceneObject]:
    """Two square columns and two round ones (of sixteen faces)."""
    stone = paint.tiles(2.4, HEIGHT, ((0.58, 0.60, 0.58), (0.78, 0.80, 0.76)), (0.6, 0.5), 80, joint=(0.36, 0.38, 0.38))
    bands = paint.tiles(
        2.4, HEIGHT, ((0.20, 0.42, 0.44), (0.46, 0.66, 0.60)), (0.3, 0.35), 82, joint=(0.86, 0.84, 0.74)
    )
    objects = []
    for number, (x, y) in enumerate(((4.5, 4.6), (9.5, 10.4)), 1):
        mesh = box((x - 0.3, y - 0.3, 0), (x + 0.3, y + 0.3, HEIGHT))
        objects.append(lobby_object(f"column-{number}", mesh, "concrete", stone, (2.4, HEIGHT), solid=True))
    for number, (x, y) in enumerate(((9.5, 4.6), (4.5, 10.4)), 3):
        mesh = prism((x, y), 0.38, 0.0, HEIGHT, 16)
        objects.append(lobby_object(f"column-{number}", mesh, "plasterboard", bands, (2.4, HEIGHT), solid=True))
    return objects


def _furniture() -> list[SceneObject]:
    """Reception desk, benches, crates, a partition, a cabinet and a table."""
    front = paint.tiles(2.0, 1.1, ((0.24, 0.34, 0.50), (0.36, 0.48, 0.62)), (0.4, 0.37), 90, joint=(0.85, 0.78, 0.6))
    top = paint.grain(2.0, 1.0, (0.40, 0.26, 0.15), 91)
    seat = paint.tiles(1.0, 1.0, ((0.60, 0.26, 0.14), (0.76, 0.40, 0.22)), (0.25, 0.25), 92, joint=(0.30, 0.14, 0.08))
    crate = paint.tiles(1.0, 1.0, ((0.66, 0.52, 0.32), (0.82, 0.68, 0.46)), (1.0, 0.2), 93, joint=(0.36, 0.26, 0.14))
    screen = paint.tiles(3.0, 1.9, ((0.30, 0.50, 0.32), (0.52, 0.68, 0.46)), (0.5, 0.475), 94, joint=(0.16, 0.26, 0.18))
    books = paint.tiles(2.0, 2.0, ((0.30, 0.20, 0.40), (0.80, 0.66, 0.30)), (0.10, 0.4), 95, joint=(0.25, 0.18, 0.12))
    objects = [
        lobby_object("desk-front", box((8.6, 12.3, 0), (12.4, 12.9, 1.1)), "wood", front, (2.0, 1.1), solid=True),
        lobby_object("desk-side", box((11.8, 12.9, 0), (12.4, 14.2, 1.1)), "wood", front, (2.0, 1.1), solid=True),
        lobby_object("desk-top", box((8.5, 12.2, 1.1), (12.5, 13.0, 1.16)), "chipboard", top, (2.0, 1.0), solid=True),
    ]
    for number, (x, y) in enumerate(((1.2, 5.6), (1.2, 9.4), (6.3, 7.1), (12.9, 7.5)), 1):
        parts = [box((x - 0.3, y - 1.0, 0.12), (x + 0.3, y + 1.0, 0.46))]
        back = x - 0.3 if number < 3 else x + 0.2
        parts.append(box((back, y - 1.0, 0.46), (back + 0.1, y + 1.0, 0.95)))
        objects.append(lobby_object(f"bench-{number}", join(parts), "wood", seat, (1.0, 1.0), solid=True))
    for number, (low, size) in enumerate(
        (((12.3, 1.0, 0.0), 0.9), ((12.5, 2.2, 0.0), 0.7), ((12.4, 1.1, 0.9), 0.6)), 1
    ):
        high = tuple(value + size for value in low)
        objects.append(lobby_object(f"crate-{number}", box(low, high), "chipboard", crate, (1.0, 1.0), solid=True))
    objects += [
        lobby_object(
            "partition", box((6.2, 11.0, 0), (8.2, 11.12, 1.9)), "plasterboard", screen, (3.0, 1.9), solid=True
        ),
        lobby_object(
            "cabinet", box((5.0, 14.5, 0), (5.0 + 2.0, 14.95, 2.0)), "chipboard", books, (2.0, 2.0), solid=True
        ),
        lobby_object("table", box((7.4, 6.4, 0.38), (8.6, 7.8, 0.45)), "chipboard", top, (2.0, 1.0), solid=True),
        lobby_object("table-foot", prism((8.0, 7.1), 0.12, 0.0, 0.38, 8), "metal", top, (2.0, 1.0), solid=True),
    ]
    return objects


def _plants() -> list[SceneObject]:
    """Potted plants, the foliage as ellipsoids of facets."""
    pot = paint.tiles(1.2, 0.5, ((0.62, 0.34, 0.22), (0.76, 0.46, 0.30)), (0.2, 0.25), 100, joint=(0.42, 0.22, 0.14))
    leaf = paint.tiles(
        0.8, 0.8, ((0.12, 0.30, 0.10), (0.38, 0.58, 0.22)), (0.1, 0.08), 101, joint=(0.08, 0.20, 0.06), shift=0.5
    )
    objects = []
    for number, (x, y) in enumerate(((13.3, 14.3), (0.8, 14.2), (4.4, 0.7), (9.9, 0.8)), 1):
        objects.append(
            lobby_object(
                f"pot-{number}",
                prism((x, y), 0.24, 0.0, 0.5, 8, top_radius=0.32),
                "concrete",
                pot,
                (1.2, 0.5),
                solid=True,
            )
        )
        foliage = ball((x, y, 1.05), (0.42, 0.42, 0.56))
        objects.append(lobby_object(f"plant-{number}", foliage, "wood", leaf, (0.8, 0.8), solid=True, scattering=0.97))
    return objects


def _signs() -> list[SceneObject]:
    """A board hanging over the desk and a free-standing sign near the entrance."""
    board = paint.lettering(3.0, 0.5, (0.10, 0.16, 0.32), (0.95, 0.92, 0.80), 110, lines=2)
    totem = paint.lettering(0.8, 1.8, (0.85, 0.80, 0.70), (0.55, 0.12, 0.10), 111, lines=7)
    return [
        lobby_object("board", box((9.0, 12.55, 2.5), (12.0, 12.6, 3.0)), "metal", board, (3.0, 0.5), solid=True),
        lobby_object("totem", box((8.6, 2.4, 0.0), (9.4, 2.55, 1.8)), "chipboard", totem, (0.8, 1.8), solid=True),
    ]
