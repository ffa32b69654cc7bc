"""Camera poses and points from photographs alone, by COLMAP's structure from motion (pycolmap, the extra `sfm`).

SIFT features on the CPU, every picture matched with every other, incremental mapping (Schönberger and Frahm,
"Structure-from-motion revisited", 2016). The world that comes out has arbitrary scale and tilt.
"""

import tempfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from types import ModuleType
from typing import Any, Literal

import numpy as np
import torch
from torch import Tensor

from rf3dgs.core.errors import DataError, InputError, MissingDependencyError
from rf3dgs.core.grids import Camera
from rf3dgs.core.progress import Progress, Silent
from rf3dgs.data.formats.colmap import pictures_in
from rf3dgs.data.photo import Photo, PhotoSet, check_camera, photo_of_file
from rf3dgs.data.safe import read_picture

NOTE = "arbitrary scale and tilt: align before radio (data.align)"
REGISTERED = 0.8
FEWEST = 3
LENSES = {"radial": "SIMPLE_RADIAL", "pinhole": "SIMPLE_PINHOLE"}
STRAIGHT = 0.1
"""Lens distortion that moves no pixel of the picture's border by more than this many pixels is dropped."""
MORE_OVERLAP = "take more pictures between those that do not connect, so that neighbours share two thirds of their view"


def poses_from_photos(
    folder: str | Path,
    *,
    camera: Literal["shared", "each"] = "shared",
    lens: Literal["radial", "pinhole"] = "radial",
    seed: int = 0,
    progress: Progress | None = None,
) -> PhotoSet:
    """Photos with cameras, and points `[n, 3]` with colours `[n, 3]`, out of the JPEG and PNG files below `folder`.

    `camera`: one camera and zoom for all pictures ("shared"), or one for each. `lens`: the focal length and one radial
    distortion are estimated and distorted pictures come back undistorted, in memory ("radial"); or only the focal
    length, more exactly, of pictures that are rendered or already undistorted ("pinhole"). `seed` makes the result
    the same on every run with one pycolmap on one machine. The world has arbitrary scale and tilt (`data.align`).

    MissingDependencyError without pycolmap; DataError for a damaged picture, when nothing or several models come out,
    or when fewer than 80 % of the pictures are registered; InputError with fewer than three pictures.
    """
    folder, progress = Path(folder), progress or Silent()
    if camera not in ("shared", "each"):
        raise InputError(f'camera must be "shared" or "each"; got {camera!r}')
    if lens not in LENSES:
        raise InputError(f'lens must be "radial" or "pinhole"; got {lens!r}')
    if not folder.is_dir():
        raise DataError(f"{folder}: there is no such folder of photographs")
    names = [str(path.relative_to(folder).as_posix()) for path in pictures_in(folder)]
    if len(names) < FEWEST:
        raise InputError(f"{folder}: poses need at least {FEWEST} JPEG or PNG pictures that overlap; got {len(names)}")
    pycolmap = _import_pycolmap()
    for name in names:
        read_picture(folder / name)
    with _quiet(pycolmap), tempfile.TemporaryDirectory(prefix="rf3dgs-sfm-") as work:
        models = _reconstruct(pycolmap, folder, names, camera, lens, seed, Path(work), progress)
        registered = {number: set(_registered(model)) for number, model in models.items()}
        return _photo_set(pycolmap, models[the_model(registered, len(names), folder)], folder, names)


def the_model(registered: Mapping[int, set[str]], pictures: int, folder: Path) -> int:
    """The number of the one model that holds enough of the pictures; `registered` names the pictures of each model.

    Scraps of fewer than three pictures and models whose pictures the largest one has too are passed over.
    """
    number = max(registered, key=lambda number: (len(registered[number]), -number), default=None)
    if number is None:
        raise DataError(f"{folder}: no poses could be found for its {pictures} pictures; {MORE_OVERLAP}")
    largest = registered[number]
    others = [len(names) for names in registered.values() if len(names) >= FEWEST and not names <= largest]
    if others:
        counts = " and ".join(str(count) for count in (len(largest), *sorted(others, reverse=True)))
        raise DataError(
            f"{folder}: the {pictures} pictures fall into {1 + len(others)} models of {counts}, whose scales and tilts "
            f"have nothing to do with each other; {MORE_OVERLAP}"
        )
    if len(largest) < REGISTERED * pictures:
        raise DataError(
            f"{folder}: only {len(largest)} of {pictures} pictures could be registered, expected at least "
            f"{REGISTERED:.0%}; {MORE_OVERLAP}, or remove the others"
        )
    return number


def _import_pycolmap() -> ModuleType:
    try:
        import pycolmap
    except ImportError as error:
        raise MissingDependencyError('poses from photographs need pycolmap: pip install "rf3dgs[sfm]"') from error
    return pycolmap


@contextmanager
def _quiet(pycolmap: Any) -> Iterator[None]:
    """Keep COLMAP's log off the terminal; what matters comes as an error or a note."""
    before = pycolmap.logging.minloglevel
    pycolmap.logging.minloglevel = int(pycolmap.logging.FATAL)
    try:
        yield
    finally:
        pycolmap.logging.minloglevel = before


