"""Reading arrays of numbers and lines of text out of MATLAB 5 files of unknown origin.

A reader of its own, because the usual one follows whatever a damaged file says and can bring the process down. Every
length is checked against the bytes that are there, compressed parts are unpacked up to a limit, and variables that
were not asked for, or are cells, structures and objects, are not looked into.
"""

import struct
import zlib
from collections.abc import Collection
from pathlib import Path

import numpy as np

from rf3dgs.core.errors import DataError

MAX_BYTES = 2 * 2**30
MAX_RATIO = 200  # unpacked bytes per byte of the file
ALWAYS_ALLOWED = 64 * 2**20
MATRIX, COMPRESSED = 14, 15
NUMBERS = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 9: "f8", 12: "i8", 13: "u8"}
LETTERS = {1: "latin-1", 2: "latin-1", 4: "utf-16", 16: "utf-8", 17: "utf-16"}
CHAR, NUMERIC = 4, range(6, 16)
OTHER = {1: "cell", 2: "struct", 3: "object", 5: "sparse array", 16: "function", 17: "object"}
COMPLEX = 0x0800


def read_mat5(path: Path, names: Collection[str]) -> dict[str, np.ndarray | str]:
    """The variables `names` that a MATLAB 5 file has: arrays in their own shape, text as str.

    DataError names the file when it is damaged, of another version, unpacks to more than its size explains, or a
    wanted variable is neither numbers nor one line of text.
    """
    size = path.stat().st_size
    if size > MAX_BYTES:
        raise DataError(f"{path}: has {size} bytes; expected at most {MAX_BYTES}, split it")
    data = path.read_bytes()
    if data.startswith(b"MATLAB 7.3"):
        raise DataError(f"{path}: is a MATLAB 7.3 file; save it with -v7, or use HDF5 of this package's layout")
    if len(data) < 136 or data[126:128] not in (b"IM", b"MI"):
        raise DataError(f"{path}: expected a MATLAB 5 file (save -v7); it is truncated, damaged or another format")
    order = "<" if data[126:128] == b"IM" else ">"
    allowed = min(MAX_BYTES, max(ALWAYS_ALLOWED, MAX_RATIO * size))
    found: dict[str, np.ndarray | str] = {}
    at = 128
    try:
        while at < len(data):
            kind, content, at = _element(data, at, order)
            if kind == COMPRESSED:
                unpacked = _unpacked(content, allowed, path)
                allowed -= len(unpacked)
                kind, content, _ = _element(unpacked, 0, order)
            if kind != MATRIX:
                raise ValueError(f"element of type {kind}")
            if content:
                _add_variable(content, order, names, found, path)
    except (ValueError, struct.error, zlib.error, OverflowError, LookupError) as error:
        raise DataError(f"{path}: the MATLAB file is truncated or damaged ({error}); write it again") from error
    return found


def _element(data: bytes, at: int, order: str) -> tuple[int, bytes, int]:
    """Type and content of the element at `at`, and where the next one begins."""
    kind, length = struct.unpack_from(f"{order}II", data, at)
    if kind >> 16:  # a small element: length and type share the first word, the content follows at once
        kind, length, start, end = kind & 0xFFFF, kind >> 16, at + 4, at + 8
        if length > 4:
            raise ValueError("a small element of more than four bytes")
    else:
        start = at + 8
        end = start + length if kind == COMPRESSED else start + (length + 7) // 8 * 8
    content = data[start : start + length]
    if len(content) != length:
        raise ValueError("an element is longer than the file")
    return kind, content, end


def _unpacked(packed: bytes, allowed: int, path: Path) -> bytes:
    unpacker = zlib.decompressobj()
    content = unpacker.decompress(packed, allowed + 1)
    if len(content) > allowed:
        raise DataError(f"{path}: unpacks to far more than the file's size explains; it is damaged or hostile")
    if not unpacker.eof:
        raise ValueError("a compressed part ends early")
    return content


def _add_variable(
    content: bytes, order: str, names: Collection[str], found: dict[str, np.ndarray | str], path: Path
) -> None:
    """Read one variable if it is wanted."""
    _, flags, at = _element(content, 0, order)
    word = struct.unpack_from(f"{order}I", flags)[0]
    _, dimensions, at = _element(content, at, order)
    _, raw_name, at = _element(content, at, order)
    name = raw_name.decode("latin-1")
    if name not in names:
        return
    if name in found:
        raise ValueError(f"{name!r} occurs twice")
    kind = word & 0xFF
    if kind != CHAR and kind not in NUMERIC:
        raise DataError(f"{path}: {name!r} must be numbers or text; got a MATLAB {OTHER.get(kind, 'object')}")
    shape = tuple(int(length) for length in np.frombuffer(dimensions, dtype=f"{order}i4"))
    if kind == CHAR:
        stored, letters, _ = _element(content, at, order)
        coding = LETTERS[stored]
        text = letters.decode(coding + ("-le" if order == "<" else "-be") if coding == "utf-16" else coding)
        if len(shape) != 2 or shape[0] > 1:
            raise DataError(f"{path}: {name!r} must be one line of text; got {list(shape)} letters")
        found[name] = text
        return
    real, at = _numbers(content, at, order, shape)
    if word & COMPLEX:
        imaginary, _ = _numbers(content, at, order, shape)
        found[name] = real + 1j * imaginary
    else:
        found[name] = real


def _numbers(content: bytes, at: int, order: str, shape: tuple[int, ...]) -> tuple[np.ndarray, int]:
    """The part of an array of `shape` at `at`, float64, and where the next part begins."""
    stored, raw, end = _element(content, at, order)
    values = np.frombuffer(raw, dtype=f"{order}{NUMBERS[stored]}")
    if min(shape, default=0) < 0 or len(values) != np.prod([float(length) for length in shape]):
        raise ValueError(f"{len(values)} numbers for an array of {list(shape)}")
    return values.astype(np.float64).reshape(shape, order="F"), end
