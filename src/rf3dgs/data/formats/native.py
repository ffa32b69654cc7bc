"""The package's own dataset folder.

    DIR/dataset.json            schema, units, frames, roles, what made it, and the sha256 of every other file
    DIR/spectra.h5              the spectra in physical units (formats/spectra_h5.py)
    DIR/photos/*.jpg|png        the photographs
    DIR/photos/transforms.json  their cameras, as nerfstudio writes them

`dataset.json` is written last: a folder without it is no dataset yet, so a killed writer leaves none that is half new.
"""

import shutil
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
from PIL import Image

from rf3dgs.core.errors import DataError, InputError
from rf3dgs.core.files import atomic_file, atomic_folder
from rf3dgs.data.dataset import Dataset
from rf3dgs.data.formats.nerfstudio import FILE_NAME, read_nerfstudio, write_nerfstudio
from rf3dgs.data.formats.spectra_codes import Precision
from rf3dgs.data.formats.spectra_h5 import read_spectra, write_spectra
from rf3dgs.data.photo import Photo
from rf3dgs.data.safe import PICTURE_SUFFIXES, read_json, sha256_of, write_json

SCHEMA = "rf3dgs.dataset"
VERSION = 1
MANIFEST = "dataset.json"
SPECTRA = "spectra.h5"
PHOTOS = "photos"
CONVENTIONS: dict[str, dict[str, str]] = {
    "units": {"length": "m", "time": "s", "frequency": "Hz", "angle": "rad", "gain": "dB"},
    "frames": {
        "world": "right-handed, metric, z up",
        "device": "x forward, y left, z up",
        "orientation": "quaternion wxyz, world_from_device",
        "aod": "unit vector, world frame, from the transmitter",
    },
}


def save_native(dataset: Dataset, path: Path, precision: Precision | None = None) -> None:
    """Write `dataset` to the folder `path`, which appears whole or not at all.

    A folder that exists keeps its other files; while the new ones are written it has no `dataset.json`.
    """
    if not path.exists() or (path.is_dir() and not any(path.iterdir())):
        with atomic_folder(path) as folder:
            _write(dataset, folder, precision)
        return
    if not path.is_dir():
        raise DataError(f"{path} is a file, but a dataset is a folder; remove it or choose another name")
    (path / MANIFEST).unlink(missing_ok=True)
    _write(dataset, path, precision)


def load_native(path: Path, *, unseal_test: bool = False) -> Dataset:
    """Open a dataset folder; the spectra are checked against their sha256, photos when `validate` is asked.

    Values of spectra stay in the file until they are asked for (`StoredSpectra`).
    """
    manifest = read_manifest(path)
    file = path / MANIFEST
    spectra = repeat = index = None
    entry = manifest.get("spectra")
    if entry is not None:
        check_sha256(path / SPECTRA, _field(entry, "sha256", str, file))
        spectra, repeat, index = read_spectra(path / SPECTRA)
    photos: tuple[Photo, ...] = ()
    if manifest.get("photos") is not None:
        photos = read_nerfstudio(path / PHOTOS).photos
        listed = _field(manifest["photos"], "files", dict, file)
        if {photo.name for photo in photos} != set(listed):
            raise DataError(
                f"{path / PHOTOS / FILE_NAME}: names {len(photos)} photos, but {file} lists {len(listed)} or others; "
                "save the dataset again"
            )
    try:
        return Dataset(
            photos,
            spectra,
            repeat=repeat,
            repeat_index=index,
            roles=_texts(manifest, "roles", file),
            photo_roles=_texts(manifest, "photo_roles", file),
            meta=_field(manifest, "meta", dict, file),
            path=path,
            unseal_test=unseal_test,
        )
    except InputError as error:
        raise DataError(f"{file}: {error}") from error


def read_manifest(path: Path) -> dict[str, Any]:
    """`dataset.json` after a check of schema, version, units and frames."""
    file = path / MANIFEST
    if not file.is_file():
        raise DataError(
            f"{path}: expected {MANIFEST} in it; this is no dataset, or saving it was interrupted: save again"
        )
    manifest = read_json(file)
    if manifest.get("schema") != SCHEMA or manifest.get("version") != VERSION:
        got = f"{manifest.get('schema')} version {manifest.get('version')}"
        raise DataError(
            f"{file}: expected schema {SCHEMA} version {VERSION}; got {got}. "
            "Save the dataset with this version of rf3dgs, or read it with the version that wrote it"
        )
    for section, expected in CONVENTIONS.items():
        found = _field(manifest, section, dict, file)
        for key, value in expected.items():
            if found.get(key) != value:
                raise DataError(
                    f"{file}: {section}.{key} must be {value!r}; got {found.get(key)!r}. "
                    f"Convert the values and set {section}.{key} to {value!r}"
                )
    return manifest


