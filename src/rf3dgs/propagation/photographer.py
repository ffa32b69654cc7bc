"""Posed photographs of a scene, rendered with Mitsuba over the meshes that the radio waves meet."""

import math
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from rf3dgs.core.errors import InputError, MissingDependencyError
from rf3dgs.core.frames import Pose, mitsuba_from_viewmat
from rf3dgs.core.grids import Camera, pinhole_grid
from rf3dgs.core.progress import Progress, Silent
from rf3dgs.propagation.config import PhotoConfig
from rf3dgs.propagation.llvm import find_llvm, mitsuba_variant, prepare
from rf3dgs.propagation.scene import Scene
from rf3dgs.propagation.scene_files import srgb_from_linear, write_visual_scene

PITCH_DEG = (-8.0, 12.0, -30.0, 0.0, 38.0, -15.0, 22.0, -48.0)
"""Pitches the tour cycles through [deg], upwards positive: walls mostly, floor and ceiling often."""


def camera_tour(scene: Scene, count: int, seed: int, config: PhotoConfig | None = None) -> list[Camera]:
    """`count` cameras spread over the free space of `camera_bounds`, which together see walls, floor and ceiling.

    Each position is the candidate farthest from those before it; yaws follow the golden angle, then of four turns the
    one with the longest free view ahead is taken.
    """
    config = PhotoConfig() if config is None else config
    grid = pinhole_grid(config.width, config.height, config.fov_deg)
    pool = scene.free_points(scene.camera_bounds, 12 * count, seed, clearance=0.45)
    chosen = [0]
    nearest = (pool - pool[0]).norm(dim=-1)
    while len(chosen) < count:
        index = int(nearest.argmax())
        chosen.append(index)
        nearest = torch.minimum(nearest, (pool - pool[index]).norm(dim=-1))
    cameras = []
    steps = torch.linspace(0.5, 6.0, 12)
    for number, position in enumerate(pool[chosen]):
        pitch = math.radians(PITCH_DEG[number % len(PITCH_DEG)])
        yaws = number * math.pi * (3 - math.sqrt(5)) + torch.arange(4) * (math.pi / 2)
        level = torch.stack((torch.cos(yaws), torch.sin(yaws), torch.zeros(4)), -1)
        open_ahead = scene.free(position + level[:, None] * steps[None, :, None], 0.1).int()
        yaw = float(yaws[int(open_ahead.cumprod(-1).sum(-1).argmax())])
        forward = torch.tensor([math.cos(yaw), math.sin(yaw), math.tan(pitch)])
        cameras.append(Camera.of(Pose.look_at(position, position + forward), grid))
    return cameras


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
    sensor = mitsuba.load_dict(_sensor(mitsuba, camera))
    integrator = mitsuba.load_dict({"type": "path", "max_depth": config.bounces, "rr_depth": 100})
    picture = mitsuba.render(loaded, sensor=sensor, integrator=integrator, spp=config.samples, seed=seed)
    return np.array(picture, dtype=np.float64)[..., :3]


def _sensor(mitsuba, camera: Camera) -> dict:
    """Mitsuba's description of a pinhole camera."""
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
        "sampler": {"type": "independent"},
    }
