"""How much of a site's surfaces a set of photographs sees well enough to be reconstructed."""

import math
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from rf3dgs.core.errors import InputError, MissingDependencyError
from rf3dgs.core.grids import Camera
from rf3dgs.propagation.llvm import find_llvm, mitsuba_variant, prepare
from rf3dgs.propagation.sites import meshes
from rf3dgs.propagation.sites.scene import Scene

HIDDEN = 0.05
"""A surface with something this close in front of it [m] cannot be photographed and does not count."""
NUDGE = 0.002
"""Rays end this far [m] from the surface they look at."""


@dataclass(frozen=True)
class Coverage:
    """share: of the surface area, what enough photographs see; by_object: (area [m^2], share) of each object."""

    share: float
    by_object: Mapping[str, tuple[float, float]]

    def share_of(self, *names: str) -> float:
        """The share of the area of some objects together."""
        parts = [self.by_object[name] for name in names]
        return sum(area * share for area, share in parts) / sum(area for area, _ in parts)


def coverage(
    scene: Scene,
    cameras: Sequence[Camera],
    *,
    views: int = 3,
    angle_deg: float = 60.0,
    distance: float = 8.0,
    samples: int = 20_000,
    seed: int = 0,
) -> Coverage:
    """The share of the area that at least `views` photographs see at less than `angle_deg` from its normal and closer
    than `distance` [m], with nothing in between.

    `samples` points are drawn uniformly on all surfaces; faces hidden by something else are left out. The share's
    standard error is at most 0.5 / sqrt(samples). MissingDependencyError without Mitsuba.
    """
    if views < 1 or samples < 1 or not 0 < angle_deg <= 90 or not distance > 0:
        raise InputError(
            f"coverage needs views and samples of at least 1, an angle up to 90 degrees and a positive distance; "
            f"got {views}, {samples}, {angle_deg} and {distance}"
        )
    point, normal, owner = _samples(scene, samples, seed)
    with _Rays(scene) as rays:
        visible = ~rays.blocked(point + NUDGE * normal, point + HIDDEN * normal)
        point, normal, owner = point[visible], normal[visible], owner[visible]
        seen = torch.zeros(len(point), dtype=torch.int64)
        for camera in cameras:
            towards = camera.position - point
            reach = towards.norm(dim=-1)
            cosine = (towards * normal).sum(-1) / reach
            _, inside = camera.grid.pixel_of(camera.pose.to_device(-towards / reach[:, None]))
            good = inside & (cosine > math.cos(math.radians(angle_deg))) & (reach < distance)
            index = good.nonzero()[:, 0]
            start = camera.position.expand(len(index), 3)
            index = index[~rays.blocked(start, point[index] + NUDGE * normal[index])]
            seen[index] += 1
    enough = (seen >= views).double()
    per_sample = _area(scene).sum() / samples
    by_object = {}
    for number, item in enumerate(scene.objects):
        mine = owner == number
        if bool(mine.any()):
            by_object[item.name] = (float(per_sample * mine.sum()), float(enough[mine].mean()))
    return Coverage(float(enough.mean()), by_object)


def _area(scene: Scene) -> Tensor:
    """The area of every triangle of the scene [m^2], object after object."""
    corners = torch.cat([item.vertices[item.faces] for item in scene.objects]).double()
    a, b, c = corners.unbind(1)
    return torch.linalg.cross(b - a, c - a).norm(dim=-1) / 2


def _samples(scene: Scene, count: int, seed: int) -> tuple[Tensor, Tensor, Tensor]:
    """Points `[n, 3]` uniform on all triangles, unit normals `[n, 3]` and the numbers of the objects they lie on."""
    generator = torch.Generator().manual_seed(seed)
    corners = torch.cat([item.vertices[item.faces] for item in scene.objects])
    owners = torch.cat([torch.full((len(item.faces),), number) for number, item in enumerate(scene.objects)])
    ends = _area(scene).cumsum(0)
    where = (torch.arange(count, dtype=torch.float64) + torch.rand(count, generator=generator)) / count * ends[-1]
    index = torch.searchsorted(ends, where).clamp_max(len(ends) - 1)
    u, v = torch.rand(2, count, generator=generator)
    u, v = torch.where(u + v > 1, 1 - u, u), torch.where(u + v > 1, 1 - v, v)
    a, b, c = corners[index].unbind(1)
    normal = torch.nn.functional.normalize(torch.linalg.cross(b - a, c - a), dim=-1)
    return a + u[:, None] * (b - a) + v[:, None] * (c - a), normal, owners[index]


class _Rays:
    """Tells whether something stands between two points; the scene's triangles in Mitsuba."""

    def __init__(self, scene: Scene) -> None:
        self._triangles = scene.mesh()[:2]

    def __enter__(self) -> "_Rays":
        if find_llvm().path is not None:
            prepare()
        try:
            import mitsuba
        except ImportError as error:
            raise MissingDependencyError("coverage needs Mitsuba: pip install 'rf3dgs[trace]'") from error
        if find_llvm().path is None:
            raise MissingDependencyError(f"coverage needs LLVM 17 to 20 ({find_llvm().reason})")
        self._mitsuba, self._variant = mitsuba, mitsuba_variant("llvm_ad_rgb")
        self._variant.__enter__()
        with tempfile.TemporaryDirectory(prefix="rf3dgs-") as folder:
            path = Path(folder) / "all.ply"
            meshes.write_mesh(path, *self._triangles, None)
            shape = {"type": "ply", "filename": str(path), "face_normals": True}
            self._scene = mitsuba.load_dict({"type": "scene", "all": shape})
        return self

    def __exit__(self, *_: object) -> None:
        self._variant.__exit__(None, None, None)

    def blocked(self, start: Tensor, end: Tensor) -> Tensor:
        """True `[n]` where a triangle lies between `start` and `end` `[n, 3]`."""
        if not len(start):
            return torch.zeros(0, dtype=torch.bool)
        mi = self._mitsuba
        along = end - start
        ray = mi.Ray3f(o=mi.Point3f(start.T.numpy()), d=mi.Vector3f(along.T.numpy()))
        ray.maxt = 1.0
        return torch.from_numpy(np.array(self._scene.ray_test(ray), dtype=bool))
