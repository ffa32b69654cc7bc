"""COLMAP's files as records: text and binary, read with every count checked against the file's size."""

import struct
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from torch import Tensor

from rf3dgs.core.errors import DataError
from rf3dgs.core.files import write_whole
from rf3dgs.core.frames import quaternion_from_matrix
from rf3dgs.data.safe import read_bytes, read_text

MODELS = {
    0: ("SIMPLE_PINHOLE", 3),
    1: ("PINHOLE", 4),
    2: ("SIMPLE_RADIAL", 4),
    3: ("RADIAL", 5),
    4: ("OPENCV", 8),
    5: ("OPENCV_FISHEYE", 8),
    6: ("FULL_OPENCV", 12),
    7: ("FOV", 5),
    8: ("SIMPLE_RADIAL_FISHEYE", 4),
    9: ("RADIAL_FISHEYE", 5),
    10: ("THIN_PRISM_FISHEYE", 12),
}
_PARAMS = dict(MODELS.values())
_NUMBERS = {name: number for number, (name, _) in MODELS.items()}


@dataclass(frozen=True)
class CameraRecord:
    """One camera: its number, model name, size in pixels and the model's parameters."""

    number: int
    model: str
    width: int
    height: int
    params: tuple[float, ...]


@dataclass(frozen=True)
class ImageRecord:
    """One image: `camera_from_world` as quaternion wxyz and translation, the camera's number, the file name."""

    number: int
    quaternion: tuple[float, ...]
    translation: tuple[float, ...]
    camera: int
    name: str

    @classmethod
    def of_viewmat(cls, number: int, viewmat: Tensor, camera: int, name: str) -> "ImageRecord":
        """The record of a pose `viewmat` `[4, 4]`, camera_from_world."""
        viewmat = viewmat.double()
        quaternion = tuple(quaternion_from_matrix(viewmat[:3, :3]).tolist())
        return cls(number, quaternion, tuple(viewmat[:3, 3].tolist()), camera, name)


@dataclass(frozen=True, eq=False)
class Points:
    """Points `[n, 3]` float64 and their colours `[n, 3]` uint8."""

    positions: np.ndarray
    colours: np.ndarray


Records = tuple[dict[int, CameraRecord], tuple[ImageRecord, ...], Points]


class _Cursor:
    """Walks through a binary file; every read is checked against its end."""

    def __init__(self, path: Path) -> None:
        self.path, self.data, self.position = path, read_bytes(path), 0

    def take(self, layout: str) -> tuple:
        """The next values of a `struct` layout, little endian."""
        size = struct.calcsize("<" + layout)
        self.need(size)
        values = struct.unpack_from("<" + layout, self.data, self.position)
        self.position += size
        return values

    def need(self, size: int) -> None:
        """DataError unless `size` bytes follow."""
        if size > len(self.data) - self.position:
            raise DataError(f"{self.path}: the file ends before its last record; it is truncated. Export it again")

    def skip(self, size: int) -> None:
        """Pass over `size` bytes."""
        self.need(size)
        self.position += size

    def count(self, least: int) -> int:
        """A record count, refused when records of `least` bytes cannot fit into the rest of the file."""
        (count,) = self.take("Q")
        self.need(count * least)
        return count

    def text(self) -> str:
        """The next name, which ends with a zero byte."""
        end = self.data.find(b"\0", self.position)
        if end < 0:
            raise DataError(f"{self.path}: a name does not end; the file is truncated. Export it again")
        raw = self.data[self.position : end]
        self.position = end + 1
        return raw.decode("utf-8", errors="replace")


def read_binary(folder: Path) -> Records:
    """The records of `cameras.bin`, `images.bin` and, where present, `points3D.bin`."""
    cursor = _Cursor(folder / "cameras.bin")
    cameras = {}
    for _ in range(cursor.count(24)):
        number, model, width, height = cursor.take("iiQQ")
        if model not in MODELS:
            raise DataError(f"{cursor.path}: camera {number} has the unknown model {model}; expected 0 to 10")
        name, count = MODELS[model]
        cameras[number] = _camera(number, name, width, height, cursor.take(f"{count}d"), cursor.path)
    cursor = _Cursor(folder / "images.bin")
    images = []
    for _ in range(cursor.count(73)):
        number, *pose, camera = cursor.take("i7di")
        name = cursor.text()
        cursor.skip(24 * cursor.count(24))
        images.append(ImageRecord(number, tuple(pose[:4]), tuple(pose[4:]), camera, name))
    positions, colours = [], []
    if (folder / "points3D.bin").is_file():
        cursor = _Cursor(folder / "points3D.bin")
        for _ in range(cursor.count(51)):
            _, x, y, z, red, green, blue, _ = cursor.take("Q3d3Bd")
            cursor.skip(8 * cursor.count(8))
            positions.append((x, y, z))
            colours.append((red, green, blue))
    return cameras, tuple(images), _points(positions, colours)


