import math

import pytest
import torch

from rf3dgs.channel.arrays import ofdm, planar_array
from rf3dgs.channel.response import cfr
from rf3dgs.channel.sounding import Sounding, sounder_response
from rf3dgs.core.errors import InputError
from rf3dgs.core.frames import Pose

RX, TX = planar_array(2, 3, "dipole"), planar_array(2, 1, "isotropic")


def silence(points=8, **changes):
    fields = {
        "response": torch.zeros(6, 2, points),
        "offsets": ofdm(4e8, points),
        "frequency": 60e9,
        "tx": Pose((0.0, 0.0, 2.0)),
        "rx": Pose((3.0, 4.0, 1.0)),
        "array_rx": RX,
        "array_tx": TX,
    }
    return Sounding(**{**fields, **changes})


def test_the_response_is_that_of_cfr_in_double_precision(random_paths):
    paths = random_paths(5, rx=Pose.from_yaw([3.0, 4.0, 1.0], 0.7))
    offsets = ofdm(4e8, 8)
    response = sounder_response(paths, RX, TX, offsets)
    assert response.dtype == torch.complex128
    expected = cfr(paths, RX, TX, offsets).to(torch.complex128)
    # cfr rounds its result to complex64: 2^-24 of the largest entry.
    assert float((response - expected).abs().max()) < 2e-7 * float(expected.abs().max())


def test_pieces_of_paths_do_not_change_the_response(random_paths, monkeypatch):
    paths = random_paths(50)
    whole = sounder_response(paths, RX, TX, ofdm(4e8, 8))
    monkeypatch.setattr("rf3dgs.channel.sounding.AT_ONCE", 64)
    assert torch.allclose(sounder_response(paths, RX, TX, ofdm(4e8, 8)), whole, rtol=1e-10, atol=1e-18)


@pytest.mark.parametrize("end", ["fov_rx", "fov_tx"])
def test_waves_outside_the_vertical_field_of_view_are_not_seen(paths_from, end):
    up = torch.deg2rad(torch.tensor([0.0, 14.0, 16.0, -16.0]))
    paths = paths_from(torch.stack((torch.cos(up), torch.zeros(4), torch.sin(up)), -1))
    heard = [sounder_response(paths._map(lambda v, i=i: v[i : i + 1]), None, None, torch.zeros(1)) for i in range(4)]
    narrow = sounder_response(paths, None, None, torch.zeros(1), **{end: math.radians(30.0)})
    assert torch.allclose(narrow, heard[0] + heard[1], rtol=1e-12)


def test_the_field_of_view_turns_with_the_device(paths_from):
    tilted = Pose.look_at((3.0, 4.0, 1.0), (4.0, 4.0, 2.0))
    ahead = paths_from([[1.0, 0.0, 1.0]], rx=tilted)
    level = paths_from([[1.0, 0.0, 0.0]], rx=tilted)
    view = {"fov_rx": math.radians(60.0)}
    assert float(sounder_response(ahead, None, None, torch.zeros(1), **view).abs()) == pytest.approx(1.0, abs=1e-6)
    assert float(sounder_response(level, None, None, torch.zeros(1), **view).abs()) == 0.0


@pytest.mark.parametrize("points", [1, 7, 8])
def test_taps_and_back_is_the_same_sounding(points):
    generator = torch.Generator().manual_seed(0)
    response = torch.view_as_complex(torch.randn(6, 2, points, 2, generator=generator, dtype=torch.float64))
    sounding = silence(points, response=response)
    taps, delay = sounding.taps()
    assert delay[-1] == pytest.approx((points - 1) / 4e8 if points > 1 else 0.0)
    again = Sounding.from_taps(taps, 1 / 4e8, 60e9, sounding.tx, sounding.rx, array_rx=RX, array_tx=TX)
    assert torch.allclose(again.response, response, atol=1e-12)
    assert torch.allclose(again.offsets, sounding.offsets, atol=1e-3)


def test_a_path_on_a_tap_is_one_tap(paths_from):
    paths = paths_from([[1.0, 0.0, 0.0]], delays=[3 / 4e8])
    sounding = silence(
        response=sounder_response(paths, None, None, ofdm(4e8, 8)), array_rx=None, array_tx=None, rx=paths.rx
    )
    taps, _ = sounding.taps()
    expected = torch.zeros(8, dtype=torch.float64)
    expected[3] = 1.0
    # The delay is float32: 7.5 ns to 1e-7 of itself, 1e-7 of a tap.
    assert torch.allclose(taps.abs().squeeze(), expected, atol=1e-6)


def test_receivers_are_indexed_with_their_noise_and_pose():
    rx = Pose([[1.0, 0.0, 1.0], [2.0, 0.0, 1.0]])
    sounding = silence(response=torch.zeros(2, 6, 2, 8), rx=rx, noise_power=torch.tensor([1.0, 2.0]))
    assert float(sounding[1].noise_power) == 2.0
    assert sounding[1].rx.position.tolist() == [2.0, 0.0, 1.0]
    assert sounding[:1].response.shape == (1, 6, 2, 8)
    assert silence(noise_power=0.5).flat().response.shape == (1, 6, 2, 8)
    assert silence().period == pytest.approx(8 / 4e8)
    with pytest.raises(InputError, match="there is no receiver axis to index"):
        silence()[0]


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"response": torch.zeros(2, 6, 8)}, r"response must be .* with \[6, 2, 8\] last.*; got \[2, 6, 8\]"),
        ({"offsets": ofdm(4e8, 8) + 60e9}, "Subtract the carrier"),
        ({"offsets": torch.tensor([0.0, 1e6, 3e6, 4e6, 5e6, 6e6, 7e6, 8e6])}, "offsets must rise in even steps"),
        ({"offsets": ofdm(4e8, 8).flip(0)}, "offsets must rise in even steps"),
        ({"frequency": 0.0}, "frequency must be positive"),
        ({"rx": Pose([[3.0, 4.0, 1.0]])}, r"rx \[\] poses, one per response; got \[\] and \[1\]"),
        ({"fov_rx": 45.0}, "fov_rx must be an angle in radians"),
        ({"noise_power": -1.0}, "noise_power must be"),
        ({"response": torch.full((6, 2, 8), math.nan)}, "NaN or infinite"),
    ],
)
def test_what_does_not_fit_is_refused(changes, message):
    with pytest.raises(InputError, match=message):
        silence(**changes)


def test_taps_need_a_step_in_seconds():
    with pytest.raises(InputError, match="delay_step must be a positive time"):
        Sounding.from_taps(torch.zeros(1, 1, 4), 0.0, 60e9, Pose((0.0, 0.0, 0.0)), Pose((1.0, 0.0, 0.0)))
