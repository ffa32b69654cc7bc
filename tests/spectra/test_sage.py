import math
from dataclasses import replace

import pytest
import torch
from benchmarks.quality.sage import QUANTITIES, SMALL, VIEWS, normalised_errors, three_paths
from benchmarks.quality.sage_lobby import LARGE as LOBBY_SOUNDER
from benchmarks.quality.sage_lobby import LIMIT, cells, lobby_positions, mirror_paths, wanted_of

from rf3dgs.channel.arrays import planar_array
from rf3dgs.channel.io import load_paths, save_paths
from rf3dgs.channel.sounding import device_directions, sounder_response
from rf3dgs.core.angles import angle_between
from rf3dgs.core.errors import InputError
from rf3dgs.core.frames import Pose
from rf3dgs.core.grids import equirect_grid
from rf3dgs.core.units import SPEED_OF_LIGHT
from rf3dgs.propagation.sounder import sound
from rf3dgs.spectra.apertures import Aperture
from rf3dgs.spectra.peaks import main_peak
from rf3dgs.spectra.sage import estimate_paths, sage
from rf3dgs.spectra.sage_fit import Fit
from rf3dgs.spectra.scan import spectrum_of

FULL = VIEWS["full"]
SILENT = replace(SMALL, snr_db=None)


def by_delay(paths):
    """In double precision and the order of delay."""
    order = paths.delay.argsort(-1)
    columns = paths._map(lambda value: value.gather(-1, order))
    double = {torch.float32: torch.float64, torch.complex64: torch.complex128}
    return columns._map(lambda value: value.to(double.get(value.dtype, value.dtype)))


def errors_of(view, trials):
    found = [normalised_errors(seed, view) for seed in range(trials)]
    return torch.stack([error for error in found if error is not None])


@pytest.mark.parametrize("view", VIEWS.values(), ids=VIEWS)
def test_errors_are_those_of_the_cramer_rao_bound(view):
    errors = errors_of(view, 14)
    assert len(errors) >= 13
    count = errors.shape[0] * errors.shape[2]
    # The mean of squares over bounds is that of chi-square, 1 with deviation sqrt(2 / count); four of them either way.
    ratio = errors.square().mean((0, 2))
    assert float(ratio.max()) < 1 + 4 * math.sqrt(2 / count)
    assert float(ratio.min()) > 1 - 4 * math.sqrt(2 / count)
    # Nor are the errors on one side: the mean has deviation 1 / sqrt(count).
    assert float(errors.mean((0, 2)).abs().max()) < 4 / math.sqrt(count)


@pytest.mark.slow
@pytest.mark.parametrize("view", VIEWS.values(), ids=VIEWS)
def test_a_hundred_trials_stay_within_one_and_a_half_bounds(view):
    errors = errors_of(view, 104)
    assert len(errors) >= 100
    assert dict(zip(QUANTITIES, (errors.square().mean((0, 2)).sqrt() < 1.5).tolist(), strict=True)) == dict.fromkeys(
        QUANTITIES, True
    )


@pytest.mark.slow
@pytest.mark.parametrize("preset", ["diffuse", "realistic"])
def test_in_the_lobby_all_dominant_mirrors_are_found_within_a_cell(preset):
    rows = []
    for position, paths in enumerate(lobby_positions(20, seed=11, preset=preset)):
        sounding = sound(paths, LOBBY_SOUNDER)
        rows.append(wanted_of(mirror_paths(paths, sounding, sage(sounding, limit=LIMIT), position)))
    rows = [row for row in rows if row]
    assert len(rows) >= 15
    assert sum(all(path.away < 1.0 for path in row) for row in rows) >= 0.95 * len(rows)


