"""Photographs out of a video: the sharpest frame of every so many, as a folder that `sfm.poses_from_photos` takes.

Videos are decoded by PyAV, which the user installs (docs/how-to/photos.md says why it is no extra of this package).
"""

import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from rf3dgs.core.errors import DataError, InputError, MissingDependencyError
from rf3dgs.core.files import atomic_folder
from rf3dgs.core.progress import Progress, Silent
from rf3dgs.data.safe import MAX_PIXELS

CONTAINERS = {".mp4": "mov", ".m4v": "mov", ".mov": "mov", ".mkv": "matroska", ".webm": "matroska", ".avi": "avi"}
"""What each ending is read as; guessing from the content would open playlists, which name other files."""
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
    out of range, MissingDependencyError without PyAV.
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
        import av
        from av.error import FFmpegError
    except ImportError as error:
        raise MissingDependencyError("videos need PyAV: pip install av") from error
    if path.suffix.lower() not in CONTAINERS:
        raise DataError(f"{path}: expected a video ending in {', '.join(CONTAINERS)}")
    if not path.is_file():
        raise DataError(f"{path}: there is no such video")
    try:
        with path.open("rb") as file, av.open(file, "r", format=CONTAINERS[path.suffix.lower()]) as container:
            if not container.streams.video:
                raise DataError(f"{path}: has no pictures, only other streams")
            stream = container.streams.video[0]
            if stream.width * stream.height > MAX_PIXELS:
                raise DataError(f"{path}: has frames of {stream.width}x{stream.height} pixels; make them smaller")
            for frame in container.decode(stream):
                if frame.width * frame.height > MAX_PIXELS:
                    raise DataError(f"{path}: has frames of {frame.width}x{frame.height} pixels; make them smaller")
                yield _upright(frame)
    except (FFmpegError, ValueError, OSError) as error:
        raise DataError(f"{path}: the video is damaged or of another kind ({error}); export it again") from error


def _upright(frame: Any) -> NDArray[np.uint8]:
    """The frame turned by what its display matrix says, which telephones use for upright videos."""
    quarter_turns = round(getattr(frame, "rotation", 0) / 90) % 4
    return np.ascontiguousarray(np.rot90(frame.to_ndarray(format="rgb24"), quarter_turns))