def photo_roles(path: Path, count: int) -> tuple[str, ...] | None:
    """The roles of a dataset folder's `count` photos, None before a split; DataError for another number of roles."""
    file = path / MANIFEST
    roles = _texts(read_manifest(path), "photo_roles", file)
    if roles and len(roles) != count:
        raise DataError(f"{file}: expected one role per photo, {count}; got {len(roles)}. Save the dataset again")
    return roles or None


def check_sha256(path: Path, expected: str) -> None:
    """DataError when a file is missing or is not the one that `dataset.json` describes."""
    if sha256_of(path) != expected:
        raise DataError(
            f"{path}: differs from its sha256 in {MANIFEST}; it is damaged or was changed. Save the dataset again"
        )


def _write(dataset: Dataset, folder: Path, precision: Precision | None) -> None:
    spectra, repeat = dataset._spectra, dataset._repeat
    manifest: dict[str, Any] = {"schema": SCHEMA, "version": VERSION, **CONVENTIONS}
    manifest["spectra"] = manifest["photos"] = None
    if spectra is not None:
        with atomic_file(folder / SPECTRA) as temporary:
            write_spectra(temporary, spectra, repeat, dataset.repeat_index, precision, meta=dataset.meta)
        manifest["spectra"] = {
            "sha256": sha256_of(folder / SPECTRA),
            "count": len(spectra),
            "repeat": 0 if repeat is None else len(repeat),
            "method": spectra.method,
            "frequency": spectra.frequency,
            "instrument": spectra.instrument.name,
            "grid": f"{spectra.grid.kind} {spectra.grid.width}x{spectra.grid.height}",
            "tx_position": None if spectra.tx is None else spectra.tx.position.tolist(),
        }
    if dataset.photos:
        names = _file_names(dataset.photos)
        for photo, name in zip(dataset.photos, names, strict=True):
            _write_photo(photo, folder / PHOTOS / name)
        write_nerfstudio(folder / PHOTOS, dataset.photos, names=names)
        manifest["photos"] = {
            "sha256": sha256_of(folder / PHOTOS / FILE_NAME),
            "files": {name: sha256_of(folder / PHOTOS / name) for name in names},
        }
    manifest |= {"roles": list(dataset.roles), "photo_roles": list(dataset.photo_roles), "meta": dataset.meta}
    try:
        write_json(folder / MANIFEST, manifest)
    except (TypeError, ValueError) as error:
        raise InputError(f"the dataset's meta must be what JSON can hold, with finite numbers; {error}") from error


def _file_names(photos: tuple[Photo, ...]) -> list[str]:
    """One file name per photo: its own where that is unique and safe, else a number."""
    names = []
    for photo in photos:
        own = PurePosixPath(photo.name if photo.path is None else photo.path.name)
        names.append(own.stem + (".png" if photo.path is None else own.suffix.lower()))
    plain = all(Path(name).suffix in PICTURE_SUFFIXES and not name.startswith(".") for name in names)
    if plain and len({name.lower() for name in names}) == len(names):
        return names
    return [f"{index:05d}{Path(name).suffix or '.png'}" for index, name in enumerate(names)]


def _write_photo(photo: Photo, target: Path) -> None:
    source = photo.path
    if source is not None and target.exists() and source.samefile(target):
        return
    with atomic_file(target) as temporary:
        if source is not None:
            if not source.is_file():
                raise DataError(f"{source}: there is no such picture")
            shutil.copyfile(source, temporary)
        else:
            pixels = (photo.load().clamp(0, 1) * 255).round().numpy().astype(np.uint8)
            Image.fromarray(pixels).save(temporary, format="PNG")


def _field(content: Any, key: str, kind: type, file: Path) -> Any:
    value = content.get(key) if isinstance(content, dict) else None
    if not isinstance(value, kind):
        raise DataError(f"{file}: expected {key!r} to be a JSON {kind.__name__}; got {value!r:.80}")
    return value


def _texts(content: dict[str, Any], key: str, file: Path) -> tuple[str, ...]:
    values = _field(content, key, list, file)
    if not all(isinstance(value, str) for value in values):
        raise DataError(f"{file}: expected {key!r} to be a list of texts")
    return tuple(values)
