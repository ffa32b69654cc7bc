"""A scene of matte surfaces in Dr.Jit's memory: what a ray hits, what that reflects and emits, what it can see.

`Any` stands for Dr.Jit's arrays, with one number per ray. Mitsuba finds the triangle; looks come from `light_tables`.
"""

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from rf3dgs.propagation.light_points import hashed, unit
from rf3dgs.propagation.light_tables import light_tables
from rf3dgs.propagation.scene import Scene
from rf3dgs.propagation.scene_files import linear_from_srgb

OFFSET = 2e-5
"""How far rays begin off a surface, as a share of the size of its coordinates plus 1 m."""


class Surfaces:
    """The tables of a scene and its rays; `lights` is how many entries `picks` has."""

    def __init__(self, scene: Scene) -> None:
        import mitsuba

        tables = light_tables(scene)
        self._scene = _merged(mitsuba, scene)
        self.triangles = mitsuba.Float(tables.triangles.reshape(-1))
        self._uv = mitsuba.Float(tables.uv.reshape(-1))
        self._looks = mitsuba.Float(tables.looks.reshape(-1))
        self._pictures = mitsuba.UInt32(tables.pictures.reshape(-1))
        self._texels = mitsuba.UInt32(tables.texels)
        self.picks = mitsuba.UInt32(tables.picks)
        self.chance = mitsuba.Float(tables.chance)
        self.mean = mitsuba.Float(tables.mean)
        self.sky, self.lamp = tables.sky, tables.lamp
        self._linear = mitsuba.Float(_linear_bytes())
        self.lights = len(tables.picks)

    def hit(self, ray: Any, active: Any = True, *, coherent: bool = False) -> Any:
        """Distance, triangle and place in it of what a ray meets; coherent: neighbouring rays go the same way."""
        return self._scene.ray_intersect_preliminary(ray, coherent=coherent, active=active)

    def place(self, hit: Any, ray: Any) -> tuple[Any, Any, Any]:
        """Place, normal towards where the ray came from, and the triangle of a hit."""
        import drjit as dr
        import mitsuba as mi

        face = hit.prim_index
        rows = [dr.gather(mi.Vector4f, self.triangles, 4 * face + part, hit.is_valid()) for part in range(3)]
        v0, e1, e2 = split(rows)
        place = mi.Point3f(v0 + e1 * hit.prim_uv.x + e2 * hit.prim_uv.y)
        normal = mi.Normal3f(rows[2].y, rows[2].z, rows[2].w)
        return place, dr.select(dr.dot(normal, ray.d) > 0, -normal, normal), face

    def look(self, face: Any, uv: Any, column: int, chance: Any, active: Any = True) -> Any:
        """What a triangle reflects (column 13) or emits (14) at one texel near `uv`; bilinear in the mean."""
        import drjit as dr
        import mitsuba as mi

        number = dr.gather(mi.Float, self.triangles, 16 * face + column, active)
        active = active & (number >= 0.0)
        number = mi.UInt32(dr.maximum(number, 0.0))
        picture = dr.gather(mi.Vector4u, self._pictures, number, active)
        start = dr.gather(mi.Vector4f, self._uv, 2 * face, active)
        rest = dr.gather(mi.Vector4f, self._uv, 2 * face + 1, active)
        across = start.x + uv.x * start.z + uv.y * rest.x
        down = start.y + uv.x * start.w + uv.y * rest.y
        chance = hashed(chance)
        column_, row = (
            _wrapped(mi, value * mi.Float(size) + jitter - 0.5, size)
            for value, size, jitter in (
                (across, picture.y, unit(chance << 16)),
                (down, picture.z, unit(chance & 0xFFFF0000)),
            )
        )
        texel = dr.gather(mi.UInt32, self._texels, picture.x + row * picture.y + column_, active)
        factor = dr.gather(mi.Vector4f, self._looks, number, active)
        parts = (dr.gather(mi.Float, self._linear, (texel >> by) & 255, active) for by in (0, 8, 16))
        return mi.Color3f(*(value * part for value, part in zip((factor.x, factor.y, factor.z), parts, strict=True)))

    def shine(self, hit: Any, face: Any, along: Any, chance: Any, active: Any = True) -> Any:
        """Light that the hit triangle sends towards the ray."""
        import drjit as dr
        import mitsuba as mi

        if not self.lights:
            return mi.Color3f(0.0)
        valid = hit.is_valid() & active
        row = dr.gather(mi.Vector4f, self.triangles, 4 * face + 2, valid)
        front = dr.dot(mi.Vector3f(row.y, row.z, row.w), along) < 0
        return dr.select(front & valid, self.look(face, hit.prim_uv, 14, chance, valid & front), 0.0)

    def seen(self, at: Any, normal: Any, way: Any, active: Any) -> Any:
        """Whether nothing stands between a point and the one that is `way` from it."""
        import drjit as dr
        import mitsuba as mi

        start = off(at, normal)
        way = mi.Point3f(at + way) - start
        length = dr.norm(way)
        ray = mi.Ray3f(start, way / length)
        ray.maxt = length * (1.0 - 1e-4)
        return active & ~self._scene.ray_test(ray, active)


def off(at: Any, normal: Any) -> Any:
    """Where rays from a point begin."""
    import drjit as dr

    return at + normal * (OFFSET * (1.0 + dr.max(dr.abs(at))))


def _wrapped(mi: Any, value: Any, size: Any) -> Any:
    """The texel that `value` lies in, the picture repeated."""
    import drjit as dr

    whole = dr.floor(value)
    wide = mi.Float(size)
    return dr.minimum(mi.UInt32(dr.maximum(whole - wide * dr.floor(whole / wide), 0.0)), size - 1)


def split(rows: Any) -> tuple[Any, Any, Any]:
    """First corner and the two edges of a triangle out of its rows of four."""
    import mitsuba as mi

    a, b, c = rows[:3]
    return mi.Vector3f(a.x, a.y, a.z), mi.Vector3f(a.w, b.x, b.y), mi.Vector3f(b.z, b.w, c.x)


def _merged(mitsuba: Any, scene: Scene) -> Any:
    """All triangles as one Mitsuba mesh; its rays name a triangle by its row in the tables."""
    corners = torch.cat([item.vertices[item.faces] for item in scene.objects]).reshape(-1, 3).float()
    mesh = mitsuba.Mesh("all", len(corners), len(corners) // 3)
    parameters = mitsuba.traverse(mesh)
    parameters["vertex_positions"] = mitsuba.Float(corners.numpy().reshape(-1))
    parameters["faces"] = mitsuba.UInt32(np.arange(len(corners), dtype=np.uint32))
    parameters.update()
    return mitsuba.load_dict({"type": "scene", "all": mesh})


def _linear_bytes() -> NDArray[np.float32]:
    return linear_from_srgb(np.arange(256) / 255.0).astype(np.float32)
