"""Spectra in HDF5: physical values as scaled integers, readable by any HDF5 program.

Every array says in its attributes `scale`, `offset`, `unit` and `missing` how a stored integer becomes a value:
`integer * scale + offset`, and no value where it equals `missing`; a missing `floor` is infinite. Departures are unit
vectors in the octahedral map: two components in [-1, 1], stored one after the other (`aod` `[position, 2, row, col]`).
Text is fixed-length UTF-8. One picture is one chunk, so that one spectrum is read without the others.
"""

import shutil
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import torch
from torch import Tensor

from rf3dgs.core.errors import DataError, InputError
from rf3dgs.core.frames import Pose
from rf3dgs.core.hdf5 import LIBVER, open_audited, read_array, read_attribute, write_text
from rf3dgs.core.units import db_from_power
from rf3dgs.data.formats.spectra_codes import MISSING, Precision, Scale, octahedral_of
from rf3dgs.data.formats.spectra_head import UNITS, read_head, write_head, write_noise, write_pose
from rf3dgs.data.formats.stored import SpectraFile, StoredSpectra, blocks, stamp_of
from rf3dgs.spectra.spectrum import Spectrum

SCHEMA = "rf3dgs.spectra"
VERSION = 1
# What a file may declare, in bytes and in bytes per byte of the file: one picture is read at a time, and pictures of
# little but nothing are compressed as far as gzip can.
LIMITS = {"max_bytes": 2**44, "max_ratio": 1100}
# What gains may be of spectra that are written before all are known: of power, and of what has no level.
POWER_DB, MUSIC_DB = (-300.0, 27.0), (0.0, 120.0)


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

    `meta`: its "generator" (what made the spectra) and "seed" become attributes. Spectra that are a whole file already
    are copied with it, unless `how` asks for another precision; others are read and written a few at a time.
    """
    if how is None and _copy_whole(path, spectra, repeat, index, meta or {}):
        return
    how = how or Precision()
    with h5py.File(path, "w", libver=LIBVER) as file:
        _write_top(file, meta or {})
        _write_group(file.create_group("spectra"), spectra, how)
        if repeat is not None and index is not None:
            group = file.create_group("repeat")
            _write_group(group, repeat, how)
            group.create_dataset("index", data=index.numpy().astype(np.int32), track_times=False)


def write_part(
    path: Path, spectra: Iterable[Spectrum], count: int, scales: Mapping[str, Scale], meta: Mapping[str, Any]
) -> None:
    """Write `count` spectra of a run, which come one `[n, row, col]` after the other, for `join_parts`.

    All parts share their `scales` (`common_scales`).
    """
    with h5py.File(path, "w", libver=LIBVER) as file:
        _write_top(file, meta)
        writer = _GroupWriter(file.create_group("spectra"), count, scales, None)
        for some in spectra:
            writer.append(some)
        writer.finish()


def join_parts(parts: Sequence[Path], path: Path, count: int) -> None:
    """One file of the `count` spectra of all `parts`, in order: compressed pictures are copied as they are."""
    if not parts:
        raise InputError("there are no parts to join")
    with h5py.File(path, "w", libver=LIBVER) as file:
        writer: _GroupWriter | None = None
        for part in parts:
            with open_audited(part, **LIMITS) as source:
                group = _group(source, "spectra")
                if writer is None:
                    _write_top(file, {name: read_attribute(source, name) for name in ("generator", "seed")})
                    writer = _GroupWriter(file.create_group("spectra"), count, read_head(group).scales, None)
                writer.copy(group)
        assert writer is not None
        writer.finish()


def common_scales(how: Precision, longest: float | None, method: str = "ideal") -> dict[str, Scale]:
    """Scales for spectra that are written before all of them are known; `longest` delay [s], None without delays."""
    scales = {"gain": Scale.over(*(MUSIC_DB if method == "music" else POWER_DB), how.gain_db)}
    if longest is not None:
        scales |= {"delay": Scale.over(0.0, longest, how.delay), "aod": Scale.over(-1.0, 1.0, how.aod)}
    return scales


def read_spectra(path: Path) -> tuple[StoredSpectra, StoredSpectra | None, Tensor | None]:
    """Open what `write_spectra` wrote; DataError for damage, another schema version, or units other than expected.

    The file is audited and its head is read; values follow when they are asked for, each picture with its checksum.
    """
    path = Path(path).absolute()
    stamp = stamp_of(path) if path.is_file() else (0, 0, 0)
    with open_audited(path, **LIMITS) as file:
        schema, version = read_attribute(file, "schema"), read_attribute(file, "version")
        if schema != SCHEMA or version != VERSION:
            raise DataError(
                f"{path}: expected schema {SCHEMA} version {VERSION}; got {schema} version {version}. "
                "Save the dataset with this version of rf3dgs, or read it with the version that wrote it"
            )
        try:
            spectra = StoredSpectra.of(SpectraFile(path, "spectra", stamp, read_head(_group(file, "spectra"))))
            if "repeat" not in file:
                return spectra, None, None
            group = _group(file, "repeat")
            index = torch.from_numpy(read_array(group, "index").astype(np.int64))
            return spectra, StoredSpectra.of(SpectraFile(path, "repeat", stamp, read_head(group))), index
        except (InputError, ValueError, RuntimeError, TypeError) as error:
            raise DataError(f"{path}: {error}") from error


def _group(file: h5py.File, name: str) -> h5py.Group:
    group = file.get(name)
    if not isinstance(group, h5py.Group):
        raise DataError(f"{file.filename}: expected the group {name!r}; it is missing")
    return group


def _write_top(file: h5py.File, meta: Mapping[str, Any]) -> None:
    write_text(file.attrs, "schema", SCHEMA)
    file.attrs["version"] = VERSION
    for name in ("generator", "seed"):
        write_text(file.attrs, name, str(meta.get(name, "")))


def _copy_whole(
    path: Path, spectra: Spectrum, repeat: Spectrum | None, index: Tensor | None, meta: Mapping[str, Any]
) -> bool:
    """Copy the file when it holds exactly these spectra; False when there is no such file."""
    if not (isinstance(spectra, StoredSpectra) and spectra.source.group == "spectra" and spectra.is_whole):
        return False
    source = spectra.source.path
    held, again, places = read_spectra(source)
    if held.source.stamp != spectra.source.stamp:
        raise DataError(f"{source}: was changed after the dataset was loaded; load it again")
    if again is None or places is None or index is None:
        if not (again is None and repeat is None):
            return False
    elif not (_is_stored(repeat, again) and torch.equal(index, places)):
        return False
    shutil.copyfile(source, path)
    wanted = {name: str(meta.get(name, "")) for name in ("generator", "seed")}
    with h5py.File(path, "r", locking="best-effort") as file:
        differ = [name for name, text in wanted.items() if read_attribute(file, name) != text]
    if differ:
        with h5py.File(path, "r+", libver=LIBVER) as file:
            for name in differ:
                write_text(file.attrs, name, wanted[name])
    return True


def _is_stored(spectra: Spectrum | None, held: StoredSpectra) -> bool:
    if not isinstance(spectra, StoredSpectra) or spectra.source.group != held.source.group:
        return False
    return spectra.source.stamp == held.source.stamp and spectra.is_whole


def _write_group(group: h5py.Group, spectra: Spectrum, how: Precision) -> None:
    if len(spectra.pose.batch_shape) != 1:
        raise InputError(f"spectra to be saved must be [position, row, col]; got {list(spectra.power.shape)}")
    low, high = {"aod": -1.0}, {}
    for block in blocks(spectra):
        for name, (values, some) in _physical(block, how.floor_db).items():
            if some.any():
                high[name] = max(high.get(name, -np.inf), float(values[some].max()))
                low[name] = min(low.get(name, np.inf), float(values[some].min()))
    steps = {"gain": how.gain_db, "delay": how.delay, "aod": how.aod, "floor": how.gain_db}
    scales = {
        name: Scale.over(low.get(name, 0.0), high.get(name, low.get(name, 0.0)), step) for name, step in steps.items()
    }
    writer = _GroupWriter(group, len(spectra), scales, how.floor_db)
    for block in blocks(spectra):
        writer.append(block)
    writer.finish()


def _physical(spectra: Spectrum, floor_db: float | None) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Values to be stored (float64) and where there are some, by name; InputError for what no spectrum has."""
    if not bool(torch.isfinite(spectra.power).all()) or bool((spectra.power < 0).any()):
        raise InputError("spectra to be saved must have finite, non-negative power; check what made them")
    gain = spectra.gain_db.double().numpy()
    some = (spectra.power > 0).numpy() & (gain > -np.inf if floor_db is None else gain >= floor_db)
    values = {"gain": (gain, some)}
    if spectra.delay is not None:
        values["delay"] = (spectra.delay.double().numpy(), some)
    if spectra.aod is not None:
        components = np.moveaxis(octahedral_of(spectra.aod.double().numpy()), -1, 1)
        values["aod"] = (components, np.repeat(some[:, None], 2, axis=1))
    if spectra.floor is not None:
        values["floor"] = (db_from_power(spectra.floor).double().numpy(), torch.isfinite(spectra.floor).numpy())
    for name, (array, known) in values.items():
        if not np.isfinite(array[known]).all():
            raise InputError(f"{name} has NaN or infinite values where power arrives; mask them by zero power")
    return values


