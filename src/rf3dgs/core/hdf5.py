"""Opening HDF5 files of unknown origin: what a file declares is audited before a single value is read.

A foreign HDF5 file can name any local file as its storage, link to other files, ask for a filter plug-in, or declare
terabytes in a kilobyte; a damaged reference to text of variable length, or a damaged list of names in the file format
before HDF5 1.10, which has no checksums, can keep the library busy for ever. This module accepts the format of HDF5
1.10 (`LIBVER`) with groups, plain arrays of numbers with gzip, shuffle and fletcher32, and attributes that are numbers
or text of fixed length, and nothing else.
"""

from collections.abc import Iterator
from pathlib import Path

import h5py
import h5py.h5o
import numpy as np

from rf3dgs.core.errors import DataError, InputError

LIBVER = ("v110", "v110")  # h5py's `libver` for files to be written
SIGNATURE = b"\x89HDF\r\n\x1a\n"
MIN_SUPERBLOCK = 3  # its structure has checksums throughout
MAX_OBJECTS = 10_000
MAX_DEPTH = 16
MAX_ATTRIBUTES = 256
MAX_ATTRIBUTE_BYTES = 65_536
MAX_TEXT_BYTES = 60_000  # what an HDF5 object header takes in one attribute, with room for its name
MAX_RATIO = 200  # declared bytes per byte of the file
ALWAYS_ALLOWED = 64 * 2**20  # declared bytes that need no ratio: constant arrays compress a thousandfold
_NUMBERS = (h5py.h5t.INTEGER, h5py.h5t.FLOAT, h5py.h5t.ENUM)
_FILTERS = (h5py.h5z.FILTER_DEFLATE, h5py.h5z.FILTER_SHUFFLE, h5py.h5z.FILTER_FLETCHER32)


def open_audited(path: str | Path, *, max_bytes: int = 8 * 2**30, max_ratio: int = MAX_RATIO) -> h5py.File:
    """Open an HDF5 file for reading after an audit of everything in it; use it in a `with` statement.

    Refused with a `DataError` that names the file: what is not HDF5 or is truncated; the file format before HDF5 1.10;
    soft and external links; external or virtual storage; compound, variable-length, reference and other types than
    numbers (text of fixed length is allowed as an attribute); filters other than gzip, shuffle and fletcher32; more
    than `max_bytes` declared, or more than `max_ratio` times the file's size.
    """
    path = Path(path)
    if not path.is_file():
        raise DataError(f"{path}: expected an HDF5 file; there is no such file")
    try:
        _check_format(path)
        file = h5py.File(path, "r", locking="best-effort")
    except (OSError, RuntimeError, ValueError) as error:
        raise DataError(f"{path}: expected an HDF5 file; it is damaged, truncated or another format") from error
    try:
        _audit(file, path, max_bytes, max_ratio)
    except DataError:
        file.close()
        raise
    except (OSError, RuntimeError, ValueError, KeyError, TypeError) as error:
        file.close()
        raise DataError(f"{path}: the HDF5 file is damaged ({error}); write it again") from error
    return file


def read_array(group: h5py.Group, name: str) -> np.ndarray:
    """The whole dataset `name` of an audited file; a missing or damaged one is a `DataError` that names the file."""
    path, where = group.file.filename, f"{group.name or ''}/{name}".replace("//", "/")
    dataset = group.get(name)
    if not isinstance(dataset, h5py.Dataset):
        raise DataError(f"{path}: expected the dataset {where!r}; it is missing")
    try:
        return np.asarray(dataset[()])
    except (OSError, RuntimeError, ValueError) as error:
        raise DataError(f"{path}: {where!r} is damaged (checksum or storage); write the file again") from error


def write_text(attrs: h5py.AttributeManager, name: str, text: str) -> None:
    """Set an attribute to text as fixed-length UTF-8, the only form of text that `open_audited` accepts."""
    raw = text.encode("utf-8")
    if len(raw) > MAX_TEXT_BYTES:
        raise InputError(
            f"the attribute {name!r} must take at most {MAX_TEXT_BYTES} bytes as UTF-8; got {len(raw)}: shorten it"
        )
    attrs.create(name, np.array(raw, dtype=h5py.string_dtype("utf-8", max(1, len(raw)))))


def read_attribute(item: h5py.HLObject, name: str) -> str | float | int | np.ndarray:
    """One attribute as text, number or small array; a missing one is a `DataError` that names file and object."""
    try:
        known = name in item.attrs
        value = item.attrs[name] if known else None
    except (OSError, RuntimeError, ValueError, TypeError) as error:
        raise DataError(f"{item.file.filename}: the attribute {name!r} of {item.name!r} is damaged") from error
    if not known:
        raise DataError(f"{item.file.filename}: {item.name!r} lacks the attribute {name!r}; write the file again")
    if isinstance(value, bytes):
        return value.decode("utf-8", errors="replace")
    if isinstance(value, str):
        return value
    array = np.asarray(value)
    return array.item() if array.ndim == 0 else array


