"""One HDF5 file of paths: ragged columns, one offset per receiver, conventions as attributes.

Layout, version 1. `offset` `[rx + 1]`: the paths of receiver i are the entries `offset[i]` to `offset[i + 1]` of every
column. Columns: `coeff_real`, `coeff_imag`, `delay` [s], `aoa_zenith`, `aoa_azimuth`, `aod_zenith`, `aod_azimuth`
[rad], and, where known, `order` and `kind`. `rx_position` `[rx, 3]` [m], `rx_orientation` `[rx, 4]` (wxyz), and, where
known, `rx_traced` `[rx]`: how many paths the tracer found before diffuse ones were merged. The columns are compressed
by gzip and shuffle; every dataset carries fletcher32 checksums, and the file format of HDF5 1.10 has checksums of
everything else, so that damage is noticed. Text attributes are fixed-length UTF-8. Any program with HDF5 1.10 or later
reads such a file, MATLAB with `h5read`.
"""

import json
import math
from collections.abc import Mapping
from pathlib import Path

import h5py
import numpy as np
import torch

from rf3dgs.channel.paths import Paths
from rf3dgs.core.errors import DataError, InputError
from rf3dgs.core.frames import Pose
from rf3dgs.core.hdf5 import open_audited, read_array, read_attribute
from rf3dgs.core.units import LONGEST_DELAY, shortest_delay

SCHEMA = "rf3dgs.paths"
VERSION = 1
CHUNK = 65_536
FLOATS = ("coeff_real", "coeff_imag", "delay", "aoa_zenith", "aoa_azimuth", "aod_zenith", "aod_azimuth")
INTEGERS = ("order", "kind")
CONVENTIONS = {
    "units": "m, s, Hz, rad, linear amplitude",
    "frames": "world: right-handed, z up; device: x forward, y left, z up; quaternion wxyz of world_from_device",
    "angles": "zenith from +z in [0, pi], azimuth from +x towards +y in (-pi, pi]; aoa seen from rx, aod from tx",
    "phase": "exp(+j 2 pi f t); coeff without the carrier's exp(-j 2 pi f delay); |coeff|^2 is the path gain",
}


class PathsFile:
    """The receivers of one file of paths; `len` and indexing.

    `meta` is what the writer was given; `frequency` [Hz]; `tx` one pose; `rx` `[rx]` poses; `traced` `[rx]` or None.
    """

    def __init__(self, path: str | Path) -> None:
        """Open and audit `path`; DataError names it when it is damaged, unsafe or something else."""
        self.path = Path(path)
        self._file = open_audited(self.path)
        try:
            self._read_head()
        except BaseException:
            self._file.close()
            raise

    def _read_head(self) -> None:
        file = self._file
        try:
            if "schema" not in file.attrs or read_attribute(file, "schema") != SCHEMA:
                raise DataError(
                    f"{self.path}: expected a file of paths with schema {SCHEMA!r}; it holds something else"
                )
            version = read_attribute(file, "version")
            if version != VERSION:
                raise DataError(f"{self.path}: schema version {version} is not {VERSION}; update rf3dgs to read it")
            self.frequency = float(read_attribute(file, "frequency"))
            self.meta: dict = json.loads(str(read_attribute(file, "meta")))
            self._offset = read_array(file, "offset").astype(np.int64)
            self.tx = Pose(*self._pose("tx", ()))
            self.rx = Pose(*self._pose("rx", (len(self._offset) - 1,)))
            self.traced = read_array(file, "rx_traced").astype(np.int64) if "rx_traced" in file else None
        except (InputError, ValueError, TypeError, OSError, RuntimeError) as error:
            raise DataError(f"{self.path}: its head is damaged ({error}); write it again") from error
        offset = self._offset
        if offset.ndim != 1 or len(offset) < 2 or offset[0] != 0 or bool((np.diff(offset) < 0).any()):
            raise DataError(f"{self.path}: 'offset' must rise from 0 with one entry per receiver and one more")
        if self.traced is not None and self.traced.shape != (len(offset) - 1,):
            raise DataError(f"{self.path}: 'rx_traced' must have one entry per receiver; it does not")
        names = [*FLOATS, *(name for name in INTEGERS if name in file)]
        self._datasets: dict[str, h5py.Dataset] = {}
        for name in names:
            dataset = file.get(name)
            if not isinstance(dataset, h5py.Dataset) or dataset.shape != (offset[-1],):
                raise DataError(f"{self.path}: the column {name!r} must have {offset[-1]} entries; it does not")
            self._datasets[name] = dataset

    def _pose(self, name: str, batch: tuple[int, ...]) -> tuple[torch.Tensor, torch.Tensor]:
        position = read_array(self._file, f"{name}_position")
        orientation = read_array(self._file, f"{name}_orientation")
        if position.shape != (*batch, 3) or orientation.shape != (*batch, 4):
            raise DataError(
                f"{self.path}: {name}_position and {name}_orientation must be {[*batch, 3]} and {[*batch, 4]}"
            )
        return torch.from_numpy(position.astype(np.float32)), torch.from_numpy(orientation.astype(np.float32))

    def __len__(self) -> int:
        return len(self._offset) - 1

    def __getitem__(self, index: int) -> Paths:
        """The paths of one receiver `[path]`."""
        if not -len(self) <= index < len(self):
            raise IndexError(f"{self.path} has {len(self)} receivers; there is no number {index}")
        index %= len(self)
        part = slice(int(self._offset[index]), int(self._offset[index + 1]))
        columns = {name: self._column(name, part) for name in self._datasets}
        self._check_units(columns, index)
        coeff = torch.complex(columns.pop("coeff_real"), columns.pop("coeff_imag"))
        valid = torch.ones(coeff.shape, dtype=torch.bool)
        return Paths(coeff=coeff, **columns, valid=valid, frequency=self.frequency, tx=self.tx, rx=self.rx[index])

    def _column(self, name: str, part: slice) -> torch.Tensor:
        try:
            value = np.asarray(self._datasets[name][part])
        except (OSError, RuntimeError, ValueError) as error:
            raise DataError(f"{self.path}: {name!r} is damaged (checksum or storage); write the file again") from error
        if name in INTEGERS:
            return torch.from_numpy(value.astype(np.int8))
        if not np.isfinite(value).all():
            raise DataError(f"{self.path}: {name!r} has NaN or infinite values; write the file again")
        return torch.from_numpy(value.astype(np.float32))

    def _check_units(self, columns: Mapping[str, torch.Tensor], index: int) -> None:
        """Refuse angles beyond a full turn, and delays that light does not have over the distance."""
        if not len(columns["delay"]):
            return
        for name, limit in {"aoa_zenith": 1, "aoa_azimuth": 2, "aod_zenith": 1, "aod_azimuth": 2}.items():
            largest = float(columns[name].abs().max())
            if largest > limit * math.pi + 1e-3:
                raise DataError(
                    f"{self.path}: {name!r} of receiver {index} reaches {largest:.4g}, expected at most {limit} pi "
                    "radians; it is in degrees, convert it to radians"
                )
        first, last = float(columns["delay"].min()), float(columns["delay"].max())
        distance = float(torch.linalg.vector_norm(self.rx[index].position - self.tx.position))
        if last > LONGEST_DELAY or first < shortest_delay(distance):
            raise DataError(
                f"{self.path}: receiver {index}, {distance:.4g} m from the transmitter, has delays from {first:.3g} to "
                f"{last:.3g} s, which light does not; positions must be in metres and delays in seconds, convert them"
            )

    def close(self) -> None:
        """Close the file."""
        self._file.close()
