import math

import pytest
import torch

from rf3dgs.channel.arrays import ofdm, planar_array
from rf3dgs.channel.response import manifold
from rf3dgs.core.errors import InputError
from rf3dgs.core.frames import Pose
from rf3dgs.core.units import SPEED_OF_LIGHT


def test_line_of_sight_gain_equals_friis(line_of_sight):
    paths = line_of_sight(Pose([0.0, 0.0, 2.0]), Pose([3.0, 4.0, 2.0]))
    expected = (SPEED_OF_LIGHT / 60e9 / (4 * math.pi * 5.0)) ** 2
    assert float(paths.cfr().abs().square().squeeze()) == pytest.approx(expected, rel=1e-5)


def test_cfr_is_the_direct_formula(random_paths):
    rx, tx = planar_array(2, 3, "dipole"), planar_array(2, 1, "isotropic")
    paths = random_paths(5, rx=Pose.from_yaw([3.0, 4.0, 1.0], 0.7))
    offsets = ofdm(400e6, 8)
    response = paths.cfr(rx, tx, offsets)
    assert response.shape == (6, 2, 8)
    expected = torch.zeros(6, 2, 8, dtype=torch.complex128)
    for p in range(5):
        a_rx = manifold(rx, paths.rx.to_device(paths.aoa[p]).double())
        a_tx = manifold(tx, paths.tx.to_device(paths.aod[p]).double())
        for k in range(8):
            turn = math.fmod((60e9 + float(offsets[k])) * float(paths.delay[p]), 1.0)
            phase = complex(math.cos(2 * math.pi * turn), -math.sin(2 * math.pi * turn))
            expected[:, :, k] += complex(paths.coeff[p]) * phase * a_rx[:, None] * a_tx
    assert torch.allclose(response.to(torch.complex128), expected, rtol=1e-4, atol=1e-9)


def test_phase_zero_adds_amplitudes_at_the_carrier(random_paths):
    paths = random_paths(7)
    response = paths.cfr(phase="zero").squeeze()
    assert float(response.real) == pytest.approx(float(paths.coeff.abs().sum()), rel=1e-5)
    assert float(response.imag) == pytest.approx(0.0, abs=1e-9)


def test_phase_random_keeps_powers_and_repeats_with_its_seed(random_paths):
    paths = random_paths(7)
    first, delay = paths.cir(phase="random", seed=3)
    again, _ = paths.cir(phase="random", seed=3)
    other, _ = paths.cir(phase="random", seed=4)
    assert torch.equal(first, again)
    assert not torch.allclose(first, other)
    assert torch.allclose(first.squeeze().abs(), paths.coeff.abs(), rtol=1e-5)
    assert torch.equal(delay, paths.delay)


def test_an_unknown_phase_is_refused(random_paths):
    with pytest.raises(InputError, match='phase must be "carrier", "zero" or "random"'):
        random_paths(2).cfr(phase="none")


def test_cir_sums_to_the_cfr_at_the_carrier(random_paths):
    array = planar_array(2, 2)
    paths = random_paths(9)
    amplitude, _ = paths.cir(array, array)
    assert amplitude.shape == (4, 4, 9)
    assert torch.allclose(amplitude.sum(-1), paths.cfr(array, array)[..., 0], rtol=1e-4, atol=1e-9)


def test_chunks_of_paths_do_not_change_the_cfr(random_paths, monkeypatch):
    paths = random_paths(50)
    array = planar_array(2, 2)
    whole = paths.cfr(array, subcarriers=ofdm(1e8, 4))
    monkeypatch.setattr("rf3dgs.channel.response.AT_ONCE", 64)
    assert torch.allclose(paths.cfr(array, subcarriers=ofdm(1e8, 4)), whole, rtol=1e-4, atol=1e-10)


def test_invalid_paths_are_silent_and_receivers_are_batched(random_paths):
    paths = random_paths(6)
    silent = paths._map(lambda value: value)
    silent.valid[3:] = False
    few = paths._map(lambda value: value[:3])
    assert torch.allclose(silent.cfr(), few.cfr(), rtol=1e-5)
    rx = Pose(torch.stack((paths.rx.position, paths.rx.position)))
    both = paths._map(lambda value: torch.stack((value, value)), rx=rx)
    assert both.cfr(planar_array(2, 2), subcarriers=ofdm(1e8, 3)).shape == (2, 4, 1, 3)
