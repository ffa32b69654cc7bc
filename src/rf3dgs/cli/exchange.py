"""`import` and `export`: paths from and for other programs."""

from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import tyro

from rf3dgs.cli.show import console, out
from rf3dgs.core.errors import DataError, InputError

if TYPE_CHECKING:
    from rf3dgs.channel.paths import Paths

Kind = Literal["deepmimo", "paths", "sounding"]
HDF5 = (".h5", ".hdf5")
SOUNDINGS = (*HDF5, ".mat", ".csv")
FEW = 25
"""Paths per receiver in formats that hold the strongest only, unless told otherwise."""


@dataclass(frozen=True)
class Import:
    """Read paths of another program, or estimate them from a measurement, into a paths file."""

    source: tyro.conf.Positional[Path]
    """A DeepMIMO v4 scenario folder, a paths file or folder of ours (.paths, .h5), or a measured sounding (.h5, .mat,
    .csv), whose paths SAGE estimates."""
    out: Path = Path("imported.paths")
    """The paths file to write."""
    pair: str | None = None
    """Of a DeepMIMO folder with several transmitters or receiver sets: which one, such as t001_tx000_r000."""
    count: int | None = None
    """Of a sounding: paths to estimate per receiver; as many as the data tell unless given."""
    untold: Literal["refuse", "ahead"] = "refuse"
    """Of a sounding whose arrays do not tell zenith and azimuth: "ahead" takes what is missing as straight ahead of the
    device."""

    def run(self) -> int:
        """Read everything first, then write the file, at once or not at all."""
        from rf3dgs.channel.io import PathsWriter
        from rf3dgs.core.progress import track

        kind = kind_of(self.source)
        if self.out.resolve() == self.source.resolve():
            raise InputError(f"--out {self.out} is the source itself; choose another name")
        untold = None if self.untold == "refuse" else self.untold
        given = (("pair", self.pair, "deepmimo"), ("count", self.count, "sounding"), ("untold", untold, "sounding"))
        for name, value, owner in given:
            if value is not None and kind != owner:
                what = "DeepMIMO folders" if owner == "deepmimo" else "measured soundings"
                raise InputError(f"--{name} is for {what}; {self.source} is none")
        with ExitStack() as stack:
            rows, total, meta = self._rows(kind, stack)
            progress = track(rows, "import", total, console())
            first = next(progress)
            meta = {**meta, "imported": kind, "from": self.source.name}
            with PathsWriter(self.out, first.frequency, first.tx, meta) as writer:
                writer.append(first)
                for row in progress:
                    writer.append(row)
        out(f"{self.out}: {total} receivers, {self.out.stat().st_size / 1e6:.1f} MB")
        return 0

    def _rows(self, kind: Kind, stack: ExitStack) -> "tuple[Iterator[Paths], int, dict]":
        """The paths of one receiver after the other, how many there are, and what the source says of itself."""
        if kind == "paths":
            from rf3dgs.channel.io import PathsReader

            reader = stack.enter_context(PathsReader(self.source))
            return iter(reader), len(reader), reader.meta
        if kind == "deepmimo":
            from rf3dgs.propagation.exchange.deepmimo import read_deepmimo

            paths = read_deepmimo(self.source, self.pair)
        else:
            from rf3dgs.propagation.exchange.measured import read_sounding
            from rf3dgs.spectra.sage import sage

            paths = sage(read_sounding(self.source), self.count, untold=self.untold, progress=console()).flat()
        return (paths[index] for index in range(len(paths.rx))), len(paths.rx), {}


@dataclass(frozen=True)
class Export:
    """Write paths for another program: DeepMIMO, MATLAB, or anything that reads HDF5."""

    paths: tyro.conf.Positional[Path]
    """A paths file, or a folder of them, such as rf3dgs trace and rf3dgs import write."""
    to: Literal["deepmimo", "matlab", "mat", "hdf5"]
    """A DeepMIMO v4 folder; a MATLAB function (.m) that makes comm.Ray objects; a .mat file; one HDF5 file with a
    MATLAB function that reads it."""
    out: Path
    """The folder or file to write; an older one of its kind is replaced."""
    strongest: int | None = None
    """Keep only so many paths of each receiver; 25 for deepmimo and matlab, all for mat and hdf5 unless given."""

    def run(self) -> int:
        """Read receiver by receiver and write, at once or not at all."""
        from rf3dgs.channel.binning import stack_paths
        from rf3dgs.channel.io import PathsReader, PathsWriter
        from rf3dgs.core.progress import track
        from rf3dgs.propagation.exchange import matlab
        from rf3dgs.propagation.exchange.deepmimo_write import write_deepmimo

        if self.strongest is not None and self.strongest < 1:
            raise InputError(f"--strongest must be at least 1; got {self.strongest}")
        suffixes = {"matlab": (".m",), "mat": (".mat",), "hdf5": (*HDF5, ".paths"), "deepmimo": ()}[self.to]
        if suffixes and self.out.suffix.lower() not in suffixes:
            raise InputError(f"--out must end in {' or '.join(suffixes)} for --to {self.to}; got {self.out}")
        if self.out.resolve() == self.paths.resolve():
            raise InputError(f"--out {self.out} is the source itself; choose another name")
        keep = FEW if self.strongest is None and self.to in ("deepmimo", "matlab") else self.strongest
        with PathsReader(self.paths) as reader:
            rows = track(reader, "export", len(reader), console())
            kept = (row if keep is None else row.strongest(keep) for row in rows)
            total = len(reader)
            if self.to == "hdf5":
                with PathsWriter(self.out, reader.frequency, reader.tx, reader.meta) as writer:
                    for row in kept:
                        writer.append(row)
                _lay_reader_beside(self.out)
            elif self.to == "deepmimo":
                write_deepmimo(self.out, stack_paths(list(kept)), max_paths=keep or FEW)
            elif self.to == "matlab":
                matlab.write_matlab(self.out, stack_paths(list(kept)), strongest=keep or FEW)
            else:
                matlab.write_mat(self.out, stack_paths(list(kept)))
        out(f"{self.out}: {total} receivers" + ("" if keep is None else f", up to {keep} paths each"))
        return 0


def kind_of(source: Path) -> Kind:
    """What a file or folder to import is; DataError when it is nothing that can be."""
    if not source.exists():
        raise InputError(f"{source}: there is no such file or folder")
    if source.is_dir():
        if (source / "params.json").is_file():
            return "deepmimo"
        if (source / "manifest.json").is_file():
            return "paths"
        raise DataError(f"{source}: expected a DeepMIMO v4 folder (params.json) or a folder of paths (manifest.json)")
    if source.suffix.lower() == ".paths" or (source.suffix.lower() in HDF5 and _says_paths(source)):
        return "paths"
    if source.suffix.lower() in SOUNDINGS:
        return "sounding"
    raise DataError(f"{source}: expected a folder, or a file ending in .paths, {', '.join(SOUNDINGS)}")


def _says_paths(source: Path) -> bool:
    from rf3dgs.channel.io import SCHEMA
    from rf3dgs.core.hdf5 import open_audited, read_attribute

    with open_audited(source) as file:
        return "schema" in file.attrs and read_attribute(file, "schema") == SCHEMA


def _lay_reader_beside(path: Path) -> None:
    """Put the MATLAB reader beside an HDF5 file, unless a file of its name is there already."""
    from rf3dgs.core.files import write_whole
    from rf3dgs.propagation.exchange.matlab import READER

    target = path.with_name(READER.name)
    if not target.exists():
        write_whole(target, READER.read_bytes())