def test_without_noise_the_paths_come_back():
    for seed in range(3):
        truth = three_paths(seed, FULL)
        found = by_delay(sage(sound(truth, SILENT)))
        expected = by_delay(truth)
        assert found.coeff.shape == (3,)
        # Paths are float32: 1e-7 of 30 ns, of a radian, of a gain. The last sweep moves by less than 1e-9 cells.
        assert torch.allclose(found.delay, expected.delay, atol=5e-15)
        assert float(angle_between(found.aoa, expected.aoa).max()) < 1e-6
        assert float(angle_between(found.aod, expected.aod).max()) < 1e-6
        assert torch.allclose(found.coeff.abs(), expected.coeff.abs(), rtol=1e-5)


def test_the_paths_found_explain_the_sounding_down_to_the_noise():
    truth = three_paths(5, FULL)
    sounding = sound(truth, SMALL)
    found = estimate_paths(sounding)
    array_rx, array_tx = sounding.array_rx, sounding.array_tx
    again = sounder_response(found.paths, array_rx, array_tx, sounding.offsets)
    residual = (again - sounding.response).abs().square().mean()
    assert float(residual) == pytest.approx(float(found.residual_power), rel=1e-4)
    # 8192 complex entries less 21 fitted numbers: deviation 1/90 of the noise power.
    assert float(residual / found.noise_power) == pytest.approx(1.0, abs=0.05)
    assert bool(found.converged)


def test_deviations_are_the_bound_at_the_truth():
    truth = three_paths(5, FULL)
    found = estimate_paths(sound(truth, SMALL))
    strongest = truth.coeff.abs().argsort(descending=True)
    error = (found.paths.delay - truth.delay[strongest]).abs()
    assert bool((error < 5 * found.deviation.delay).all())
    assert bool((found.deviation.delay > 0).all())


def test_turning_the_world_turns_the_paths():
    sounding = sound(three_paths(4, FULL), SMALL)
    straight = sage(sounding)
    turned = sage(replace(sounding, rx=sounding.rx.turned(1.1), tx=sounding.tx.turned(1.1)))
    turn = Pose.from_yaw((0.0, 0.0, 0.0), 1.1)
    # Poses are float32.
    assert float(angle_between(turned.aoa, turn.to_world(straight.aoa)).max()) < 1e-5
    assert float(angle_between(turned.aod, turn.to_world(straight.aod)).max()) < 1e-5
    assert torch.allclose(turned.delay, straight.delay, atol=1e-15)


def test_receivers_of_a_batch_do_not_know_each_other():
    soundings = [sound(three_paths(seed, FULL), replace(SMALL, seed=seed)) for seed in (1, 2)]
    rx = Pose(soundings[0].rx.position.expand(2, 3), soundings[0].rx.orientation.expand(2, 4))
    response = torch.stack([one.response for one in soundings])
    noise = torch.stack([one.noise_power for one in soundings])
    both = sage(replace(soundings[0], response=response, noise_power=noise, rx=rx))
    assert both.coeff.shape[0] == 2
    for index, one in enumerate(soundings):
        alone = sage(one)
        length = alone.coeff.shape[-1]
        assert both.valid[index].tolist() == [True] * length + [False] * (both.coeff.shape[1] - length)
        # Not the same sums of products in another order: far below the bound, 1e-12 s.
        assert torch.allclose(both.delay[index, :length], alone.delay, atol=1e-14)


def test_noise_alone_has_no_paths_and_silence_neither():
    sounding = sound(three_paths(0, FULL), SMALL)
    generator = torch.Generator().manual_seed(3)
    noise = torch.view_as_complex(torch.randn(16, 8, 64, 2, generator=generator, dtype=torch.float64)) / math.sqrt(2)
    for power in (1.0, None):
        assert sage(replace(sounding, response=noise, noise_power=power)).coeff.shape == (0,)
    silent = estimate_paths(replace(sounding, response=torch.zeros(16, 8, 64), noise_power=None))
    assert silent.paths.coeff.shape == (0,)
    assert bool(silent.converged)


