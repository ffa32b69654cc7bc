"""PLY files: Gaussians in the format of 3DGS, which other viewers open, and plain point clouds.

The header is believed only as far as the file's size allows; every fault is a DataError that names the file. 3DGS
stores raw values: logarithmic scales, opacity logits, quaternions wxyz, and harmonics as `f_dc_*` (constant term) and
`f_rest_*` (all higher terms of the first channel, then of the next).
"""

from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import numpy as np
import torch
from torch import Tensor

from rf3dgs.core.errors import DataError, InputError
from rf3dgs.core.files import atomic_file
from rf3dgs.splats.gaussians import Gaussians
from rf3dgs.splats.harmonics import coefficient_count

_TYPES = {"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4", "float": "f4"}
_TYPES |= {"double": "f8", "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4"}
_TYPES |= {"float32": "f4", "float64": "f8"}
_FORMATS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
_MAX_LINES, _MAX_LINE, _MAX_TOKEN = 2000, 4096, 64


def write_ply(path: str | Path, gaussians: Gaussians) -> None:
    """Write Gaussians as a binary little-endian 3DGS file; an older file is replaced only when the new one is complete.

    Viewers expect three channels. Raises InputError when a value is not finite, DataError when the disk refuses.
    """
    gaussians.check()
    values = gaussians.detach()
    count, channels = len(values), values.channels
    rest = values.sh[:, 1:].transpose(1, 2).reshape(count, -1)
    columns = {
        ("x", "y", "z"): values.means,
        ("nx", "ny", "nz"): torch.zeros(count, 3),
        tuple(f"f_dc_{index}" for index in range(channels)): values.sh[:, 0],
        tuple(f"f_rest_{index}" for index in range(rest.shape[1])): rest,
        ("opacity",): values.logit_opacities[:, None],
        ("scale_0", "scale_1", "scale_2"): values.log_scales,
        ("rot_0", "rot_1", "rot_2", "rot_3"): values.quats,
    }
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {count}"]
    header += [f"property float {name}" for names in columns for name in names]
    body = torch.cat(list(columns.values()), 1).numpy().astype("<f4")
    with atomic_file(path) as temporary, temporary.open("wb") as file:
        file.write(("\n".join([*header, "end_header"]) + "\n").encode("ascii"))
        file.write(body.tobytes())


def read_ply(path: str | Path) -> Gaussians:
    """The Gaussians of a 3DGS file, ASCII or binary, with any number of channels and degree 0 to 3."""
    path = Path(path)
    table = _read_vertices(path)
    channels = _numbered(table, "f_dc_")
    rest = _numbered(table, "f_rest_")
    if channels == 0:
        raise DataError(
            f"{path}: expected the properties of 3DGS; f_dc_0 is missing. Read a point cloud with read_point_cloud, "
            "and export compressed splats as an ordinary .ply first"
        )
    terms = [coefficient_count(degree) - 1 for degree in range(4)]
    if rest not in [channels * term for term in terms]:
        raise DataError(
            f"{path}: {channels} channels need {' or '.join(str(channels * term) for term in terms)} f_rest "
            f"properties; got {rest}. Export the file again"
        )
    constant = _columns(path, table, [f"f_dc_{index}" for index in range(channels)])
    higher = _columns(path, table, [f"f_rest_{index}" for index in range(rest)])
    sh = torch.cat((constant[:, None], higher.reshape(len(constant), channels, -1).transpose(1, 2)), 1)
    gaussians = Gaussians(
        means=_columns(path, table, ["x", "y", "z"]),
        quats=_columns(path, table, ["rot_0", "rot_1", "rot_2", "rot_3"]),
        log_scales=_columns(path, table, ["scale_0", "scale_1", "scale_2"]),
        logit_opacities=_columns(path, table, ["opacity"]).squeeze(-1),
        sh=sh,
    )
    try:
        gaussians.check()
    except InputError as error:
        raise DataError(f"{path}: {error}") from error
    return gaussians


def read_point_cloud(path: str | Path) -> tuple[Tensor, Tensor | None]:
    """Points `[point, 3]` and their colours `[point, 3]` in 0..1, or None where the file has none.

    Integer colours are divided by their type's largest value; floating-point ones are taken as they are.
    """
    path = Path(path)
    table = _read_vertices(path)
    points = _columns(path, table, ["x", "y", "z"])
    if not len(points) or not bool(torch.isfinite(points).all()):
        raise DataError(f"{path}: a point cloud needs at least one point and finite x, y, z; remove the bad points")
    names = ["red", "green", "blue"]
    if not all(name in table for name in names):
        return points, None
    kind = table["red"].dtype
    colours = _columns(path, table, names)
    return points, colours / float(np.iinfo(kind).max) if kind.kind in "iu" else colours


@dataclass(frozen=True)
class _Element:
    """One element of a header; `row` is None when it has a list property."""

    name: str
    count: int
    names: tuple[str, ...]
    row: np.dtype | None


