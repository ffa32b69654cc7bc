"""Posed photographs of a scene, rendered with Mitsuba over the meshes that the radio waves meet."""

import math
import tempfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from rf3dgs.core.cube import face_cameras, sample_faces
from rf3dgs.core.errors import InputError, MissingDependencyError
from rf3dgs.core.frames import Pose, mitsuba_from_viewmat
from rf3dgs.core.grids import Camera, equirect_grid
from rf3dgs.core.progress import Progress, Silent
from rf3dgs.propagation.config import PhotoConfig
from rf3dgs.propagation.llvm import find_llvm, mitsuba_variant, prepare
from rf3dgs.propagation.sites.scene import Scene
from rf3dgs.propagation.sites.scene_files import srgb_from_linear, write_visual_scene
from rf3dgs.propagation.sites.walks import camera_tour as camera_tour

ROULETTE_FROM = 3
"""Light paths of so many segments and more go on by chance, with more weight: as bright in the mean, and cheaper."""


def render_photos(
    scene: Scene, cameras: Sequence[Camera], config: PhotoConfig | None = None, progress: Progress | None = None
) -> Iterator[NDArray[np.uint8]]:
    """Yield one photograph `[row, col, 3]`, sRGB bytes, per camera; path traced, the same on every run.

    Works without LLVM too, three times slower. Raises MissingDependencyError without Mitsuba.
    """
    config = PhotoConfig() if config is None else config
    progress = Silent() if progress is None else progress
    with _studio(scene, config) as light:
        progress.start("photographs", len(cameras))
        for number, camera in enumerate(cameras):
            yield _developed(light(camera, config.seed + number), scene, config)
            progress.update(number + 1)
        progress.finish()


def render_panoramas(
    scene: Scene, poses: Pose, width: int, config: PhotoConfig | None = None, progress: Progress | None = None
) -> Iterator[NDArray[np.uint8]]:
    """Yield one equirectangular photograph `[width / 2, width, 3]`, sRGB bytes, per pose `[n]`.

    Pixels are those of `equirect_grid(width, width // 2)`, so a photograph lies over a spectrum of the same pose. Six
    pinhole pictures on the faces of a cube are put together; what `config` says of size and field of view is ignored.
    """
    config = PhotoConfig() if config is None else config
    progress = Silent() if progress is None else progress
    if width < 8 or width % 2 or len(poses.batch_shape) != 1:
        raise InputError(
            f"panoramas need an even width of at least 8 pixels and a list of poses [n]; got {width} and "
            f"{list(poses.batch_shape)}"
        )
    grid, size = equirect_grid(width, width // 2), math.ceil(width / 3)  # a face is as fine as the sphere's equator
    with _studio(scene, config) as light:
        progress.start("panoramas", len(poses))
        for number in range(len(poses)):
            seeds = range(config.seed + 6 * number, config.seed + 6 * number + 6)
            faces = [light(camera, seed) for camera, seed in zip(face_cameras(poses[number], size), seeds, strict=True)]
            picture = sample_faces(torch.from_numpy(np.stack(faces)).float(), size, grid.directions)
            yield _developed(picture.double().numpy(), scene, config)
            progress.update(number + 1)
        progress.finish()


def render_panorama(scene: Scene, pose: Pose, width: int, config: PhotoConfig | None = None) -> NDArray[np.uint8]:
    """The equirectangular photograph `[width / 2, width, 3]`, sRGB bytes, at one pose; see `render_panoramas`."""
    if pose.batch_shape:
        raise InputError(f"a panorama stands at one pose; got {list(pose.batch_shape)}. Choose one, as in pose[0]")
    (picture,) = render_panoramas(scene, Pose(pose.position[None], pose.orientation[None]), width, config)
    return picture


@contextmanager
def _studio(scene: Scene, config: PhotoConfig) -> Iterator[Callable[[Camera, int], NDArray[np.float64]]]:
    """The scene loaded into Mitsuba, as a function of camera and seed that gives linear light `[row, col, 3]`."""
    if config.samples < 1 or config.bounces < 1:
        raise InputError(f"samples and bounces must be at least 1; got {config.samples} and {config.bounces}")
    if find_llvm().path is not None:
        prepare()
    try:
        import mitsuba
    except ImportError as error:
        raise MissingDependencyError("photographs need Mitsuba: pip install 'rf3dgs[trace]'") from error
    variant = "llvm_ad_rgb" if find_llvm().path is not None else "scalar_rgb"
    with tempfile.TemporaryDirectory(prefix="rf3dgs-") as folder, mitsuba_variant(variant):
        loaded = mitsuba.load_file(str(write_visual_scene(scene, Path(folder))), optimize=False)
        yield lambda camera, seed: linear_light(mitsuba, loaded, camera, config, seed)


def _developed(light: NDArray[np.float64], scene: Scene, config: PhotoConfig) -> NDArray[np.uint8]:
    return np.round(255.0 * srgb_from_linear(config.exposure * scene.exposure * light)).astype(np.uint8)


def linear_light(
    mitsuba, loaded, camera: Camera, config: PhotoConfig, seed: int, *, roulette_from: int = ROULETTE_FROM
) -> NDArray[np.float64]:
    """Linear light `[row, col, 3]` that one camera sees in a scene loaded into Mitsuba."""
    samples = (math.isqrt(config.samples - 1) + 1) ** 2
    sensor = mitsuba.load_dict(_sensor(mitsuba, camera, samples))
    integrator = mitsuba.load_dict({"type": "path", "max_depth": config.bounces, "rr_depth": roulette_from})
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
