"""Reading one array out of an .npz file of unknown origin: sizes are checked before data, and nothing is unpickled."""

import math
import zipfile
import zlib
from pathlib import Path

import numpy as np

from rf3dgs.core.errors import DataError

MAX_BYTES = 2 * 2**30
MAX_RATIO = 200  # declared bytes per byte of the file
ALWAYS_ALLOWED = 64 * 2**20  # declared bytes that need no ratio: constant arrays compress a thousandfold
MAX_MEMBERS = 64
MAX_HEADER = 4096  # bytes of the text that says dtype and shape


def read_npz_array(path: str | Path, name: str | None = None, *, max_bytes: int = MAX_BYTES) -> np.ndarray:
    """The array `name` of real numbers in `path`, or its only one; DataError names a damaged, unsafe or foreign file.

    Refused are pickled objects, complex numbers and text, more than `max_bytes` declared or more than 200 times the
    file's size, and arrays whose data are shorter or longer than their shape says.
    """
    path = Path(path)
    if not path.is_file():
        raise DataError(f"{path}: there is no such file")
    try:
        with zipfile.ZipFile(path) as archive:
            members = archive.infolist()
            if len(members) > MAX_MEMBERS:
                raise DataError(f"{path}: holds {len(members)} arrays; expected at most {MAX_MEMBERS}")
            known = {member.filename.removesuffix(".npy"): member for member in members}
            if name is None and len(members) != 1:
                raise DataError(f"{path}: expected one array; it holds {', '.join(sorted(known)) or 'none'}")
            member = members[0] if name is None else known.get(name)
            if member is None:
                raise DataError(f"{path}: has no array {name!r}; it holds {', '.join(sorted(known)) or 'none'}")
            allowed = min(max_bytes, max(ALWAYS_ALLOWED, MAX_RATIO * path.stat().st_size))
            if member.file_size > allowed:
                raise DataError(
                    f"{path}: declares {member.file_size} bytes, more than the {allowed} that a file of its size may "
                    "hold; it is damaged or hostile"
                )
            with archive.open(member) as stream:
                shape, column_major, dtype = _header(stream, path)
                size = math.prod(shape) * dtype.itemsize
                if size > member.file_size:
                    raise DataError(f"{path}: an array of shape {list(shape)} does not fit into its {size} bytes")
                data = stream.read(size + 1)
    except (zipfile.BadZipFile, zlib.error, OSError, EOFError, ValueError, NotImplementedError, RuntimeError) as error:
        raise DataError(f"{path}: expected an .npz file; it is damaged or another format ({error})") from error
    if len(data) != size:
        raise DataError(f"{path}: the data of an array of shape {list(shape)} must take {size} bytes; they do not")
    return np.frombuffer(data, dtype=dtype).reshape(shape, order="F" if column_major else "C")


def _header(stream, path: Path) -> tuple[tuple[int, ...], bool, np.dtype]:
    """Shape, whether columns come first, and dtype of the .npy file in `stream`, which is left at its data."""
    version = np.lib.format.read_magic(stream)
    readers = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}
    if version not in readers:
        raise DataError(f"{path}: an array has the .npy version {version}; expected 1.0 or 2.0, save it with numpy")
    shape, column_major, dtype = readers[version](stream, max_header_size=MAX_HEADER)
    if dtype.kind not in "iufb":
        raise DataError(f"{path}: expected an array of real numbers; got the dtype {dtype}")
    return shape, column_major, dtype
