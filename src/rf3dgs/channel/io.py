"""Writing and reading paths: one HDF5 file (`paths_file` says its layout), or a folder of such files.

A folder holds `manifest.json` (`core.manifest`) and the shards `00000.h5`, `00001.h5`, ...: files of paths whose `meta`
carries the digest of the manifest as `set` and the number of the first receiver as `first`.
"""

import re
from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np
import torch

from rf3dgs.channel.binning import stack_paths
from rf3dgs.channel.paths import Paths
from rf3dgs.channel.paths_file import SCHEMA, PathsFile
from rf3dgs.channel.paths_writer import PathsWriter
from rf3dgs.core.errors import DataError
from rf3dgs.core.frames import Pose
from rf3dgs.core.manifest import Manifest, load_manifest


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
