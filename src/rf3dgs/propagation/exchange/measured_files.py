"""The containers of measured soundings: named fields to and from HDF5, MATLAB 5 and CSV; `measured` says which fields.

All are of unknown origin when read, so each is bounded before it is opened: HDF5 by its audit, MATLAB files by a reader
of their own (`mat5`), CSV by its size. What is not a known field is left alone.
"""

from collections.abc import Callable, Mapping
from pathlib import Path

import h5py
import numpy as np

from rf3dgs.core.errors import DataError
from rf3dgs.core.hdf5 import LIBVER, open_audited, read_array, read_attribute, write_text
from rf3dgs.propagation.exchange.mat5 import read_mat5

Fields = Mapping[str, np.ndarray | str]

SCHEMA, VERSION = "rf3dgs.sounding", 1
TEXTS = ("pattern_rx", "pattern_tx")
NUMBERS = (
    "response",
    "offsets",
    "frequency",
    "tx_position",
    "tx_orientation",
    "rx_position",
    "rx_orientation",
    "array_rx",
    "array_tx",
    "noise_power",
    "fov_rx",
    "fov_tx",
    "delay_offset",
)
COLUMNS = "position,rx_ant,tx_ant,offset,real,imag"
MAX_BYTES = 2 * 2**30
MAX_CSV_BYTES = 512 * 2**20


def read_hdf5(path: Path) -> Fields:
    """The fields of an HDF5 file: datasets, text as attributes, the response as real and imaginary parts."""
    with open_audited(path, max_bytes=MAX_BYTES) as file:
        schema = read_attribute(file, "schema") if "schema" in file.attrs else None
        if schema != SCHEMA:
            raise DataError(f"{path}: expected an HDF5 file with the attribute schema = {SCHEMA!r}; got {schema!r}")
        version = read_attribute(file, "version")
        if version != VERSION:
            raise DataError(f"{path}: schema version {version} is not {VERSION}; update rf3dgs to read it")
        real, imaginary = read_array(file, "response_real"), read_array(file, "response_imag")
        if real.shape != imaginary.shape:
            raise DataError(f"{path}: 'response_real' and 'response_imag' differ in shape; write the file again")
        fields: dict[str, np.ndarray | str] = {"response": real + 1j * imaginary}
        for name in NUMBERS:
            if name in file:
                fields[name] = read_array(file, name)
        for name in TEXTS:
            if name in file.attrs:
                fields[name] = str(read_attribute(file, name))
    return fields


def write_hdf5(path: Path, fields: Fields) -> None:
    """Write what `read_hdf5` reads."""
    with h5py.File(path, "w", libver=LIBVER) as file:
        write_text(file.attrs, "schema", SCHEMA)
        file.attrs["version"] = VERSION
        for name, value in fields.items():
            if isinstance(value, str):
                write_text(file.attrs, name, value)
            elif name == "response":
                packed = {"compression": "gzip", "shuffle": True, "fletcher32": True, "track_times": False}
                # Flushed at once: when Python drops the last reference must not decide where chunks lie in the file.
                file.create_dataset("response_real", data=np.real(value), **packed).flush()
                file.create_dataset("response_imag", data=np.imag(value), **packed).flush()
            else:
                file.create_dataset(name, data=value, track_times=False)


def read_mat(path: Path) -> Fields:
    """The fields that are variables of a MATLAB 5 file."""
    return read_mat5(path, (*NUMBERS, *TEXTS))


def write_mat(path: Path, fields: Fields) -> None:
    """Write a MATLAB 5 file, compressed."""
    from scipy.io import savemat

    savemat(path, dict(fields), do_compression=True, oned_as="row")


