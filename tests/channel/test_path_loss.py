"""Laws of path loss by formula: published values, ranges, and what a fit gives back."""

import math

import pytest
import torch

from rf3dgs.channel import path_loss
from rf3dgs.core.errors import InputError

DISTANCE = torch.tensor([1.0, 3.0, 10.0, 30.0, 100.0])


def test_free_space_at_a_metre_and_60_ghz_is_68_db_and_6_db_more_at_twice_the_distance():
    loss = path_loss.free_space_loss(torch.tensor([1.0, 2.0]), 60e9)
    assert float(loss[0]) == pytest.approx(32.4478 + 20 * math.log10(60.0), abs=1e-3)  # the usual 32.45 + 20 log10 GHz
    assert float(loss[1] - loss[0]) == pytest.approx(20 * math.log10(2.0), abs=1e-4)


@pytest.mark.parametrize(
    ("frequency", "distance", "sight", "expected"),
    [  # TR 38.901: 32.4 + 17.3 log10 d + 20 log10 f, and 17.30 + 38.3 log10 d + 24.9 log10 f, by hand
        (1e9, 1.0, True, 32.4),
        (60e9, 10.0, True, 32.4 + 17.3 + 35.563),
        (60e9, 10.0, False, 17.3 + 38.3 + 44.276),
        (60e9, 1.0, False, 32.4 + 35.563),  # never less than with a line of sight
    ],
)
def test_the_indoor_office_of_tr_38901_has_its_tabulated_losses(frequency, distance, sight, expected):
    loss = path_loss.tr38901_indoor_loss(torch.tensor(distance), frequency, line_of_sight=sight)
    assert float(loss) == pytest.approx(expected, abs=2e-3)


def test_the_indoor_model_of_the_itu_has_its_tabulated_losses():
    at = torch.tensor(10.0)
    assert float(path_loss.itu_indoor_loss(at, 1e9)) == pytest.approx(14.6 + 34.62, abs=1e-4)
    assert float(path_loss.itu_indoor_loss(at, 10e9, line_of_sight=False)) == pytest.approx(
        24.6 + 29.53 + 23.8, abs=1e-4
    )
    corridor = path_loss.itu_indoor_loss(at, 10e9, environment="corridor")
    assert float(corridor) == pytest.approx(16.3 + 28.12 + 22.5, abs=1e-4)


def test_hata_gives_the_published_losses():
    # 126.4 + 35.2 log10 km at 900 MHz, base 30 m, mobile 1.5 m; 137.93 dB is a published test value of a simulator.
    usual = path_loss.okumura_hata_loss(torch.tensor([1000.0, 10_000.0]), 900e6, base_height=30.0)
    assert usual.tolist() == pytest.approx([126.42, 126.42 + 35.22], abs=0.02)
    large = path_loss.okumura_hata_loss(
        torch.tensor(2000.0), 869e6, base_height=30.0, mobile_height=1.0, area="large city"
    )
    assert float(large) == pytest.approx(137.93, abs=0.01)


def test_hata_loses_less_in_the_suburb_and_least_in_the_open():
    far = torch.tensor(5000.0)
    city, suburb, country = (
        float(path_loss.okumura_hata_loss(far, 900e6, base_height=50.0, area=area))
        for area in ("city", "suburb", "open")
    )
    assert city - suburb == pytest.approx(9.94, abs=0.01)  # 2 log10(900 / 28)^2 + 5.4
    assert city - country == pytest.approx(28.50, abs=0.03)  # 4.78 log10(900)^2 - 18.33 log10(900) + 40.94


def test_cost_231_gives_the_published_loss_and_3_db_more_in_a_large_city():
    far = torch.tensor(1000.0)
    city = float(path_loss.cost231_hata_loss(far, 1800e6, base_height=30.0))
    assert city == pytest.approx(136.2, abs=0.05)  # 136.2 + 35.2 log10 km, as in handbooks
    large = float(path_loss.cost231_hata_loss(far, 1800e6, base_height=30.0, area="large city"))
    assert large - city == pytest.approx(3.0, abs=1e-4)


