"""A small made-up room: point sources (the transmitter and four images of it) over a dim, patterned background."""

import math
from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch

from rf3dgs.core.angles import angle_between
from rf3dgs.core.frames import Pose
from rf3dgs.core.grids import DirectionGrid, equirect_grid
from rf3dgs.evaluation.lpips import Lpips
from rf3dgs.spectra.spectrum import Instrument, Spectrum, stack_spectra

GRID = equirect_grid(48, 24)
TX = torch.tensor([2.0, 3.0, 2.8])
IMAGES = torch.tensor([[2.0, 3, 2.8], [-2, 3, 2.8], [2, -3, 2.8], [26, 3, 2.8], [2.0, 3, -2.8]])
STRENGTH = torch.tensor([1.0, 0.3, 0.3, 0.2, 0.2])
INSTRUMENT = Instrument.gaussian(math.radians(12))


def spectrum_at(pose: Pose, grid: DirectionGrid = GRID, *, noise_db: float = 0.0, seed: int = 0) -> Spectrum:
    """The room's true spectrum `[row, col]` at one pose."""
    generator = torch.Generator().manual_seed(seed)
    relative = IMAGES - pose.position
    distance = torch.linalg.vector_norm(relative, dim=-1)
    world = pose.to_world(grid.directions)[:, :, None].expand(*grid.shape, 5, 3)
    angle = angle_between(world, (relative / distance[:, None]).expand_as(world))
    points = INSTRUMENT.kernel(angle) * (0.005 / (4 * math.pi * distance)) ** 2 * STRENGTH
    pattern = torch.sin(3 * world[..., 0, 0] + 4 * world[..., 0, 2])
    noise = noise_db * torch.randn(grid.shape, generator=generator)
    walls = 1e-11 * 10 ** ((5 * pattern + noise) / 10)
    power = points.sum(-1) + walls
    delay = ((points * distance).sum(-1) / 3e8 + walls * 6e-8) / power
    leaving = torch.nn.functional.normalize(pose.position - TX, dim=0) + 0.5 * world[..., 0, :]
    departure = torch.nn.functional.normalize(leaving, dim=-1)
    return Spectrum(power, grid, pose, 60e9, INSTRUMENT, "ideal", delay, departure, Pose(TX))


def spectra_at(pose: Pose, grid: DirectionGrid = GRID, *, noise_db: float = 0.0, seed: int = 0) -> Spectrum:
    """The room's spectra `[n, row, col]` at n poses."""
    return stack_spectra([spectrum_at(pose[i], grid, noise_db=noise_db, seed=seed + i) for i in range(len(pose))])


def receivers(count: int, seed: int = 0) -> Pose:
    return Pose.scatter(((4.0, 1, 1), (13, 14, 2)), count, seed)


class Oracle:
    """A predictor that knows the room, up to a gain offset [dB] and noise."""

    def __init__(self, *, offset_db: float = 0.0, noise_db: float = 0.0) -> None:
        self.offset_db, self.noise_db = offset_db, noise_db

    def render(self, pose: Pose, grid: DirectionGrid) -> Spectrum:
        spectrum = spectrum_at(pose, grid, noise_db=self.noise_db, seed=99)
        return replace(spectrum, power=spectrum.power * 10 ** (self.offset_db / 10))


CHANNELS = {"alex": (64, 192, 384, 256, 256), "vgg": (64, 128, 256, 512, 512)}
LAYERS = {  # (index in the published state dict, inputs, outputs, side) of each convolution
    "alex": ((0, 3, 64, 11), (3, 64, 192, 5), (6, 192, 384, 3), (8, 384, 256, 3), (10, 256, 256, 3)),
    "vgg": (
        *((0, 3, 64, 3), (2, 64, 64, 3), (5, 64, 128, 3), (7, 128, 128, 3), (10, 128, 256, 3), (12, 256, 256, 3)),
        *((14, 256, 256, 3), (17, 256, 512, 3), (19, 512, 512, 3), (21, 512, 512, 3), (24, 512, 512, 3)),
        *((26, 512, 512, 3), (28, 512, 512, 3)),
    ),
}


def random_weights(network: str) -> dict[str, torch.Tensor]:
    """A backbone ("alex", "vgg") and heads that were never trained, named as in the published files."""
    generator = torch.Generator().manual_seed(3)
    weights = {}
    for index, inputs, outputs, size in LAYERS[network]:
        shape = (outputs, inputs, size, size)
        weights[f"features.{index}.weight"] = torch.randn(shape, generator=generator) * (2 / (inputs * size**2)) ** 0.5
        weights[f"features.{index}.bias"] = 0.1 * torch.randn(outputs, generator=generator)
    for head, channels in enumerate(CHANNELS[network]):
        weights[f"lin{head}.model.1.weight"] = torch.rand(1, channels, 1, 1, generator=generator)
    return weights


@pytest.fixture(scope="session", name="random_weights")
def random_weights_fixture():
    return random_weights


@pytest.fixture(scope="session")
def random_lpips():
    return lambda network: Lpips(random_weights(network))


@pytest.fixture(scope="session")
def room() -> SimpleNamespace:
    return SimpleNamespace(
        grid=GRID, tx=TX, spectrum_at=spectrum_at, spectra_at=spectra_at, receivers=receivers, Oracle=Oracle
    )
