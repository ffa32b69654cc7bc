"""Measured soundings in files: HDF5, MATLAB 5 and CSV with the same fields.

| field | shape | unit |
|---|---|---|
| response | [position, rx_ant, tx_ant, frequency], complex | linear, H(f) of each pair of elements |
| offsets | [frequency] | Hz from the carrier, evenly spaced, rising |
| frequency | one number | Hz, the carrier |
| tx_position, tx_orientation | [3], [4] | m; quaternion wxyz of world_from_device |
| rx_position, rx_orientation | [position, 3], [position, 4] | the same, one row per receiver |
| array_rx, array_tx | [4] | rows, columns, vertical and horizontal spacing [wavelengths] |
| pattern_rx, pattern_tx | text | element: isotropic, dipole, patch or tr38901 |
| noise_power | [position] | mean noise power of an entry, linear |
| fov_rx, fov_tx | one number | rad, vertical field of view of the elements |
| delay_offset | 0 or 1 | 1: clocks not synchronised, delays are relative |

The first three and the positions must be there. Without orientation a device is level and looks along +x; without array
it is one isotropic element; without noise power that is unknown; without field of view everything is seen.
"""

import math
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import torch

from rf3dgs.channel.arrays import PlanarArray
from rf3dgs.channel.sounding import Sounding
from rf3dgs.core.errors import DataError, InputError
from rf3dgs.core.files import atomic_file
from rf3dgs.core.frames import Pose
from rf3dgs.propagation.exchange.measured_files import FORMATS, Fields

LOWEST, HIGHEST = 1e8, 1e12  # Hz: carriers outside are in another unit


def read_sounding(path: str | Path) -> Sounding:
    """The sounding `[position]` in a .h5, .hdf5, .mat (MATLAB 5 to 7) or .csv file.

    DataError names the file when it is missing, damaged, unsafe, or its fields or units are not those above.
    """
    path = Path(path)
    read, _ = _format(path, DataError)
    if not path.is_file():
        raise DataError(f"{path}: expected a file with a sounding; there is none of that name")
    try:
        return _sounding(read(path), path)
    except InputError as error:
        raise DataError(f"{path}: {error}") from error


def write_sounding(path: str | Path, sounding: Sounding) -> None:
    """Write a sounding `[*batch]` as a list of positions; the suffix chooses the format. At once or not at all."""
    path = Path(path)
    _, write = _format(path, InputError)
    with atomic_file(path) as temporary:
        write(temporary, _fields(sounding.flat()))


def _format(path: Path, kind: type[DataError] | type[InputError]):
    if path.suffix.lower() not in FORMATS:
        raise kind(f"{path}: a sounding's file must end in {', '.join(FORMATS)}; rename or convert it")
    return FORMATS[path.suffix.lower()]


def _fields(sounding: Sounding) -> Fields:
    fields: dict[str, np.ndarray | str] = {
        "response": sounding.response.numpy(),
        "offsets": sounding.offsets.numpy(),
        "frequency": np.array(float(sounding.frequency)),
        "tx_position": sounding.tx.position.double().numpy(),
        "tx_orientation": sounding.tx.orientation.double().numpy(),
        "rx_position": sounding.rx.position.double().numpy(),
        "rx_orientation": sounding.rx.orientation.double().numpy(),
        "fov_rx": np.array(sounding.fov_rx),
        "fov_tx": np.array(sounding.fov_tx),
        "delay_offset": np.array(float(sounding.delay_offset)),
    }
    if isinstance(sounding.noise_power, torch.Tensor):
        fields["noise_power"] = sounding.noise_power.numpy()
    for end, array in (("rx", sounding.array_rx), ("tx", sounding.array_tx)):
        if array is not None:
            numbers = (array.rows, array.cols, array.vertical, array.horizontal)
            fields[f"array_{end}"] = np.array(numbers, dtype=np.float64)
            fields[f"pattern_{end}"] = array.pattern
    return fields