def _reconstruct(
    pycolmap: Any, folder: Path, names: list[str], camera: str, lens: str, seed: int, work: Path, progress: Progress
) -> dict[int, Any]:
    """The models that COLMAP finds, by number.

    Pictures are numbered before features are sought, and one thread seeks, matches and maps: nothing hangs on which
    thread is first.
    """
    database, sparse = work / "database.db", work / "sparse"
    sparse.mkdir()
    progress.start("poses from photographs", 2 + len(names))
    pycolmap.set_random_seed(seed)
    mode = pycolmap.CameraMode.SINGLE if camera == "shared" else pycolmap.CameraMode.PER_IMAGE
    reader = pycolmap.ImageReaderOptions()
    reader.camera_model = LENSES[lens]
    cpu = pycolmap.Device.cpu
    try:
        pycolmap.Database.open(database).close()
        pycolmap.import_images(database, folder, mode, names, reader)
        extraction, matching = pycolmap.FeatureExtractionOptions(), pycolmap.FeatureMatchingOptions()
        extraction.num_threads = matching.num_threads = 1
        pycolmap.extract_features(database, folder, names, mode, reader, extraction, device=cpu)
        progress.update(1, "features found")
        verification = pycolmap.TwoViewGeometryOptions()
        verification.ransac.random_seed = seed
        pycolmap.match_exhaustive(database, matching, verification_options=verification, device=cpu)
        progress.update(2, "features matched")
        options = pycolmap.IncrementalPipelineOptions()
        options.num_threads = options.mapper.num_threads = 1
        options.random_seed = options.mapper.random_seed = options.triangulation.random_seed = seed
        options.min_model_size = FEWEST
        done = [2]

        def registered() -> None:
            done[0] += 1
            progress.update(min(done[0], 2 + len(names)), "picture registered")

        models = pycolmap.incremental_mapping(database, folder, sparse, options, next_image_callback=registered)
    except (RuntimeError, ValueError, OSError) as error:
        raise DataError(f"{folder}: structure from motion failed ({error}); check its pictures") from error
    progress.finish()
    return models


def _registered(model: Any) -> dict[str, Any]:
    """The images of a model that have a pose, by name."""
    return {image.name: image for image in model.images.values() if image.has_pose}


def _photo_set(pycolmap: Any, model: Any, folder: Path, names: list[str]) -> PhotoSet:
    photos = [_photo(pycolmap, model, image, folder) for _, image in sorted(_registered(model).items())]
    points = sorted(model.points3D.items())
    xyz = torch.from_numpy(np.array([point.xyz for _, point in points], dtype=np.float32).reshape(-1, 3))
    paint = torch.from_numpy(np.array([point.color for _, point in points], dtype=np.float32).reshape(-1, 3)) / 255.0
    notes = [NOTE, f"{len(photos)} of {len(names)} pictures registered, {len(points)} points"]
    undistorted = sum(photo.pixels is not None for photo in photos)
    if undistorted:
        notes.append(f"{undistorted} pictures were undistorted")
    return PhotoSet(tuple(photos), "sfm", xyz, paint, notes=tuple(notes))


def _photo(pycolmap: Any, model: Any, image: Any, folder: Path) -> Photo:
    """One registered picture with a camera without distortion."""
    viewmat = torch.eye(4, dtype=torch.float64)
    viewmat[:3] = torch.from_numpy(np.array(image.cam_from_world().matrix()))
    lens, path = model.cameras[image.camera_id], folder / image.name
    pixels = None
    if distortion_of(lens.params, lens.width, lens.height) > STRAIGHT:
        bitmap = pycolmap.Bitmap.from_array(read_picture(path))
        bitmap, lens = pycolmap.undistort_image(pycolmap.UndistortCameraOptions(), bitmap, lens)
        pixels = torch.from_numpy(np.array(bitmap.to_array())).float() / 255.0
    K = _intrinsics(lens)
    check_camera(viewmat, K, where=f"{path}: the estimate")
    camera = Camera(viewmat.float(), K, lens.width, lens.height)
    return Photo(image.name, camera, pixels=pixels) if pixels is not None else photo_of_file(image.name, camera, path)


def _intrinsics(lens: Any) -> Tensor:
    return torch.tensor(
        [
            [lens.focal_length_x, 0.0, lens.principal_point_x],
            [0.0, lens.focal_length_y, lens.principal_point_y],
            [0.0, 0.0, 1.0],
        ]
    )


def distortion_of(params: np.ndarray, width: int, height: int) -> float:
    """How far [pixel] a lens (f, cx, cy, radial distortion if any) moves the corner farthest from its centre."""
    focal, centre_x, centre_y, radial = (float(value) for value in (*params, 0.0)[:4])
    x, y = max(centre_x, width - centre_x) / focal, max(centre_y, height - centre_y) / focal
    square = x * x + y * y
    return focal * abs(radial) * square * square**0.5