@pytest.mark.parametrize(
    "loss",
    [
        lambda d: path_loss.free_space_loss(d, 60e9),
        lambda d: path_loss.itu_indoor_loss(d, 60e9),
        lambda d: path_loss.tr38901_indoor_loss(d, 60e9),
        lambda d: path_loss.tr38901_indoor_loss(d, 60e9, line_of_sight=False),
        lambda d: path_loss.okumura_hata_loss(1000 + d, 1e9, base_height=30.0),
        lambda d: path_loss.cost231_hata_loss(1000 + d, 1.8e9, base_height=30.0),
        path_loss.LogDistance(68.0, 1.7).loss,
    ],
)
def test_further_is_weaker_in_every_model(loss):
    values = loss(DISTANCE)
    assert values.shape == DISTANCE.shape
    assert bool((values.diff() > 0).all())


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (
            lambda: path_loss.okumura_hata_loss(torch.tensor(2e3), 60e9, base_height=30.0),
            "Okumura-Hata takes a frequency .MHz. from 150 to 1500; got 60000. Use tr38901_indoor_loss",
        ),
        (
            lambda: path_loss.okumura_hata_loss(torch.tensor(2e3), 1.8e9, base_height=30.0),
            "from 150 to 1500; got 1800. Use cost231_hata_loss",
        ),
        (
            lambda: path_loss.cost231_hata_loss(torch.tensor(2e3), 60e9, base_height=30.0),
            "COST 231-Hata takes a frequency .MHz. from 1500 to 2000; got 60000. Use tr38901",
        ),
        (
            lambda: path_loss.cost231_hata_loss(torch.tensor(2e3), 900e6, base_height=30.0),
            "from 1500 to 2000; got 900. Use okumura_hata_loss",
        ),
        (
            lambda: path_loss.okumura_hata_loss(torch.tensor(2e3), 900e6, base_height=2.6),
            "a base station's height .m. from 30 to 200; got 2.6",
        ),
        (
            lambda: path_loss.okumura_hata_loss(torch.tensor(2e3), 900e6, base_height=30.0, mobile_height=0.5),
            "a mobile's height .m. from 1 to 10; got 0.5",
        ),
        (
            lambda: path_loss.okumura_hata_loss(torch.tensor([2e3, 20.0]), 900e6, base_height=30.0),
            "distances .m. from 1000 to 20000; got 20",
        ),
        (lambda: path_loss.tr38901_indoor_loss(DISTANCE, 200e9), "from 0.5 to 100; got 200"),
        (lambda: path_loss.tr38901_indoor_loss(torch.tensor(400.0), 60e9), "from 1 to 150; got 400"),
        (lambda: path_loss.itu_indoor_loss(DISTANCE, 90e9), "P.1238 takes a frequency .GHz. from 0.3 to 83.5; got 90"),
        (lambda: path_loss.itu_indoor_loss(DISTANCE, 60e9, environment="attic"), "environment must be one of office"),
        (lambda: path_loss.okumura_hata_loss(DISTANCE, 1e9, base_height=30.0, area="sea"), "area must be one of"),
        (lambda: path_loss.cost231_hata_loss(DISTANCE, 1e9, base_height=30.0, area="open"), "area must be large city"),
        (lambda: path_loss.free_space_loss(torch.tensor([1.0, 0.0]), 1e9), "distances must be positive, in metres"),
    ],
)
def test_what_is_outside_a_models_range_is_refused_with_another_model(call, message):
    with pytest.raises(InputError, match=message):
        call()


def test_a_fit_gives_back_the_line_that_made_the_gains():
    line = path_loss.LogDistance(70.0, 1.8)
    fit = path_loss.fit_log_distance(DISTANCE, 10 ** (-line.loss(DISTANCE).double() / 10))
    assert fit.loss_1m_db == pytest.approx(70.0, abs=1e-4)
    assert fit.exponent == pytest.approx(1.8, abs=1e-5)
    assert fit.shadowing_db == pytest.approx(0.0, abs=1e-4)


def test_a_fit_reports_the_shadowing_that_the_gains_have():
    generator = torch.Generator().manual_seed(0)
    distance = 1.0 + 19.0 * torch.rand(2000, generator=generator)
    loss = path_loss.LogDistance(70.0, 1.8).loss(distance) + 3.0 * torch.randn(2000, generator=generator)
    fit = path_loss.fit_log_distance(distance, 10 ** (-loss.double() / 10))
    assert fit.shadowing_db == pytest.approx(3.0, abs=5 * 3.0 / math.sqrt(2 * 2000))
    assert fit.exponent == pytest.approx(1.8, abs=0.15)  # 3 dB / (10 sqrt(2000) 0.24 decades) = 0.03, five times


@pytest.mark.parametrize(
    ("distance", "gain", "message"),
    [
        ([2.0, 2.0], [1e-8, 1e-8], "needs two different distances"),
        ([2.0], [1e-8], "needs two different distances"),
        ([2.0, 3.0], [1e-8, 0.0], "gains linear and positive"),
        ([2.0, 3.0], [1e-8], "gains linear and positive"),
    ],
)
def test_a_fit_refuses_what_has_no_slope(distance, gain, message):
    with pytest.raises(InputError, match=message):
        path_loss.fit_log_distance(torch.tensor(distance), torch.tensor(gain))


def test_an_open_office_is_in_sight_up_to_5_m_and_less_and_less_beyond():
    chance = path_loss.open_office_sight(torch.tensor([1.0, 5.0, 20.0, 48.9, 49.1, 100.0]))
    assert chance[:2].tolist() == [1.0, 1.0]
    assert bool((chance[[1, 2, 3, 5]].diff() < 0).all())
    assert float(chance[2]) == pytest.approx(math.exp(-15 / 70.8), rel=1e-5)
    assert abs(float(chance[3] - chance[4])) < 0.01  # the two pieces meet but for the standard's rounding
