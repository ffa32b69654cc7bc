"""What stands in the lobby at full detail: sofas, tables and chairs with legs, things on the desk, leafy plants."""

import math

import numpy as np
import torch

from rf3dgs.propagation.sites import textures as paint
from rf3dgs.propagation.sites.lobby_parts import lobby_object, plain_object
from rf3dgs.propagation.sites.scene import SceneObject
from rf3dgs.propagation.sites.shapes import Mesh, box, join, prism, rod, turned

STEEL, BLACK, OAK = (0.46, 0.47, 0.50), (0.10, 0.10, 0.11), (0.46, 0.31, 0.18)
PLANTS = ((13.3, 14.3), (0.8, 14.2), (4.4, 0.7), (9.9, 0.8))
LEAVES = 90
"""Leaves of one plant."""


def furnishings() -> list[SceneObject]:
    """Everything movable that the plain lobby lacks."""
    return [*_sofas(), *_tables_and_chairs(), *_on_the_desk(), *_small_things(), *plants_with_leaves()]


def _sofas() -> list[SceneObject]:
    fabric = paint.tiles(
        1.0, 1.0, ((0.20, 0.30, 0.44), (0.30, 0.42, 0.56)), (0.12, 0.12), 300, joint=(0.14, 0.20, 0.30)
    )
    objects = []
    for number, (place, heading) in enumerate((((9.55, 7.1, 0.0), math.pi), ((7.6, 9.2, 0.0), -math.pi / 2)), 1):
        parts = [
            box((-0.40, -0.95, 0.10), (0.45, 0.95, 0.34)),
            box((-0.42, -0.95, 0.34), (-0.22, 0.95, 0.82)),
            box((-0.42, -1.10, 0.10), (0.45, -0.95, 0.60)),
            box((-0.42, 0.95, 0.10), (0.45, 1.10, 0.60)),
        ]
        parts += [box((-0.20, y, 0.345), (0.44, y + 0.61, 0.46)) for y in (-0.94, -0.305, 0.33)]
        sofa = turned(join(parts), place, heading)
        objects.append(lobby_object(f"sofa-{number}", sofa, "cloth", fabric, (1.0, 1.0), solid=True))
        feet = [prism((x, y), 0.03, 0.0, 0.10, 8) for x in (-0.35, 0.38) for y in (-1.0, 1.0)]
        objects.append(plain_object(f"sofa-feet-{number}", turned(join(feet), place, heading), "metal", STEEL))
    return objects


def _chair(place: tuple[float, float], heading: float) -> tuple[Mesh, Mesh]:
    """Seat with back, and four legs, of a chair that faces `heading`."""
    seat = [box((-0.21, -0.22, 0.43), (0.22, 0.22, 0.47)), box((-0.23, -0.21, 0.52), (-0.20, 0.21, 0.88))]
    legs = [rod((x, y, 0.002), (0.9 * x, 0.9 * y, 0.43), 0.014, 6) for x in (-0.2, 0.2) for y in (-0.2, 0.2)]
    legs += [rod((-0.215, y, 0.43), (-0.215, y, 0.60), 0.012, 6) for y in (-0.15, 0.15)]
    at = (*place, 0.0)
    return turned(join(seat), at, heading), turned(join(legs), at, heading)


def _tables_and_chairs() -> list[SceneObject]:
    """Three round tables with chairs, and the chair behind the desk."""
    objects, seats, legs = [], [], []
    wood = paint.grain(0.9, 0.9, OAK, 310)
    for number, (x, y, chairs) in enumerate(((2.8, 2.9, 3), (11.6, 5.0, 4), (2.9, 12.3, 3)), 1):
        top = prism((x, y), 0.45, 0.71, 0.74, 20)
        objects.append(lobby_object(f"cafe-table-{number}", top, "wood", wood, (0.9, 0.9), solid=True))
        foot = join((prism((x, y), 0.035, 0.02, 0.71, 10), prism((x, y), 0.28, 0.0, 0.02, 16)))
        objects.append(plain_object(f"cafe-foot-{number}", foot, "metal", STEEL))
        for chair in range(chairs):
            angle = 2 * math.pi * chair / chairs + 0.4 * number
            seat, four = _chair((x + 0.72 * math.cos(angle), y + 0.72 * math.sin(angle)), angle + math.pi)
            seats.append(seat)
            legs.append(four)
    seat, four = _chair((10.3, 13.7), -math.pi / 2)
    colours = ((0.78, 0.36, 0.14), (0.22, 0.44, 0.40), (0.70, 0.62, 0.46))
    for number, (mesh, under) in enumerate(zip((*seats, seat), (*legs, four), strict=True), 1):
        objects.append(plain_object(f"chair-{number}", mesh, "wood", colours[number % 3]))
        objects.append(plain_object(f"chair-legs-{number}", under, "metal", STEEL))
    return objects