def _check_format(path: Path) -> None:
    """Refuse, before the library sees it, a file whose structure has no checksums."""
    with path.open("rb") as file:
        head = file.read(len(SIGNATURE) + 1)
    if len(head) <= len(SIGNATURE) or not head.startswith(SIGNATURE):
        raise ValueError("no signature of HDF5 at the beginning")
    if head[-1] < MIN_SUPERBLOCK:
        raise DataError(
            f"{path}: is in the file format before HDF5 1.10, which has no checksums, so that damage can make reading "
            "hang; write it in the format of 1.10 (h5py: File(name, 'w', libver='v110'))"
        )


def _audit(file: h5py.File, path: Path, max_bytes: int, max_ratio: int) -> None:
    allowed = min(max_bytes, max(ALWAYS_ALLOWED, max_ratio * path.stat().st_size))
    declared = 0
    for name, item in _objects(file, path):
        _audit_attributes(item, path, name)
        if isinstance(item, h5py.Dataset):
            declared += _audit_dataset(item, path, name)
            if declared > allowed:
                raise DataError(
                    f"{path}: declares more than {allowed / 2**20:.0f} MiB at {name!r}, far more than the file's size "
                    "explains; it is damaged or hostile"
                )


def _objects(file: h5py.File, path: Path) -> Iterator[tuple[str, h5py.Group | h5py.Dataset]]:
    """Every object once, parents first, following hard links only."""
    pending: list[tuple[str, h5py.Group, int]] = [("/", file, 0)]
    seen = {h5py.h5o.get_info(file.id).addr}
    yield "/", file
    while pending:
        prefix, group, depth = pending.pop()
        if depth > MAX_DEPTH:
            raise DataError(f"{path}: groups are nested more than {MAX_DEPTH} deep at {prefix!r}")
        for key in group:
            name = f"{prefix.rstrip('/')}/{key}"
            link = group.get(key, getlink=True)
            if not isinstance(link, h5py.HardLink):
                raise DataError(f"{path}: {name!r} is a soft or external link; only data inside the file are read")
            item = group[key]
            address = h5py.h5o.get_info(item.id).addr
            if address in seen:
                continue
            seen.add(address)
            if len(seen) > MAX_OBJECTS:
                raise DataError(f"{path}: holds more than {MAX_OBJECTS} objects; split it into several files")
            if not isinstance(item, h5py.Group | h5py.Dataset):
                raise DataError(f"{path}: {name!r} is neither a group nor an array of numbers")
            yield name, item
            if isinstance(item, h5py.Group):
                pending.append((name, item, depth + 1))


def _audit_dataset(dataset: h5py.Dataset, path: Path, name: str) -> int:
    """Refuse unsafe storage; the bytes that reading the dataset takes."""
    kind = dataset.id.get_type()
    if kind.get_class() not in _NUMBERS:
        raise DataError(f"{path}: {name!r} must be a plain array of numbers; got HDF5 type {dataset.dtype}")
    properties = dataset.id.get_create_plist()
    if properties.get_layout() == h5py.h5d.VIRTUAL:
        raise DataError(f"{path}: {name!r} is a virtual dataset, which reads other files; copy the data into one file")
    if properties.get_external_count() > 0:
        raise DataError(f"{path}: {name!r} has external storage, which reads other files; copy the data into one file")
    for index in range(properties.get_nfilters()):
        if properties.get_filter(index)[0] not in _FILTERS:
            raise DataError(f"{path}: {name!r} uses an HDF5 filter other than gzip, shuffle and fletcher32; repack it")
    count = _product(dataset.shape or ())
    chunk = _product(dataset.chunks) if dataset.chunks else 0
    return max(count, chunk) * kind.get_size()


def _audit_attributes(item: h5py.Group | h5py.Dataset, path: Path, name: str) -> None:
    count = h5py.h5a.get_num_attrs(item.id)
    if count > MAX_ATTRIBUTES:
        raise DataError(f"{path}: {name!r} has {count} attributes; expected at most {MAX_ATTRIBUTES}")
    for index in range(count):
        attribute = h5py.h5a.open(item.id, index=index)
        kind = attribute.get_type()
        label = attribute.name.decode("utf-8", errors="replace")
        text = isinstance(kind, h5py.h5t.TypeStringID)
        if (text and kind.is_variable_str()) or kind.detect_class(h5py.h5t.VLEN):
            raise DataError(
                f"{path}: attribute {label!r} of {name!r} has variable length, which is not safe to read; "
                "store it as fixed-length text (h5py: attrs[name] = numpy.bytes_(text.encode())) or a plain array"
            )
        size = _product(attribute.shape) * kind.get_size()
        if size > MAX_ATTRIBUTE_BYTES or not (text or kind.get_class() in _NUMBERS):
            raise DataError(f"{path}: attribute {label!r} of {name!r} must be one text or a few numbers")


def _product(shape: tuple[int, ...]) -> int:
    result = 1
    for length in shape:
        result *= int(length)
    return result
