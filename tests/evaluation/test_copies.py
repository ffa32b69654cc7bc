"""Laws of what learns nothing: linear interpolation, the constant, the line of sight."""

import math

import pytest
import torch
from benchmarks.quality.methods import copies
from benchmarks.quality.methods.method import Task

from rf3dgs.core.angles import angle_between
from rf3dgs.core.errors import InputError
from rf3dgs.core.frames import Pose
from rf3dgs.core.grids import equirect_grid, pinhole_grid, sample_grid
from rf3dgs.core.units import SPEED_OF_LIGHT, friis_gain
from rf3dgs.evaluation.baselines import Constant, LinearInterpolation, LineOfSight
from rf3dgs.evaluation.metrics import peak_direction
from rf3dgs.spectra.codec import window_of
from rf3dgs.spectra.spectrum import Instrument, Spectrum, stack_spectra
from rf3dgs.splats.obstacles import Obstacles

GRID = equirect_grid(24, 12)
INSTRUMENT = Instrument.gaussian(math.radians(15))


def linear_field(pose: Pose, grid=GRID, *, height: float = 0.0) -> Spectrum:
    """Power linear in position [m], in every direction by another slope."""
    world = pose.to_world(grid.directions.expand(len(pose), *grid.shape, 3))
    place = pose.position * torch.tensor([1.0, 1.0, height])
    power = 30.0 + (world * place[:, None, None]).sum(-1)
    return Spectrum(power, grid, pose, 60e9, INSTRUMENT)


@pytest.mark.parametrize(("span", "height"), [(0.0, 0.0), (2.0, 1.0)])
def test_linear_interpolation_reproduces_a_field_that_is_linear_in_position(span, height):
    high = (4.0, 4.0, 1.0 + span)
    train = linear_field(Pose.scatter(((0.0, 0, 1.0), high), 40, 0), height=height)
    inside = Pose.scatter(((1.5, 1.5, 1.0 + 0.4 * span), (2.5, 2.5, 1.0 + 0.6 * span)), 8, 1)
    answer = LinearInterpolation(train).render(inside, GRID)
    torch.testing.assert_close(answer.power, linear_field(inside, height=height).power, rtol=1e-5, atol=1e-4)


def test_linear_interpolation_returns_the_training_spectrum_at_a_training_position(room):
    train = room.spectra_at(room.receivers(9))
    answer = LinearInterpolation(train).render(train.pose, train.grid)
    torch.testing.assert_close(answer.power, train.power, rtol=1e-5, atol=0.0)
    torch.testing.assert_close(answer.delay, train.delay, rtol=1e-5, atol=0.0)
    torch.testing.assert_close(answer.aod, train.aod, rtol=0.0, atol=1e-5)


def test_outside_their_hull_and_without_one_linear_interpolation_copies_the_nearest():
    train = linear_field(Pose([[0.0, 0, 1], [1.0, 0, 1], [0.0, 1, 1], [1.0, 1, 1]]))
    far = LinearInterpolation(train).render(Pose((5.0, 0.1, 1)), GRID)
    assert torch.equal(far.power, train.power[1])
    two = LinearInterpolation(train[:2]).render(Pose((0.4, 0, 1)), GRID)
    assert torch.equal(two.power, train.power[0])
    line = linear_field(Pose([[0.0, 0, 1], [1.0, 0, 1], [2.0, 0, 1], [3.0, 0, 1]]))
    assert torch.equal(LinearInterpolation(line).render(Pose((2.2, 0, 1)), GRID).power, line.power[2])


def test_heights_count_only_where_positions_span_them():
    flat = linear_field(Pose([[0.0, 0, 1.0], [1.0, 0, 1.1], [0.0, 1, 1.2], [1.0, 1, 1.0]]))
    low, high = (LinearInterpolation(flat).render(Pose((0.3, 0.2, z)), GRID) for z in (0.0, 9.0))
    assert torch.equal(low.power, high.power)


