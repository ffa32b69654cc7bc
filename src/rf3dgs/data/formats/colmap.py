"""COLMAP reconstructions, text and binary: cameras, images and points.

COLMAP's camera frame and pixel centres are this package's, so poses pass through unchanged. Its world has arbitrary
scale and tilt: bring it to metres with data/align.py before radio enters.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from rf3dgs.core.errors import DataError
from rf3dgs.core.frames import matrix_from_quaternion
from rf3dgs.core.grids import Camera
from rf3dgs.data.formats.colmap_records import (
    CameraRecord,
    ImageRecord,
    Points,
    read_binary,
    read_text_model,
    write_binary,
    write_text_model,
)
from rf3dgs.data.photo import Photo, PhotoSet, check_camera, photo_of_file
from rf3dgs.data.safe import PICTURE_SUFFIXES, inside

_FOCAL_COUNT = {"SIMPLE_PINHOLE": 1, "PINHOLE": 2, "SIMPLE_RADIAL": 1, "RADIAL": 1, "OPENCV": 2}


@dataclass(frozen=True)
class Model:
    """One reconstruction as stored: its folder, cameras by number, images and points."""

    folder: Path
    cameras: dict[int, CameraRecord]
    images: tuple[ImageRecord, ...]
    points: Points


def model_folder(path: Path) -> Path | None:
    """Where a folder's first reconstruction lies: `sparse/0`, `sparse` or the folder itself; None without one."""
    for folder in (path / "sparse" / "0", path / "sparse", path):
        if any((folder / f"cameras{suffix}").is_file() for suffix in (".bin", ".txt")):
            return folder
    return None


def read_model(path: str | Path) -> Model:
    """The raw records; binary files come before text when a folder has both."""
    path = Path(path)
    folder = model_folder(path)
    if folder is None:
        raise DataError(f"{path}: expected cameras.bin or cameras.txt in it, in sparse/0 or in sparse")
    read = read_binary if (folder / "cameras.bin").is_file() else read_text_model
    return Model(folder, *read(folder))


def read_colmap(path: str | Path, *, images: str | Path | None = None) -> PhotoSet:
    """The photos and points of a COLMAP folder; pictures come from `images`, by default the folder `images` beside it.

    Lens distortion is refused: undistort with `colmap image_undistorter` first. What COLMAP left out is noted.
    """
    path = Path(path)
    model = read_model(path)
    folder = images_folder(path, model.folder) if images is None else Path(images)
    photos = [photo_of_record(model, record, folder) for record in model.images]
    notes = ["the world of this reconstruction has arbitrary scale and tilt; align it before adding radio"]
    registered = {photo.path for photo in photos}
    left_out = [item for item in pictures_in(folder) if item not in registered]
    if left_out:
        notes.append(f"{len(left_out)} pictures in {folder} are not registered, such as {left_out[0].name}")
    others = sorted(item.name for item in model.folder.parent.glob("[0-9]*") if item.is_dir() and item != model.folder)
    if model.folder.parent.name == "sparse" and others:
        notes.append(f"the reconstruction fell into several models; {', '.join(others)} are left out")
    points, colours = torch.from_numpy(model.points.positions), torch.from_numpy(model.points.colours)
    if not bool(torch.isfinite(points).all()):
        raise DataError(f"{model.folder}: points3D holds NaN or infinity; remove those points")
    has_points = len(points) > 0
    return PhotoSet(
        tuple(photos),
        "colmap",
        points.float() if has_points else None,
        colours.float() / 255.0 if has_points else None,
        notes=tuple(notes),
    )


def photo_of_record(model: Model, record: ImageRecord, folder: Path) -> Photo:
    """The photo of one image record, its pose and camera checked."""
    where = f"{model.folder}: image {record.name!r}"
    quaternion = torch.tensor(record.quaternion, dtype=torch.float64)
    length = float(torch.linalg.vector_norm(quaternion))
    if not abs(length - 1.0) < 1e-2:
        raise DataError(f"{where}: expected a unit quaternion; got {record.quaternion} of length {length:.3g}")
    viewmat = torch.eye(4, dtype=torch.float64)
    viewmat[:3, :3] = matrix_from_quaternion(quaternion)
    viewmat[:3, 3] = torch.tensor(record.translation, dtype=torch.float64)
    camera = model.cameras.get(record.camera)
    if camera is None:
        raise DataError(f"{where}: its camera {record.camera} is not in the list of cameras")
    K = intrinsics(camera, where)
    check_camera(viewmat, K, where=where)
    picture = inside(folder, record.name, named_in=model.folder)
    return photo_of_file(record.name, Camera(viewmat.float(), K, camera.width, camera.height), picture)


def intrinsics(camera: CameraRecord, where: str) -> Tensor:
    """`K` `[3, 3]` [pixel] of a camera without distortion."""
    focals = _FOCAL_COUNT.get(camera.model)
    if focals is None:
        raise DataError(f"{where}: camera model {camera.model} is no pinhole; undistort to PINHOLE with colmap first")
    focal_x, focal_y = camera.params[0], camera.params[focals - 1]
    centre_x, centre_y, *distortion = camera.params[focals:]
    if any(distortion):
        raise DataError(
            f"{where}: camera {camera.number} has lens distortion {distortion}; undistort the pictures with "
            "colmap image_undistorter first"
        )
    return torch.tensor([[focal_x, 0.0, centre_x], [0.0, focal_y, centre_y], [0.0, 0.0, 1.0]], dtype=torch.float32)


def images_folder(path: Path, model: Path) -> Path:
    """The folder `images` beside a reconstruction, else the folder itself."""
    candidates = (path / "images", model / "images", model.parent / "images", model.parent.parent / "images")
    return next((folder for folder in candidates if folder.is_dir()), path)


def pictures_in(folder: Path) -> list[Path]:
    """Every JPEG and PNG in a folder and below, sorted."""
    return sorted(item for item in folder.rglob("*") if item.suffix.lower() in PICTURE_SUFFIXES and item.is_file())


def write_colmap(
    path: str | Path,
    photos: Sequence[Photo],
    *,
    points: Tensor | None = None,
    colours: Tensor | None = None,
    binary: bool = True,
) -> None:
    """Write `path/sparse/0` with the cameras of photos under their names; pictures stay where they are.

    `points` `[n, 3]` and their `colours` `[n, 3]` in 0..1, mid-grey without them; `binary` or text files.
    """
    folder = Path(path) / "sparse" / "0"
    numbers: dict[tuple, int] = {}
    cameras, images = {}, []
    for index, photo in enumerate(photos, start=1):
        K = photo.camera.K.double()
        params = (float(K[0, 0]), float(K[1, 1]), float(K[0, 2]), float(K[1, 2]))
        key = (photo.camera.width, photo.camera.height, *params)
        number = numbers.setdefault(key, len(numbers) + 1)
        cameras[number] = CameraRecord(number, "PINHOLE", photo.camera.width, photo.camera.height, params)
        images.append(ImageRecord.of_viewmat(index, photo.camera.viewmat, number, photo.name))
    positions = np.zeros((0, 3)) if points is None else points.double().numpy()
    paint = torch.full((len(positions), 3), 0.5) if colours is None else colours
    cloud = Points(positions, (paint.clamp(0, 1) * 255).round().numpy().astype(np.uint8))
    write = write_binary if binary else write_text_model
    write(folder, cameras, tuple(images), cloud)