def _sounding(fields: Fields, path: Path) -> Sounding:
    response = fields.get("response")
    if response is None or isinstance(response, str):
        raise DataError(f"{path}: expected the field 'response', complex [position, rx_ant, tx_ant, frequency]")
    if response.ndim > 4:
        raise DataError(f"{path}: 'response' must be [position, rx_ant, tx_ant, frequency]; got {list(response.shape)}")
    # MATLAB drops axes of length 1 at the end.
    response = response.reshape([*response.shape, *[1] * (4 - response.ndim)])
    positions, points = len(response), response.shape[-1]
    frequency = _number(fields, "frequency", path)
    if not LOWEST <= frequency <= HIGHEST:
        raise DataError(f"{path}: 'frequency' must be in hertz, 100 MHz to 1 THz; got {frequency:g}, convert it")
    fov = {}
    for name in ("fov_rx", "fov_tx"):
        fov[name] = _number(fields, name, path, default=math.pi)
        if fov[name] > math.pi + 1e-9:
            raise DataError(
                f"{path}: {name!r} must be in radians, up to pi; got {fov[name]:g}, convert it from degrees"
            )
    synchronised = _number(fields, "delay_offset", path, default=0.0)
    if synchronised not in (0.0, 1.0):
        raise DataError(f"{path}: 'delay_offset' must be 0 or 1; got {synchronised:g}")
    noise = _array(fields, "noise_power", (positions,), path) if "noise_power" in fields else None
    return Sounding(
        response=torch.from_numpy(np.ascontiguousarray(response, dtype=np.complex128)),
        offsets=torch.from_numpy(_array(fields, "offsets", (points,), path)),
        frequency=frequency,
        tx=_pose(fields, "tx", (), path),
        rx=_pose(fields, "rx", (positions,), path),
        array_rx=_planar(fields, "rx", path),
        array_tx=_planar(fields, "tx", path),
        noise_power=None if noise is None else torch.from_numpy(noise),
        fov_rx=fov["fov_rx"],
        fov_tx=fov["fov_tx"],
        delay_offset=synchronised == 1.0,
    )


def _pose(fields: Fields, end: str, batch: tuple[int, ...], path: Path) -> Pose:
    position = _array(fields, f"{end}_position", (*batch, 3), path)
    orientation = (1.0, 0.0, 0.0, 0.0)
    if f"{end}_orientation" in fields:
        orientation = torch.from_numpy(_array(fields, f"{end}_orientation", (*batch, 4), path))
    return Pose(torch.from_numpy(position), orientation)


def _planar(fields: Fields, end: str, path: Path) -> PlanarArray | None:
    if f"array_{end}" not in fields:
        return None
    rows, cols, vertical, horizontal = _array(fields, f"array_{end}", (4,), path).tolist()
    if not (rows == round(rows) and cols == round(cols) and 1 <= rows <= 4096 and 1 <= cols <= 4096):
        raise DataError(
            f"{path}: 'array_{end}' must be rows, columns, vertical and horizontal spacing; got {rows:g} rows and "
            f"{cols:g} columns"
        )
    pattern = fields.get(f"pattern_{end}", "isotropic")
    if not isinstance(pattern, str):
        raise DataError(f"{path}: 'pattern_{end}' must be text, such as patch; got numbers")
    return PlanarArray(int(rows), int(cols), pattern, vertical, horizontal)


def _number(fields: Fields, name: str, path: Path, default: float | None = None) -> float:
    if name not in fields and default is not None:
        return default
    return float(_array(fields, name, (), path))


def _array(fields: Mapping[str, np.ndarray | str], name: str, shape: tuple[int, ...], path: Path) -> np.ndarray:
    """A real field of `shape`, float64; axes of length 1 may be missing or too many."""
    value = fields.get(name)
    if value is None:
        raise DataError(f"{path}: expected the field {name!r} {list(shape)}; it is missing")
    if isinstance(value, str) or np.iscomplexobj(value) or not np.isfinite(value).all():
        raise DataError(f"{path}: {name!r} must be finite real numbers; it holds something else")
    if [length for length in value.shape if length != 1] != [length for length in shape if length != 1]:
        raise DataError(f"{path}: {name!r} must be {list(shape)}; got {list(value.shape)}")
    return np.array(value, dtype=np.float64).reshape(shape)
