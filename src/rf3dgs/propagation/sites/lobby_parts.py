"""Measures and materials of the lobby, and the one way in which all its objects are made."""

from collections.abc import Sequence
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from rf3dgs.propagation.sites import textures as paint
from rf3dgs.propagation.sites.scene import SceneObject
from rf3dgs.propagation.sites.shapes import Mesh, box

WIDTH, LENGTH, HEIGHT = 14.0, 15.0, 3.5  # x, y, z [m]

SCATTERING = {
    "concrete": 0.90,
    "plasterboard": 0.90,
    "ceiling_board": 0.92,
    "floorboard": 0.85,
    "wood": 0.80,
    "chipboard": 0.85,
    "glass": 0.45,
    "metal": 0.60,
    "cloth": 0.90,
    "skin": 0.80,
}
"""Scattering amplitude S of each material: S^2 of the reflected power is diffuse, the rest mirror-like."""

THICKNESS = {
    "concrete": 0.20,
    "plasterboard": 0.10,
    "ceiling_board": 0.02,
    "floorboard": 0.03,
    "wood": 0.03,
    "chipboard": 0.02,
    "glass": 0.012,
    "metal": 0.01,
    "cloth": 0.05,
    "skin": 0.10,
}
"""Thickness of each material [m], which its reflection depends on."""

WINDOWS = ((2.5, 5.0, 0.8, 2.8), (6.25, 8.75, 0.8, 2.8), (10.0, 12.5, 0.8, 2.8))
ENTRANCE = (5.6, 8.4, 0.0, 2.6)
DOORS = ((3.0, 4.0, 0.0, 2.1), (10.0, 11.0, 0.0, 2.1))
LIFTS = ((1.6, 2.8, 0.0, 2.2), (3.4, 4.6, 0.0, 2.2))
"""Openings of the west, south, east and north wall: (left, right, foot, head) [m], from inside, along the wall."""

Wall = Literal["west", "south", "east", "north"]


def lobby_object(
    name: str,
    mesh: Mesh,
    material: str,
    picture: NDArray[np.floating],
    size: Sequence[float],
    *,
    solid: bool = False,
    glow: float = 0.0,
    scattering: float | None = None,
) -> SceneObject:
    """An object whose texture is `picture`, `size` (width, height) [m], repeated where the surface is larger."""
    vertices, faces, uv = mesh
    return SceneObject(
        name=name,
        vertices=vertices,
        faces=faces,
        material=material,
        scattering=SCATTERING[material] if scattering is None else scattering,
        thickness=THICKNESS[material],
        texture=paint.finish(picture),
        uv=uv / uv.new_tensor([float(size[0]), float(size[1])]),
        glow=glow,
        solid=solid,
    )


def plain_object(
    name: str,
    mesh: Mesh,
    material: str,
    colour: tuple[float, float, float],
    *,
    solid: bool = True,
    glow: float = 0.0,
    scattering: float | None = None,
) -> SceneObject:
    """A small object in one sRGB colour."""
    vertices, faces, _ = mesh
    return SceneObject(
        name=name,
        vertices=vertices,
        faces=faces,
        material=material,
        scattering=SCATTERING[material] if scattering is None else scattering,
        thickness=THICKNESS[material],
        colour=colour,
        glow=glow,
        solid=solid,
    )


def on_wall(wall: Wall, along: tuple[float, float], heights: tuple[float, float], depths: tuple[float, float]) -> Mesh:
    """A box on a wall: from and to along it (to the right, from inside), above the floor and in front of it [m]."""
    (s0, s1), (z0, z1), (d0, d1) = along, heights, depths
    spans = {
        "west": ((d0, s0), (d1, s1)),
        "south": ((WIDTH - s1, d0), (WIDTH - s0, d1)),
        "east": ((WIDTH - d1, LENGTH - s1), (WIDTH - d0, LENGTH - s0)),
        "north": ((s0, LENGTH - d1), (s1, LENGTH - d0)),
    }
    (x0, y0), (x1, y1) = spans[wall]
    return box((x0, y0, z0), (x1, y1, z1))
