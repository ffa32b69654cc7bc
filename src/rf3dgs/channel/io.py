"""Writing and reading paths: one HDF5 file (`paths_file` says its layout), or a folder of such files.

A folder holds `manifest.json` (`core.manifest`) and the shards `00000.h5`, `00001.h5`, ...: files of paths whose `meta`
carries the digest of the manifest as `set` and the number of the first receiver as `first`.
"""

import json
import re
from collections.abc import Iterator, Mapping
from contextlib import ExitStack
from io import BytesIO
from pathlib import Path
from types import TracebackType

import h5py
import numpy as np
import torch

from rf3dgs.channel.binning import stack_paths
from rf3dgs.channel.paths import Paths
from rf3dgs.channel.paths_file import CHUNK, CONVENTIONS, FLOATS, INTEGERS, SCHEMA, VERSION, PathsFile
from rf3dgs.core.errors import DataError, InputError
from rf3dgs.core.files import atomic_file
from rf3dgs.core.frames import Pose
from rf3dgs.core.hdf5 import LIBVER, write_text
from rf3dgs.core.manifest import Manifest, load_manifest


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


def save_paths(paths: Paths, path: str | Path, *, meta: Mapping[str, object] | None = None) -> None:
    """Write paths `[*batch, path]` to an HDF5 file; batches of several axes become one list of receivers."""
    with PathsWriter(path, paths.frequency, paths.tx, meta) as writer:
        writer.append(paths.flat())


def load_paths(path: str | Path) -> Paths:
    """Read paths `[rx, path]`, padded to the longest receiver. DataError names a damaged, unsafe or foreign file."""
    with PathsReader(path) as reader:
        return stack_paths(list(reader))


def shard_name(number: int) -> str:
    """The file of shard `number` in a folder of paths."""
    return f"{number:05d}.h5"


class PathsReader:
    """The receivers of a file of paths, or of a folder of such files, read one at a time.

    Has `len`, indexing, iteration and `with`. `meta` is what the writer was given (of a folder: what the set is made
    from and by); `frequency` [Hz]; `tx` one pose; `rx` `[rx]` poses; `traced` `[rx]` numbers of paths before diffuse
    ones were merged, or None. Of a folder one shard is open at a time.
    """

    def __init__(self, path: str | Path) -> None:
        """Open and audit `path`; DataError names it when it is damaged, unsafe, not complete or something else."""
        self.path = Path(path)
        self._manifest = _complete(self.path) if self.path.is_dir() else None
        self._number = 0
        if self._manifest is None:
            self._file = PathsFile(self.path)
            self.meta = self._file.meta
        else:
            self._file = self._shard(self._manifest, 0)
            self.meta = {"made_from": dict(self._manifest.made_from), "made_by": dict(self._manifest.made_by)}
        self.frequency, self.tx = self._file.frequency, self._file.tx
        self._heads: tuple[Pose, np.ndarray | None] | None = None

    def __len__(self) -> int:
        return len(self._file) if self._manifest is None else self._manifest.count

    def __getitem__(self, index: int) -> Paths:
        """The paths of one receiver `[path]`."""
        if not -len(self) <= index < len(self):
            raise IndexError(f"{self.path} has {len(self)} receivers; there is no number {index}")
        index %= len(self)
        if self._manifest is None:
            return self._file[index]
        number = self._manifest.shard_of(index)
        if number != self._number:
            self._file.close()
            self._file, self._number = self._shard(self._manifest, number), number
        return self._file[index - self._manifest.part(number).start]

    @property
    def rx(self) -> Pose:
        """The poses `[rx]` of all receivers; of a folder, the head of every shard is read once."""
        return self._all_heads()[0]

    @property
    def traced(self) -> np.ndarray | None:
        """How many paths `[rx]` the tracer found before diffuse ones were merged; None where that is not known."""
        return self._all_heads()[1]

    def _all_heads(self) -> tuple[Pose, np.ndarray | None]:
        if self._manifest is None:
            return self._file.rx, self._file.traced
        if self._heads is None:
            poses, traced = [], []
            for number in range(self._manifest.shards):
                file = self._shard(self._manifest, number)
                file.close()
                poses.append(file.rx)
                traced.append(file.traced)
            position, orientation = (
                torch.cat([getattr(p, name) for p in poses]) for name in ("position", "orientation")
            )
            known = [part for part in traced if part is not None]
            self._heads = Pose(position, orientation), np.concatenate(known) if len(known) == len(traced) else None
        return self._heads

    def _shard(self, manifest: Manifest, number: int) -> PathsFile:
        """Open one shard; DataError when it is another set's."""
        file = PathsFile(self.path / shard_name(number))
        part = manifest.part(number)
        own = (file.meta.get("set"), file.meta.get("first"), len(file)) == (manifest.digest, part.start, len(part))
        first = not hasattr(self, "tx") or (file.frequency == self.frequency and _same(file.tx, self.tx))
        if not (own and first):
            file.close()
            raise DataError(
                f"{file.path} does not belong to this set: another run wrote it; delete it and run the same "
                "rf3dgs trace command again"
            )
        return file

    def __iter__(self) -> Iterator[Paths]:
        return (self[index] for index in range(len(self)))

    def __enter__(self) -> "PathsReader":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the file."""
        self._file.close()


def _complete(folder: Path) -> Manifest:
    """The manifest of a folder that has all of its shards."""
    manifest = load_manifest(folder)
    if manifest.schema != SCHEMA:
        raise DataError(f"{folder}: expected a folder of paths with schema {SCHEMA!r}; it holds {manifest.schema!r}")
    names = (item.name for item in folder.iterdir())
    numbers = {int(name.removesuffix(".h5")) for name in names if re.fullmatch(r"\d{5,9}\.h5", name)}
    there = sum(number < manifest.shards for number in numbers)
    if there < manifest.shards:
        raise DataError(
            f"{folder} has {there} of {manifest.shards} shards; run the same rf3dgs trace command again, which makes "
            "the missing ones"
        )
    return manifest


def _same(one: Pose, other: Pose) -> bool:
    return torch.equal(one.position, other.position) and torch.equal(one.orientation, other.orientation)
