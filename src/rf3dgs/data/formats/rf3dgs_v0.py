"""The layout of the published RF-3DGS data: pictures of spectra with COLMAP poses and a split in two text files.

    DIR/images/NNNNN.png  DIR/sparse/0/{cameras,images,points3D}.{txt,bin}  DIR/train_index.txt  DIR/test_index.txt

The pictures hold levels from 0 to 1 in 8 bits, grey or jet colours, without a unit. They become spectra only with a dB
window that the user supplies; delay and departure are not in them.
"""

from dataclasses import replace
from pathlib import Path

import torch
from torch import Tensor

from rf3dgs.core.errors import DataError, InputError
from rf3dgs.core.frames import Pose
from rf3dgs.core.progress import Progress, Silent, track
from rf3dgs.data.dataset import Dataset
from rf3dgs.data.formats.colmap import read_colmap
from rf3dgs.data.photo import PhotoSet
from rf3dgs.data.safe import read_text
from rf3dgs.spectra.codec import DbWindow
from rf3dgs.spectra.jet import jet_level
from rf3dgs.spectra.spectrum import Instrument, Spectrum

INDEX_FILES = {"train": "train_index.txt", "test": "test_index.txt"}


def is_rf3dgs_v0(path: Path) -> bool:
    """True for a folder with both index files."""
    return all((path / name).is_file() for name in INDEX_FILES.values())


def read_rf3dgs_v0_pictures(path: str | Path) -> PhotoSet:
    """The pictures with the cameras that COLMAP's files store and the published split, noted as uncalibrated."""
    path = Path(path)
    found = read_colmap(path)
    role_of: dict[str, str] = {}
    for role, name in INDEX_FILES.items():
        for line in read_text(path / name).splitlines():
            stem = Path(line.strip()).stem
            if stem and role_of.setdefault(stem, role) != role:
                raise DataError(f"{path / name}: {stem!r} is in both index files; the test must not be trained on")
    missing = [photo.name for photo in found.photos if Path(photo.name).stem not in role_of]
    if missing:
        raise DataError(f"{path}: {len(missing)} pictures are in neither index file, such as {missing[0]!r}; add them")
    note = "uncalibrated: 8-bit levels from 0 to 1 without a unit"
    photos = tuple(replace(photo, note=note) for photo in found.photos)
    roles = tuple(role_of[Path(photo.name).stem] for photo in photos)
    return PhotoSet(photos, "rf3dgs_v0", found.points, found.colours, roles, (*found.notes, note))


def read_rf3dgs_v0(
    path: str | Path,
    window: DbWindow | None = None,
    *,
    frequency: float | None = None,
    instrument: Instrument | None = None,
    tx: Pose | None = None,
    progress: Progress | None = None,
) -> Dataset:
    """The pictures as gain spectra `[picture, row, col]`: level 0 ... 1 through the dB `window` that the user knows.

    Grey pictures are levels as they are; coloured ones are taken back through matplotlib's jet map. The published files
    state neither window nor frequency nor beam, so InputError says what is missing. COLMAP's world is taken as metres.
    """
    if window is None or frequency is None or instrument is None:
        raise InputError(
            "the pictures of rf3dgs_v0 carry no units: give window=DbWindow(floor_db, ceil_db), frequency in hertz and "
            "instrument=Instrument.gaussian(lobe), or use read_rf3dgs_v0_pictures for the levels alone"
        )
    found = read_rf3dgs_v0_pictures(path)
    first = found.photos[0].camera
    for photo in found.photos:
        same_size = (photo.camera.width, photo.camera.height) == (first.width, first.height)
        if not same_size or not torch.allclose(photo.camera.K, first.K):
            raise DataError(f"{photo.path}: its camera differs from {found.photos[0].name}; one grid is needed for all")
    power = torch.empty(len(found), first.height, first.width)
    for index, photo in enumerate(track(found.photos, "pictures", len(found), progress or Silent())):
        power[index] = window.decode(level_of(photo.load()))
    pose = Pose.from_viewmat(torch.stack([photo.camera.viewmat for photo in found.photos]))
    spectra = Spectrum(power, first.grid, pose, frequency, instrument, "rf3dgs_v0", tx=tx)
    meta = {"generator": "rf3dgs_v0 pictures", "seed": None, "notes": list(found.notes)}
    return Dataset((), spectra, roles=found.roles or (), meta=meta)


def level_of(picture: Tensor) -> Tensor:
    """Levels `[row, col]`, 0 to 1, of a grey picture or of one in jet colours `[row, col, 3]`."""
    if bool((picture - picture[..., :1]).abs().max() < 2.5 / 255):
        return picture[..., 0]
    return jet_level(picture)
