"""Laws of fields that are fitted to what arrays show, in a room whose walls are known."""

import math
from dataclasses import replace

import pytest
import torch

from rf3dgs.channel.arrays import planar_array
from rf3dgs.core.frames import Pose
from rf3dgs.core.grids import equirect_grid, pinhole_grid
from rf3dgs.core.units import friis_gain
from rf3dgs.spectra.beamformers import capon
from rf3dgs.spectra.config import Loading
from rf3dgs.spectra.covariance import plane_waves
from rf3dgs.spectra.scan import array_instrument
from rf3dgs.spectra.spectrum import Instrument, Spectrum, stack_spectra
from rf3dgs.spectra.steering import PlanarSteering
from rf3dgs.splats.gaussians import Gaussians
from rf3dgs.splats.surface import sample_mesh
from rf3dgs.training.config import RadioConfig
from rf3dgs.training.radio import fit_radio

HIGH = torch.tensor([6.0, 5.0, 3.0])
TX = torch.tensor([1.0, 1.2, 2.4])
GRID = equirect_grid(60, 30)
LOBE = Instrument.gaussian(math.radians(9))
ARRAY, PICTURE = planar_array(8, 8, "patch"), pinhole_grid(32, 28, 110)
MIRROR = RadioConfig(model="mirror", array_grid=(60, 30), mirror_order=0)


def room() -> Gaussians:
    corner = [[float(HIGH[axis]) if i >> axis & 1 else 0.0 for axis in range(3)] for i in range(8)]
    quads = ((0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3))
    faces = [triangle for a, b, c, d in quads for triangle in ((a, b, c), (a, c, d))]
    return sample_mesh(torch.tensor(corner), torch.tensor(faces), spacing=0.3, thickness=0.01)


def diffuse_at(position: torch.Tensor) -> torch.Tensor:
    """Power per lobe `[row, col]` of walls that scatter what falls on them evenly."""
    directions = GRID.directions
    ahead = torch.where(directions > 0, HIGH - position, -position) / directions
    second = torch.where(directions.abs() > 1e-6, ahead, torch.full_like(ahead, 1e9)).amin(-1)
    hit = position + second[..., None] * directions
    return 3e-9 / (TX - hit).square().sum(-1)


def ideal_at(position: torch.Tensor) -> Spectrum:
    straight = TX - position
    distance = torch.linalg.vector_norm(straight)
    angle = torch.acos((GRID.directions @ (straight / distance)).clamp(-1, 1))
    power = diffuse_at(position) + LOBE.kernel(angle) * friis_gain(distance, 60e9)
    return Spectrum(power, GRID, Pose(position), 60e9, LOBE, "ideal", tx=Pose(TX))


def pictures_at(position: torch.Tensor) -> list[Spectrum]:
    """Capon's pictures of four sides, of the same walls and line of sight."""
    straight = TX - position
    power = (diffuse_at(position) * GRID.solid_angle).reshape(-1) / LOBE.beam_solid_angle
    power = torch.cat((power, friis_gain(torch.linalg.vector_norm(straight)[None], 60e9))).double()
    directions = torch.cat((GRID.directions.reshape(-1, 3), torch.nn.functional.normalize(straight, dim=-1)[None]))
    result = []
    for yaw in (0.0, math.pi / 2, math.pi, -math.pi / 2):
        pose = Pose.from_yaw(position, torch.tensor(yaw))
        R = plane_waves(power, pose.to_device(directions), ARRAY)
        noise = 1e-2 * float(R.diagonal().real.mean())
        shown = capon(R, PlanarSteering(ARRAY, PICTURE.directions), Loading(noise, "absolute")) / ARRAY.peak_gain
        spread = torch.tensor(noise / ARRAY.peak_gain, dtype=torch.float64)
        instrument = array_instrument(ARRAY, "capon")
        result.append(
            Spectrum(shown.float(), PICTURE, pose, 60e9, instrument, "capon", tx=Pose(TX), noise=spread.reshape(()))
        )
    return result


PLACES = Pose.scatter(((1.5, 1.5, 0.8), (5.0, 4.0, 1.8)), 9, 0).position
HELD_OUT = Pose.scatter(((1.5, 1.5, 0.8), (5.0, 4.0, 1.8)), 3, 9).position


@pytest.fixture(scope="module")
def pictures() -> Spectrum:
    rows = [one for place in PLACES for one in pictures_at(place)]
    noise = torch.stack([one.noise for one in rows if one.noise is not None])
    return replace(stack_spectra([replace(one, noise=None) for one in rows]), noise=noise)


@pytest.mark.slow
def test_a_field_of_capon_pictures_is_that_of_ideal_spectra(pictures):
    field = fit_radio(room(), pictures, MIRROR)
    assert field.instrument.array is None
    held_out = stack_spectra([ideal_at(place) for place in HELD_OUT])
    shown = field.render(held_out.pose, GRID, csi=False)
    seen = GRID.directions[..., 2].abs() < math.sin(math.radians(35))
    error = (shown.gain_db - held_out.gain_db)[:, seen]
    straight = torch.nn.functional.normalize(TX - held_out.pose.position, dim=-1)
    lamp = (GRID.directions[seen] @ straight.mT).mT > math.cos(math.radians(20))
    # Waves are told from noise where the array gathers them as strongly: 20 dB under all that arrives.
    assert float(error[~lamp].square().mean().sqrt()) < 2.5
    peak = shown.gain_db.amax((-2, -1)) - held_out.gain_db.amax((-2, -1))
    # A few steps leave some of the line of sight in the pixels beside it, where the array does not tell them apart.
    assert float(peak.abs().max()) < 1.5


def test_what_stands_where_nobody_looked_does_not_matter():
    spectra = stack_spectra([ideal_at(place) for place in PLACES[:4]])
    hidden = (GRID.directions[..., 1] < 0).expand_as(spectra.power)
    floor = torch.where(hidden, torch.inf, torch.zeros(()))
    first = fit_radio(room(), replace(spectra, floor=floor), MIRROR)
    other = replace(spectra, power=torch.where(hidden, 1e-3, spectra.power), floor=floor)
    second = fit_radio(room(), other, MIRROR)
    assert torch.equal(first.surface.level, second.surface.level)
    assert first.window == second.window


def test_a_pixel_under_its_floor_says_at_most_that():
    spectra = stack_spectra([ideal_at(place) for place in PLACES[:4]])
    lamp = spectra.power > 5e-9
    dim = replace(spectra, power=torch.where(lamp, spectra.power, 1e-3 * spectra.power))
    floor = torch.where(lamp, torch.zeros(()), spectra.power)
    levels = []
    for one in (dim, replace(dim, floor=floor)):
        shown = fit_radio(room(), one, MIRROR).without_sources().render(spectra.pose, GRID, csi=False)
        levels.append((shown.gain_db - spectra.gain_db)[~lamp].median())
    # Without a floor the walls are 30 dB darker; with one nothing says so, and nothing brighter than it is shown.
    assert float(levels[0]) < -20.0
    assert -15.0 < float(levels[1]) < 3.0