def test_the_constant_is_the_mean_in_the_world_and_the_same_at_every_pose(room):
    train = room.spectra_at(room.receivers(6))
    constant = Constant(train)
    here, there = (constant.render(Pose(place), train.grid) for place in ((1.0, 2, 1), (9.0, 9, 2)))
    assert torch.equal(here.power, there.power)
    torch.testing.assert_close(here.power, train.power.mean(0))
    weight = train.power.double() / train.power.double().sum(0)
    torch.testing.assert_close(here.delay, (weight * train.delay).sum(0).float())
    turned = constant.render(Pose.from_yaw((3.0, 3, 1), 2 * math.pi * 5 / room.grid.width), train.grid)
    torch.testing.assert_close(turned.power, here.power.roll(5, -1), rtol=1e-3, atol=1e-14)


def test_pictures_of_many_orientations_make_one_constant(room):
    """Directions that several pictures have seen are averaged over all of them, whatever pose is asked."""
    grid, yaws = pinhole_grid(16, 12, fov_deg=120), (0.0, math.pi / 2)
    one, other = (room.spectrum_at(Pose.from_yaw((6.0, 6, 1.5), yaw), grid) for yaw in yaws)
    answer = Constant(stack_spectra([one, one, other])).render(one.pose, grid)
    direction = one.pose.to_world(grid.directions)
    _, both = grid.pixel_of(other.pose.to_device(direction))
    torch.testing.assert_close(answer.power[~both], one.power[~both], rtol=1e-4, atol=0.0)
    weighed = (2 * one.power + sample_grid(other.power[..., None], grid, other.pose.to_device(direction))[..., 0]) / 3
    assert bool(both.any())
    torch.testing.assert_close(answer.power[both], weighed[both], rtol=1e-4, atol=0.0)


def test_the_line_of_sight_is_exact():
    tx, place = torch.tensor([1.0, 2.0, 3.0]), torch.tensor([5.0, 4.0, 1.5])
    grid = equirect_grid(180, 90)
    sight = LineOfSight(Pose(tx), 60e9, Instrument.gaussian(math.radians(8)))
    answer = sight.render(Pose.from_yaw(place, 0.3), grid)
    distance = torch.linalg.vector_norm(tx - place)
    # a lobe of 8 degrees on pixels of 2 is summed to parts in a thousand, its peak found to a share of a pixel
    assert float(answer.path_gain / friis_gain(distance, 60e9)) == pytest.approx(1.0, abs=3e-3)
    assert float(torch.rad2deg(angle_between(peak_direction(answer), tx - place))) < 0.1
    torch.testing.assert_close(answer.delay, torch.full(grid.shape, float(distance) / SPEED_OF_LIGHT))
    torch.testing.assert_close(answer.aod, ((place - tx) / distance).expand(*grid.shape, 3))


def test_a_wall_before_the_transmitter_leaves_no_line_of_sight():
    tx = Pose((0.0, 0.0, 1.0))
    wall = torch.tensor([[2.0, 0.0, 1.0]])
    size = torch.tensor([[0.01, 2.0, 2.0]])
    obstacles = Obstacles(wall, torch.tensor([[1.0, 0, 0, 0]]), size, torch.ones(1))
    sight = LineOfSight(tx, 60e9, INSTRUMENT, obstacles)
    answer = sight.render(Pose([[1.0, 0, 1], [4.0, 0, 1]]), GRID)
    assert float(answer.power[0].max()) > 0
    assert float(answer.power[1].max()) == 0


def test_what_cannot_be_copied_is_refused(room):
    one = room.spectrum_at(Pose((5.0, 5, 1)))
    with pytest.raises(InputError, match="the constant needs training spectra with a pose axis"):
        Constant(one)
    with pytest.raises(InputError, match="a lookup needs training spectra with a pose axis"):
        LinearInterpolation(one)
    with pytest.raises(InputError, match="needs spectra that name their transmitter; give tx"):
        LineOfSight.of(linear_field(room.receivers(2)))


def test_every_method_of_the_file_answers_at_a_held_out_pose(room):
    train = room.spectra_at(room.receivers(6))
    task = Task(train, window_of(train), scale="smoke")
    pose = room.receivers(1, seed=5)[0]
    for method in copies.METHODS:
        answer = method.made(task).render(pose, room.grid)
        assert answer.power.shape == room.grid.shape, method.name
        assert float(answer.power.max()) > 0, method.name
    assert [method.name for method in copies.METHODS] == ["constant", "nearest", "idw4", "idw8", "linear", "los"]
