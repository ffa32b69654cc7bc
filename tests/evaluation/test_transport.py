import math

import numpy as np
import pytest
import torch
from scipy import sparse
from scipy.optimize import linprog
from scipy.stats import wasserstein_distance

from rf3dgs.core.angles import angle_between
from rf3dgs.core.frames import Pose
from rf3dgs.core.grids import DirectionGrid, equirect_grid, list_grid, pinhole_grid
from rf3dgs.evaluation.transport import angular_wasserstein
from rf3dgs.spectra.spectrum import Instrument, Spectrum

LOBE = Instrument.gaussian(math.radians(12))


def spectrum(power: torch.Tensor, grid: DirectionGrid) -> Spectrum:
    return Spectrum(power, grid, Pose((0.0, 0, 0)), 60e9, LOBE)


def shares(energies: dict[tuple[int, int], float], grid: DirectionGrid) -> Spectrum:
    """A spectrum whose pixels (row, col) hold these energies (power times solid angle), and no others any."""
    power = torch.zeros(grid.shape)
    for pixel, energy in energies.items():
        power[pixel] = 1e-9 * energy / grid.solid_angle[pixel]
    return spectrum(power, grid)


@pytest.mark.parametrize("grid", [equirect_grid(36, 18), pinhole_grid(36, 24, fov_deg=90)], ids=["sphere", "pinhole"])
def test_two_single_directions_are_their_angle_apart(grid):
    generator = torch.Generator().manual_seed(0)
    for _ in range(20):
        rows = torch.randint(0, grid.height, (2,), generator=generator)
        cols = torch.randint(0, grid.width, (2,), generator=generator)
        first, second = zip(rows.tolist(), cols.tolist(), strict=True)
        angle = angle_between(grid.directions[first], grid.directions[second])
        distance = angular_wasserstein(shares({first: 1.0}, grid), shares({second: 0.2}, grid))
        torch.testing.assert_close(distance, angle, atol=1e-5, rtol=0)


def test_a_share_that_moves_counts_as_its_share_of_the_way():
    grid = equirect_grid(36, 18)
    strong, weak, elsewhere = (9, 4), (6, 20), (12, 30)
    truth = shares({strong: 0.7, weak: 0.3}, grid)
    leaked = shares({strong: 0.6, weak: 0.4}, grid)
    way = float(angle_between(grid.directions[strong], grid.directions[weak]))
    assert float(angular_wasserstein(truth, leaked)) == pytest.approx(0.1 * way, abs=1e-5)
    way = float(angle_between(grid.directions[strong], grid.directions[elsewhere]))
    lost = shares({strong: 0.5, elsewhere: 0.5}, grid)
    alone = shares({strong: 1.0}, grid)
    assert float(angular_wasserstein(alone, lost)) == pytest.approx(0.5 * way, abs=1e-5)


def test_power_along_a_meridian_is_moved_as_scipy_moves_it_along_a_line():
    grid = equirect_grid(36, 60)
    generator = torch.Generator().manual_seed(1)
    weights = torch.rand(2, grid.height, generator=generator) ** 4
    powers = torch.zeros(2, *grid.shape)
    powers[:, :, 7] = 1e-9 * weights / grid.solid_angle[:, 7]
    zenith = (np.arange(grid.height) + 0.5) * math.pi / grid.height
    expected = wasserstein_distance(zenith, zenith, *weights.double().numpy())
    distance = angular_wasserstein(*(spectrum(power, grid) for power in powers))
    assert float(distance) == pytest.approx(expected, rel=1e-5)


def best_transport(first: np.ndarray, second: np.ndarray, cost: np.ndarray) -> float:
    """The exact distance of two distributions `[n]`: the linear programme over all plans `[n, n]`."""
    count = len(first)
    leaving = sparse.kron(sparse.eye(count), np.ones((1, count)))
    arriving = sparse.kron(np.ones((1, count)), sparse.eye(count))
    rows = sparse.vstack([leaving, arriving]).tocsr()[:-1]  # one condition follows from the others
    plan = linprog(cost.ravel(), A_eq=rows, b_eq=np.concatenate((first, second))[:-1], method="highs")
    assert plan.success
    return float(plan.fun)


def test_it_is_a_lower_bound_of_the_best_transport_and_near_it(room):
    grid = equirect_grid(20, 10)
    truth, other = room.spectra_at(room.receivers(4), grid), room.spectra_at(room.receivers(4, seed=1), grid)
    directions = grid.directions.reshape(-1, 3).double()
    square = (len(directions), len(directions), 3)
    cost = angle_between(directions[:, None].expand(square), directions.expand(square)).numpy()
    ratios = []
    found = angular_wasserstein(truth, other)
    for index in range(4):
        first, second = ((one.power[index].double() * grid.solid_angle).flatten() for one in (truth, other))
        exact = best_transport((first / first.sum()).numpy(), (second / second.sum()).numpy(), cost)
        ratios.append(float(found[index]) / exact)
    assert max(ratios) <= 1 + 1e-5
    assert min(ratios) > 0.7  # rooms like this one; skies of many lobes that all move differently fall lower


def test_neither_a_gain_nor_a_faint_floor_changes_it_and_the_order_does_not_matter(room):
    truth, other = (room.spectrum_at(room.receivers(2)[index]) for index in range(2))
    distance = angular_wasserstein(truth, other)
    louder = spectrum(other.power * 100, other.grid)
    floored = spectrum(other.power + 1e-6 * other.power.mean(), other.grid)
    torch.testing.assert_close(angular_wasserstein(truth, louder), distance)
    torch.testing.assert_close(angular_wasserstein(truth, floored), distance, rtol=1e-4, atol=0)
    torch.testing.assert_close(angular_wasserstein(other, truth), distance)
    assert float(angular_wasserstein(truth, truth)) == 0.0


def test_a_dark_prediction_is_as_far_as_can_be(room):
    truth = room.spectra_at(room.receivers(2))
    power = truth.power.clone()
    power[1] = 0.0
    dark = Spectrum(power, truth.grid, truth.pose, 60e9, LOBE)
    torch.testing.assert_close(angular_wasserstein(truth, dark), torch.tensor([0.0, math.pi]))


def test_a_pole_of_many_pixels_is_one_direction():
    grid = equirect_grid(72, 36)
    around, once = torch.zeros(2, *grid.shape)
    around[0] = 1.0
    once[0, 0] = 1.0
    # half a pixel off the pole, so on average 2.5 degrees times 4 / pi from the one
    assert float(angular_wasserstein(spectrum(around, grid), spectrum(once, grid))) < math.radians(4)


def test_directions_of_a_list_without_solid_angles_count_alike():
    grid = list_grid(torch.tensor([[1.0, 0, 0], [0, 1, 0]]))
    first, second = (spectrum(torch.tensor([row]), grid) for row in ([1.0, 0.0], [1.0, 1.0]))
    assert float(angular_wasserstein(first, second)) == pytest.approx(math.pi / 4, abs=1e-5)
