"""The head of a group of spectra: grid, poses, frequency, instrument, method; every quantity with its unit."""

import math
from dataclasses import dataclass

import h5py
import numpy as np
import torch
from torch import Tensor

from rf3dgs.channel.arrays import PlanarArray
from rf3dgs.core.errors import DataError, InputError
from rf3dgs.core.frames import Pose
from rf3dgs.core.grids import DirectionGrid, equirect_grid, list_grid, pinhole_grid
from rf3dgs.core.hdf5 import read_array, read_attribute, write_text
from rf3dgs.data.formats.spectra_codes import MISSING, Scale
from rf3dgs.spectra.spectrum import Instrument, Spectrum

UNITS = {"gain": "dB", "delay": "s", "aod": "octahedral", "floor": "dB"}
NOISE = "linear power"


@dataclass(frozen=True, eq=False)
class Head:
    """What is known of a group of spectra before their values are read: the fields of `Spectrum`, and the scales."""

    grid: DirectionGrid
    pose: Pose
    frequency: float
    instrument: Instrument
    method: str
    tx: Pose | None
    scales: dict[str, Scale]
    noise: Tensor | None = None


def write_head(group: h5py.Group, spectrum: Spectrum | Head) -> None:
    """Write all of the head but the receivers' poses and noise."""
    write_text(group.attrs, "method", spectrum.method)
    write_text(group.attrs, "instrument", spectrum.instrument.name)
    _write_quantity(group, "frequency", spectrum.frequency, "Hz")
    _write_quantity(group, "lobe", spectrum.instrument.lobe, "rad")
    _write_quantity(group, "beam_solid_angle", spectrum.instrument.beam_solid_angle, "sr")
    _write_grid(group, spectrum.grid)
    _write_array(group, spectrum.instrument)
    if spectrum.tx is not None:
        write_pose(group, "tx_", spectrum.tx)


def read_head(group: h5py.Group) -> Head:
    """The head of an audited group; DataError for what is missing, does not fit together, or has another unit."""
    for name, unit in (("frequency", "Hz"), ("lobe", "rad"), ("beam_solid_angle", "sr")):
        expect_unit(group, f"{name}_unit", unit)
    scales = {name: _read_scale(group, name) for name in UNITS if name == "gain" or name in group}
    instrument = Instrument(
        str(read_attribute(group, "instrument")),
        _number(group, "lobe"),
        _number(group, "beam_solid_angle"),
        *_read_array(group),
    )
    head = Head(
        grid=_read_grid(group),
        pose=read_pose(group, ""),
        frequency=_number(group, "frequency"),
        instrument=instrument,
        method=str(read_attribute(group, "method")),
        tx=read_pose(group, "tx_") if "tx_position" in group else None,
        scales=scales,
        noise=_read_noise(group),
    )
    if head.noise is not None and tuple(head.noise.shape) != head.pose.batch_shape:
        raise DataError(f"{group.file.filename}: noise must be {list(head.pose.batch_shape)}, one a spectrum")
    for name in scales:
        between = (2,) if name == "aod" else ()
        expected = (*head.pose.batch_shape, *between, *head.grid.shape)
        shape = tuple(getattr(group[name], "shape", ()))
        if shape != expected:
            where = f"{group.file.filename}: '{group.name}/{name}'"
            raise DataError(f"{where} must be {list(expected)}, poses and grid; got {list(shape)}")
    return head


def write_pose(group: h5py.Group, prefix: str, pose: Pose) -> None:
    """Write `position` [m] and `orientation`, their names led by `prefix`."""
    units = {"position": "m", "orientation": "quaternion wxyz, world_from_device"}
    for name, unit in units.items():
        values = getattr(pose, name).contiguous().numpy()
        write_text(group.create_dataset(prefix + name, data=values, track_times=False).attrs, "unit", unit)


def read_pose(group: h5py.Group, prefix: str) -> Pose:
    """What `write_pose` wrote."""
    position, orientation = read_array(group, prefix + "position"), read_array(group, prefix + "orientation")
    expect_unit(group[prefix + "position"], "unit", "m")
    expect_unit(group[prefix + "orientation"], "unit", "quaternion wxyz, world_from_device")
    return Pose(torch.from_numpy(position), torch.from_numpy(orientation))


def write_noise(group: h5py.Group, noise: Tensor) -> None:
    """Write the noise `[position]` of array pictures."""
    dataset = group.create_dataset("noise", data=noise.double().contiguous().numpy(), track_times=False)
    write_text(dataset.attrs, "unit", NOISE)


def _read_noise(group: h5py.Group) -> Tensor | None:
    if "noise" not in group:
        return None
    values = read_array(group, "noise")
    expect_unit(group["noise"], "unit", NOISE)
    if not (np.isfinite(values).all() and (values >= 0).all()):
        raise DataError(f"{group.file.filename}: noise must be finite powers of at least 0; write the file again")
    return torch.from_numpy(values.astype(np.float64))