def _on_the_desk() -> list[SceneObject]:
    """A monitor with its foot, a keyboard, a telephone, a lamp, a stack of paper; the desk's top is at 1.16 m."""
    picture = paint.lettering(0.6, 0.36, (0.10, 0.14, 0.20), (0.70, 0.85, 0.95), 320, lines=6)
    foot = join((prism((10.3, 12.72), 0.10, 1.165, 1.18, 12), prism((10.3, 12.72), 0.02, 1.18, 1.34, 8)))
    lamp = join(
        (
            prism((11.6, 12.6), 0.09, 1.165, 1.185, 12),
            rod((11.6, 12.6, 1.185), (11.6, 12.78, 1.55), 0.012, 6),
            rod((11.6, 12.78, 1.55), (11.6, 12.55, 1.70), 0.012, 6),
            prism((11.6, 12.5), 0.11, 1.60, 1.72, 12, top_radius=0.03),
        )
    )
    return [
        lobby_object(
            "monitor", box((10.0, 12.66, 1.28), (10.6, 12.70, 1.64)), "glass", picture, (0.6, 0.36), solid=True
        ),
        plain_object("monitor-foot", foot, "metal", BLACK),
        plain_object("keyboard", box((10.08, 12.78, 1.165), (10.52, 12.93, 1.185)), "chipboard", BLACK),
        plain_object("telephone", box((9.5, 12.6, 1.165), (9.68, 12.82, 1.22)), "chipboard", (0.2, 0.2, 0.22)),
        plain_object("desk-lamp", lamp, "metal", (0.70, 0.60, 0.25)),
        plain_object("paper", box((9.0, 12.45, 1.165), (9.21, 12.75, 1.25)), "chipboard", (0.93, 0.92, 0.88)),
    ]


def _small_things() -> list[SceneObject]:
    """Bins, a queue's posts and belts, a brochure stand, a suitcase, an umbrella stand."""
    posts = [
        join((prism((x, 11.4), 0.16, 0.0, 0.03, 14), prism((x, 11.4), 0.03, 0.03, 0.95, 10))) for x in (8.9, 10.0, 11.1)
    ]
    belts = [box((x + 0.04, 11.39, 0.85), (x + 1.06, 11.41, 0.91)) for x in (8.9, 10.0)]
    pages = paint.tiles(0.5, 1.2, ((0.75, 0.25, 0.2), (0.25, 0.45, 0.7)), (0.125, 0.3), 330, joint=(0.9, 0.9, 0.88))
    case = paint.speckled(0.7, 0.5, (0.45, 0.12, 0.16), 331, strength=0.1)
    objects = [
        plain_object(f"bin-{number}", prism((x, y), 0.15, 0.0, 0.62, 12, top_radius=0.18), "metal", (0.35, 0.40, 0.42))
        for number, (x, y) in enumerate(((5.1, 0.45), (13.6, 10.2), (5.1, 11.3)), 1)
    ]
    return [
        *objects,
        plain_object("queue-posts", join(posts), "metal", (0.72, 0.60, 0.30)),
        plain_object("queue-belts", join(belts), "cloth", (0.50, 0.08, 0.12)),
        lobby_object("brochures", box((8.3, 14.5, 0.0), (8.8, 14.8, 1.3)), "chipboard", pages, (0.5, 1.2), solid=True),
        lobby_object("suitcase", box((8.75, 5.35, 0.03), (9.0, 5.8, 0.68)), "chipboard", case, (0.7, 0.5), solid=True),
        plain_object("umbrella-stand", prism((9.0, 0.4), 0.12, 0.0, 0.55, 10), "metal", BLACK),
    ]


def plants_with_leaves() -> list[SceneObject]:
    """The potted plants' stems and leaves; the leaves are open sheets of two facets, bent along the middle."""
    objects = []
    for number, (x, y) in enumerate(PLANTS, 1):
        stems = [
            rod((x, y, 0.45), (x + dx, y + dy, 1.35), 0.018, 6, end_radius=0.006)
            for dx, dy in ((0.0, 0.02), (0.14, 0.10), (-0.12, 0.12), (0.02, -0.16))
        ]
        objects.append(plain_object(f"stems-{number}", join(stems), "wood", (0.30, 0.22, 0.12), scattering=0.97))
        leaves = _leaves((x, y, 1.05), (0.42, 0.42, 0.56), number)
        objects.append(
            plain_object(f"leaves-{number}", leaves, "wood", (0.22, 0.42, 0.15), solid=False, scattering=0.97)
        )
    return objects


def _leaves(centre: tuple[float, float, float], radii: tuple[float, float, float], seed: int) -> Mesh:
    """Leaves on and in an ellipsoid, each of four triangles, pointing outwards and drooping."""
    generator = np.random.default_rng(400 + seed)
    vertices, faces = [], []
    for number in range(LEAVES):
        unit = generator.standard_normal(3)
        unit /= np.linalg.norm(unit)
        base = np.array(centre) + (0.45 + 0.4 * generator.random()) * unit * np.array(radii)
        out = unit + np.array([0.0, 0.0, -0.35])
        out /= np.linalg.norm(out)
        side = np.cross(out, [0.0, 0.0, 1.0])
        side /= np.linalg.norm(side) + 1e-9
        up = np.cross(side, out)
        length, width = 0.14 + 0.08 * generator.random(), 0.04 + 0.02 * generator.random()
        middle = base + 0.5 * length * out
        vertices += [base, middle + width * side - 0.01 * up, middle + 0.015 * up, middle - width * side - 0.01 * up]
        vertices.append(base + length * out - 0.02 * up)
        faces += [[5 * number + i for i in face] for face in ((0, 1, 2), (0, 2, 3), (1, 4, 2), (2, 4, 3))]
    corners = torch.from_numpy(np.array(vertices, dtype=np.float32))
    return corners, torch.tensor(faces), torch.zeros(len(corners), 2)
