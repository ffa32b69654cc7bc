"""What is fixed to the lobby's shell at full detail: frames, handles, skirting, lamps' rims, grilles, signs."""

from itertools import pairwise

from rf3dgs.propagation.sites import textures as paint
from rf3dgs.propagation.sites.lobby_parts import (
    DOORS,
    ENTRANCE,
    HEIGHT,
    LENGTH,
    LIFTS,
    WIDTH,
    WINDOWS,
    Wall,
    lobby_object,
    on_wall,
    plain_object,
)
from rf3dgs.propagation.sites.scene import SceneObject
from rf3dgs.propagation.sites.shapes import Mesh, box, join, prism

ALUMINIUM, STEEL, WHITE, DARK = (0.62, 0.64, 0.66), (0.46, 0.47, 0.50), (0.88, 0.88, 0.86), (0.14, 0.14, 0.16)
OAK = (0.42, 0.28, 0.16)
GAP = 0.004
"""Distance [m] of what hangs on a surface from it, so that no two faces lie in each other."""


def fixtures() -> list[SceneObject]:
    """Everything on walls, ceiling and openings that the plain lobby only has painted or not at all."""
    return [*_windows(), *_entrance(), *_doors(), *_lifts(), *_skirting(), *_ceiling(), *_on_the_walls()]


def _frame(
    wall: Wall, opening: tuple[float, float, float, float], bar: float, depth: float, *, foot: bool
) -> list[Mesh]:
    """Bars round an opening, `bar` [m] broad on both sides of its edge; a door has none at its foot."""
    left, right, low, high = opening
    depths = (GAP, depth)
    parts = [
        on_wall(wall, (left - bar, left + bar), (low, high + bar), depths),
        on_wall(wall, (right - bar, right + bar), (low, high + bar), depths),
        on_wall(wall, (left + bar, right - bar), (high - bar, high + bar), depths),
    ]
    if foot:
        parts.append(on_wall(wall, (left + bar, right - bar), (low, low + bar), depths))
    return parts


def _windows() -> list[SceneObject]:
    objects = []
    for number, opening in enumerate(WINDOWS, 1):
        left, right, low, high = opening
        middle = (left + right) / 2
        parts = _frame("west", opening, 0.03, 0.07, foot=True)
        parts.append(on_wall("west", (middle - 0.03, middle + 0.03), (low, high), (GAP, 0.06)))
        parts.append(on_wall("west", (left, right), (low + 1.4, low + 1.45), (GAP, 0.05)))
        objects.append(plain_object(f"window-frame-{number}", join(parts), "metal", ALUMINIUM))
        handle = on_wall("west", (middle + 0.05, middle + 0.08), (low + 0.6, low + 0.75), (0.062, 0.10))
        objects.append(plain_object(f"window-handle-{number}", handle, "metal", STEEL))
        sill = on_wall("west", (left - 0.1, right + 0.1), (low - 0.06, low - 0.02), (GAP, 0.24))
        objects.append(plain_object(f"window-sill-{number}", sill, "chipboard", WHITE))
        ribs = [
            on_wall("west", (left + 0.1 + 0.2 * rib, left + 0.22 + 0.2 * rib), (0.15, 0.62), (0.05, 0.13))
            for rib in range(11)
        ]
        objects.append(plain_object(f"radiator-{number}", join(ribs), "metal", WHITE))
    return objects


def _entrance() -> list[SceneObject]:
    left, right, low, high = ENTRANCE
    parts = _frame("south", ENTRANCE, 0.04, 0.09, foot=False)
    for share in (0.25, 0.5, 0.75):
        at = left + share * (right - left)
        parts.append(on_wall("south", (at - 0.03, at + 0.03), (low, high), (GAP, 0.08)))
    parts.append(on_wall("south", (left, right), (2.08, 2.14), (GAP, 0.07)))
    bars = [
        on_wall("south", (at - 0.02, at + 0.02), (0.8, 1.4), (0.12, 0.16))
        for at in (left + 0.47 * (right - left), left + 0.53 * (right - left))
    ]
    mat = paint.speckled(2.6, 1.4, (0.20, 0.20, 0.22), 200, strength=0.2)
    x0, x1 = WIDTH - right + 0.1, WIDTH - left - 0.1
    doormat = box((x0, 0.2, GAP), (x1, 1.6, 0.02))
    return [
        plain_object("entrance-frame", join(parts), "metal", ALUMINIUM),
        plain_object("entrance-handles", join(bars), "metal", STEEL),
        lobby_object("doormat", doormat, "cloth", mat, (2.6, 1.4), solid=True),
    ]


def _doors() -> list[SceneObject]:
    objects = []
    for number, opening in enumerate(DOORS, 1):
        left, right, _, high = opening
        frame = join(_frame("east", opening, 0.05, 0.05, foot=False))
        objects.append(plain_object(f"door-frame-{number}", frame, "wood", OAK))
        at = right - 0.1
        handle = join(
            (
                on_wall("east", (at - 0.02, at + 0.02), (0.98, 1.16), (GAP, 0.02)),
                on_wall("east", (at - 0.12, at + 0.01), (1.05, 1.07), (0.04, 0.06)),
                on_wall("east", (at - 0.01, at + 0.01), (1.05, 1.07), (0.015, 0.05)),
            )
        )
        objects.append(plain_object(f"door-handle-{number}", handle, "metal", STEEL))
        sign = paint.lettering(0.5, 0.25, (0.05, 0.45, 0.22), (0.95, 0.97, 0.95), 210 + number, lines=1)
        middle = (left + right) / 2
        mesh = on_wall("east", (middle - 0.25, middle + 0.25), (high + 0.12, high + 0.37), (GAP, 0.05))
        objects.append(lobby_object(f"exit-sign-{number}", mesh, "glass", sign, (0.5, 0.25), solid=True, glow=0.9))
    return objects


