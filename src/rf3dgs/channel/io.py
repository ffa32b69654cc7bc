"""Paths in HDF5: ragged columns, one offset per receiver, conventions as attributes.

Layout, version 1. `offset` `[rx + 1]`: the paths of receiver i are the entries `offset[i]` to `offset[i + 1]` of every
column. Columns: `coeff_real`, `coeff_imag`, `delay` [s], `aoa_zenith`, `aoa_azimuth`, `aod_zenith`, `aod_azimuth`
[rad], and, where known, `order` and `kind`. `rx_position` `[rx, 3]` [m], `rx_orientation` `[rx, 4]` (wxyz). The columns
are compressed by gzip and shuffle; every dataset carries fletcher32 checksums, and the file format of HDF5 1.10 has
checksums of everything else, so that damage is noticed. Text attributes are fixed-length UTF-8. Any program with HDF5
1.10 or later reads such a file, MATLAB with `h5read`.
"""

import json
import math
from collections.abc import Iterator, Mapping
from contextlib import ExitStack
from pathlib import Path
from types import TracebackType

import h5py
import numpy as np
import torch

from rf3dgs.channel.binning import stack_paths
from rf3dgs.channel.paths import Paths
from rf3dgs.core.errors import DataError, InputError
from rf3dgs.core.files import atomic_file
from rf3dgs.core.frames import Pose
from rf3dgs.core.hdf5 import LIBVER, open_audited, read_array, read_attribute, write_text
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


class PathsWriter:
    """Writes the paths of one receiver after another, so that a long trace never holds more than one.

    Use it in a `with` statement: the file appears under its name when the block ends well and not at all otherwise.
    """

    def __init__(self, path: str | Path, frequency: float, tx: Pose, meta: Mapping[str, object] | None = None) -> None:
        """Open `path` for paths at `frequency` [Hz] from `tx` (one pose); `meta` is what JSON can hold in 60 kB."""
        if tx.batch_shape:
            raise InputError(f"tx must be one pose; got {list(tx.batch_shape)} of them")
        self.path = Path(path)
        self.frequency = float(frequency)
        self.tx = tx
        self._meta = json.dumps(dict(meta or {}), allow_nan=False)
        self._stack = ExitStack()
        self._file: h5py.File | None = None
        self._columns: tuple[str, ...] = ()
        self._offset = [0]
        self._rx: list[Pose] = []

    def __enter__(self) -> "PathsWriter":
        with ExitStack() as stack:
            temporary = stack.enter_context(atomic_file(self.path))
            file = stack.enter_context(h5py.File(temporary, "w", libver=LIBVER))
            for name, text in {**CONVENTIONS, "schema": SCHEMA, "meta": self._meta}.items():
                write_text(file.attrs, name, text)
            file.attrs["version"] = VERSION
            file.attrs["frequency"] = self.frequency
            self._file, self._stack = file, stack.pop_all()
        return self

    def append(self, paths: Paths) -> None:
        """Add the valid paths of one receiver (no batch) or of several `[rx, path]`."""
        if paths.coeff.dim() == 2:
            for index in range(len(paths.rx)):
                self.append(paths[index])
            return
        if self._file is None:
            raise InputError(f"the writer of {self.path} is not open; use it in a with statement")
        if paths.coeff.dim() != 1:
            raise InputError(f"append takes the paths of one or more receivers; got shape {list(paths.coeff.shape)}")
        if paths.frequency != self.frequency:
            raise InputError(f"{self.path} holds paths at {self.frequency} Hz; got {paths.frequency} Hz")
        if not torch.equal(paths.tx.position, self.tx.position):
            raise InputError(
                f"{self.path} holds paths from {self.tx.position.tolist()}; got some from "
                f"{paths.tx.position.tolist()}. Write one file per transmitter"
            )
        columns = _columns(paths)
        if not all(np.isfinite(value).all() for value in columns.values()):
            raise InputError(f"paths for {self.path} have NaN or infinite values; mark such entries as not valid")
        if not self._columns:
            self._columns = tuple(columns)
            for name, value in columns.items():
                self._create(name, value.dtype)
        if tuple(columns) != self._columns:
            raise InputError(f"{self.path} holds the columns {self._columns}; got {tuple(columns)}")
        end = self._offset[-1] + len(columns["delay"])
        for name, value in columns.items():
            dataset = self._file[name]
            assert isinstance(dataset, h5py.Dataset)
            dataset.resize((end,))
            dataset[self._offset[-1] :] = value
        self._offset.append(end)
        self._rx.append(paths.rx)

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        try:
            if kind is None:
                self._finish()
        except BaseException as failure:
            self._stack.__exit__(type(failure), failure, failure.__traceback__)
            raise
        self._stack.__exit__(kind, error, trace)

    def _create(self, name: str, dtype: np.dtype) -> None:
        assert self._file is not None
        self._file.create_dataset(
            name,
            shape=(0,),
            maxshape=(None,),
            chunks=(CHUNK,),
            dtype=dtype,
            compression="gzip",
            compression_opts=4,
            shuffle=True,
            fletcher32=True,
        )

    def _finish(self) -> None:
        assert self._file is not None
        file = self._file
        if not self._rx:
            raise InputError(f"no receiver was written to {self.path}; append the paths of at least one")
        head = {
            "offset": np.asarray(self._offset, dtype=np.int64),
            "rx_position": torch.stack([rx.position for rx in self._rx]).numpy(),
            "rx_orientation": torch.stack([rx.orientation for rx in self._rx]).numpy(),
            "tx_position": self.tx.position.numpy(),
            "tx_orientation": self.tx.orientation.numpy(),
        }
        for name, value in head.items():
            file.create_dataset(name, data=value, fletcher32=True)


def _columns(paths: Paths) -> dict[str, np.ndarray]:
    valid = paths.valid
    coeff = paths.coeff[valid]
    columns = {"coeff_real": coeff.real.float().numpy(), "coeff_imag": coeff.imag.float().numpy()}
    for name in FLOATS[2:]:
        columns[name] = getattr(paths, name)[valid].float().numpy()
    for name in INTEGERS:
        value = getattr(paths, name)
        if value is not None:
            columns[name] = value[valid].to(torch.int8).numpy()
    return columns


def save_paths(paths: Paths, path: str | Path, *, meta: Mapping[str, object] | None = None) -> None:
    """Write paths `[*batch, path]` to an HDF5 file; batches of several axes become one list of receivers."""
    with PathsWriter(path, paths.frequency, paths.tx, meta) as writer:
        writer.append(paths.flat())


def load_paths(path: str | Path) -> Paths:
    """Read paths `[rx, path]`, padded to the longest receiver. DataError names a damaged, unsafe or foreign file."""
    with PathsReader(path) as reader:
        return stack_paths(list(reader))


class PathsReader:
    """The receivers of a file of paths, read one at a time; `len`, indexing, iteration and `with`.

    `meta` is what the writer was given; `frequency` [Hz]; `tx` one pose; `rx` `[rx]` poses.
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
        except (InputError, ValueError, TypeError, OSError, RuntimeError) as error:
            raise DataError(f"{self.path}: its head is damaged ({error}); write it again") from error
        offset = self._offset
        if offset.ndim != 1 or len(offset) < 2 or offset[0] != 0 or bool((np.diff(offset) < 0).any()):
            raise DataError(f"{self.path}: 'offset' must rise from 0 with one entry per receiver and one more")
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

    def __iter__(self) -> Iterator[Paths]:
        return (self[index] for index in range(len(self)))

    def __enter__(self) -> "PathsReader":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the file."""
        self._file.close()
