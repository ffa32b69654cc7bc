"""Opening files of unknown origin: JSON, pictures and file names, each bounded before it is read.

HDF5 files are opened by core/hdf5.py.
"""

import hashlib
import json
import re
import struct
import warnings
import zlib
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
from PIL import Image

from rf3dgs.core.errors import DataError
from rf3dgs.core.files import write_whole

MAX_JSON_BYTES = 64 * 2**20
MAX_JSON_DEPTH = 64
MAX_TEXT_BYTES = 512 * 2**20
MAX_PIXELS = 64_000_000
PICTURE_SUFFIXES = (".jpg", ".jpeg", ".png")
_BRACKETS = re.compile(r'"(?:[^"\\]|\\.)*+"|[\[{\]}]', re.DOTALL)
_PICTURE_ERRORS = (OSError, SyntaxError, ValueError, EOFError, IndexError, KeyError, struct.error, zlib.error)


def read_json(path: Path) -> dict[str, Any]:
    """The object in a JSON file; DataError when it is missing, too large, nested too deeply, not JSON, or holds NaN."""
    text = read_text(path, limit=MAX_JSON_BYTES)
    if _depth(text) > MAX_JSON_DEPTH:
        raise DataError(f"{path}: JSON is nested more than {MAX_JSON_DEPTH} deep; it is damaged or hostile")

    def refuse(constant: str) -> None:
        raise DataError(f"{path}: JSON must hold finite numbers; got {constant}. Remove that entry")

    try:
        value = json.loads(text, parse_constant=refuse)
    except (ValueError, RecursionError) as error:
        raise DataError(f"{path}: expected JSON; {error}. Write the file again") from error
    if not isinstance(value, dict):
        raise DataError(f"{path}: expected a JSON object {{...}}; got {type(value).__name__}")
    return value


def write_json(path: Path, value: dict[str, Any]) -> None:
    """Write an object as readable JSON, at once or not at all; NaN is refused."""
    text = json.dumps(value, indent=1, allow_nan=False, ensure_ascii=False)
    write_whole(path, (text + "\n").encode())


def read_text(path: Path, *, limit: int = MAX_TEXT_BYTES) -> str:
    """A UTF-8 text file of at most `limit` bytes."""
    return _decoded(read_bytes(path, limit=limit), path)


def read_bytes(path: Path, *, limit: int = MAX_TEXT_BYTES) -> bytes:
    """A file of at most `limit` bytes."""
    if not path.is_file():
        raise DataError(f"{path}: there is no such file")
    size = path.stat().st_size
    if size > limit:
        raise DataError(f"{path}: has {size} bytes; expected at most {limit}")
    try:
        return path.read_bytes()
    except OSError as error:
        raise DataError(f"{path}: cannot be read ({error.strerror})") from error


def inside(folder: Path, name: object, *, named_in: Path) -> Path:
    """The file `name` inside `folder`; absolute names and names that lead out of the folder are refused."""
    if not isinstance(name, str) or not name or "\0" in name or len(name) > 1000:
        raise DataError(f"{named_in}: expected a file name; got {str(name)[:80]!r}")
    relative = PurePosixPath(name.replace("\\", "/"))
    target = folder / relative
    is_absolute = relative.is_absolute() or (len(name) > 1 and name[1] == ":")
    if is_absolute or not target.resolve().is_relative_to(folder.resolve()):
        raise DataError(f"{named_in}: the file name {name!r} leads outside {folder}; use names relative to that folder")
    return target


def sha256_of(path: Path) -> str:
    """The sha256 of a file in hexadecimal digits."""
    if not path.is_file():
        raise DataError(f"{path}: there is no such file")
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def picture_size(path: Path) -> tuple[int, int]:
    """Width and height of a JPEG or PNG from its header alone."""
    with _open_picture(path) as picture:
        return picture.size


def read_picture(path: Path) -> np.ndarray:
    """A JPEG or PNG as `[row, col, 3]` uint8 RGB; transparent pixels are laid over black.

    DataError when the file is missing, another format, truncated, not 8 bits a channel or above 64 megapixels.
    """
    with _open_picture(path) as picture:
        if picture.mode not in ("1", "L", "LA", "P", "RGB", "RGBA", "CMYK", "YCbCr"):
            raise DataError(
                f"{path}: expected 8 bits a channel; got Pillow mode {picture.mode}. Convert it to 8-bit RGB"
            )
        try:
            picture.load()
            if picture.mode in ("LA", "P", "RGBA"):
                rgba = picture.convert("RGBA")
                flat = Image.new("RGBA", rgba.size, (0, 0, 0, 255))
                return np.array(Image.alpha_composite(flat, rgba).convert("RGB"))
            return np.array(picture.convert("RGB"))
        except _PICTURE_ERRORS as error:
            raise DataError(f"{path}: the picture is truncated or damaged ({error}); copy it again") from error


def _open_picture(path: Path) -> Image.Image:
    if not path.is_file():
        raise DataError(f"{path}: there is no such picture")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", Image.DecompressionBombWarning)
            picture = Image.open(path, formats=("JPEG", "PNG"))
    except Image.DecompressionBombError as error:
        raise DataError(f"{path}: more than {MAX_PIXELS // 10**6} megapixels; make the picture smaller") from error
    except _PICTURE_ERRORS as error:
        raise DataError(
            f"{path}: expected a JPEG or PNG picture; it is truncated, damaged or another format"
        ) from error
    if picture.width * picture.height > MAX_PIXELS:
        picture.close()
        raise DataError(f"{path}: more than {MAX_PIXELS // 10**6} megapixels; make the picture smaller")
    return picture


def _decoded(data: bytes, path: Path) -> str:
    try:
        return data.decode("utf-8")
    except UnicodeDecodeError as error:
        raise DataError(f"{path}: expected UTF-8 text; it is binary or damaged") from error


def _depth(text: str) -> int:
    """How deeply brackets outside strings nest; stops counting soon after the limit."""
    depth = deepest = 0
    for match in _BRACKETS.finditer(text):
        token = match[0]
        if token in "[{":
            depth += 1
            deepest = max(deepest, depth)
            if deepest > MAX_JSON_DEPTH:
                break
        elif token in "]}":
            depth -= 1
    return deepest