def scattered(seed, count, level_db):
    """A mirror path, and `count` lumps of diffuse power about it, each louder by `level_db` and made of ten paths."""
    generator = torch.Generator().manual_seed(seed)

    def uniform(low, high, *shape):
        return low + (high - low) * torch.rand(*shape, generator=generator, dtype=torch.float64)

    mirror = three_paths(seed, FULL)._map(lambda value: value[:1])
    turn = [2 * math.atan2(float(pose.orientation[3]), float(pose.orientation[0])) for pose in (mirror.rx, mirror.tx)]
    centre = [uniform(*limits, count, 1) for limits in ((1.0, 2.1), (-1.0, 1.0), (1.0, 2.1), (-1.0, 1.0), (2e-8, 5e-8))]
    spread = [
        value + uniform(-1, 1, count, 10) * size for value, size in zip(centre, (0.1,) * 4 + (3e-10,), strict=True)
    ]
    aoa_zenith, aoa_azimuth, aod_zenith, aod_azimuth, delay = (value.reshape(-1) for value in spread)
    loud = float(mirror.coeff.abs()) * 10 ** (0.05 * level_db) / math.sqrt(10)
    cloud = {
        "coeff": loud * torch.polar(torch.ones_like(delay), uniform(0, 2 * math.pi, 10 * count)),
        "delay": delay,
        "aoa_zenith": aoa_zenith,
        "aoa_azimuth": aoa_azimuth + turn[0],
        "aod_zenith": aod_zenith,
        "aod_azimuth": aod_azimuth + turn[1],
        "valid": torch.ones(10 * count, dtype=torch.bool),
    }
    both = {name: torch.cat((getattr(mirror, name), value)) for name, value in cloud.items()}
    return mirror, replace(mirror, **both)


def test_a_mirror_is_found_among_louder_lumps_of_diffuse_power():
    found, early = 0, 0
    for seed in range(4):
        mirror, everything = scattered(seed, 20, 4.0)
        sounding = sound(everything, SMALL)
        place = cells(mirror, sounding)
        estimates = cells(sage(sounding), sounding)
        found += int(float((place - estimates).abs().amax(-1).min()) < 1.0)
        early += int(float((place - estimates[:6]).abs().amax(-1).min()) < 1.0)
    assert found == 4
    assert early < 4  # it is not among the loudest


def test_waves_that_come_together_are_no_side_lobes_of_each_other():
    sounding = sound(three_paths(0, FULL), SILENT)
    aperture = Aperture.of(sounding)
    theta = torch.tensor([[-0.5, 0.2, 0.3, 0.1, 3e-8], [0.5, -0.2, -0.3, 0.1, 4e-8]], dtype=torch.float64)
    one = aperture.strongest(aperture.model(theta[:1], torch.ones(1, dtype=torch.complex128)), 4)
    both = aperture.strongest(aperture.model(theta, torch.tensor([1.0, 0.8], dtype=torch.complex128)), 4)
    assert one.shape == (1, 5)
    assert both.shape == (2, 5)
    assert float(((both - theta) / aperture.cell).abs().max()) < 0.5
    weak = aperture.strongest(aperture.model(theta, torch.tensor([1.0, 0.4], dtype=torch.complex128)), 4)
    assert weak.shape == (1, 5)  # 8 dB down: it comes when the first is explained


def test_count_asks_for_so_many():
    sounding = sound(three_paths(0, FULL), SMALL)
    assert sage(sounding, 2).coeff.shape == (2,)
    assert sage(sounding, 5).coeff.shape == (5,)
    assert sage(sounding, limit=1).coeff.shape == (1,)
    levels = sage(sounding, 3).coeff.abs()
    assert bool((levels.diff() <= 0).all())


def test_overlapping_paths_are_told_apart_at_high_snr():
    truth = three_paths(0, FULL)._map(lambda value: value[:1].repeat(2))
    near = replace(truth, delay=truth.delay + torch.tensor([0.0, 0.4e-9]), aoa_azimuth=truth.aoa_azimuth)
    sounding = sound(near, replace(SMALL, snr_db=40.0))
    found = estimate_paths(sounding)
    assert found.paths.coeff.shape == (2,)
    assert bool((by_delay(found.paths).delay - near.delay).abs().max() < 5 * found.deviation.delay.max())


