import math
from dataclasses import replace

import pytest
import torch

from rf3dgs.channel.arrays import planar_array
from rf3dgs.channel.sounding import sounder_response
from rf3dgs.core.errors import InputError
from rf3dgs.core.frames import Pose
from rf3dgs.propagation.sounder import BOLTZMANN, Sounder, sound

SOUNDER = Sounder(bandwidth=1e9, points=256, array_rx=planar_array(2, 2), array_tx=planar_array(2, 2, "isotropic"))


def batch_of(paths, count):
    rx = Pose(paths.rx.position.expand(count, 3), paths.rx.orientation.expand(count, 4))
    return paths._map(lambda value: value.expand(count, -1), rx=rx)


def test_without_noise_a_sounding_is_the_response_of_its_paths(random_paths):
    paths = random_paths(6)
    sounding = sound(paths, SOUNDER)
    expected = sounder_response(paths, SOUNDER.array_rx, SOUNDER.array_tx, sounding.offsets)
    assert torch.equal(sounding.response, expected)
    assert float(sounding.noise_power) == 0.0
    assert sounding.bandwidth == pytest.approx(1e9)
    assert not sounding.delay_offset


def test_noise_has_the_power_that_it_says(random_paths):
    sounding = sound(random_paths(6), replace(SOUNDER, snr_db=10.0))
    clean = sound(random_paths(6), SOUNDER)
    noise = (sounding.response - clean.response).abs().square()
    assert float(clean.response.abs().square().mean() / sounding.noise_power) == pytest.approx(10.0)
    # The mean of 4096 exponential variables: deviation 1/64; four of them.
    assert float(noise.mean() / sounding.noise_power) == pytest.approx(1.0, abs=4 / 64)
    rest = sounding.response - clean.response
    assert float(rest.mean().abs() / sounding.noise_power.sqrt()) < 4 / 64
    assert float(rest.square().mean().abs() / sounding.noise_power) < 4 / 64  # circular


def test_thermal_noise_is_boltzmanns():
    sounder = replace(SOUNDER, tx_power_dbm=20.0, noise_figure_db=7.0, averages=10)
    # -174 dBm/Hz + 90 dB Hz + 7 dB - 20 dBm - 10 dB, to the hundredth that -174 is rounded to.
    assert 10 * math.log10(sounder.noise_power) == pytest.approx(-174 + 90 + 7 - 20 - 10, abs=0.03)
    assert replace(sounder, noise_figure_db=0.0, averages=1, tx_power_dbm=30.0).noise_power == pytest.approx(
        BOLTZMANN * 290 * 1e9
    )


def test_paths_outside_either_view_leave_no_trace(paths_from):
    steep = paths_from([[1.0, 0.0, 1.0]])
    for end in ("fov_rx_deg", "fov_tx_deg"):
        assert float(sound(steep, replace(SOUNDER, **{end: 80.0})).response.abs().max()) == 0.0
        assert float(sound(steep, replace(SOUNDER, **{end: 100.0})).response.abs().max()) > 0.0


def test_clocks_turn_and_delay_a_receivers_whole_response(random_paths):
    paths = batch_of(random_paths(6), 3)
    clean = sound(paths, SOUNDER)
    off = sound(paths, replace(SOUNDER, delay_error=5e-9, phase_error=2.0, seed=4))
    assert off.delay_offset
    ratio = off.response / clean.response
    assert torch.allclose(ratio.abs(), torch.ones(()).double(), atol=1e-9)
    turn = ratio[:, 0, 0]
    step = torch.angle(turn[:, 1:] * turn[:, :-1].conj()) / (-2 * math.pi * clean.spacing)
    # One delay per receiver, the same at all frequencies and elements, another for each receiver.
    assert float((step - step[:, :1]).abs().max()) < 1e-15
    assert len({round(1e12 * float(value)) for value in step[:, 0]}) == 3
    assert torch.allclose(ratio, turn[:, None, None].expand_as(ratio), atol=1e-9)


def test_a_seed_repeats_and_receivers_draw_their_own(random_paths):
    paths = batch_of(random_paths(6), 2)
    first, again, other = (sound(paths, replace(SOUNDER, snr_db=10.0, seed=seed)) for seed in (0, 0, 1))
    assert torch.equal(first.response, again.response)
    assert not torch.equal(first.response[0], first.response[1])
    assert torch.equal(first.response[1], other.response[0])


def test_a_receiver_that_nothing_reaches_has_silence_or_noise(random_paths):
    paths = random_paths(3)
    paths.valid[:] = False
    assert float(sound(paths, replace(SOUNDER, snr_db=10.0)).response.abs().max()) == 0.0
    thermal = sound(paths, replace(SOUNDER, tx_power_dbm=10.0))
    assert float(thermal.response.abs().square().mean() / thermal.noise_power) == pytest.approx(1.0, abs=4 / 64)
    none = paths._map(lambda value: value[:0])
    assert float(sound(none, SOUNDER).response.abs().max()) == 0.0


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"snr_db": 10.0, "tx_power_dbm": 0.0}, "noise is given twice"),
        ({"fov_rx_deg": 0.0}, "fov_rx_deg must be above 0 and up to 180 degrees"),
        ({"fov_tx_deg": 200.0}, "fov_tx_deg must be above 0 and up to 180 degrees"),
        ({"averages": 0}, "averages must be at least 1"),
        ({"delay_error": -1e-9}, "averages must be at least 1, delay_error"),
        ({"points": 50}, r"over 1e\+09 Hz tell 5e-08 s; use at least \d+ points"),
    ],
)
def test_settings_that_cannot_be_are_refused(random_paths, changes, message):
    with pytest.raises(InputError, match=message):
        sound(random_paths(6), replace(SOUNDER, **changes))
