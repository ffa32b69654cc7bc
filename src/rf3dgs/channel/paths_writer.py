"""`PathsWriter`: an HDF5 file of paths, one receiver after another; `paths_file` says its layout and reads it."""

import json
from collections.abc import Mapping
from contextlib import ExitStack
from io import BytesIO
from pathlib import Path
from types import TracebackType

import h5py
import numpy as np
import torch

from rf3dgs.channel.paths import Paths
from rf3dgs.channel.paths_file import CHUNK, CONVENTIONS, FLOATS, INTEGERS, SCHEMA, VERSION
from rf3dgs.core.errors import InputError
from rf3dgs.core.files import atomic_file
from rf3dgs.core.frames import Pose
from rf3dgs.core.hdf5 import LIBVER, write_text


class PathsWriter:
    """Writes the paths of one receiver after another, so that a long trace never holds more than one.

    Use it in a `with` statement: the file appears under its name when the block ends well and not at all otherwise.
    """

    def __init__(
        self, path: str | Path | BytesIO, frequency: float, tx: Pose, meta: Mapping[str, object] | None = None
    ) -> None:
        """Open `path` for paths at `frequency` [Hz] from `tx` (one pose); `meta` is what JSON can hold in 60 kB.

        An empty `BytesIO` in place of a path gets the bytes of the file. The same paths give the same bytes.
        """
        if tx.batch_shape:
            raise InputError(f"tx must be one pose; got {list(tx.batch_shape)} of them")
        self.path = path if isinstance(path, BytesIO) else Path(path)
        self.frequency = float(frequency)
        self.tx = tx
        self._meta = json.dumps(dict(meta or {}), allow_nan=False)
        self._stack = ExitStack()
        self._file: h5py.File | None = None
        self._columns: dict[str, h5py.Dataset] = {}
        self._offset = [0]
        self._rx: list[Pose] = []
        self._traced: list[int | None] = []

    def __enter__(self) -> "PathsWriter":
        with ExitStack() as stack:
            target = self.path
            temporary = target if isinstance(target, BytesIO) else stack.enter_context(atomic_file(target))
            file = stack.enter_context(h5py.File(temporary, "w", libver=LIBVER))
            for name, text in {**CONVENTIONS, "schema": SCHEMA, "meta": self._meta}.items():
                write_text(file.attrs, name, text)
            file.attrs["version"] = VERSION
            file.attrs["frequency"] = self.frequency
            self._file, self._stack = file, stack.pop_all()
        return self

    def append(self, paths: Paths, *, traced: int | None = None) -> None:
        """Add the valid paths of one receiver (no batch) or of several `[rx, path]`.

        traced: how many paths the tracer found for each of these receivers, before diffuse ones were merged.
        """
        if paths.coeff.dim() == 2:
            for index in range(len(paths.rx)):
                self.append(paths[index], traced=traced)
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
            self._columns = {name: self._create(name, value.dtype) for name, value in columns.items()}
        if list(columns) != list(self._columns):
            raise InputError(f"{self.path} holds the columns {tuple(self._columns)}; got {tuple(columns)}")
        end = self._offset[-1] + len(columns["delay"])
        for name, value in columns.items():
            self._columns[name].resize((end,))
            self._columns[name][self._offset[-1] :] = value
        self._offset.append(end)
        self._rx.append(paths.rx)
        self._traced.append(traced)

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

    def _create(self, name: str, dtype: np.dtype) -> h5py.Dataset:
        assert self._file is not None
        return self._file.create_dataset(
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
        # Space in the file is given out when a dataset is flushed. Left to the moment when Python drops the dataset,
        # which a profiler or a debugger may put off, the same paths would make files of different bytes.
        for dataset in self._columns.values():
            dataset.flush()
        if not self._rx:
            raise InputError(f"no receiver was written to {self.path}; append the paths of at least one")
        head = {
            "offset": np.asarray(self._offset, dtype=np.int64),
            "rx_position": torch.stack([rx.position for rx in self._rx]).numpy(),
            "rx_orientation": torch.stack([rx.orientation for rx in self._rx]).numpy(),
            "tx_position": self.tx.position.numpy(),
            "tx_orientation": self.tx.orientation.numpy(),
        }
        traced = [number for number in self._traced if number is not None]
        if len(traced) == len(self._rx):
            head["rx_traced"] = np.asarray(traced, dtype=np.int64)
        for name, value in head.items():
            file.create_dataset(name, data=value, fletcher32=True).flush()


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
