import math
from dataclasses import replace

import pytest
import torch

from rf3dgs.core.frames import Pose
from rf3dgs.core.grids import equirect_grid, pinhole_grid
from rf3dgs.evaluation import metrics
from rf3dgs.spectra.codec import DbWindow
from rf3dgs.spectra.spectrum import Instrument, Spectrum

WINDOW = DbWindow(-120.0, -80.0)
LOBE = Instrument.gaussian(math.radians(12))


def lobe_at(zenith: float, azimuth: float, grid, *, level_db: float = -85.0) -> Spectrum:
    from rf3dgs.core.angles import angle_between, direction_of

    centre = direction_of(torch.tensor(zenith), torch.tensor(azimuth))
    power = LOBE.kernel(angle_between(grid.directions, centre.expand_as(grid.directions))) * 10 ** (level_db / 10)
    return Spectrum(power + 1e-13, grid, Pose((0.0, 0, 0)), 60e9, LOBE)


def test_every_metric_is_perfect_on_identical_spectra(room):
    truth = room.spectra_at(room.receivers(3))
    weight = metrics.pixel_weight(truth.grid)
    picture = WINDOW.encode(truth.power)
    zero = torch.zeros(3)
    assert torch.equal(metrics.psnr(picture, picture, weight), torch.full((3,), 100.0))
    torch.testing.assert_close(metrics.ssim(picture, picture, truth.grid), torch.ones(3))
    assert torch.equal(metrics.rmse_db(truth.power, truth.power, WINDOW, weight), zero)
    assert torch.equal(metrics.mae_db(truth.power, truth.power, WINDOW, weight), zero)
    for error in (metrics.peak_error, metrics.path_gain_error, metrics.delay_spread_error):
        torch.testing.assert_close(error(truth, truth), zero, atol=1e-6, rtol=0)
    assert torch.equal(metrics.delay_error(truth, truth, WINDOW), zero)
    torch.testing.assert_close(metrics.departure_error(truth, truth, WINDOW), zero, atol=1e-6, rtol=0)


def test_every_metric_is_bad_on_the_spectrum_of_another_place(room):
    pose = room.receivers(2)
    truth = room.spectra_at(pose[torch.tensor([0])])
    wrong = replace(room.spectra_at(pose[torch.tensor([1])]), pose=truth.pose)
    weight = metrics.pixel_weight(truth.grid)
    first, second = (WINDOW.encode(item.power) for item in (truth, wrong))
    assert metrics.psnr(first, second, weight) < 30
    assert metrics.ssim(first, second, truth.grid) < 0.9
    assert metrics.rmse_db(truth.power, wrong.power, WINDOW, weight) > 1
    assert metrics.peak_error(truth, wrong) > math.radians(5)
    assert metrics.path_gain_error(truth, wrong) > 0.1
    assert metrics.delay_error(truth, wrong, WINDOW) > 1e-9
    assert metrics.departure_error(truth, wrong, WINDOW) > math.radians(2)
    assert metrics.delay_spread_error(truth, wrong) > 1e-11


def test_a_gain_offset_is_an_offset_and_leaves_directions_alone(room):
    truth = room.spectra_at(room.receivers(2))
    louder = replace(truth, power=truth.power * 10**0.3)
    weight = metrics.pixel_weight(truth.grid)
    wide = DbWindow(-200.0, 0.0)
    torch.testing.assert_close(metrics.rmse_db(truth.power, louder.power, wide, weight), torch.full((2,), 3.0))
    torch.testing.assert_close(metrics.path_gain_error(truth, louder), torch.full((2,), 3.0))
    torch.testing.assert_close(metrics.peak_error(truth, louder), torch.zeros(2), atol=1e-4, rtol=0)
    torch.testing.assert_close(metrics.delay_spread_error(truth, louder), torch.zeros(2), atol=1e-15, rtol=0)
    first, second = (wide.encode(item.power) for item in (truth, louder))
    torch.testing.assert_close(metrics.psnr(first, second, weight), torch.full((2,), -20 * math.log10(3 / 200)))


