import numpy as np
import pytest
import torch
from PIL import Image

from rf3dgs.core.frames import Pose
from rf3dgs.core.grids import Camera, equirect_grid, pinhole_grid
from rf3dgs.core.units import SPEED_OF_LIGHT, power_from_db
from rf3dgs.data.dataset import Dataset
from rf3dgs.data.photo import Photo
from rf3dgs.spectra.spectrum import Instrument, Spectrum


def make_spectra(count: int = 20, *, width: int = 16, height: int = 8, seed: int = 0) -> Spectrum:
    generator = torch.Generator().manual_seed(seed)
    pose = Pose.scatter(((1, 1, 1), (13, 14, 2)), count, seed=7)
    tx = Pose((0.5, 0.5, 2.5))
    shape = (count, height, width)
    power = power_from_db(-130 + 30 * torch.rand(shape, generator=generator))
    power[:, 0] = 0.0
    first = torch.linalg.vector_norm(pose.position - tx.position, dim=-1) / SPEED_OF_LIGHT
    delay = first[:, None, None] + 60e-9 * torch.rand(shape, generator=generator)
    aod = torch.nn.functional.normalize(torch.randn(*shape, 3, generator=generator), dim=-1)
    instrument = Instrument.gaussian(0.2)
    return Spectrum(power, equirect_grid(width, height), pose, 60e9, instrument, "ideal", delay, aod, tx)


def make_photos(folder, count: int = 6, *, width: int = 16, height: int = 12) -> list[Photo]:
    """Photos in files of noise, cameras on a circle."""
    folder.mkdir(parents=True, exist_ok=True)
    random = np.random.default_rng(3)
    photos = []
    for index in range(count):
        name = f"{index:03d}.png"
        Image.fromarray(random.integers(0, 256, (height, width, 3), dtype=np.uint8)).save(folder / name)
        angle = 2 * np.pi * index / count
        pose = Pose.look_at((7 + 4 * np.cos(angle), 7 + 4 * np.sin(angle), 1.5), (7.0, 7.0, 1.0))
        photos.append(Photo(name, Camera.of(pose, pinhole_grid(width, height, 70)), folder / name))
    return photos


@pytest.fixture
def spectra() -> Spectrum:
    return make_spectra()


@pytest.fixture
def photos(tmp_path) -> list[Photo]:
    return make_photos(tmp_path / "pictures")


@pytest.fixture
def dataset(spectra, photos) -> Dataset:
    index = torch.arange(0, 20, 2)
    repeat = make_spectra(seed=1)[index]
    return Dataset(photos, spectra, repeat=repeat, repeat_index=index, meta={"generator": "test", "seed": 0})


@pytest.fixture
def saved(dataset, tmp_path):
    """A sound native folder."""
    dataset.split(seed=1).save(tmp_path / "site")
    return tmp_path / "site"
