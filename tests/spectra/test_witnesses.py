"""Array spectra against formulas written down a second time: NumPy, explicit loops, other factorisations."""

import math

import numpy as np
import pytest
import torch

from rf3dgs.channel.arrays import planar_array
from rf3dgs.channel.response import manifold
from rf3dgs.core.grids import pinhole_grid
from rf3dgs.spectra.beamformers import bartlett, capon, hann_taper, music, tapered
from rf3dgs.spectra.config import ArrayProcessing
from rf3dgs.spectra.covariance import covariance_of
from rf3dgs.spectra.order import source_count
from rf3dgs.spectra.scan import spectrum_of
from rf3dgs.spectra.steering import PlanarSteering

ARRAY = planar_array(3, 4, "tr38901", vertical=0.6, horizontal=0.45)
GRID = pinhole_grid(9, 7, 100)
SNAPSHOTS = 60
RELATIVE = 1e-6


def _steering(direction, array=ARRAY):
    """Element by element: position from row and column, phase from the projection onto the direction."""
    _, y, z = (float(part) for part in direction)
    response = np.empty(array.rows * array.cols, dtype=complex)
    for row in range(array.rows):
        for col in range(array.cols):
            left = (col - (array.cols - 1) / 2) * array.horizontal
            up = ((array.rows - 1) / 2 - row) * array.vertical
            response[row + col * array.rows] = np.exp(2j * math.pi * (left * y + up * z))
    return response


def _snapshots(seed=0):
    """Three sources of unequal power and noise, complex128 `[element, snapshot]`."""
    generator = np.random.default_rng(seed)
    towards = [(0.9, 0.3, 0.316), (0.8, -0.5, 0.332), (0.95, 0.0, -0.312)]
    x = 0.1 * (generator.normal(size=(ARRAY.count, SNAPSHOTS, 2)) @ [1, 1j])
    for power, direction in zip((1.0, 0.5, 0.3), towards, strict=True):
        signal = generator.normal(size=(SNAPSHOTS, 2)) @ [1, 1j]
        x = x + math.sqrt(power / 2) * np.outer(_steering(direction), signal)
    return x


def _covariance(x):
    """Mean outer product, one snapshot after the other."""
    total = np.zeros((len(x), len(x)), dtype=complex)
    for column in x.T:
        total += column[:, None] * column.conj()[None, :]
    return total / x.shape[1]


def _picture(function):
    directions = GRID.directions.double().numpy()
    return np.array([[function(_steering(directions[row, col])) for col in range(9)] for row in range(7)])


@pytest.fixture(params=["manifold", "planar"])
def steering(request):
    return (
        manifold(ARRAY, GRID.directions.double())
        if request.param == "manifold"
        else PlanarSteering(ARRAY, GRID.directions)
    )


def test_bartlett_is_the_mean_power_of_the_steered_sum(steering):
    x = _snapshots()
    expected = _picture(lambda v: np.mean([abs(sum(v.conj() * column)) ** 2 for column in x.T]) / ARRAY.count**2)
    found = bartlett(torch.from_numpy(_covariance(x)), steering).numpy()
    assert np.allclose(found, expected, rtol=RELATIVE, atol=0)


def test_tapered_is_the_mean_power_of_the_weighted_sum(steering):
    x = _snapshots()
    weight = np.empty(ARRAY.count)
    for row in range(ARRAY.rows):
        for col in range(ARRAY.cols):
            vertical = 0.5 - 0.5 * math.cos(2 * math.pi * (row + 1) / (ARRAY.rows + 1))
            horizontal = 0.5 - 0.5 * math.cos(2 * math.pi * (col + 1) / (ARRAY.cols + 1))
            weight[row + col * ARRAY.rows] = vertical * horizontal
    weight /= weight.sum()
    expected = _picture(lambda v: np.mean(np.abs((weight * v).conj() @ x) ** 2))
    found = tapered(torch.from_numpy(_covariance(x)), steering, hann_taper(ARRAY)).numpy()
    assert np.allclose(found, expected, rtol=RELATIVE, atol=0)


def test_capon_is_the_least_power_of_all_weights_that_pass_the_direction(steering):
    """By eigenvalues: 1 / sum_i |v^H e_i|^2 / (lambda_i + loading)."""
    R = _covariance(_snapshots())
    values, vectors = np.linalg.eigh(R)
    values = values + 1e-3 * np.trace(R).real / ARRAY.count
    expected = _picture(
        lambda v: 1.0 / sum(abs(np.vdot(vectors[:, i], v)) ** 2 / values[i] for i in range(ARRAY.count))
    )
    assert np.allclose(capon(torch.from_numpy(R), steering).numpy(), expected, rtol=RELATIVE, atol=0)