def test_an_error_in_half_of_the_sky_has_its_closed_form():
    grid = equirect_grid(36, 18)
    weight = metrics.pixel_weight(grid)
    truth = torch.full(grid.shape, 1e-10)
    half = truth.clone()
    half[:, :18] *= 10**0.6
    wide = DbWindow(-150.0, -50.0)
    assert float(metrics.rmse_db(truth, half, wide, weight)) == pytest.approx(6 / math.sqrt(2), abs=1e-4)
    assert float(metrics.mae_db(truth, half, wide, weight)) == pytest.approx(3.0, abs=1e-4)
    low = DbWindow(-150.0, -98.0)  # ends 2 dB above the truth, so that only two of the six are seen
    assert float(metrics.rmse_db(truth, half, low, weight)) == pytest.approx(2 / math.sqrt(2), abs=1e-4)
    assert float(metrics.mae_db(truth, half, low, weight)) == pytest.approx(1.0, abs=1e-4)
    high = DbWindow(-90.0, -50.0)  # both are below its floor
    assert float(metrics.rmse_db(truth, half, high, weight)) == 0.0


@pytest.mark.parametrize("grid", [equirect_grid(180, 90), pinhole_grid(90, 60, fov_deg=90)], ids=["sphere", "pinhole"])
def test_the_path_gain_of_lobes_is_the_sum_of_their_gains(grid):
    """The beam's solid angle is that of a flat Gaussian; on the sphere it holds lobe^2 / (24 ln 2), 0.3 %, less."""
    one, two = lobe_at(1.5, 0.1, grid, level_db=-80.0), lobe_at(1.6, -0.2, grid, level_db=-84.0)
    both = replace(one, power=one.power + two.power - 2e-13)
    total = 10 * math.log10(1e-8 + 10**-8.4)
    assert 10 * math.log10(float(both.path_gain)) == pytest.approx(total, abs=0.02)
    error = total + 80.0
    assert float(metrics.path_gain_error(both, replace(one, power=one.power - 1e-13))) == pytest.approx(error, abs=0.01)


def test_the_mean_delay_error_has_its_closed_form():
    grid = equirect_grid(36, 18)
    power = torch.full(grid.shape, 1e-9)
    truth = Spectrum(power, grid, Pose((0.0, 0, 0)), 60e9, LOBE, delay=torch.full(grid.shape, 4e-8))
    below = torch.arange(18)[:, None].expand(grid.shape) >= 12  # zenith above 120 degrees: a quarter of the sphere
    late = replace(truth, delay=torch.where(below, truth.delay + 8e-9, truth.delay - 4e-9))
    assert float(metrics.delay_error(truth, late, WINDOW)) == pytest.approx(0.25 * 8e-9 + 0.75 * 4e-9, rel=1e-4)


def test_a_shifted_peak_is_seen_in_its_angle_across_the_seam_and_near_the_pole():
    grid = equirect_grid(120, 60)
    truth = lobe_at(1.5, math.pi - 0.03, grid)
    shifted = lobe_at(1.5, -math.pi + 0.07, grid)
    torch.testing.assert_close(
        metrics.peak_error(truth, shifted), torch.tensor(0.10 * math.sin(1.5)), atol=3e-3, rtol=0
    )
    near_pole = lobe_at(0.04, 0.0, grid), lobe_at(0.06, math.pi, grid)
    torch.testing.assert_close(metrics.peak_error(*near_pole), torch.tensor(0.10), atol=0.01, rtol=0)


def test_ssim_runs_on_over_the_seam():
    grid = equirect_grid(60, 30)
    base = WINDOW.encode(lobe_at(1.5, 0.0, grid).power)
    other = WINDOW.encode(lobe_at(1.5, 0.3, grid).power)
    turned = [picture.roll(30, -1) for picture in (base, other)]
    torch.testing.assert_close(metrics.ssim(base, other, grid), metrics.ssim(*turned, grid))


def test_ssim_agrees_with_its_definition_in_the_middle_of_a_pinhole_picture():
    generator = torch.Generator().manual_seed(0)
    a, b = torch.rand(2, 11, 11, generator=generator, dtype=torch.float64)
    axis = torch.arange(11, dtype=torch.float64) - 5
    kernel = torch.exp(-(axis**2) / 4.5)
    window = kernel[:, None] * kernel / (kernel.sum() ** 2)
    mean_a, mean_b = (window * a).sum(), (window * b).sum()
    var_a, var_b = (window * (a - mean_a) ** 2).sum(), (window * (b - mean_b) ** 2).sum()
    covariance = (window * (a - mean_a) * (b - mean_b)).sum()
    top = (2 * mean_a * mean_b + 1e-4) * (2 * covariance + 9e-4)
    expected = top / ((mean_a**2 + mean_b**2 + 1e-4) * (var_a + var_b + 9e-4))
    big = [torch.nn.functional.pad(picture, (10,) * 4) for picture in (a, b)]
    grid = pinhole_grid(31, 31, fov_deg=90)
    centre = _ssim_map(big[0], big[1], window)[15 - 5, 15 - 5]
    torch.testing.assert_close(centre, expected, atol=1e-9, rtol=0)
    inner = _ssim_map(*(torch.nn.functional.pad(picture, (5,) * 4) for picture in big), window)
    torch.testing.assert_close(metrics.ssim(big[0], big[1], grid).double(), inner.mean(), atol=1e-6, rtol=0)


