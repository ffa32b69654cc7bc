"""Laws of what an instrument's lobe makes of a picture."""

import math

import pytest
import torch

from rf3dgs.core.angles import angle_between
from rf3dgs.core.frames import Pose
from rf3dgs.core.grids import DirectionGrid, equirect_grid, pinhole_grid, view_of
from rf3dgs.field.beam import through_lobe
from rf3dgs.spectra.spectrum import Instrument

LOBE = math.radians(6)
SPHERE, CAMERA = equirect_grid(120, 60), pinhole_grid(75, 50, 90.0)
HERE = Pose([0.0, 0.0, 0.0])


def steps(grid: DirectionGrid) -> torch.Tensor:
    """Power and a constant `[row, col, 2]`: a corner 30 dB above the rest, and 1."""
    bright = (grid.directions[..., 1] > 0.1) & (grid.directions[..., 2] > -0.2)
    return torch.stack((torch.where(bright, 1e-6, 1e-9), torch.ones(grid.shape)), -1)


def by_angles(picture: torch.Tensor, grid: DirectionGrid) -> torch.Tensor:
    """The mean over the lobe `[row, col, channel]`, pixel by pixel."""
    u, area = grid.directions.reshape(-1, 3), grid.solid_angle.flatten()
    weight = Instrument.gaussian(LOBE).kernel(angle_between(u[:, None], u[None])) * area
    return (weight @ picture.flatten(0, 1) / weight.sum(-1, keepdim=True)).reshape(picture.shape)


def mean_error_db(grid: DirectionGrid, where: torch.Tensor) -> float:
    """How far rows and columns one after the other are from the lobe, beside an edge of 30 dB."""
    picture = steps(grid)
    shown, expected = through_lobe(picture, view_of(HERE, grid), LOBE), by_angles(picture, grid)
    error_db = 10 * torch.log10(shown[..., 0] / expected[..., 0]).abs()
    area = grid.solid_angle * where
    return float((error_db * area).sum() / area.sum())


def test_a_sphere_through_the_lobe_is_its_mean_over_the_beam():
    up = SPHERE.directions[..., 2].abs()
    assert mean_error_db(SPHERE, up < 0.8) < 0.01
    assert mean_error_db(SPHERE, up <= 1.0) < 0.03  # beside the poles the lobe has another shape


def test_a_camera_through_the_lobe_is_nearly_its_mean_over_the_beam():
    ahead = CAMERA.directions[..., 0]
    assert mean_error_db(CAMERA, ahead > 0.95) < 0.1
    assert mean_error_db(CAMERA, ahead > 0.0) < 0.25  # towards the corners the lobe is narrower


@pytest.mark.parametrize("grid", [SPHERE, CAMERA], ids=["sphere", "camera"])
def test_what_is_the_same_everywhere_stays(grid):
    shown = through_lobe(steps(grid), view_of(HERE, grid), LOBE)[..., 1]
    torch.testing.assert_close(shown, torch.ones_like(shown), rtol=1e-5, atol=0.0)  # sums of float32


def test_power_over_the_sphere_stays():
    picture = steps(SPHERE)[..., :1]
    shown = through_lobe(picture, view_of(HERE, SPHERE), LOBE)
    before, after = ((one[..., 0] * SPHERE.solid_angle).sum() for one in (picture, shown))
    assert float(after / before) == pytest.approx(1.0, abs=2e-3)  # pixels of 3 degrees in a lobe of 6


def test_what_is_dark_beside_what_is_bright_keeps_its_level():
    picture = torch.full((*SPHERE.shape, 1), 1e-12)
    picture[30, 60] = 1.0
    shown = through_lobe(picture, view_of(HERE, SPHERE), LOBE)[..., 0]
    away = angle_between(SPHERE.directions, SPHERE.directions[30, 60].expand(*SPHERE.shape, 3)) > 5 * LOBE
    torch.testing.assert_close(shown[away], torch.full_like(shown[away], 1e-12), rtol=1e-3, atol=0.0)


def test_turning_the_picture_turns_what_the_lobe_shows():
    picture, view = steps(SPHERE), view_of(HERE, SPHERE)
    torch.testing.assert_close(
        through_lobe(picture.roll(17, 1).flip(0), view, LOBE),
        through_lobe(picture, view, LOBE).roll(17, 1).flip(0),
        rtol=1e-5,
        atol=0.0,
    )


def test_no_lobe_shows_the_picture_itself():
    picture = steps(CAMERA)
    assert through_lobe(picture, view_of(HERE, CAMERA), 0.0) is picture


@pytest.mark.parametrize("grid", [equirect_grid(12, 6), pinhole_grid(9, 6, 90.0)], ids=["sphere", "camera"])
def test_the_gradient_is_that_of_finite_differences(grid):
    generator = torch.Generator().manual_seed(0)
    picture = torch.rand(*grid.shape, 2, generator=generator, dtype=torch.float64).requires_grad_()
    assert torch.autograd.gradcheck(lambda one: through_lobe(one, view_of(HERE, grid), 1.0), (picture,))


@pytest.mark.parametrize("grid", [SPHERE, CAMERA], ids=["sphere", "camera"])
def test_far_from_everything_there_is_nothing_and_beside_it_the_same_delay(grid):
    picture = torch.zeros(*grid.shape, 2)
    picture[20:24, 30:34] = torch.tensor([1.0, 40.0])
    shown = through_lobe(picture, view_of(HERE, grid), LOBE)
    reached = shown[..., 0] > 0
    assert 0.02 < float(reached.float().mean()) < 0.3
    assert not bool(shown[~reached].any())
    delay = shown[reached][:, 1] / shown[reached][:, 0]
    torch.testing.assert_close(delay, torch.full_like(delay, 40.0), rtol=2e-2, atol=0.0)
