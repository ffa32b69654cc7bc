"""A room of 6 m x 5 m x 3 m with a transmitter, hand-made: every pixel's truth is known in closed form."""

import math
from dataclasses import dataclass

import pytest
import torch
from torch import Tensor

from rf3dgs.core.angles import angle_between
from rf3dgs.core.frames import Pose
from rf3dgs.core.grids import DirectionGrid, equirect_grid
from rf3dgs.core.units import SPEED_OF_LIGHT, friis_gain
from rf3dgs.field.radiance import Surface
from rf3dgs.field.radio_field import RadioField
from rf3dgs.field.sources import PointSources
from rf3dgs.spectra.codec import DbWindow
from rf3dgs.spectra.spectrum import Instrument, Spectrum
from rf3dgs.splats.gaussians import Gaussians
from rf3dgs.splats.surface import sample_mesh

LOW, HIGH = (0.0, 0.0, 0.0), (6.0, 5.0, 3.0)
FREQUENCY = 60e9


def box(low: tuple[float, ...], high: tuple[float, ...]) -> tuple[Tensor, Tensor]:
    """Vertices [8, 3] and triangles [12, 3] of a box."""
    corner = [[(low, high)[i >> axis & 1][axis] for axis in range(3)] for i in range(8)]
    quads = ((0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3))
    faces = [triangle for a, b, c, d in quads for triangle in ((a, b, c), (a, c, d))]
    return torch.tensor(corner), torch.tensor(faces)


@dataclass(frozen=True)
class Room:
    """The room's geometry and what an instrument sees in it."""

    geometry: Gaussians
    tx: Tensor
    instrument: Instrument

    def receivers(self, count: int, seed: int) -> Pose:
        return Pose.scatter(((1.0, 1.0, 0.8), (5.0, 4.0, 2.0)), count, seed)

    def spectra(self, pose: Pose, grid: DirectionGrid) -> Spectrum:
        """Diffuse single bounces off the walls plus the line of sight at Friis' level."""
        here = pose.position[:, None, None, :]
        directions = pose.to_world(grid.directions.expand(len(pose), *grid.shape, 3))
        low, high = torch.tensor(LOW), torch.tensor(HIGH)
        ahead = torch.where(directions > 0, high - here, low - here) / directions
        second = torch.where(directions.abs() > 1e-6, ahead, torch.full_like(ahead, 1e9)).amin(-1)
        outward = here + second[..., None] * directions - self.tx
        first = torch.linalg.vector_norm(outward, dim=-1)
        diffuse = 1e-9 / first**2
        straight = self.tx - here
        distance = torch.linalg.vector_norm(straight, dim=-1)
        angle = angle_between(directions, straight.expand_as(directions))
        line = self.instrument.kernel(angle) * friis_gain(distance, FREQUENCY)
        power = diffuse + line
        delay = (diffuse * (first + second) + line * distance) / power / SPEED_OF_LIGHT
        departure = (diffuse / first)[..., None] * outward - (line / distance)[..., None] * straight
        aod = torch.nn.functional.normalize(departure, dim=-1)
        return Spectrum(power, grid, pose, FREQUENCY, self.instrument, "ideal", delay, aod, Pose(self.tx))


@pytest.fixture(scope="session")
def room() -> Room:
    vertices, faces = box(LOW, HIGH)
    geometry = sample_mesh(vertices, faces, spacing=0.4, thickness=0.01)
    return Room(geometry, torch.tensor([1.0, 1.2, 2.4]), Instrument.gaussian(math.radians(12)))


@pytest.fixture(scope="session")
def sphere() -> DirectionGrid:
    return equirect_grid(48, 24)


@pytest.fixture(scope="session")
def field(room: Room) -> RadioField:
    """A field whose surface has random harmonics: no training, every law must hold all the same."""
    generator = torch.Generator().manual_seed(3)
    window = DbWindow(-120.0, -70.0)
    bare = Surface.bare(room.geometry, tx=room.tx, window=window, degree=3)
    gain_sh = 0.1 * torch.randn(bare.gain_sh.shape, generator=generator)
    csi_sh = 0.2 * torch.randn(bare.csi_sh.shape, generator=generator)
    surface = Surface(
        bare.means, bare.quats, bare.log_scales, bare.logit_opacities, gain_sh, csi_sh, room.tx, window, "vector"
    )
    return RadioField(
        surface=surface,
        sources=PointSources.line_of_sight(room.tx, FREQUENCY),
        solidity=room.geometry.opacities,
        frequency=FREQUENCY,
        instrument=room.instrument,
        tx=Pose(room.tx),
        bounds=torch.tensor([[1.0, 1.0, 0.8], [5.0, 4.0, 2.0]]),
        colour=torch.full((len(surface), 3), 128, dtype=torch.uint8),
        meta={"seed": 3},
    )


@pytest.fixture(scope="session")
def wall() -> Gaussians:
    """A solid wall across the room at x = 3 m."""
    vertices, faces = box((2.95, 0.0, 0.0), (3.05, 5.0, 3.0))
    return sample_mesh(vertices, faces, spacing=0.2, thickness=0.01)
