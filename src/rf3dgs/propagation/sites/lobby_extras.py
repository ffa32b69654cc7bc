"""People in the lobby, and things that radio and eye see differently."""

import math
from dataclasses import replace
from typing import NamedTuple

from rf3dgs.core.errors import InputError
from rf3dgs.propagation.sites import textures as paint
from rf3dgs.propagation.sites.lobby_parts import lobby_object, plain_object
from rf3dgs.propagation.sites.scene import SceneObject
from rf3dgs.propagation.sites.shapes import Mesh, ball, box, join, quad, rod, turned

Colour = tuple[float, float, float]


class Person(NamedTuple):
    """Where somebody stands (x, y) [m], where they look [rad], how far they stride [rad], their height [m], colours."""

    place: tuple[float, float]
    heading: float
    stride: float
    height: float
    coat: Colour
    legs: Colour
    skin: Colour


PEOPLE = (
    Person((6.4, 4.0), 1.2, 0.35, 1.76, (0.16, 0.24, 0.42), (0.12, 0.12, 0.14), (0.80, 0.60, 0.48)),
    Person((10.2, 11.9), 1.5, 0.00, 1.68, (0.62, 0.16, 0.20), (0.20, 0.24, 0.36), (0.52, 0.34, 0.24)),
    Person((10.5, 13.5), -1.6, 0.00, 1.72, (0.86, 0.86, 0.84), (0.10, 0.10, 0.12), (0.84, 0.66, 0.54)),
    Person((2.6, 7.5), -0.4, 0.40, 1.83, (0.28, 0.36, 0.24), (0.34, 0.30, 0.24), (0.40, 0.26, 0.18)),
    Person((11.5, 8.9), 2.6, 0.25, 1.61, (0.80, 0.58, 0.16), (0.16, 0.18, 0.28), (0.76, 0.56, 0.44)),
    Person((3.2, 13.6), -1.5, 0.00, 1.79, (0.40, 0.20, 0.46), (0.22, 0.22, 0.24), (0.70, 0.50, 0.38)),
    Person((7.1, 1.9), 1.6, 0.45, 1.70, (0.14, 0.40, 0.44), (0.30, 0.26, 0.22), (0.60, 0.42, 0.32)),
    Person((12.2, 3.7), 2.8, 0.00, 1.74, (0.52, 0.50, 0.48), (0.14, 0.16, 0.24), (0.82, 0.64, 0.52)),
)


def people_of(count: int) -> list[SceneObject]:
    """The first `count` of the people: clothes and skin of each, all with the radio material of skin.

    Cloth of a millimetre or two is nearly transparent to radio waves, so the body under it is what they meet.
    """
    if not 0 <= count <= len(PEOPLE):
        raise InputError(f"people must be between 0 and {len(PEOPLE)}; got {count}")
    objects = []
    for number, person in enumerate(PEOPLE[:count], 1):
        place, scale = (*person.place, 0.0), person.height / 1.75
        coat, legs, skin = (_sized(mesh, scale, place, person.heading) for mesh in _body(person.stride))
        objects += [
            plain_object(f"person-{number}-coat", coat, "skin", person.coat, scattering=0.9),
            plain_object(f"person-{number}-legs", legs, "skin", person.legs, scattering=0.9),
            plain_object(f"person-{number}-skin", skin, "skin", person.skin),
        ]
    return objects


def _body(stride: float) -> tuple[Mesh, Mesh, Mesh]:
    """Coat with arms, legs with shoes, head with hands, of someone 1.75 m tall who looks along x."""
    coat = [
        rod((0, 0, 0.92), (0, 0, 1.20), 0.16, 12, end_radius=0.17),
        rod((0, 0, 1.20), (0, 0, 1.46), 0.17, 12, end_radius=0.11),
    ]
    legs, skin = [], [rod((0, 0, 1.46), (0, 0, 1.54), 0.055, 8), ball((0.01, 0, 1.64), (0.095, 0.08, 0.115))]
    for side, swing in ((1, stride), (-1, -stride)):
        shoulder, hip = (0.0, 0.21 * side, 1.40), (0.0, 0.095 * side, 0.93)
        elbow = (0.28 * math.sin(-swing), 0.25 * side, 1.40 - 0.28 * math.cos(swing))
        hand = (elbow[0] + 0.26 * math.sin(0.3 - swing), 0.25 * side, elbow[2] - 0.26 * math.cos(0.3 - swing))
        coat += [rod((0, 0.1 * side, 1.41), shoulder, 0.06, 8), rod(shoulder, elbow, 0.055, 8, end_radius=0.045)]
        coat.append(rod(elbow, hand, 0.045, 8, end_radius=0.035))
        skin.append(ball(hand, (0.045, 0.03, 0.06), around=8, rows=4))
        knee = (0.44 * math.sin(swing), hip[1], 0.93 - 0.44 * math.cos(swing))
        foot = (knee[0] + 0.43 * math.sin(0.4 * swing - 0.15 * abs(swing)), hip[1], 0.075)
        legs += [rod(hip, knee, 0.085, 10, end_radius=0.06), rod(knee, foot, 0.06, 10, end_radius=0.045)]
        legs.append(box((foot[0] - 0.08, hip[1] - 0.045, 0.005), (foot[0] + 0.19, hip[1] + 0.045, 0.08)))
    return join(coat), join(legs), join(skin)


def _sized(mesh: Mesh, scale: float, place: tuple[float, float, float], heading: float) -> Mesh:
    return turned((scale * mesh[0], mesh[1], mesh[2]), place, heading)


COATING = (1.0, 2.0e7)
"""Permittivity and conductivity [S/m] of a metal film; 10 nm of it have 5 ohms per square and pass 0.07 % of a wave."""


def see_through() -> list[SceneObject]:
    """A coated glass partition (light passes, radio is reflected), a curtain and a thin poster wall (the other way)."""
    clear = paint.speckled(2.4, 2.2, (0.72, 0.84, 0.82), 500, strength=0.02)
    folds = paint.tiles(2.2, 2.6, ((0.46, 0.12, 0.18), (0.62, 0.22, 0.26)), (0.10, 2.6), 501, joint=(0.32, 0.08, 0.12))
    sheet = paint.speckled(2.4, 2.1, (0.86, 0.82, 0.70), 502)
    paint.poster(sheet, 2.4, 0.3, 0.3, (1.8, 1.5), 503)
    glass = lobby_object(
        "glass-partition", quad((3.4, 6.2, 2.2), (0, 2.4, 0), (0, 0, -2.2)), "glass", clear, (2.4, 2.2), scattering=0.05
    )
    curtain = lobby_object("curtain", _folded(10.9, 1.6, 2.2, 2.6), "cloth", folds, (2.2, 2.6), scattering=0.3)
    poster = lobby_object(
        "poster-wall",
        quad((5.4, 9.3, 2.1), (0, 0, -2.1), (2.4, 0, 0)),
        "plasterboard",
        sheet,
        (2.1, 2.4),
        scattering=0.2,
    )
    return [
        replace(glass, thickness=1e-8, electric=COATING, transparency=0.9),
        replace(curtain, thickness=0.001),
        replace(poster, thickness=0.010),
    ]


def _folded(x: float, y: float, length: float, height: float) -> Mesh:
    """A curtain along y that hangs in folds, its lower edge just above the floor."""
    strips = []
    count = 22
    for number in range(count):
        sway = 0.04 if number % 2 else -0.04
        start = (x + sway, y + number * length / count, height + 0.02)
        strips.append(
            quad(start, (-2 * sway, length / count, 0.0), (0.0, 0.0, -height), (number * length / count, 0.0))
        )
    return join(strips)