def test_no_sweep_and_no_leap_explains_less():
    sounding = sound(three_paths(2, FULL), SMALL)
    fit = Fit(Aperture.of(sounding), sounding.response, None)
    generator = torch.Generator().manual_seed(0)
    theta = torch.rand(4, 5, generator=generator, dtype=torch.float64) * fit.aperture.cell * 0.4
    fit._set(theta, torch.zeros(4, dtype=torch.complex128))
    fit._weigh()
    for _ in range(4):
        for move in (fit._sweep, fit._leap):
            before = fit.residual_power
            move()
            assert fit.residual_power <= before * (1 + 1e-12)


def test_two_paths_in_one_place_that_cancel_become_one():
    sounding = sound(three_paths(2, FULL)._map(lambda value: value[:1]), SMALL)
    fit = Fit(Aperture.of(sounding), sounding.response, float(sounding.noise_power))
    fit.search(1, selective=False)
    fit._set(fit.theta.repeat(2, 1), torch.stack((101.0 * fit.gain[0], -100.0 * fit.gain[0])))
    fit._until_settled = lambda: None  # as if it had settled there
    fit.settle(selective=False)
    assert len(fit.gain) == 1


def test_elements_that_hear_backwards_show_it_mirrored_ahead():
    sounder = replace(SILENT, array_rx=planar_array(4, 4, "isotropic"))
    truth = three_paths(3, FULL)._map(lambda value: value[:1])
    local = device_directions(truth)[0] * torch.tensor([-1.0, 1.0, 1.0], dtype=torch.float64)
    behind = truth.rx.world_from_device.double() @ local[0]
    zenith, azimuth = torch.acos(behind[2]), torch.atan2(behind[1], behind[0])
    found = by_delay(sage(sound(replace(truth, aoa_zenith=zenith[None], aoa_azimuth=azimuth[None]), sounder)))
    assert float(angle_between(found.aoa, truth.aoa)) < 1e-5


def test_estimates_stay_in_view():
    truth = three_paths(1, VIEWS["both 45 deg"])
    sounder = replace(SMALL, fov_rx_deg=45.0, fov_tx_deg=45.0, snr_db=0.0)
    found = sage(sound(truth, sounder), 12)
    for directions in device_directions(found):
        assert float(directions[:, 2].abs().max()) <= math.sin(math.radians(22.5)) + 1e-7


def test_with_an_unknown_offset_the_earliest_path_is_the_straight_line():
    truth = three_paths(6, FULL)
    sounder = replace(SMALL, delay_error=2e-8, phase_error=3.0)
    straight = float((truth.rx.position - truth.tx.position).norm()) / SPEED_OF_LIGHT
    for seed in range(4):
        found = by_delay(sage(sound(truth, replace(sounder, seed=seed))))
        late = by_delay(truth).delay - truth.delay.min()
        assert torch.allclose(found.delay, straight + late, atol=2e-11)
        assert float(angle_between(found.aoa, by_delay(truth).aoa).max()) < 0.05


def test_delays_longer_than_a_period_are_those_after_the_straight_line():
    truth = three_paths(7, FULL)
    far = replace(truth, delay=truth.delay + 8e-8, rx=Pose((24.0, 0.0, 2.0), truth.rx.orientation))
    found = by_delay(sage(sound(far, SMALL)))
    assert float(far.delay.min()) > SMALL.points / SMALL.bandwidth
    assert torch.allclose(found.delay, by_delay(far).delay, atol=2e-11)