def read_csv(path: Path) -> Fields:
    """The fields in the lines "# name = value" and in the table below them."""
    size = path.stat().st_size
    if size > MAX_CSV_BYTES:
        raise DataError(f"{path}: has {size} bytes; expected at most {MAX_CSV_BYTES}, use HDF5")
    try:
        lines = path.read_bytes().decode("utf-8-sig").splitlines()
    except UnicodeDecodeError as error:
        raise DataError(f"{path}: expected UTF-8 text; it is binary or damaged") from error
    head = 0
    fields: dict[str, np.ndarray | str] = {}
    while head < len(lines) and lines[head].startswith("#"):
        name, equals, text = lines[head][1:].partition("=")
        name, text = name.strip(), text.strip()
        if equals and name in TEXTS:
            fields[name] = text
        elif equals and name in NUMBERS:
            fields[name] = _matrix(text, name, path)
        head += 1
    if head == len(lines) or lines[head].replace(" ", "") != COLUMNS:
        raise DataError(f"{path}: expected the line {COLUMNS!r} after the lines that begin with #; it is missing")
    fields["offsets"], fields["response"] = _table(lines[head + 1 :], path)
    return fields


def write_csv(path: Path, fields: Fields) -> None:
    """Write what `read_csv` reads; numbers keep all their digits."""
    response, offsets = fields["response"], fields["offsets"]
    assert isinstance(response, np.ndarray)
    assert isinstance(offsets, np.ndarray)
    with path.open("w", encoding="utf-8", newline="\n") as file:
        file.write(f"# {SCHEMA} {VERSION}\n")
        for name, value in fields.items():
            if isinstance(value, str):
                file.write(f"# {name} = {value}\n")
            elif name not in ("response", "offsets"):
                rows = np.atleast_2d(value)
                file.write(f"# {name} = {'; '.join(' '.join(repr(float(x)) for x in row) for row in rows)}\n")
        file.write(COLUMNS + "\n")
        for place, value in np.ndenumerate(response):
            position, rx, tx, at = place
            file.write(f"{position},{rx},{tx},{float(offsets[at])!r},{float(value.real)!r},{float(value.imag)!r}\n")


def _matrix(text: str, name: str, path: Path) -> np.ndarray:
    """Numbers apart by spaces or commas, rows apart by semicolons."""
    try:
        return np.array([[float(x) for x in row.replace(",", " ").split()] for row in text.split(";")])
    except ValueError as error:
        raise DataError(f"{path}: {name!r} must be numbers, rows apart by ';'; got {text[:60]!r}") from error


def _table(lines: list[str], path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Offsets `[frequency]` and response `[position, rx_ant, tx_ant, frequency]` of the rows of a CSV file."""
    if not lines:
        raise DataError(f"{path}: has no rows of numbers; expected one per position, pair of elements and frequency")
    try:
        rows = np.loadtxt(lines, delimiter=",", ndmin=2)
    except ValueError as error:
        raise DataError(f"{path}: a row is not six numbers ({error}); mend it") from error
    if rows.shape[1:] != (6,) or not np.isfinite(rows).all():
        raise DataError(f"{path}: every row must be six finite numbers: {COLUMNS}; mend it")
    offsets, at = np.unique(rows[:, 3], return_inverse=True)
    index = rows[:, :3]
    if bool((index != np.round(index)).any()) or bool((index < 0).any()) or bool((index >= len(rows)).any()):
        raise DataError(f"{path}: position, rx_ant and tx_ant must count from 0; got something else")
    shape = (*(index.max(0).astype(np.int64) + 1).tolist(), len(offsets))
    count = 1
    for length in shape:
        count *= int(length)
    if count != len(rows):
        raise DataError(
            f"{path}: {shape[0]} positions, {shape[1]} x {shape[2]} elements and {shape[3]} frequencies need {count} "
            f"rows; got {len(rows)}. One row for each combination, with the same frequencies for all"
        )
    place = np.ravel_multi_index((*index.astype(np.int64).T, at.reshape(-1)), shape)
    if len(np.unique(place)) != count:
        raise DataError(f"{path}: some combinations of position, elements and frequency occur twice; remove them")
    response = np.empty(count, dtype=np.complex128)
    response[place] = rows[:, 4] + 1j * rows[:, 5]
    return offsets, response.reshape(shape)


FORMATS: dict[str, tuple[Callable[[Path], Fields], Callable[[Path, Fields], None]]] = {
    ".h5": (read_hdf5, write_hdf5),
    ".hdf5": (read_hdf5, write_hdf5),
    ".mat": (read_mat, write_mat),
    ".csv": (read_csv, write_csv),
}
