"""Follows light through a scene of matte surfaces: the photographer's path tracer, on Mitsuba's rays.

Every surface of a `Scene` reflects by Lambert's law, so one table of triangles and one kernel serve all cameras, and
light is gathered with few rays:

- At each point a light is chosen out of `CANDIDATES`, with odds as each would shine there were nothing in between
  (resampled importance sampling, Talbot et al. 2005), and one ray asks whether it is seen. What a light sends and what
  the next ray finds by chance share the weight by the balance heuristic of Veach (1997).
- After the second point only every second, then every fourth sample goes on, with twice, four times the weight.
  Samples of neighbouring pixels, which the processor works on together, go on together.
- Points of each pixel are Sobol's, scrambled: `propagation.light_points`.

None of it changes the mean: the expected picture is that of Mitsuba's integrator "path", which the tests hold it to.
Dr.Jit records the arithmetic once and compiles it; `Any` stands for its arrays, with one number per pixel.
"""

import math
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from rf3dgs.core.grids import Camera
from rf3dgs.propagation.light_points import hashed, point
from rf3dgs.propagation.light_surfaces import Surfaces, off, split
from rf3dgs.propagation.scene import Scene

CANDIDATES = 4
"""Lights that are compared at each point before one is asked for."""
THINNED = ((2, 2), (3, 4))
"""From the point of this number (the first is 0) on, one of that many samples is followed, a power of two."""
TOGETHER = 16
"""Pixels whose samples go on together: at least as many as the processor's registers hold numbers."""


def is_matte(scene: Scene) -> bool:
    """Whether `Light` can follow light through the scene: nothing in it is transparent."""
    return all(item.transparency == 0 for item in scene.objects)