def _ssim_map(a, b, window):
    def local(picture):
        return torch.nn.functional.conv2d(picture[None, None], window[None, None])[0, 0]

    mean_a, mean_b = local(a), local(b)
    var_a, var_b = local(a * a) - mean_a**2, local(b * b) - mean_b**2
    top = (2 * mean_a * mean_b + 1e-4) * (2 * (local(a * b) - mean_a * mean_b) + 9e-4)
    return top / ((mean_a**2 + mean_b**2 + 1e-4) * (var_a + var_b + 9e-4))


def test_the_rows_at_the_pole_count_for_the_sky_they_cover():
    grid = equirect_grid(36, 18)
    truth = torch.full(grid.shape, 1e-10)
    at_pole, at_equator = truth.clone(), truth.clone()
    at_pole[0] *= 10
    at_equator[9] *= 10
    weight = metrics.pixel_weight(grid)
    pole, equator = (metrics.mae_db(truth, wrong, DbWindow(-150, -50), weight) for wrong in (at_pole, at_equator))
    band = math.radians(10)
    torch.testing.assert_close(pole / equator, torch.tensor((1 - math.cos(band)) / math.sin(band)), rtol=1e-3, atol=0)


def test_a_dark_prediction_is_wrong_not_perfect(room):
    truth = room.spectra_at(room.receivers(2))
    nothing = torch.zeros_like(truth.power)
    dark = replace(truth, power=nothing, delay=nothing, aod=torch.zeros_like(truth.directions))
    assert torch.equal(metrics.peak_error(truth, dark), torch.full((2,), math.pi))
    torch.testing.assert_close(metrics.departure_error(truth, dark, WINDOW), torch.full((2,), math.pi / 2))
    assert bool((metrics.delay_error(truth, dark, WINDOW) > 1e-8).all())
    assert bool((metrics.path_gain_error(truth, dark) > 100).all())


def test_delay_counts_only_directions_that_a_path_reaches(room):
    truth = room.spectra_at(room.receivers(1))
    floor = float(truth.gain_db.median())
    below = truth.gain_db < floor
    late = replace(truth, delay=torch.where(below, truth.delay + 1e-6, truth.delay + 2e-9))
    error = metrics.delay_error(truth, late, DbWindow(floor, -50.0))
    torch.testing.assert_close(error, torch.tensor([2e-9]), rtol=1e-3, atol=0)


def test_spectra_without_delays_have_no_delay_error(room):
    truth = room.spectra_at(room.receivers(2))
    plain = replace(truth, delay=None, aod=None)
    assert bool(metrics.delay_error(truth, plain, WINDOW).isnan().all())
    assert bool(metrics.departure_error(plain, truth, WINDOW).isnan().all())
    assert bool(metrics.delay_spread_error(truth, plain).isnan().all())


def test_a_peak_is_distinct_when_it_leads_by_a_decibel():
    grid = equirect_grid(90, 45)
    strong, weak, close = (lobe_at(1.5, 0.0, grid), *(lobe_at(1.5, 1.5, grid, level_db=x) for x in (-88.0, -85.5)))
    clear = replace(strong, power=strong.power + weak.power)
    unclear = replace(strong, power=strong.power + close.power)
    assert bool(metrics.is_distinct(clear))
    assert not bool(metrics.is_distinct(unclear))
    assert bool(metrics.is_distinct(strong))


@pytest.mark.parametrize("spread_ns", [0.0, 10.0])
def test_delay_spread_is_the_power_weighted_deviation(spread_ns):
    grid = equirect_grid(36, 18)
    power = torch.zeros(grid.shape)
    power[9, 0] = power[9, 18] = 1e-9
    delay = torch.full(grid.shape, 50e-9)
    delay[9, 0] += spread_ns * 1e-9
    delay[9, 18] -= spread_ns * 1e-9
    spectrum = Spectrum(power, grid, Pose((0.0, 0, 0)), 60e9, LOBE, delay=delay)
    torch.testing.assert_close(metrics.delay_spread(spectrum), torch.tensor(spread_ns * 1e-9), atol=1e-13, rtol=1e-4)