@pytest.mark.parametrize("points", [64, 63])
def test_unwrapped_paths_explain_the_sounding_on_any_comb(points):
    truth = three_paths(7, FULL)
    far = replace(truth, delay=truth.delay + 8e-8, rx=Pose((24.0, 0.0, 2.0), truth.rx.orientation))
    sounding = sound(far, replace(SMALL, points=points))
    offsets = sounding.offsets + 0.3e6
    response = sounder_response(far, sounding.array_rx, sounding.array_tx, offsets)
    found = sage(replace(sounding, response=response, offsets=offsets, noise_power=None))
    again = sounder_response(found, sounding.array_rx, sounding.array_tx, offsets)
    # Paths are float32: phases at 60 GHz are exact to 1e-3, amplitudes to 1e-7.
    assert float((again - response).abs().square().mean() / response.abs().square().mean()) < 1e-5


@pytest.mark.parametrize(
    ("array", "message"),
    [
        (planar_array(1, 8), "the receiving array of 1x8 elements does not tell the zenith of arrival"),
        (planar_array(8, 1), "the receiving array of 8x1 elements does not tell the azimuth of arrival"),
        (None, "the receiving array of one element does not tell the zenith and azimuth of arrival"),
    ],
)
def test_what_an_array_does_not_tell_is_refused(array, message):
    sounding = sound(three_paths(0, FULL), replace(SMALL, array_rx=array))
    with pytest.raises(InputError, match=message):
        sage(sounding)


def test_ahead_takes_the_untold_zenith_as_the_horizon():
    truth = three_paths(0, FULL)
    level = replace(truth, aoa_zenith=torch.full((3,), math.pi / 2, dtype=torch.float64))
    found = estimate_paths(sound(level, replace(SMALL, array_rx=planar_array(1, 8))), untold="ahead")
    assert torch.allclose(found.paths.aoa_zenith, torch.tensor(math.pi / 2))
    assert bool(torch.isinf(found.deviation.aoa_zenith).all())
    error = (by_delay(found.paths).aoa_azimuth - by_delay(level).aoa_azimuth).abs()
    assert bool((error < 5 * found.deviation.aoa_azimuth.max()).all())
    alone = estimate_paths(sound(truth, replace(SMALL, array_rx=None)), untold="ahead")
    assert bool(torch.isinf(alone.deviation.aoa_azimuth).all())
    assert torch.allclose(by_delay(alone.paths).delay, by_delay(truth).delay, atol=1e-10)


def test_a_zenith_that_the_field_of_view_tells_better_is_no_estimate():
    sounder = replace(SMALL, array_rx=planar_array(2, 4), snr_db=-10.0, fov_rx_deg=1.0)
    truth = three_paths(0, (1.0, 180.0))._map(lambda value: value[:1])
    found = estimate_paths(sound(truth, sounder), 1)
    assert float(found.paths.aoa_zenith) == pytest.approx(math.pi / 2)
    assert bool(torch.isinf(found.deviation.aoa_zenith).all())
    assert bool(torch.isfinite(found.deviation.aod_zenith).all())


def test_bad_arguments_are_refused():
    sounding = sound(three_paths(0, FULL), SMALL)
    with pytest.raises(InputError, match="count and limit must be at least 1"):
        sage(sounding, 0)
    with pytest.raises(InputError, match='untold must be "refuse" or "ahead"'):
        sage(sounding, untold="guess")  # pyright: ignore[reportArgumentType]


def test_the_coarse_grid_starts_within_half_a_cell():
    for seed in range(5):
        truth = three_paths(seed, FULL)._map(lambda value: value[:1])
        sounding = sound(truth, SILENT)
        start = Aperture.of(sounding).strongest(sounding.response) / Aperture.of(sounding).cell
        assert float((start - cells(truth, sounding)[0]).abs().max()) < 0.5


def test_estimates_go_where_traced_paths_go(tmp_path):
    truth = three_paths(0, FULL)
    found = sage(sound(truth, SMALL))
    save_paths(found, tmp_path / "found.paths")
    again = load_paths(tmp_path / "found.paths")
    assert torch.equal(again.delay[0], found.delay)
    spectrum = spectrum_of(found, grid=equirect_grid(90, 45))
    assert float(angle_between(main_peak(spectrum), found.aoa[0].float())) < 0.05