class _GroupWriter:
    """Fills a group with `count` spectra, block after block; the first block gives the head."""

    def __init__(self, group: h5py.Group, count: int, scales: Mapping[str, Scale], floor_db: float | None) -> None:
        self.group, self.count, self.scales, self.floor_db = group, count, scales, floor_db
        self.done = 0
        self.pose: list[Pose] = []
        self.noise: list[Tensor] = []

    def append(self, spectra: Spectrum) -> None:
        """The next spectra `[n, row, col]`."""
        if not self.pose:
            write_head(self.group, spectra)
        for name, (values, some) in _physical(spectra, self.floor_db).items():
            codes = self.scales[name].encode(values, some, name)
            dataset = self._dataset(name, codes.shape[1:])
            dataset[self.done : self.done + len(codes)] = codes
            # Chunks get their place in the file when the dataset is flushed. Left to the moment when Python drops the
            # last reference to it, the same spectra would make files of different bytes.
            dataset.flush()
        self._count(spectra.pose, spectra.noise)

    def copy(self, source: h5py.Group) -> None:
        """The next spectra from a group that was written in the same scales; pictures are not decompressed."""
        head = read_head(source)
        if head.scales != dict(self.scales):
            raise DataError(f"{source.file.filename}: is stored in other scales than the parts before; make it again")
        if not self.pose:
            write_head(self.group, head)
        for name in self.scales:
            stored = source[name]
            assert isinstance(stored, h5py.Dataset)
            target = self._dataset(name, stored.shape[1:])
            for number in range(stored.id.get_num_chunks()):
                place = stored.id.get_chunk_info(number).chunk_offset
                mask, content = stored.id.read_direct_chunk(place)
                target.id.write_direct_chunk((place[0] + self.done, *place[1:]), content, mask)
        self._count(head.pose, head.noise)

    def finish(self) -> None:
        """Write the poses, and the noise where all have one; InputError where spectra are missing."""
        if self.done != self.count:
            raise InputError(f"expected {self.count} spectra; got {self.done}")
        position, orientation = (
            torch.cat([getattr(pose, name) for pose in self.pose]) for name in ("position", "orientation")
        )
        write_pose(self.group, "", Pose(position, orientation))
        if len(self.noise) == len(self.pose):
            write_noise(self.group, torch.cat(self.noise))

    def _count(self, pose: Pose, noise: Tensor | None) -> None:
        self.pose.append(pose)
        self.noise.extend([] if noise is None else [noise])
        self.done += len(pose)

    def _dataset(self, name: str, shape: tuple[int, ...]) -> h5py.Dataset:
        if name not in self.group:
            dataset = self.group.create_dataset(
                name,
                shape=(self.count, *shape),
                dtype=np.uint16,
                chunks=(*(1,) * (len(shape) - 1), *shape[-2:]),
                compression="gzip",
                compression_opts=6,
                shuffle=True,
                fletcher32=True,
            )
            scale = self.scales[name]
            dataset.attrs["scale"], dataset.attrs["offset"] = scale.step, scale.offset
            dataset.attrs["missing"] = MISSING
            write_text(dataset.attrs, "unit", UNITS[name])
        dataset = self.group[name]
        assert isinstance(dataset, h5py.Dataset)
        return dataset