def _write_array(group: h5py.Group, instrument: Instrument) -> None:
    """Write the array that took the pictures, where one is known."""
    array = instrument.array
    if array is None:
        return
    group.attrs["array_rows"], group.attrs["array_cols"] = array.rows, array.cols
    write_text(group.attrs, "array_pattern", array.pattern)
    _write_quantity(group, "array_spacing", np.array([array.vertical, array.horizontal]), "wavelength")
    _write_quantity(group, "array_fov", instrument.fov, "rad")


def _read_array(group: h5py.Group) -> tuple[PlanarArray | None, float]:
    """The array and its elements' vertical field of view [rad]; None and pi where the file names none."""
    if "array_rows" not in group.attrs:
        return None, math.pi
    expect_unit(group, "array_spacing_unit", "wavelength")
    expect_unit(group, "array_fov_unit", "rad")
    rows, cols = (int(_number(group, f"array_{name}")) for name in ("rows", "cols"))
    spacing = np.asarray(read_attribute(group, "array_spacing"), dtype=np.float64).reshape(-1)
    if spacing.shape != (2,):
        raise DataError(f"{group.file.filename}: array_spacing must be two numbers; got {spacing.size}")
    try:
        array = PlanarArray(
            rows, cols, str(read_attribute(group, "array_pattern")), float(spacing[0]), float(spacing[1])
        )
    except InputError as error:
        raise DataError(f"{group.file.filename}: the array is not one ({error}); write the file again") from error
    return array, min(_number(group, "array_fov"), math.pi)


def expect_unit(item: h5py.HLObject, key: str, unit: str) -> None:
    """DataError where the attribute `key` is another than `unit`."""
    found = read_attribute(item, key)
    if found != unit:
        raise DataError(
            f"{item.file.filename}: {item.name!r} has {key} {found!r}; expected {unit!r}. "
            f"Convert the values and set the attribute to {unit!r}"
        )


def _read_scale(group: h5py.Group, name: str) -> Scale:
    dataset = group.get(name)
    if not isinstance(dataset, h5py.Dataset):
        raise DataError(f"{group.file.filename}: expected the dataset '{group.name}/{name}'; it is missing")
    if dataset.dtype != np.uint16:
        raise DataError(f"{group.file.filename}: {dataset.name!r} must be uint16; got {dataset.dtype}")
    expect_unit(dataset, "unit", UNITS[name])
    scale, offset, missing = (float(read_attribute(dataset, key)) for key in ("scale", "offset", "missing"))  # type: ignore[arg-type]
    if not (np.isfinite(scale) and scale > 0 and np.isfinite(offset)):
        raise DataError(f"{group.file.filename}: {dataset.name!r} has scale {scale}, offset {offset}; expected finite")
    if missing != MISSING:
        raise DataError(f"{group.file.filename}: {dataset.name!r} has missing {missing:g}; expected {MISSING}")
    return Scale(scale, offset)


def _write_quantity(group: h5py.Group, name: str, value: float | np.ndarray, unit: str) -> None:
    group.attrs[name] = value
    write_text(group.attrs, f"{name}_unit", unit)


def _number(group: h5py.Group, name: str) -> float:
    value = read_attribute(group, name)
    if not isinstance(value, int | float) or not np.isfinite(value) or value <= 0:
        raise DataError(f"{group.file.filename}: {name} must be a positive number; got {value!r}")
    return float(value)


def _write_grid(group: h5py.Group, grid: DirectionGrid) -> None:
    write_text(group.attrs, "grid", grid.kind)
    group.attrs["rows"], group.attrs["cols"] = grid.height, grid.width
    if grid.K is not None:
        _write_quantity(group, "K", grid.K.numpy(), "pixel")
    if grid.kind == "list":
        directions = group.create_dataset("directions", data=grid.directions[0].numpy(), track_times=False)
        write_text(directions.attrs, "unit", "unit vector, device frame")
        solid_angle = group.create_dataset("solid_angle", data=grid.solid_angle[0].numpy(), track_times=False)
        write_text(solid_angle.attrs, "unit", "sr")


def _read_grid(group: h5py.Group) -> DirectionGrid:
    kind, rows, cols = (read_attribute(group, key) for key in ("grid", "rows", "cols"))
    gain = group["gain"]
    if not isinstance(gain, h5py.Dataset) or gain.ndim != 3 or gain.shape[1:] != (rows, cols):
        raise DataError(f"{group.file.filename}: {group.name!r} has a grid of {rows}x{cols}, but gain of another size")
    if kind == "equirect":
        return equirect_grid(int(cols), int(rows))
    if kind == "pinhole":
        expect_unit(group, "K_unit", "pixel")
        K = torch.as_tensor(np.asarray(read_attribute(group, "K"), dtype=np.float32))
        return pinhole_grid(int(cols), int(rows), K=K.reshape(3, 3))
    if kind == "list":
        solid_angle = torch.from_numpy(read_array(group, "solid_angle"))
        return list_grid(torch.from_numpy(read_array(group, "directions")), solid_angle)
    raise DataError(f"{group.file.filename}: grid must be equirect, pinhole or list; got {kind!r}")