def test_capon_is_beaten_by_no_weight(steering):
    """Its power is that of w^H R w at w = R^-1 v / (v^H R^-1 v), and random other w with w^H v = 1 let more through."""
    R = _covariance(_snapshots())
    full = R + 1e-3 * np.trace(R).real / ARRAY.count * np.eye(ARRAY.count)
    v = _steering(GRID.directions[2, 5].double())
    power = float(capon(torch.from_numpy(R), steering)[2, 5])
    weight = np.linalg.solve(full, v)
    weight /= np.vdot(weight, v).conj()
    assert power == pytest.approx(np.vdot(weight, full @ weight).real, rel=RELATIVE)
    generator = np.random.default_rng(1)
    for _ in range(50):
        other = weight + 0.1 * (generator.normal(size=(ARRAY.count, 2)) @ [1, 1j]) / ARRAY.count
        other /= np.vdot(other, v).conj()
        assert np.vdot(other, full @ other).real > power


def test_music_measures_the_distance_to_the_signal_subspace(steering):
    """By the singular vectors of the snapshots: 1 / (1 - |U^H v|^2 / M), never forming a covariance."""
    x = _snapshots()
    left = np.linalg.svd(x)[0][:, :3]
    expected = _picture(lambda v: 1.0 / (1.0 - np.linalg.norm(left.conj().T @ v) ** 2 / ARRAY.count))
    found = music(torch.from_numpy(_covariance(x)), steering, 3).numpy()
    assert np.allclose(found, expected, rtol=RELATIVE, atol=0)


@pytest.mark.parametrize("criterion", ["mdl", "aic"])
def test_criteria_are_the_likelihood_ratio_and_its_penalty(criterion):
    """Products instead of logarithms, for every order; then the first least."""
    R = _covariance(_snapshots(seed=4))
    values = sorted(np.linalg.eigvalsh(R), reverse=True)
    costs = []
    for k in range(ARRAY.count):
        rest = values[k:]
        ratio = math.prod(rest) ** (1 / len(rest)) / (sum(rest) / len(rest))
        free = k * (2 * ARRAY.count - k)
        likelihood = -SNAPSHOTS * len(rest) * math.log(ratio)
        costs.append(likelihood + (free if criterion == "aic" else free * math.log(SNAPSHOTS) / 2))
    assert int(source_count(torch.from_numpy(R), SNAPSHOTS, criterion)) == costs.index(min(costs)) == 3


def test_the_covariance_of_paths_is_the_mean_outer_product_of_direct_sums(random_paths):
    paths, count, bandwidth = random_paths(40), 16, 4e8
    array = planar_array(2, 3, "isotropic", vertical=0.7)
    expected = np.zeros((array.count, array.count), dtype=complex)
    directions = paths.aoa.double().numpy()
    for k in range(count):
        offset = (k - count // 2) * bandwidth / count
        x = np.zeros(array.count, dtype=complex)
        for p in range(40):
            turn = math.fmod((paths.frequency + offset) * float(paths.delay[p]), 1.0)
            x += complex(paths.coeff[p]) * np.exp(-2j * math.pi * turn) * _steering(directions[p], array)
        expected += np.outer(x, x.conj()) / count
    found = covariance_of(paths, array, snapshots=count, bandwidth=bandwidth).numpy()
    assert np.abs(found - expected).max() < RELATIVE * np.abs(expected).max()


@pytest.mark.parametrize("pattern", ["isotropic", "patch", "tr38901", "dipole"])
@pytest.mark.parametrize("shape", [(1, 1), (1, 6), (5, 1), (6, 7)], ids=str)
def test_planar_steering_is_the_manifold(pattern, shape, random_paths):
    """The lags of a planar array give the same numbers as the full matrix, for every beamformer."""
    array = planar_array(*shape, pattern, vertical=0.6, horizontal=0.45)
    R = covariance_of(random_paths(300), array, snapshots=128, snr_db=20)
    fast, slow = PlanarSteering(array, GRID.directions), manifold(array, GRID.directions.double())
    pairs = [(bartlett(R, A), tapered(R, A, hann_taper(array)), capon(R, A)) for A in (fast, slow)]
    for one, other in zip(*pairs, strict=True):
        assert torch.allclose(one, other, rtol=1e-9, atol=1e-13 * float(other.max()))
    if array.count > 2:
        assert torch.allclose(music(R, fast, 2), music(R, slow, 2), rtol=1e-9)


def test_uncorrelated_paths_by_lags_are_the_sum_of_outer_products(random_paths):
    paths, array = random_paths(10_000), planar_array(4, 3, "patch")
    found = covariance_of(paths, array)
    amplitude = manifold(array, paths.rx.to_device(paths.aoa).double()) * paths.path_gain.double().sqrt()[:, None]
    expected = amplitude.mT @ amplitude.conj()
    # the same sum of 10,000 terms of which few cancel, in another order, from directions rounded to float32
    assert float((found - expected).abs().max() / expected.abs().max()) < 1e-6


def test_spectrum_of_is_covariance_then_beamformer(random_paths):
    paths, array = random_paths(50), planar_array(4, 4)
    R = covariance_of(paths, array, snapshots=64, snr_db=15, seed=3)
    A = manifold(array, GRID.directions.double())
    expected = {"capon": capon(R, A) / array.peak_gain, "music": music(R, A, 5)}
    for method, power in expected.items():
        how = ArrayProcessing(snapshots=64, snr_db=15, sources=5 if method == "music" else None)
        found = spectrum_of(paths, array, GRID, method=method, processing=how, seed=3).power
        assert torch.allclose(found, power.float(), rtol=1e-5)
