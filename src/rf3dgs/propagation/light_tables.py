"""A scene as flat tables of triangles, looks and lights: what `propagation.light` follows light paths through."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rf3dgs.propagation.scene import Scene, SceneObject
from rf3dgs.propagation.scene_files import LAMP_REFLECTANCE, SKY, lamp_of, linear_from_srgb, mean_colour

PICKS = 4096
"""Entries of the table that a light is picked from, or more where lights are many; the more powerful it is the more of
them are its own."""


class LightTables(NamedTuple):
    """A scene in arrays; a triangle is v0, v0 + e1, v0 + e2, its light comes from the side that its normal points to.

    triangles `[F, 16]`: v0, e1, e2, unit normal, area, and the numbers of what it reflects and emits (-1: nothing).
    uv `[F, 8]`: texture coordinates of v0, those of e1 and e2 as differences, two zeros.
    looks `[L, 4]`: factors on linear red, green and blue, a zero; pictures `[L, 4]`: where the look's texture begins in
    `texels`, its width and height, a zero. texels `[T]`: red + green 2^8 + blue 2^16, sRGB.
    picks `[P]`: triangles that emit; chance `[F]`: the share of `picks` that is a triangle's own.
    mean `[F]`: mean radiance of a triangle over red, green and blue.
    sky: radiance of what no triangle covers; lamp: place of a point lamp [m] and its intensity, or None.
    """

    triangles: NDArray[np.float32]
    uv: NDArray[np.float32]
    looks: NDArray[np.float32]
    pictures: NDArray[np.uint32]
    texels: NDArray[np.uint32]
    picks: NDArray[np.uint32]
    chance: NDArray[np.float32]
    mean: NDArray[np.float32]
    sky: tuple[float, float, float]
    lamp: tuple[tuple[float, float, float], float] | None


class Looks:
    """Collects the looks of objects; a texture that several share is kept once."""

    def __init__(self) -> None:
        self.factors: list[tuple[float, float, float, float]] = []
        self.pictures: list[tuple[int, int, int, int]] = []
        self.mean: list[float] = []
        self.texels: list[NDArray[np.uint32]] = [np.array([0xFFFFFF], dtype=np.uint32)]
        self._begun: dict[int, int] = {}
        self._length = 1

    def of(self, item: SceneObject) -> tuple[int, int]:
        """The numbers of what an object reflects and emits; -1 when it emits nothing."""
        if item.glow <= 0:
            return self._add(item, 1.0), -1
        reflects = self._plain(np.full(3, LAMP_REFLECTANCE))
        return reflects, self._add(item, item.glow)

    def _add(self, item: SceneObject, scale: float) -> int:
        if item.texture is None or scale > 1.0:
            return self._plain(scale * linear_from_srgb(mean_colour(item)))
        rows, cols = item.texture.shape[:2]
        begin = self._begun.get(id(item.texture))
        if begin is None:
            begin = self._begun[id(item.texture)] = self._length
            bytes_ = item.texture.reshape(-1, 3).astype(np.uint32)
            self.texels.append((bytes_ << np.array([0, 8, 16], dtype=np.uint32)).sum(1, dtype=np.uint32))
            self._length += rows * cols
        light = scale * linear_from_srgb(item.texture.reshape(-1, 3) / 255.0)
        return self._note((scale, scale, scale), (begin, cols, rows), float(light.mean()))

    def _plain(self, light: NDArray[np.float64]) -> int:
        red, green, blue = light.tolist()
        return self._note((red, green, blue), (0, 1, 1), float(light.mean()))

    def _note(self, factors: tuple[float, float, float], picture: tuple[int, int, int], mean: float) -> int:
        self.factors.append((*factors, 0.0))
        self.pictures.append((*picture, 0))
        self.mean.append(mean)
        return len(self.factors) - 1


def light_tables(scene: Scene) -> LightTables:
    """The tables of a scene without transparent objects, with the looks that `write_visual_scene` gives it."""
    looks = Looks()
    triangles, coordinates = [], []
    for item in scene.objects:
        corners = item.vertices[item.faces].numpy().astype(np.float64)
        v0, e1, e2 = corners[:, 0], corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
        normal = np.cross(e1, e2)
        double = np.linalg.norm(normal, axis=-1, keepdims=True)
        reflects, emits = looks.of(item)
        numbers = np.broadcast_to([reflects, emits], (len(v0), 2))
        triangles.append(np.concatenate((v0, e1, e2, normal / np.maximum(double, 1e-30), double / 2, numbers), 1))
        triangles[-1] = np.pad(triangles[-1], ((0, 0), (0, 1)))
        uv = np.zeros((len(v0), 3, 2)) if item.uv is None else item.uv[item.faces].numpy().astype(np.float64)
        parts = (uv[:, 0], uv[:, 1] - uv[:, 0], uv[:, 2] - uv[:, 0], np.zeros((len(v0), 2)))
        coordinates.append(np.concatenate(parts, 1))
    table = np.concatenate(triangles)
    mean = np.array([*looks.mean, 0.0])[table[:, 14].astype(int)]
    picks = _picks(mean * table[:, 12])
    chance = np.bincount(picks, minlength=len(table)) / len(picks) if len(picks) else np.zeros(len(table))
    return LightTables(
        triangles=table.astype(np.float32),
        uv=np.concatenate(coordinates).astype(np.float32),
        looks=np.array(looks.factors, dtype=np.float32),
        pictures=np.array(looks.pictures, dtype=np.uint32),
        texels=np.concatenate(looks.texels),
        picks=picks.astype(np.uint32),
        chance=chance.astype(np.float32),
        mean=mean.astype(np.float32),
        sky=(scene.sky * SKY[0], scene.sky * SKY[1], scene.sky * SKY[2]),
        lamp=lamp_of(scene),
    )


def _picks(power: NDArray[np.float64]) -> NDArray[np.int64]:
    """Numbers of triangles, each as often as its share of the power, and every one that emits at least once."""
    emits = np.flatnonzero(power > 0)
    if not len(emits):
        return np.zeros(0, dtype=np.int64)
    share = power[emits] / power[emits].sum()
    room = max(PICKS, 4 * len(emits))
    edges = np.round(np.cumsum(share) * (room - len(emits))).astype(np.int64)
    return np.repeat(emits, 1 + np.diff(edges, prepend=0))
