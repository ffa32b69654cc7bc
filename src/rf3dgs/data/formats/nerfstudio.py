"""nerfstudio's `transforms.json`: intrinsics for all frames or per frame, OpenGL camera-to-world matrices.

Poses are used as they stand in the file; an `applied_transform` (original world to the file's world) is only noted.
"""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from rf3dgs.core.errors import DataError, InputError
from rf3dgs.core.frames import opengl_from_viewmat, viewmat_from_opengl
from rf3dgs.core.grids import Camera
from rf3dgs.data.photo import Photo, PhotoSet, check_camera, photo_of_file
from rf3dgs.data.safe import PICTURE_SUFFIXES, inside, picture_size, read_json, write_json

FILE_NAME = "transforms.json"
MAX_FRAMES = 1_000_000
_DISTORTION = ("k1", "k2", "k3", "k4", "p1", "p2")
_MODELS = ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL")


def read_nerfstudio(path: str | Path) -> PhotoSet:
    """The photos of a folder with `transforms.json`, or of such a file; DataError names the file and the frame."""
    path = Path(path)
    file = path / FILE_NAME if path.is_dir() else path
    content = read_json(file)
    photos = [photo_of_frame(content, frame, index, file) for index, frame in enumerate(frames_of(content, file))]
    notes = []
    if "applied_transform" in content:
        notes.append("the file's world was moved by its applied_transform; poses are used as they stand in the file")
    return PhotoSet(tuple(photos), "nerfstudio", notes=tuple(notes))


def write_nerfstudio(path: str | Path, photos: Sequence[Photo], *, names: Sequence[str] | None = None) -> None:
    """Write `transforms.json` (a folder's, or that file) for photos; `names` are their files relative to it.

    Without `names` each photo's own name is written. The pictures themselves are left where they are.
    """
    path = Path(path)
    file = path if path.suffix == ".json" else path / FILE_NAME
    names = [photo.name for photo in photos] if names is None else names
    if len(names) != len(photos):
        raise InputError(f"expected one file name per photo, {len(photos)}; got {len(names)}")
    frames = []
    for photo, name in zip(photos, names, strict=True):
        matrix = opengl_from_viewmat(photo.camera.viewmat).double().tolist()
        frames.append({"file_path": name, **_intrinsics(photo.camera), "transform_matrix": matrix})
    content: dict[str, Any] = {"camera_model": "PINHOLE"}
    if frames:
        shared = _intrinsics(photos[0].camera)
        if all(all(frame[key] == value for key, value in shared.items()) for frame in frames):
            content |= shared
            frames = [{key: value for key, value in frame.items() if key not in shared} for frame in frames]
    write_json(file, content | {"frames": frames})


def photo_of_frame(content: dict[str, Any], frame: dict[str, Any], index: int, file: Path) -> Photo:
    """The photo of one frame; its own intrinsics come before the whole file's, and its file name may lack a suffix."""
    where = f"{file}: frame {index}"
    picture = inside(file.parent, frame.get("file_path"), named_in=file)
    if picture.suffix.lower() not in PICTURE_SUFFIXES:
        named = [picture.with_name(picture.name + suffix) for suffix in PICTURE_SUFFIXES]
        picture = next((candidate for candidate in named if candidate.is_file()), named[-1])
    camera = _camera(content | frame, matrix_of(frame, where), picture, where)
    return photo_of_file(str(frame["file_path"]).removeprefix("./"), camera, picture)


def frames_of(content: dict[str, Any], file: Path) -> list[dict[str, Any]]:
    """The list under "frames", checked."""
    frames = content.get("frames")
    if not isinstance(frames, list) or not all(isinstance(frame, dict) for frame in frames):
        raise DataError(f'{file}: expected a list of objects under "frames"; this is no transforms.json')
    if not 0 < len(frames) <= MAX_FRAMES:
        raise DataError(f"{file}: expected 1 to {MAX_FRAMES} frames; got {len(frames)}")
    return frames


def matrix_of(frame: dict[str, Any], where: str) -> Tensor:
    """`camera_from_world` `[4, 4]` of a frame's OpenGL `transform_matrix`."""
    try:
        matrix = torch.tensor(frame.get("transform_matrix"), dtype=torch.float64)
    except (TypeError, ValueError, RuntimeError, OverflowError) as error:
        raise DataError(f"{where}: transform_matrix must be 4 rows of 4 numbers") from error
    if tuple(matrix.shape) not in ((4, 4), (3, 4)):
        raise DataError(f"{where}: transform_matrix must be 4 rows of 4 numbers; got shape {list(matrix.shape)}")
    viewmat = viewmat_from_opengl(matrix)
    check_camera(viewmat, torch.eye(3), where=where)
    return viewmat


def number(content: dict[str, Any], key: str, where: str, default: float | None = None) -> float:
    """A finite number under `key`."""
    value = content.get(key, default)
    if isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) < 1e30:
        raise DataError(f"{where}: expected a number under {key!r}; got {value!r}")
    return float(value)


def _camera(content: dict[str, Any], viewmat: Tensor, picture: Path, where: str) -> Camera:
    model = content.get("camera_model", "OPENCV")
    if model not in _MODELS:
        raise DataError(f"{where}: camera model {model!r} is not a pinhole; undistort the pictures to PINHOLE first")
    if any(number(content, key, where, 0.0) != 0.0 for key in _DISTORTION):
        raise DataError(f"{where}: the camera has lens distortion; undistort the pictures and set k1..k4, p1, p2 to 0")
    if "w" in content and "h" in content:
        width, height = number(content, "w", where), number(content, "h", where)
    else:
        width, height = picture_size(picture)
    if not (1 <= width <= 1e6 and 1 <= height <= 1e6 and width == int(width) and height == int(height)):
        raise DataError(f"{where}: w and h must be whole numbers of pixels; got {width}, {height}")
    if "fl_x" in content:
        focal_x = number(content, "fl_x", where)
    else:
        angle = number(content, "camera_angle_x", where)
        if not 0.0 < angle < math.pi:
            raise DataError(f"{where}: camera_angle_x must lie between 0 and pi rad; got {angle}. Is it in degrees?")
        focal_x = 0.5 * width / math.tan(0.5 * angle)
    focal_y = number(content, "fl_y", where, focal_x)
    centre_x, centre_y = number(content, "cx", where, width / 2), number(content, "cy", where, height / 2)
    K = torch.tensor([[focal_x, 0.0, centre_x], [0.0, focal_y, centre_y], [0.0, 0.0, 1.0]])
    check_camera(viewmat, K, where=where)
    return Camera(viewmat, K, int(width), int(height))


def _intrinsics(camera: Camera) -> dict[str, float | int]:
    K = camera.K.double().tolist()
    return {
        "fl_x": K[0][0],
        "fl_y": K[1][1],
        "cx": K[0][2],
        "cy": K[1][2],
        "w": camera.width,
        "h": camera.height,
    }
