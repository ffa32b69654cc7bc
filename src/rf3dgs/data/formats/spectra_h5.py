"""Spectra in HDF5: physical values as scaled integers, readable by any HDF5 program.

Every array says in its attributes `scale`, `offset`, `unit` and `missing` how a stored integer becomes a value:
`integer * scale + offset`, and no value where it equals `missing`. Departures are unit vectors in the octahedral map:
two components in [-1, 1], stored one after the other (`aod` `[position, 2, row, col]`). Text is fixed-length UTF-8.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import torch
from torch import Tensor

from rf3dgs.core.errors import DataError, InputError
from rf3dgs.core.frames import Pose
from rf3dgs.core.grids import DirectionGrid, equirect_grid, list_grid, pinhole_grid
from rf3dgs.core.hdf5 import LIBVER, open_audited, read_array, read_attribute, write_text
from rf3dgs.core.units import power_from_db
from rf3dgs.spectra.spectrum import Instrument, Spectrum

SCHEMA = "rf3dgs.spectra"
VERSION = 1
LAST = 65_535  # the largest code of uint16; 0 means missing


@dataclass(frozen=True)
class Precision:
    """How finely spectra are stored."""

    gain_db: float = 0.005
    """Step of the gain [dB]; coarser where the span of the data needs it."""
    delay: float = 10e-12
    """Step of the delay [s]; coarser where the longest delay needs it."""
    aod: float = 1 / 2048
    """Step of the two octahedral components of the departure; 1/2048 keeps directions within 0.06 degrees."""
    floor_db: float | None = None
    """Power below this [dB] is stored as no power, without delay and departure; None stores all."""


def write_spectra(
    path: Path,
    spectra: Spectrum,
    repeat: Spectrum | None = None,
    index: Tensor | None = None,
    how: Precision | None = None,
    *,
    meta: Mapping[str, Any] | None = None,
) -> None:
    """Write spectra `[position]`, and a second solve `repeat` of the positions `index`, to an HDF5 file.

    `meta`: its "generator" (what made the spectra) and "seed" become attributes.
    """
    how = how or Precision()
    meta = meta or {}
    with h5py.File(path, "w", libver=LIBVER) as file:
        write_text(file.attrs, "schema", SCHEMA)
        file.attrs["version"] = VERSION
        for name in ("generator", "seed"):
            write_text(file.attrs, name, str(meta.get(name, "")))
        _write_group(file.create_group("spectra"), spectra, how)
        if repeat is not None and index is not None:
            group = file.create_group("repeat")
            _write_group(group, repeat, how)
            group.create_dataset("index", data=index.numpy().astype(np.int32), track_times=False)


def read_spectra(path: Path) -> tuple[Spectrum, Spectrum | None, Tensor | None]:
    """Read what `write_spectra` wrote; DataError for damage, another schema version, or units other than expected."""
    with open_audited(path) as file:
        schema, version = read_attribute(file, "schema"), read_attribute(file, "version")
        if schema != SCHEMA or version != VERSION:
            raise DataError(
                f"{path}: expected schema {SCHEMA} version {VERSION}; got {schema} version {version}. "
                "Save the dataset with this version of rf3dgs, or read it with the version that wrote it"
            )
        try:
            spectra = _read_group(_group(file, "spectra"))
            if "repeat" not in file:
                return spectra, None, None
            group = _group(file, "repeat")
            index = torch.from_numpy(read_array(group, "index").astype(np.int64))
            return spectra, _read_group(group), index
        except (InputError, ValueError, RuntimeError, TypeError) as error:
            raise DataError(f"{path}: {error}") from error


def _group(file: h5py.File, name: str) -> h5py.Group:
    group = file.get(name)
    if not isinstance(group, h5py.Group):
        raise DataError(f"{file.filename}: expected the group {name!r}; it is missing")
    return group


def _write_group(group: h5py.Group, spectrum: Spectrum, how: Precision) -> None:
    if len(spectrum.pose.batch_shape) != 1:
        raise InputError(f"spectra to be saved must be [position, row, col]; got {list(spectrum.power.shape)}")
    if not bool(torch.isfinite(spectrum.power).all()) or bool((spectrum.power < 0).any()):
        raise InputError("spectra to be saved must have finite, non-negative power; check what made them")
    write_text(group.attrs, "method", spectrum.method)
    write_text(group.attrs, "instrument", spectrum.instrument.name)
    _write_quantity(group, "frequency", spectrum.frequency, "Hz")
    _write_quantity(group, "lobe", spectrum.instrument.lobe, "rad")
    _write_quantity(group, "beam_solid_angle", spectrum.instrument.beam_solid_angle, "sr")
    _write_grid(group, spectrum.grid)
    _write_pose(group, "", spectrum.pose)
    if spectrum.tx is not None:
        _write_pose(group, "tx_", spectrum.tx)
    gain = spectrum.gain_db.double().numpy()
    some = (spectrum.power > 0).numpy() & (gain > -np.inf if how.floor_db is None else gain >= how.floor_db)
    _write_scaled(group, "gain", gain, some, step=how.gain_db, unit="dB")
    if spectrum.delay is not None:
        _write_scaled(group, "delay", spectrum.delay.double().numpy(), some, step=how.delay, unit="s")
    if spectrum.aod is not None:
        components = np.moveaxis(octahedral_of(spectrum.aod.double().numpy()), -1, 1)
        known = np.repeat(some[:, None], 2, axis=1)
        _write_scaled(group, "aod", components, known, step=how.aod, unit="octahedral", low=-1.0)


def _write_quantity(group: h5py.Group, name: str, value: float | np.ndarray, unit: str) -> None:
    group.attrs[name] = value
    write_text(group.attrs, f"{name}_unit", unit)


def _write_scaled(
    group: h5py.Group,
    name: str,
    values: np.ndarray,
    some: np.ndarray,
    *,
    step: float,
    unit: str,
    low: float | None = None,
) -> None:
    """Store values where `some`, as uint16 codes 1 ... 65535 of `step`, made coarser where the span needs it."""
    chosen = values[some]
    if not np.isfinite(chosen).all():
        raise InputError(f"{name} has NaN or infinite values where power arrives; mask them by zero power")
    if low is None:
        low = float(chosen.min(initial=np.inf)) if chosen.size else 0.0
    high = float(chosen.max(initial=low))
    scale = max(step, (high - low) / (LAST - 2))
    offset = low - scale
    codes = np.zeros(values.shape, dtype=np.uint16)
    codes[some] = np.clip(np.rint((chosen - offset) / scale), 1, LAST).astype(np.uint16)
    chunk = (*(1,) * (codes.ndim - 2), *codes.shape[-2:])
    dataset = group.create_dataset(
        name, data=codes, chunks=chunk, compression="gzip", compression_opts=9, shuffle=True, fletcher32=True
    )
    dataset.attrs["scale"], dataset.attrs["offset"], dataset.attrs["missing"] = scale, offset, 0
    write_text(dataset.attrs, "unit", unit)


def _read_scaled(group: h5py.Group, name: str, unit: str) -> tuple[np.ndarray, np.ndarray]:
    """Values (0 where missing) as float64, and where they are known."""
    codes = read_array(group, name)
    dataset = group[name]
    if codes.dtype != np.uint16:
        raise DataError(f"{group.file.filename}: {dataset.name!r} must be uint16; got {codes.dtype}")
    _expect_unit(dataset, "unit", unit)
    scale, offset, missing = (float(read_attribute(dataset, key)) for key in ("scale", "offset", "missing"))  # type: ignore[arg-type]
    if not (np.isfinite(scale) and scale > 0 and np.isfinite(offset)):
        raise DataError(f"{group.file.filename}: {dataset.name!r} has scale {scale}, offset {offset}; expected finite")
    some = codes != missing
    return np.where(some, codes * scale + offset, 0.0), some


def _read_group(group: h5py.Group) -> Spectrum:
    _expect_unit(group, "frequency_unit", "Hz")
    _expect_unit(group, "lobe_unit", "rad")
    _expect_unit(group, "beam_solid_angle_unit", "sr")
    gain, some = _read_scaled(group, "gain", "dB")
    power = torch.where(torch.from_numpy(some), power_from_db(torch.from_numpy(gain)), 0.0).float()
    delay = aod = None
    if "delay" in group:
        delay = torch.from_numpy(_read_scaled(group, "delay", "s")[0]).float()
    if "aod" in group:
        components, _ = _read_scaled(group, "aod", "octahedral")
        aod = torch.from_numpy(vector_of(np.moveaxis(components, 1, -1))).float()
        aod = torch.where(torch.from_numpy(some)[..., None], aod, 0.0)
    instrument = Instrument(
        str(read_attribute(group, "instrument")), _number(group, "lobe"), _number(group, "beam_solid_angle")
    )
    return Spectrum(
        power,
        _read_grid(group),
        _read_pose(group, ""),
        _number(group, "frequency"),
        instrument,
        str(read_attribute(group, "method")),
        delay,
        aod,
        _read_pose(group, "tx_") if "tx_position" in group else None,
    )


def _number(group: h5py.Group, name: str) -> float:
    value = read_attribute(group, name)
    if not isinstance(value, int | float) or not np.isfinite(value) or value <= 0:
        raise DataError(f"{group.file.filename}: {name} must be a positive number; got {value!r}")
    return float(value)


def _expect_unit(item: h5py.HLObject, key: str, unit: str) -> None:
    found = read_attribute(item, key)
    if found != unit:
        raise DataError(
            f"{item.file.filename}: {item.name!r} has {key} {found!r}; expected {unit!r}. "
            f"Convert the values and set the attribute to {unit!r}"
        )


def _write_pose(group: h5py.Group, prefix: str, pose: Pose) -> None:
    units = {"position": "m", "orientation": "quaternion wxyz, world_from_device"}
    for name, unit in units.items():
        values = getattr(pose, name).contiguous().numpy()
        write_text(group.create_dataset(prefix + name, data=values, track_times=False).attrs, "unit", unit)


def _read_pose(group: h5py.Group, prefix: str) -> Pose:
    position, orientation = read_array(group, prefix + "position"), read_array(group, prefix + "orientation")
    _expect_unit(group[prefix + "position"], "unit", "m")
    _expect_unit(group[prefix + "orientation"], "unit", "quaternion wxyz, world_from_device")
    return Pose(torch.from_numpy(position), torch.from_numpy(orientation))


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
        _expect_unit(group, "K_unit", "pixel")
        K = torch.as_tensor(np.asarray(read_attribute(group, "K"), dtype=np.float32))
        return pinhole_grid(int(cols), int(rows), K=K.reshape(3, 3))
    if kind == "list":
        solid_angle = torch.from_numpy(read_array(group, "solid_angle"))
        return list_grid(torch.from_numpy(read_array(group, "directions")), solid_angle)
    raise DataError(f"{group.file.filename}: grid must be equirect, pinhole or list; got {kind!r}")


def octahedral_of(vector: np.ndarray) -> np.ndarray:
    """Octahedral components `[..., 2]` in [-1, 1] of vectors `[..., 3]`; zero vectors give (0, 0)."""
    vector = vector / np.maximum(np.abs(vector).sum(-1, keepdims=True), 1e-30)
    x, y, z = vector[..., 0], vector[..., 1], vector[..., 2]
    folded_x = (1 - np.abs(y)) * np.where(x >= 0, 1.0, -1.0)
    folded_y = (1 - np.abs(x)) * np.where(y >= 0, 1.0, -1.0)
    return np.stack((np.where(z < 0, folded_x, x), np.where(z < 0, folded_y, y)), -1)


def vector_of(octahedral: np.ndarray) -> np.ndarray:
    """Unit vectors `[..., 3]` of octahedral components `[..., 2]`."""
    x, y = octahedral[..., 0], octahedral[..., 1]
    z = 1 - np.abs(x) - np.abs(y)
    fold = np.maximum(-z, 0.0)
    x = x - np.where(x >= 0, fold, -fold)
    y = y - np.where(y >= 0, fold, -fold)
    vector = np.stack((x, y, z), -1)
    return vector / np.linalg.norm(vector, axis=-1, keepdims=True)
