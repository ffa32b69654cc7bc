"""Posed photographs of a scene, rendered with Mitsuba over the meshes that the radio waves meet."""

import math
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from rf3dgs.core.errors import InputError, MissingDependencyError
from rf3dgs.core.frames import Pose, mitsuba_from_viewmat
from rf3dgs.core.grids import Camera, pinhole_grid
from rf3dgs.core.progress import Progress, Silent
from rf3dgs.propagation.config import PhotoConfig
from rf3dgs.propagation.llvm import find_llvm, mitsuba_variant, prepare
from rf3dgs.propagation.scene import Scene
from rf3dgs.propagation.scene_files import srgb_from_linear, write_visual_scene

REACH = 0.8
"""How far the walk goes towards the edge of `camera_bounds`, as a share of half its size."""
SWAY = 0.3
"""How far camera heights swing about the middle of `camera_bounds`, as a share of half its height."""
PITCH_DEG, NOD_DEG = -3.0, 7.0
"""Mean pitch of the cameras, upwards positive, and how far it swings about it."""
SWAYS, NODS = 7, 5
"""Swings of height and of pitch in one round."""
CLEARANCE = 0.45
"""Distance of the cameras from every surface [m]."""


def camera_tour(scene: Scene, count: int, seed: int, config: PhotoConfig | None = None) -> list[Camera]:
    """`count` cameras of one walk round the middle of `camera_bounds`, in equal steps, all looking across it.

    The walk is a rounded rectangle; height and pitch swing slowly, so that neighbours see nearly the same from places
    a step apart, and every wall is seen from the far side. Where something stands in the way the camera steps towards
    the middle, or, when all of that is blocked, to the nearest of many free places drawn with `seed`.
    """
    config = PhotoConfig() if config is None else config
    grid = pinhole_grid(config.width, config.height, config.fov_deg)
    low, high = (torch.tensor(corner, dtype=torch.float64) for corner in scene.camera_bounds)
    middle, half = (low + high) / 2, (high - low) / 2
    around = _rounded_rectangle(count) * REACH * half[:2]
    part = torch.arange(count, dtype=torch.float64) * (2 * math.pi / count)
    height = SWAY * half[2] * torch.sin(SWAYS * part)
    pitch = torch.deg2rad(PITCH_DEG + NOD_DEG * torch.sin(NODS * part))
    nearer = torch.linspace(1.0, 0.3, 36, dtype=torch.float64)[:, None, None]
    level = torch.cat((nearer * around, height[:, None].expand(len(nearer), -1, 1)), -1)
    places = (middle + level).float()
    free = scene.free(places, CLEARANCE)
    place = places[free.int().argmax(0), torch.arange(count)]
    blocked = ~free.any(0)
    if bool(blocked.any()):
        pool = scene.free_points(scene.camera_bounds, 4000, seed, clearance=CLEARANCE)
        place = torch.where(blocked[:, None], pool[torch.cdist(place, pool).argmin(-1)], place)
    ahead = -torch.nn.functional.normalize(around, dim=-1)
    forward = torch.cat((ahead, torch.tan(pitch)[:, None]), -1).float()
    return [Camera.of(Pose.look_at(at, at + way), grid) for at, way in zip(place, forward, strict=True)]


def _rounded_rectangle(count: int) -> Tensor:
    """Points `[count, 2]` in equal steps along x^4 + y^4 = 1, from the x axis counter-clockwise."""
    angle = torch.linspace(0.0, 2 * math.pi, 4001, dtype=torch.float64)
    curve = torch.stack((torch.cos(angle), torch.sin(angle)), -1)
    curve = curve / curve.pow(4).sum(-1, keepdim=True) ** 0.25
    length = torch.cat((curve.new_zeros(1), torch.linalg.vector_norm(curve[1:] - curve[:-1], dim=-1).cumsum(0)))
    at = torch.arange(count, dtype=torch.float64) * (length[-1] / count)
    return curve[torch.searchsorted(length, at)]


def render_photos(
    scene: Scene, cameras: Sequence[Camera], config: PhotoConfig | None = None, progress: Progress | None = None
) -> Iterator[NDArray[np.uint8]]:
    """Yield one photograph `[row, col, 3]`, sRGB bytes, per camera; path traced, the same on every run.

    Works without LLVM too, three times slower. Raises MissingDependencyError without Mitsuba.
    """
    config = PhotoConfig() if config is None else config
    if config.samples < 1 or config.bounces < 1:
        raise InputError(f"samples and bounces must be at least 1; got {config.samples} and {config.bounces}")
    progress = Silent() if progress is None else progress
    if find_llvm().path is not None:
        prepare()
    try:
        import mitsuba
    except ImportError as error:
        raise MissingDependencyError("photographs need Mitsuba: pip install 'rf3dgs[trace]'") from error
    variant = "llvm_ad_rgb" if find_llvm().path is not None else "scalar_rgb"
    with tempfile.TemporaryDirectory(prefix="rf3dgs-") as folder, mitsuba_variant(variant):
        loaded = mitsuba.load_file(str(write_visual_scene(scene, Path(folder))), optimize=False)
        progress.start("photographs", len(cameras))
        for number, camera in enumerate(cameras):
            picture = _render(mitsuba, loaded, camera, config, config.seed + number)
            yield np.round(255.0 * srgb_from_linear(config.exposure * scene.exposure * picture)).astype(np.uint8)
            progress.update(number + 1)
        progress.finish()


def _render(mitsuba, loaded, camera: Camera, config: PhotoConfig, seed: int) -> NDArray[np.float64]:
    """Linear light `[row, col, 3]` that one camera sees."""
    samples = (math.isqrt(config.samples - 1) + 1) ** 2
    sensor = mitsuba.load_dict(_sensor(mitsuba, camera, samples))
    integrator = mitsuba.load_dict({"type": "path", "max_depth": config.bounces, "rr_depth": 100})
    picture = mitsuba.render(loaded, sensor=sensor, integrator=integrator, spp=samples, seed=seed)
    return np.array(picture, dtype=np.float64)[..., :3]


def _sensor(mitsuba, camera: Camera, samples: int) -> dict:
    """Mitsuba's description of a pinhole camera; `samples` light paths per pixel, a square number, are well spread."""
    focal_x, focal_y = float(camera.K[0, 0]), float(camera.K[1, 1])
    if abs(focal_x - focal_y) > 1e-3 * focal_x:
        raise InputError(f"photographs need square pixels; got focal lengths {focal_x:g} and {focal_y:g} pixels")
    matrix = mitsuba_from_viewmat(camera.viewmat.double())
    return {
        "type": "perspective",
        "fov_axis": "x",
        "fov": math.degrees(2 * math.atan(0.5 * camera.width / focal_x)),
        "principal_point_offset_x": 0.5 - float(camera.K[0, 2]) / camera.width,
        "principal_point_offset_y": 0.5 - float(camera.K[1, 2]) / camera.height,
        "near_clip": 0.02,
        "to_world": mitsuba.ScalarTransform4f(matrix.numpy()),
        "film": {
            "type": "hdrfilm",
            "width": camera.width,
            "height": camera.height,
            "pixel_format": "rgb",
            "rfilter": {"type": "box"},
        },
        "sampler": {"type": "multijitter", "sample_count": samples},
    }