def _lifts() -> list[SceneObject]:
    parts = [bar for opening in LIFTS for bar in _frame("north", opening, 0.06, 0.05, foot=False)]
    panel = on_wall("north", (2.95, 3.1), (1.0, 1.35), (GAP, 0.03))
    display = paint.lettering(0.6, 0.16, (0.05, 0.05, 0.06), (0.95, 0.55, 0.12), 220, lines=1)
    mesh = on_wall("north", (2.8, 3.4), (2.35, 2.51), (GAP, 0.05))
    return [
        plain_object("lift-frames", join(parts), "metal", STEEL),
        plain_object("lift-buttons", panel, "metal", ALUMINIUM),
        lobby_object("lift-display", mesh, "glass", display, (0.6, 0.16), solid=True, glow=0.8),
    ]


def _skirting() -> list[SceneObject]:
    """A board at the foot of every wall, between the openings that reach the floor."""
    lengths: dict[Wall, float] = {"west": LENGTH, "south": WIDTH, "east": LENGTH, "north": WIDTH}
    gaps: dict[Wall, tuple] = {"west": (), "south": (ENTRANCE,), "east": DOORS, "north": LIFTS}
    objects = []
    for wall, length in lengths.items():
        edges = [0.02, *(edge for gap in gaps[wall] for edge in (gap[0] - 0.07, gap[1] + 0.07)), length - 0.02]
        spans = [span for span in list(pairwise(edges))[::2] if span[1] - span[0] > 0.01]
        boards = [on_wall(wall, span, (GAP, 0.10), (GAP, 0.018)) for span in spans]
        objects.append(plain_object(f"skirting-{wall}", join(boards), "wood", OAK))
    return objects


def _ceiling() -> list[SceneObject]:
    """Rims of the eight luminous panels, four ventilation grilles, smoke detectors and sprinklers."""
    objects = []
    for number in range(8):
        x, y = (3.5, 10.5)[number % 2], 1.9 + 3.75 * (number // 2)
        objects.append(plain_object(f"light-frame-{number + 1}", _rim(x, y, 0.9, 0.3, 0.05), "metal", WHITE))
    for number, (x, y) in enumerate(((7.0, 2.4), (7.0, 12.6), (1.5, 7.4), (12.5, 7.4)), 1):
        slats = [
            box((x - 0.29, y + at - 0.012, HEIGHT - 0.045), (x + 0.29, y + at + 0.012, HEIGHT - 0.012))
            for at in (-0.24, -0.16, -0.08, 0.0, 0.08, 0.16, 0.24)
        ]
        grille = join((_rim(x, y, 0.29, 0.29, 0.03), *slats))
        objects.append(plain_object(f"grille-{number}", grille, "metal", ALUMINIUM))
        objects.append(
            plain_object(f"smoke-detector-{number}", prism((x + 1.2, y), 0.06, 3.44, 3.495, 12), "chipboard", WHITE)
        )
    heads = [prism((x, y), 0.02, 3.42, 3.495, 8, top_radius=0.04) for x in (2.0, 7.0, 12.0) for y in (3.8, 11.2)]
    objects.append(plain_object("sprinklers", join(heads), "metal", STEEL))
    return objects


def _rim(x: float, y: float, half_x: float, half_y: float, bar: float) -> Mesh:
    """Four bars under the ceiling round a rectangle."""
    low, high = HEIGHT - 0.06, HEIGHT - GAP
    return join(
        (
            box((x - half_x - bar, y - half_y - bar, low), (x + half_x + bar, y - half_y, high)),
            box((x - half_x - bar, y + half_y, low), (x + half_x + bar, y + half_y + bar, high)),
            box((x - half_x - bar, y - half_y, low), (x - half_x, y + half_y, high)),
            box((x + half_x, y - half_y, low), (x + half_x + bar, y + half_y, high)),
        )
    )


def _on_the_walls() -> list[SceneObject]:
    """A television, a fire extinguisher, switches, a letter board, a pipe."""
    screen = paint.lettering(1.6, 0.9, (0.06, 0.12, 0.30), (0.85, 0.92, 1.0), 230, lines=5)
    board = paint.lettering(1.0, 1.3, (0.92, 0.90, 0.84), (0.20, 0.22, 0.30), 231, lines=9)
    switches = [on_wall("east", (at, at + 0.09), (1.05, 1.14), (GAP, 0.02)) for at in (2.75, 9.75)]
    switches += [on_wall("west", (at, at + 0.09), (1.05, 1.14), (GAP, 0.02)) for at in (1.2, 13.4)]
    extinguisher = join((prism((13.85, 9.4), 0.08, 0.35, 0.85, 10), prism((13.85, 9.4), 0.03, 0.85, 0.95, 8)))
    television = on_wall("north", (6.3, 7.9), (1.35, 2.25), (0.05, 0.10))
    return [
        lobby_object("television", television, "glass", screen, (1.6, 0.9), solid=True, glow=0.7),
        lobby_object(
            "letter-board",
            on_wall("west", (5.2, 6.05), (1.1, 2.2), (GAP, 0.03)),
            "chipboard",
            board,
            (1.0, 1.3),
            solid=True,
        ),
        plain_object("switches", join(switches), "chipboard", WHITE),
        plain_object("extinguisher", extinguisher, "metal", (0.75, 0.08, 0.08)),
        plain_object("pipe", prism((13.93, 14.93), 0.04, GAP, HEIGHT - GAP, 10), "metal", DARK),
    ]