def read_text_model(folder: Path) -> Records:
    """The records of `cameras.txt`, `images.txt` and, where present, `points3D.txt`."""
    path = folder / "cameras.txt"
    cameras = {}
    for line in _lines(path):
        if line.strip():
            words = line.split()
            model = words[1] if len(words) > 1 else ""
            if len(words) != 4 + _PARAMS.get(model, -9):
                raise DataError(f"{path}: expected 'number model width height parameters'; got {line[:80]!r}")
            numbers = _floats(words[4:], path, line)
            number, width, height = _integers((words[0], words[2], words[3]), path, line)
            cameras[number] = _camera(number, model, width, height, numbers, path)
    path = folder / "images.txt"
    images = []
    lines = iter(_lines(path))
    for line in lines:
        if line.strip():
            words = line.split(maxsplit=9)
            if len(words) != 10:
                raise DataError(f"{path}: expected 'number qw qx qy qz tx ty tz camera name'; got {line[:80]!r}")
            pose = _floats(words[1:8], path, line)
            number, camera = _integers((words[0], words[8]), path, line)
            images.append(ImageRecord(number, pose[:4], pose[4:], camera, words[9].strip()))
            next(lines, None)
    path = folder / "points3D.txt"
    positions, colours = [], []
    if path.is_file():
        for line in _lines(path):
            if line.strip():
                words = line.split(maxsplit=7)
                if len(words) < 7:
                    raise DataError(f"{path}: expected 'number x y z r g b error track'; got {line[:80]!r}")
                positions.append(_floats(words[1:4], path, line))
                colours.append(_integers(words[4:7], path, line))
    return cameras, tuple(images), _points(positions, colours)


def write_binary(
    folder: Path, cameras: dict[int, CameraRecord], images: tuple[ImageRecord, ...], points: Points
) -> None:
    """Write the three binary files, each at once or not at all."""
    parts = [struct.pack("<Q", len(cameras))]
    for camera in cameras.values():
        parts.append(struct.pack("<iiQQ", camera.number, _NUMBERS[camera.model], camera.width, camera.height))
        parts.append(struct.pack(f"<{len(camera.params)}d", *camera.params))
    write_whole(folder / "cameras.bin", b"".join(parts))
    parts = [struct.pack("<Q", len(images))]
    for image in images:
        parts.append(struct.pack("<i7di", image.number, *image.quaternion, *image.translation, image.camera))
        parts.append(image.name.encode() + b"\0" + struct.pack("<Q", 0))
    write_whole(folder / "images.bin", b"".join(parts))
    parts = [struct.pack("<Q", len(points.positions))]
    for number, (position, colour) in enumerate(zip(points.positions, points.colours, strict=True), start=1):
        parts.append(struct.pack("<Q3d3BdQ", number, *position.tolist(), *colour.tolist(), 0.0, 0))
    write_whole(folder / "points3D.bin", b"".join(parts))


def write_text_model(
    folder: Path, cameras: dict[int, CameraRecord], images: tuple[ImageRecord, ...], points: Points
) -> None:
    """Write the three text files, each at once or not at all, with every digit."""
    lines = ["# CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]"]
    for camera in cameras.values():
        lines.append(" ".join(map(str, (camera.number, camera.model, camera.width, camera.height, *camera.params))))
    write_whole(folder / "cameras.txt", "\n".join([*lines, ""]).encode())
    lines = ["# IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME", "# POINTS2D[] as (X, Y, POINT3D_ID)"]
    for image in images:
        lines.append(
            " ".join(map(str, (image.number, *image.quaternion, *image.translation, image.camera, image.name)))
        )
        lines.append("")
    write_whole(folder / "images.txt", "\n".join([*lines, ""]).encode())
    lines = ["# POINT3D_ID, X, Y, Z, R, G, B, ERROR, TRACK[] as (IMAGE_ID, POINT2D_IDX)"]
    for number, (position, colour) in enumerate(zip(points.positions, points.colours, strict=True), start=1):
        lines.append(" ".join(map(str, (number, *position.tolist(), *colour.tolist(), 0.0))))
    write_whole(folder / "points3D.txt", "\n".join([*lines, ""]).encode())


def _camera(number: int, model: str, width: int, height: int, params: tuple[float, ...], path: Path) -> CameraRecord:
    if not (1 <= width <= 1_000_000 and 1 <= height <= 1_000_000):
        raise DataError(f"{path}: camera {number} has {width}x{height} pixels; the file is damaged")
    return CameraRecord(number, model, width, height, tuple(params))


def _lines(path: Path) -> list[str]:
    return [line for line in read_text(path).splitlines() if not line.startswith("#")]


def _floats(words: list[str], path: Path, line: str) -> tuple[float, ...]:
    try:
        return tuple(float(word) for word in words)
    except ValueError as error:
        raise DataError(f"{path}: expected numbers; got {line[:80]!r}") from error


def _integers(words: tuple[str, ...] | list[str], path: Path, line: str) -> tuple[int, ...]:
    try:
        return tuple(int(word) for word in words)
    except ValueError as error:
        raise DataError(f"{path}: expected whole numbers; got {line[:80]!r}") from error


def _points(positions: list, colours: list) -> Points:
    paint = np.clip(np.array(colours, dtype=np.float64).reshape(-1, 3), 0, 255).astype(np.uint8)
    return Points(np.array(positions, dtype=np.float64).reshape(-1, 3), paint)
