"""Photographs out of a video: the sharpest frame of every so many, as a folder that `sfm.poses_from_photos` takes."""

import math
import os
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from rf3dgs.core.errors import DataError, InputError, MissingDependencyError
from rf3dgs.core.files import atomic_folder
from rf3dgs.core.progress import Progress, Silent
from rf3dgs.data.safe import MAX_PIXELS

MP4, MATROSKA, RIFF = (4, b"ftyp"), (0, b"\x1aE\xdf\xa3"), (8, b"AVI ")
CONTAINERS = {".mp4": MP4, ".m4v": MP4, ".mov": MP4, ".mkv": MATROSKA, ".webm": MATROSKA, ".avi": RIFF}
"""Which bytes a file of each ending has, and where: a decoder that guesses would open playlists, which name files."""
WHOLE = 0.9
"""A video that ends before this part of the frames it promises is cut short."""
MOST_PHOTOS = 5_000
SHARPNESS_WIDTH = 320
"""Frames are compared at about this width [pixel]."""


def photos_of_video(
    path: str | Path,
    folder: str | Path,
    *,
    every: int = 15,
    longest: int = 1600,
    progress: Progress | None = None,
) -> list[Path]:
    """Write the sharpest of each `every` frames of a video as JPEG files into `folder`, and return their paths.

    every: frames of one photograph, half a second of a usual video by default. longest: pictures with a longer edge
    [pixel] are made smaller. A folder of that name must be empty or missing; it appears whole or not at all.
    Raises DataError for a video that is missing, damaged, of another kind or without pictures, InputError for values
    out of range, MissingDependencyError without OpenCV.
    """
    path, folder, progress = Path(path), Path(folder), progress or Silent()
    if every < 1 or longest < 16:
        raise InputError(f"every must be at least 1 frame and longest at least 16 pixels; got {every} and {longest}")
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise InputError(f"{folder} is there already and not empty; choose another folder for the photographs")
    names = []
    with atomic_folder(folder) as temporary:
        progress.start("frames of the video", 0)
        best, sharpest, number = None, -math.inf, 0
        for number, picture in enumerate(_frames(path), 1):
            sharp = sharpness(picture)
            if sharp > sharpest:
                best, sharpest = picture, sharp
            if number % every == 0 and best is not None:
                names.append(_save(best, temporary, len(names), longest, path))
                best, sharpest = None, -math.inf
                progress.update(number)
        if best is not None and number % every > every // 2:
            names.append(_save(best, temporary, len(names), longest, path))
        if not names:
            raise DataError(f"{path}: has {number} frames, too few for one photograph of {every}; make `every` smaller")
        progress.finish()
    return [folder / name for name in names]


def sharpness(picture: NDArray[np.uint8]) -> float:
    """Mean square of the brightness differences between neighbours of `[row, col, 3]`, at a comparable size.

    Blur by motion or focus lowers it; it compares frames of one scene, not scenes.
    """
    step = max(picture.shape[1] // SHARPNESS_WIDTH, 1)
    grey = picture[::step, ::step].astype(np.float32).mean(-1)
    return float(np.square(np.diff(grey, axis=0)).mean() + np.square(np.diff(grey, axis=1)).mean())


def _save(picture: NDArray[np.uint8], folder: Path, number: int, longest: int, path: Path) -> str:
    if number >= MOST_PHOTOS:
        raise DataError(f"{path}: gives more than {MOST_PHOTOS} photographs; make `every` larger")
    image = Image.fromarray(picture)
    image.thumbnail((longest, longest))
    name = f"{number:05d}.jpg"
    image.save(folder / name, quality=95, subsampling=0)
    return name


def _frames(path: Path) -> Iterator[NDArray[np.uint8]]:
    """The frames `[row, col, 3]` of a video, upright."""
    try:
        os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")  # what it has to say is said by the errors below
        import cv2
    except ImportError as error:
        raise MissingDependencyError("videos need OpenCV: pip install 'rf3dgs[video]'") from error
    _check_container(path)
    capture = cv2.VideoCapture(str(path), cv2.CAP_FFMPEG)
    try:
        width, height = (capture.get(name) for name in (cv2.CAP_PROP_FRAME_WIDTH, cv2.CAP_PROP_FRAME_HEIGHT))
        if not capture.isOpened() or width < 1 or height < 1:
            raise DataError(f"{path}: the video is damaged or has no pictures; export it again")
        if width * height > MAX_PIXELS:
            raise DataError(f"{path}: has frames of {width:.0f}x{height:.0f} pixels; make them smaller")
        promised, number = capture.get(cv2.CAP_PROP_FRAME_COUNT), 0
        while True:
            good, picture = capture.read()
            if not good:
                break
            number += 1
            yield np.ascontiguousarray(picture[..., ::-1], dtype=np.uint8)
        if number < WHOLE * promised:
            raise DataError(
                f"{path}: the video is damaged after {number} of {promised:.0f} frames; copy or export it again"
            )
    finally:
        capture.release()


def _check_container(path: Path) -> None:
    if path.suffix.lower() not in CONTAINERS:
        raise DataError(f"{path}: expected a video ending in {', '.join(CONTAINERS)}")
    if not path.is_file():
        raise DataError(f"{path}: there is no such video")
    place, mark = CONTAINERS[path.suffix.lower()]
    with path.open("rb") as file:
        start = file.read(16)
    if start[place : place + len(mark)] != mark:
        raise DataError(f"{path}: the video is damaged or of another kind than its name says; export it again")
