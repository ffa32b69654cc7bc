import math

import pytest
import torch

from rf3dgs.core.errors import InputError
from rf3dgs.core.frames import Pose
from rf3dgs.core.grids import list_grid, pinhole_grid
from rf3dgs.evaluation.baselines import InverseDistance, NearestNeighbour
from rf3dgs.spectra.spectrum import stack_spectra


@pytest.mark.parametrize("baseline", [NearestNeighbour, InverseDistance])
def test_a_lookup_returns_the_training_spectrum_at_a_training_position(room, baseline):
    train = room.spectra_at(room.receivers(6))
    answer = baseline(train).render(train.pose, train.grid)
    assert torch.equal(answer.power, train.power)
    assert torch.equal(answer.delay, train.delay)
    assert torch.equal(answer.aod, train.aod)
    assert answer.method == baseline.name


def test_nearest_neighbour_copies_the_nearest(room):
    train = room.spectra_at(room.receivers(6))
    place = Pose(train.pose.position[3] + 0.01)
    answer = NearestNeighbour(train).render(place, train.grid)
    assert torch.equal(answer.power, train.power[3])
    assert torch.equal(answer.pose.position, place.position)


def test_inverse_distance_is_the_linear_mean_with_squared_distances(room):
    train = room.spectra_at(Pose([[5.0, 5, 1], [8.0, 5, 1], [100.0, 5, 1]]))
    answer = InverseDistance(train, neighbours=2).render(Pose((6.0, 5, 1)), train.grid)
    expected = 0.8 * train.power[0] + 0.2 * train.power[1]
    torch.testing.assert_close(answer.power, expected)
    share = 0.8 * train.power[0] / expected
    torch.testing.assert_close(answer.delay, share * train.delay[0] + (1 - share) * train.delay[1])
    torch.testing.assert_close(torch.linalg.vector_norm(answer.aod, dim=-1), torch.ones(train.grid.shape))


def test_a_copy_is_turned_to_the_asked_orientation(room):
    train = room.spectra_at(room.receivers(2))
    turned = Pose.from_yaw(train.pose.position[0], 2 * math.pi * 5 / room.grid.width)
    answer = NearestNeighbour(train).render(turned, train.grid)
    torch.testing.assert_close(answer.power, train.power[0].roll(5, -1), rtol=1e-3, atol=1e-14)
    torch.testing.assert_close(answer.delay, train.delay[0].roll(5, -1), rtol=1e-3, atol=1e-10)
    torch.testing.assert_close(answer.aod, train.aod[0].roll(5, 1), rtol=0, atol=5e-3)


def test_four_pinhole_views_of_a_position_see_all_around_together(room):
    grid = pinhole_grid(32, 24, fov_deg=100)
    place = torch.tensor([6.0, 6, 1.5])
    yaws = torch.arange(4) * (math.pi / 2)
    train = stack_spectra([room.spectrum_at(Pose.from_yaw(place, yaw), grid) for yaw in yaws])
    between = Pose.from_yaw(place, math.pi / 4)
    narrow = pinhole_grid(16, 8, fov_deg=60)
    answer = NearestNeighbour(train).render(between, narrow)
    truth = room.spectrum_at(between, narrow)
    gap = (answer.gain_db - truth.gain_db).abs()
    assert bool((answer.power > 0).all())
    assert float(gap.mean()) < 0.5
    above = NearestNeighbour(train).render(Pose(place), list_grid(torch.tensor([[0.0, 0.0, 1.0]])))
    assert float(above.power) == 0.0


def test_a_lookup_needs_training_spectra(room):
    with pytest.raises(InputError, match="needs training spectra with a pose axis"):
        NearestNeighbour(room.spectrum_at(Pose((5.0, 5, 1))))
    with pytest.raises(InputError, match="neighbours must be at least 1; got 0"):
        InverseDistance(room.spectra_at(room.receivers(2)), neighbours=0)