class Light:
    """A scene in Dr.Jit's memory; Mitsuba must compute with "llvm_ad_rgb" while it is made and used."""

    def __init__(self, scene: Scene) -> None:
        self._surfaces = Surfaces(scene)

    def picture(self, camera: Camera, samples: int, bounces: int, seed: int) -> NDArray[np.float64]:
        """Linear light `[row, col, 3]`, the mean of `samples` paths of at most `bounces` segments in each pixel."""
        import drjit as dr
        import mitsuba as mi

        opaque = {
            name: dr.opaque(mi.Float, value)
            for name, value in zip(("fx", "fy", "cx", "cy"), camera.K[[0, 1, 0, 1], [0, 1, 2, 2]].tolist(), strict=True)
        }
        world_from_camera = torch.linalg.inv(camera.viewmat.double())
        columns = [
            mi.Vector3f(*(dr.opaque(mi.Float, value) for value in world_from_camera[:3, column].tolist()))
            for column in range(4)
        ]
        lane = dr.arange(mi.UInt32, camera.width * camera.height)
        width = dr.opaque(mi.UInt32, camera.width)
        row = lane // width
        col = lane - row * width
        of_run = hashed(dr.opaque(mi.UInt32, seed % 2**32) + 0x9E3779B9)
        own = hashed(lane ^ of_run)  # what sets the points of this pixel apart
        shift = hashed(lane // TOGETHER + of_run)
        count, segments = dr.opaque(mi.UInt32, samples), dr.opaque(mi.UInt32, bounces)

        def sample(number: Any, total: Any) -> tuple[Any, Any]:
            across, down = point(number, own)
            along = (
                columns[0] * ((mi.Float(col) + across - opaque["cx"]) / opaque["fx"])
                + columns[1] * ((mi.Float(row) + down - opaque["cy"]) / opaque["fy"])
                + columns[2]
            )
            ray = mi.Ray3f(mi.Point3f(columns[3]), dr.normalize(along))
            return number + 1, total + self._followed(ray, number, own, number + shift, segments)

        _, total = dr.while_loop(
            (mi.UInt32(0), mi.Color3f(0.0)), lambda number, _: number < count, sample, mode="symbolic"
        )
        light = np.array(total, dtype=np.float64) / samples
        return light.T.reshape(camera.height, camera.width, 3)

    def _followed(self, ray: Any, number: Any, own: Any, turn: Any, segments: Any) -> Any:
        """Light that comes along one ray per pixel."""
        import drjit as dr
        import mitsuba as mi

        surfaces = self._surfaces
        first = surfaces.hit(ray, coherent=True)
        found = first.is_valid()
        place, normal, face = surfaces.place(first, ray)
        light = dr.select(found, surfaces.shine(first, face, ray.d, own + number), mi.Color3f(*surfaces.sky))

        def onward(depth: Any, active: Any, at: Any, normal: Any, face: Any, uv: Any, weight: Any, light: Any) -> tuple:
            key = hashed(own + depth * 0x632BE5AB)
            weight = weight * surfaces.look(face, uv, 13, hashed(key + number))
            last = depth + 2 >= segments
            light = light + dr.select(active, weight * self._lit(at, normal, key, number, last, active), 0.0)
            # The next point, where light that was found by chance counts as far as it was not asked for. The sky is
            # never asked for.
            if not any(surfaces.sky):
                active = active & ~last
            before = 1
            for begin, one_of in THINNED:
                active = active & ((depth < begin) | ((turn & (one_of - 1)) == 0))
                weight = dr.select(depth == begin, weight * (one_of / before), weight)
                before = one_of
            local = mi.warp.square_to_cosine_hemisphere(mi.Point2f(*point(number, key ^ 0x2C1B3C6D)))
            ray = mi.Ray3f(off(at, normal), mi.Frame3f(normal).to_world(local))
            hit = surfaces.hit(ray, active)
            found = hit.is_valid() & active
            light = light + dr.select(active & ~found, weight * mi.Color3f(*surfaces.sky), 0.0)
            at, normal, face = surfaces.place(hit, ray)
            shine = surfaces.shine(hit, face, ray.d, key + number, found)
            asked = self._asked(face, hit.t * hit.t, dr.abs(dr.dot(normal, ray.d)), found)
            share = dr.rcp(1.0 + asked * math.pi / dr.maximum(local.z, 1e-9))
            light = light + dr.select(found & ~last, weight * share * shine, 0.0)
            return depth + 1, found & ~last, at, normal, face, mi.Point2f(hit.prim_uv), weight, light

        state = (
            mi.UInt32(0),
            found & (segments > 1),
            place,
            normal,
            face,
            mi.Point2f(first.prim_uv),
            mi.Color3f(1.0),
            light,
        )
        return dr.while_loop(state, lambda depth, active, *_: active, onward, mode="symbolic")[-1]

    def _asked(self, face: Any, square: Any, cosine: Any, active: Any) -> Any:
        """How densely `_lit` asks for the light of a triangle [1/sr], candidates together."""
        import drjit as dr
        import mitsuba as mi

        surfaces = self._surfaces
        if not surfaces.lights:
            return mi.Float(0.0)
        area = dr.gather(mi.Float, surfaces.triangles, 16 * face + 12, active)
        chance = dr.gather(mi.Float, surfaces.chance, face, active)
        return CANDIDATES * chance * square / dr.maximum(area * cosine, 1e-12)

    def _lit(self, at: Any, normal: Any, key: Any, number: Any, last: Any, active: Any) -> Any:
        """Light that lamps send to a point, times cosine over pi; all of it when no ray follows that may find them."""
        import drjit as dr
        import mitsuba as mi

        surfaces = self._surfaces
        if surfaces.lamp is not None:
            way = mi.Point3f(*surfaces.lamp[0]) - at
            square = dr.squared_norm(way)
            cosine = dr.dot(normal, way) * dr.rsqrt(square)
            strength = dr.maximum(cosine, 0.0) * (surfaces.lamp[1] / math.pi) / square
            return mi.Color3f(strength & surfaces.seen(at, normal, way, active & (cosine > 0)))
        if not surfaces.lights:
            return mi.Color3f(0.0)
        across, down = point(number, key ^ 0x165667B1)
        pick, fate = point(number, key ^ 0x7F4A7C15)
        total, chosen, chosen_way, chosen_uv, target = (
            mi.Float(0.0),
            mi.UInt32(0),
            mi.Vector3f(0.0, 0.0, 1.0),
            mi.Point2f(0.0),
            mi.Float(1.0),
        )
        for candidate in range(CANDIDATES):
            entry = mi.UInt32((pick + candidate) * (surfaces.lights / CANDIDATES))
            face = dr.gather(mi.UInt32, surfaces.picks, dr.minimum(entry, surfaces.lights - 1), active)
            u, v = (_fraction(dr, value + candidate * step) for value, step in ((across, 0.7548777), (down, 0.5698403)))
            flip = u + v > 1.0
            u, v = dr.select(flip, 1.0 - u, u), dr.select(flip, 1.0 - v, v)
            rows = [dr.gather(mi.Vector4f, surfaces.triangles, 4 * face + part, active) for part in range(4)]
            v0, e1, e2 = split(rows)
            way = mi.Vector3f(v0 + e1 * u + e2 * v - at)
            square = dr.maximum(dr.squared_norm(way), 1e-12)
            length = dr.sqrt(square)
            here = dr.maximum(dr.dot(normal, way), 0.0) / length
            there = dr.maximum(-dr.dot(mi.Vector3f(rows[2].y, rows[2].z, rows[2].w), way), 0.0) / length
            density = dr.gather(mi.Float, surfaces.chance, face, active) / rows[3].x
            asked = CANDIDATES * density * square / dr.maximum(there, 1e-12)
            share = dr.select(last, 1.0, asked / (asked + here / math.pi))
            shape = here * there * share / (square * math.pi)
            mean = dr.gather(mi.Float, surfaces.mean, face, active)
            odds = mean * shape / density
            total += odds
            odds = dr.select(total > 0, odds / total, 0.0)
            taken = fate < odds
            fate = dr.select(taken, fate / dr.maximum(odds, 1e-9), (fate - odds) / dr.maximum(1.0 - odds, 1e-9))
            chosen, chosen_way = dr.select(taken, face, chosen), dr.select(taken, way, chosen_way)
            chosen_uv = dr.select(taken, mi.Point2f(u, v), chosen_uv)
            target = dr.select(taken, mean, target)
        seen = surfaces.seen(at, normal, chosen_way, active & (total > 0))
        colour = surfaces.look(chosen, chosen_uv, 14, key + number + 1, seen)
        return dr.select(seen, colour * (total / (CANDIDATES * target)), 0.0)


def _fraction(dr: Any, value: Any) -> Any:
    return value - dr.floor(value)
