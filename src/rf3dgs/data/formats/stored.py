"""`StoredSpectra`: spectra that stay in their file until somebody looks at them."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import torch
from torch import Tensor

from rf3dgs.core.errors import DataError
from rf3dgs.core.frames import Pose
from rf3dgs.core.units import power_from_db
from rf3dgs.data.formats.spectra_codes import MISSING, Scale, vector_of
from rf3dgs.data.formats.spectra_head import Head
from rf3dgs.spectra.spectrum import Spectrum

AT_ONCE = 2**19  # pixels that a pass over many spectra holds at a time


@dataclass(frozen=True, eq=False)
class SpectraFile:
    """One group of an audited file: where its values are and how they are read.

    `stamp` is what the file was when it was audited (inode, size, time of change): reading refuses another one.
    """

    path: Path
    group: str
    stamp: tuple[int, int, int]
    head: Head

    def read(self, names: Sequence[str], index: Tensor) -> dict[str, Tensor]:
        """Values of the spectra `index` `[n]`: "power", "delay", "floor" `[n, row, col]`, "aod" `[n, row, col, 3]`."""
        shape = (len(index), *self.head.grid.shape)
        values = {name: torch.empty(*shape, 3) if name == "aod" else torch.empty(shape) for name in names}
        tables = {name: _table(name, self.head.scales["gain" if name == "power" else name]) for name in names}
        with self._opened() as group:
            for place, number in enumerate(index.tolist()):
                for name in names:
                    stored = group["gain" if name == "power" else name]
                    assert isinstance(stored, h5py.Dataset)
                    codes = np.asarray(stored[number])
                    found = tables[name][codes]
                    if name == "aod":
                        found = vector_of(np.moveaxis(found, 0, -1)) * (codes[0] != MISSING)[..., None]
                    values[name][place] = torch.from_numpy(found)
        return values

    @contextmanager
    def _opened(self) -> Iterator[h5py.Group]:
        try:
            if stamp_of(self.path) != self.stamp:
                raise DataError(f"{self.path}: was changed after the dataset was loaded; load it again")
            with h5py.File(self.path, "r", locking="best-effort") as file:
                group = file[self.group]
                assert isinstance(group, h5py.Group)
                yield group
        except (OSError, RuntimeError, ValueError, KeyError) as error:
            raise DataError(f"{self.path}: cannot be read ({error}); it is damaged, write the file again") from error


@lru_cache(maxsize=16)
def _table(name: str, scale: Scale) -> np.ndarray:
    """The physical value of each code `[65536]`, float32 but for departures, whose components are combined."""
    values = scale.values()
    if name == "aod":
        return values
    value = torch.from_numpy(values)
    value = (power_from_db(value) if name in ("power", "floor") else value).float()
    value[MISSING] = torch.inf if name == "floor" else 0.0
    return value.numpy()


def stamp_of(path: Path) -> tuple[int, int, int]:
    """What changes when a file is changed or replaced: inode, size, time of the last change [ns]."""
    status = path.stat()
    return status.st_ino, status.st_size, status.st_mtime_ns


class StoredSpectra(Spectrum):
    """A `Spectrum` `[position, row, col]` in a file: poses and grid are known, values are read when they are needed.

    `spectra[3]` and iteration read one picture; `spectra[2:9]` and `spectra[places]` read nothing yet. `power`,
    `delay`, `aod` and `floor` read what they are asked for, once, and keep it, as everything does that works on a whole
    `Spectrum` (training, evaluation, `dataclasses.replace`). Raises DataError where the file is damaged or was changed
    since.
    """

    source: SpectraFile
    index: Tensor

    def __new__(cls, *fields: Any, **named: Any) -> Spectrum:  # type: ignore[misc]
        """A plain spectrum: this is how `dataclasses.replace` makes a changed copy, which no file holds."""
        return Spectrum(*fields, **named)

    @classmethod
    def of(cls, source: SpectraFile, index: Tensor | None = None) -> "StoredSpectra":
        """The spectra `index` `[n]` of a file, all when None."""
        head = source.head
        index = torch.arange(len(head.pose)) if index is None else index
        values = {name: getattr(head, name) for name in ("grid", "frequency", "instrument", "method", "tx")}
        self = object.__new__(cls)
        values |= {"noise": None if head.noise is None else head.noise[index]}
        for name, value in (values | {"pose": head.pose[index], "source": source, "index": index}).items():
            object.__setattr__(self, name, value)
        return self

    @cached_property
    def power(self) -> Tensor:  # type: ignore[override]
        """Power `[position, row, col]`, linear; read when first asked for."""
        return self.source.read(("power",), self.index)["power"]

    @cached_property
    def delay(self) -> Tensor | None:  # type: ignore[override]
        """Delay `[position, row, col]` [s]; read when first asked for."""
        return self.source.read(("delay",), self.index)["delay"] if "delay" in self.source.head.scales else None

    @cached_property
    def aod(self) -> Tensor | None:  # type: ignore[override]
        """Departures `[position, row, col, 3]`; read when first asked for."""
        return self.source.read(("aod",), self.index)["aod"] if "aod" in self.source.head.scales else None

    @cached_property
    def floor(self) -> Tensor | None:  # type: ignore[override]
        """Floor `[position, row, col]`; read when first asked for."""
        return self.source.read(("floor",), self.index)["floor"] if "floor" in self.source.head.scales else None

    @property
    def is_whole(self) -> bool:
        """True when these are all spectra of the file's group, in its order."""
        return torch.equal(self.index, torch.arange(len(self.source.head.pose)))

    def __getitem__(self, index: int | slice | Tensor) -> Spectrum:
        """One spectrum, read; or some of them, not yet read."""
        if "power" in self.__dict__:
            return super().__getitem__(index)
        if isinstance(index, int):
            if not -len(self) <= index < len(self):
                raise IndexError(f"there are {len(self)} spectra; there is no number {index}")
            return self._read(index % len(self))
        return StoredSpectra.of(self.source, self.index[index])

    def __iter__(self) -> Iterator[Spectrum]:
        """Each spectrum `[row, col]` in turn, one in memory at a time."""
        return (self[index] for index in range(len(self)))

    def __len__(self) -> int:
        return len(self.index)

    def __repr__(self) -> str:
        grid = f"{self.grid.kind} {self.grid.width}x{self.grid.height}"
        return f"StoredSpectra({len(self)} of {self.source.path}, {grid}, {self.method})"

    def __reduce__(self) -> tuple:
        return StoredSpectra.of, (self.source, self.index)

    def _read(self, number: int) -> Spectrum:
        names = ["power", *(name for name in ("delay", "aod", "floor") if name in self.source.head.scales)]
        values = self.source.read(names, self.index[number : number + 1])
        pose: Pose = self.pose[number]
        return Spectrum(
            values["power"][0],
            self.grid,
            pose,
            self.frequency,
            self.instrument,
            self.method,
            values["delay"][0] if "delay" in values else None,
            values["aod"][0] if "aod" in values else None,
            self.tx,
            values["floor"][0] if "floor" in values else None,
            None if self.noise is None else self.noise[number],
        )


def blocks(spectra: Spectrum) -> Iterator[Spectrum]:
    """The spectra `[position, row, col]` in blocks of a few, in order, so that a pass over a file stays small."""
    step = max(1, AT_ONCE // (spectra.grid.height * spectra.grid.width))
    for start in range(0, len(spectra), step):
        yield spectra[start : start + step]