def _read_vertices(path: Path) -> dict[str, np.ndarray]:
    """The columns of the element `vertex` by name, each with the type the header gives it."""
    try:
        size = path.stat().st_size
        with path.open("rb") as file:
            order, elements = _read_header(path, file)
            for element in elements:
                remaining = size - file.tell()
                if not element.names and element.count:
                    raise DataError(
                        f"{path}: element {element.name} has rows without properties; export the file again"
                    )
                if element.row is None:
                    raise DataError(
                        f"{path}: element {element.name} has a list property before or in the vertices; "
                        "export plain vertices"
                    )
                needed = element.count * (element.row.itemsize if order else 2 * len(element.names)) - (not order)
                if needed > remaining:
                    raise DataError(
                        f"{path}: the header promises {element.count} rows of {element.name} ({needed} bytes), but "
                        f"{remaining} bytes follow; the file is truncated or its header wrong. Fetch or export it again"
                    )
                if element.name == "vertex":
                    return _read_rows(path, file, element, binary=bool(order))
                if order:
                    file.seek(element.count * element.row.itemsize, 1)
                else:
                    for _ in range(element.count):
                        file.readline(_MAX_LINE)
    except OSError as error:
        raise DataError(f"{path}: cannot be read: {error.strerror}; check the name and the permissions") from error
    raise DataError(f"{path}: the header has no element vertex; export points or Gaussians as vertices")


def _read_header(path: Path, file: BinaryIO) -> tuple[str, list[_Element]]:
    """The byte order ("" for ASCII) and the elements; leaves `file` at the first byte after the header."""
    if file.readline(_MAX_LINE).strip() != b"ply":
        raise DataError(f"{path}: expected a PLY file, which begins with the line 'ply'; give a .ply file")
    order: str | None = None
    elements: list[tuple[str, int, list[tuple[str, str | None]]]] = []
    for _ in range(_MAX_LINES):
        line = file.readline(_MAX_LINE)
        words = line.decode("ascii", "replace").split()
        if not line:
            break
        match words:
            case [] | ["comment" | "obj_info", *_]:
                continue
            case ["format", name, "1.0"] if name in _FORMATS:
                order = _FORMATS[name]
            case ["element", name, count] if count.isascii() and count.isdigit() and len(count) < 16:
                elements.append((name, int(count), []))
            case ["property", "list", _, _, name] if elements:
                elements[-1][2].append((name, None))
            case ["property", kind, name] if elements and kind in _TYPES:
                elements[-1][2].append((name, _TYPES[kind]))
            case ["end_header"] if order is not None:
                return order, [_element(path, order, *element) for element in elements]
            case _:
                raise DataError(f"{path}: bad header line {' '.join(words)[:60]!r}; fetch or export the file again")
    raise DataError(f"{path}: the header has no end_header line; the file is truncated. Fetch or export it again")


def _element(path: Path, order: str, name: str, count: int, properties: list[tuple[str, str | None]]) -> _Element:
    names = tuple(label for label, _ in properties)
    if len(set(names)) != len(names):
        raise DataError(f"{path}: element {name} names a property twice; export the file again")
    plain = [(label, order + kind) for label, kind in properties if kind is not None]
    return _Element(name, count, names, np.dtype(plain) if len(plain) == len(properties) else None)


def _read_rows(path: Path, file: BinaryIO, element: _Element, *, binary: bool) -> dict[str, np.ndarray]:
    assert element.row is not None
    if binary:
        rows = np.frombuffer(file.read(element.count * element.row.itemsize), dtype=element.row, count=element.count)
        return {name: rows[name] for name in element.names}
    tokens = file.read().split()[: element.count * len(element.names)]
    if len(tokens) < element.count * len(element.names) or max(map(len, tokens), default=0) > _MAX_TOKEN:
        raise DataError(f"{path}: the header promises {element.count} rows of numbers; fewer follow. Fetch it again")
    try:
        values = np.array(tokens, dtype=f"S{_MAX_TOKEN}").astype(np.float64).reshape(element.count, len(element.names))
    except ValueError as error:
        raise DataError(f"{path}: a vertex is not a row of numbers ({error}); export the file again") from error
    with np.errstate(over="ignore", invalid="ignore"):
        return {name: values[:, index].astype(element.row[name]) for index, name in enumerate(element.names)}


def _numbered(table: dict[str, np.ndarray], prefix: str) -> int:
    """How many of `prefix0`, `prefix1`, ... the table has without a gap."""
    count = 0
    while f"{prefix}{count}" in table:
        count += 1
    return count


def _columns(path: Path, table: dict[str, np.ndarray], names: list[str]) -> Tensor:
    """The named columns as float32 `[row, name]`."""
    missing = [name for name in names if name not in table]
    if missing:
        raise DataError(f"{path}: the vertices lack the property {', '.join(missing)}; export the file again")
    rows = len(next(iter(table.values()))) if table else 0
    if not names:
        return torch.zeros(rows, 0)
    with np.errstate(over="ignore", invalid="ignore"):
        return torch.from_numpy(np.stack([table[name].astype(np.float32) for name in names], 1))
