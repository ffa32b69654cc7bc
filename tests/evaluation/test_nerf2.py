"""NeRF2: its tracing against sums by hand, and that it learns: one view by heart, others better than a constant."""

import math
from dataclasses import replace

import pytest
import torch

from rf3dgs.core.errors import InputError, TrainingError
from rf3dgs.core.frames import Pose
from rf3dgs.core.grids import equirect_grid, list_grid, pinhole_grid
from rf3dgs.evaluation import metrics
from rf3dgs.evaluation.baselines.nerf2 import Nerf2, fit_nerf2
from rf3dgs.evaluation.baselines.nerf2_config import Nerf2Config
from rf3dgs.evaluation.baselines.nerf2_network import Nerf2Network, encode, received
from rf3dgs.propagation.room import shoebox
from rf3dgs.spectra.codec import DbWindow, PerViewLinear, window_of
from rf3dgs.spectra.scan import spectrum_of
from rf3dgs.spectra.spectrum import Instrument, Spectrum

TINY = Nerf2Config(
    target="db",
    depth=2,
    width=16,
    position_octaves=3,
    direction_octaves=2,
    samples=6,
    steps=20,
    rays=64,
    report_every=10,
    device="cpu",
)
BY_HEART = replace(Nerf2Config.for_scale("smoke"), samples=8, rays=96, steps=600, lr=5e-3, lr_final=5e-4, device="cpu")


def shoebox_spectra(pose, grid, lobe_deg=None):
    """Ideal spectra of an exact room, `[n, row, col]`."""
    paths = shoebox((6.0, 5.0, 3.0), Pose([1.0, 1.0, 2.5]), pose, 60e9, order=2, reflection=-0.5)
    lobe = None if lobe_deg is None else math.radians(lobe_deg)
    return spectrum_of(paths, None, grid, method="ideal", lobe=lobe)


def turned_spectra(count, seed, grid, lobe_deg=None):
    """The same with receivers that look in many directions."""
    place = Pose.scatter(((2.0, 2.0, 1.0), (5.0, 4.0, 2.0)), count, seed).position
    return shoebox_spectra(Pose.from_yaw(place, 2.4 * torch.arange(count)), grid, lobe_deg)


def psnr(model, truth, window):
    weight = metrics.pixel_weight(truth.grid)
    return metrics.psnr(window.encode(truth.power), window.encode(model.render(truth.pose, truth.grid).power), weight)


def test_the_received_sum_is_each_signal_through_all_points_before_it():
    generator = torch.Generator().manual_seed(0)
    decay, phase = torch.rand(2, 3, 5, generator=generator)
    signal = torch.complex(*torch.randn(2, 3, 5, generator=generator))
    step = 0.3
    expected = torch.zeros(3, dtype=torch.complex64)
    for ray in range(3):
        through = torch.tensor(1.0 + 0j)
        for point in range(5):
            expected[ray] += through * signal[ray, point]
            through = through * torch.exp(-step * torch.complex(decay[ray, point], phase[ray, point]))
    # Sums of five terms of order one in single precision.
    torch.testing.assert_close(received(torch.complex(decay, phase), signal, step), expected, rtol=1e-5, atol=1e-5)


def test_an_opaque_point_hides_what_is_behind_it():
    attenuation = torch.tensor([[0.0, 1e4, 0.0]], dtype=torch.complex64)
    signal = torch.tensor([[1.0, 2.0, 50.0]], dtype=torch.complex64)
    assert float(received(attenuation, signal, 0.1).abs()) == pytest.approx(3.0, abs=1e-6)


def test_signals_of_opposite_phase_cancel():
    attenuation = torch.tensor([[1j * math.pi, 0.0]], dtype=torch.complex64)
    signal = torch.ones(1, 2, dtype=torch.complex64)
    # Half a turn between two equal signals; single precision leaves pi's rounding.
    assert float(received(attenuation, signal, 1.0).abs()) == pytest.approx(0.0, abs=1e-6)


def test_the_encoding_has_a_sine_and_a_cosine_an_octave():
    code = encode(torch.tensor([0.25, 0.0, -0.5]), 2)
    expected = [0.25, 0, -0.5, *(math.sin(math.pi * x) for x in (0.25, 0, -0.5))]
    expected += [*(math.sin(2 * math.pi * x) for x in (0.25, 0, -0.5))]
    expected += [math.cos(octave * math.pi * x) for octave in (1, 2) for x in (0.25, 0, -0.5)]
    torch.testing.assert_close(code, torch.tensor(expected), rtol=0, atol=1e-6)  # single precision of sine


def test_the_published_network_has_the_published_size():
    network = Nerf2Network(Nerf2Config.for_scale("paper"))
    assert len(network.attenuation_layers) == 8
    assert network.attenuation_layers[0].weight.shape == (256, 63)
    assert network.attenuation_layers[4].weight.shape == (256, 256 + 63)
    assert network.radiance_of_feature.in_features + network.radiance_of_ray.in_features == 256 + 63 + 63
    assert network.radiance_hidden.weight.shape == (128, 256)


def test_attenuation_never_amplifies_and_asks_neither_direction_nor_transmitter():
    torch.manual_seed(0)
    network = Nerf2Network(TINY)
    points = torch.randn(4, 6, 3)
    here, there = torch.nn.functional.normalize(torch.randn(2, 4, 3), dim=-1)
    first, signal = network(points, here, torch.zeros(3))
    second, other = network(points, there, torch.ones(3))
    assert bool((first.real >= 0).all())
    torch.testing.assert_close(first, second, rtol=0, atol=0)
    assert bool((signal - other).abs().amin() > 0)


@pytest.mark.parametrize("target", ["db", "linear"])
@pytest.mark.parametrize("grid", [equirect_grid(16, 8), pinhole_grid(12, 8, 90.0)], ids=["sphere", "pinhole"])
def test_the_same_seed_is_the_same_network_and_another_is_not(grid, target):
    train = turned_spectra(3, 0, grid)
    window = window_of(train)
    config = replace(TINY, target=target)
    torch.manual_seed(1)
    first = fit_nerf2(train, config, window)
    torch.manual_seed(2)
    again = fit_nerf2(train, config, window)
    other = fit_nerf2(train, replace(config, seed=1), window)
    pose = Pose([3.0, 3.0, 1.5])
    power = first.render(pose, grid).power
    torch.testing.assert_close(power, again.render(pose, grid).power, rtol=0, atol=0)
    assert not torch.equal(power, other.render(pose, grid).power)
    assert bool((power >= 0).all())
    assert bool(torch.isfinite(power).all())


def test_fitting_leaves_the_callers_random_numbers_alone():
    train = turned_spectra(2, 0, equirect_grid(16, 8))
    torch.manual_seed(5)
    expected = torch.rand(1)
    torch.manual_seed(5)
    fit_nerf2(train, TINY, window_of(train))
    torch.testing.assert_close(torch.rand(1), expected, rtol=0, atol=0)


def test_a_picture_in_pieces_is_the_picture_and_a_turned_one_sees_the_same_world():
    train = turned_spectra(2, 0, equirect_grid(16, 8))
    model = Nerf2(train, TINY, window_of(train))
    pieces = Nerf2(train, replace(TINY, chunk=7), window_of(train))
    whole = model.render(train.pose[0], train.grid)
    # Sums of products in another order, in single precision; levels span tens of dB.
    torch.testing.assert_close(whole.power, pieces.render(train.pose[0], train.grid).power, rtol=1e-4, atol=0)
    pose = Pose.from_yaw(train.pose.position[0], 1.0)
    seen = list_grid(pose.to_device(train.pose[0].to_world(train.grid.directions)).reshape(-1, 3))
    torch.testing.assert_close(model.render(pose, seen).power.reshape(train.grid.shape), whole.power, rtol=1e-3, atol=0)


def test_several_poses_are_answered_as_one_each():
    train = turned_spectra(3, 0, equirect_grid(16, 8))
    model = Nerf2(train, TINY, window_of(train))
    both = model.render(train.pose[:2], train.grid)
    torch.testing.assert_close(both.power[1], model.render(train.pose[1], train.grid).power, rtol=0, atol=0)
    assert both.delay is None
    assert both.aod is None


def test_rays_reach_as_far_as_the_box_of_positions_and_transmitter():
    grid = equirect_grid(8, 4)
    power = torch.rand(2, 4, 8, generator=torch.Generator().manual_seed(0)) + 0.1
    pose, tx = Pose([[0.0, 0, 0], [2.0, 1.0, 0]]), Pose([0.0, 0.0, 2.0])
    train = Spectrum(power, grid, pose, 60e9, Instrument.gaussian(0.3), tx=tx)
    window = DbWindow(-10.0, 1.0)
    model = Nerf2(train, TINY, window)
    assert model.far == pytest.approx(3.0, rel=1e-6)  # 2 x 1 x 2 m
    torch.testing.assert_close(model.centre, torch.tensor([1.0, 0.5, 1.0]))
    assert Nerf2(train, replace(TINY, far=7.0), window).far == 7.0
    with pytest.raises(InputError, match="give far in metres"):
        Nerf2(replace(train[:1], tx=None), TINY, window)


def test_linear_training_forgets_each_pictures_level_and_answers_at_the_mean_of_peaks():
    train = turned_spectra(3, 0, equirect_grid(16, 8))
    louder = replace(train, power=train.power * torch.tensor([100.0, 1.0, 0.01])[:, None, None])
    config = replace(TINY, target="linear")
    pose, window = Pose([3.0, 3.0, 1.5]), window_of(train)
    first, second = (fit_nerf2(spectra, config, window) for spectra in (train, louder))
    # +20, 0 and -20 dB cancel in the mean of peaks; what is learned is equal up to the rounding of P / max(P).
    torch.testing.assert_close(
        first.render(pose, train.grid).power, second.render(pose, train.grid).power, rtol=1e-3, atol=0
    )
    assert first.peak_db == pytest.approx(second.peak_db, abs=1e-4)


def test_history_has_an_entry_for_each_report_and_keeps_the_answers():
    train = turned_spectra(2, 0, equirect_grid(16, 8))
    model = fit_nerf2(train, replace(TINY, steps=25), window_of(train), on_step=lambda done, model: 2.0 * done)
    assert [entry[0] for entry in model.history] == [10, 20, 25]
    assert [entry[3] for entry in model.history] == [20.0, 40.0, 50.0]
    assert all(a[1] < b[1] for a, b in zip(model.history, model.history[1:], strict=False))


def test_one_small_view_is_learned_by_heart():
    train = turned_spectra(1, 0, pinhole_grid(12, 8, 90.0))
    window = window_of(train)
    config = replace(BY_HEART, target="db")
    assert float(psnr(fit_nerf2(train, config, window), train, window)[0]) > 30


def test_a_linear_view_is_learned_by_heart():
    train = turned_spectra(1, 0, pinhole_grid(12, 8, 90.0))
    answer = fit_nerf2(train, BY_HEART, window_of(train)).render(train.pose, train.grid).power
    scale, weight = PerViewLinear(), metrics.pixel_weight(train.grid)
    assert float(metrics.psnr(scale.encode(train.power), scale.encode(answer), weight)[0]) > 30


@pytest.mark.slow
def test_one_view_of_the_laptop_size_is_learned_by_heart():
    train = turned_spectra(1, 0, pinhole_grid(75, 50, 90.0), lobe_deg=6.0)
    window = window_of(train)
    config = replace(Nerf2Config.for_scale("laptop", "db"), steps=800, device="cpu")
    assert float(psnr(fit_nerf2(train, config, window), train, window)[0]) > 30


def test_held_out_positions_are_predicted_better_than_by_a_constant():
    grid = equirect_grid(24, 12)
    train, held = turned_spectra(24, 0, grid), turned_spectra(8, 1, grid)
    window = window_of(train)
    model = fit_nerf2(train, replace(Nerf2Config.for_scale("smoke", "db"), steps=300, device="cpu"), window)
    weight = metrics.pixel_weight(grid)
    constant = window.decode(window.encode(train.power).mean(0)).expand_as(held.power)
    level = window.decode((window.encode(train.power) * weight).sum((-2, -1)).mean()).expand_as(held.power)
    error = metrics.rmse_db(held.power, model.render(held.pose, grid).power, window, weight).mean()
    for guess in (constant, level):
        # Nine tenths: a margin that another order of additions does not eat.
        assert float(error) < 0.9 * float(metrics.rmse_db(held.power, guess, window, weight).mean())


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"samples": 0}, "samples must be at least 1; got 0"),
        ({"width": 1}, "width must be at least 2"),
        ({"lr": 1e-9}, "learning rates must fall"),
        ({"far": -1.0}, "far must be a positive length in metres, or None"),
        ({"weight_decay": -1.0}, "weight_decay must not be negative"),
    ],
)
def test_settings_that_cannot_be_are_refused(changed, message):
    with pytest.raises(InputError, match=message):
        Nerf2Config(**changed)


def test_an_unknown_scale_is_refused_by_name():
    with pytest.raises(InputError, match="smoke; got 'huge'"):
        Nerf2Config.for_scale("huge")


def test_training_without_pictures_or_power_is_refused():
    train = turned_spectra(2, 0, equirect_grid(16, 8))
    window = window_of(train)
    with pytest.raises(InputError, match="at least one picture"):
        fit_nerf2(train[torch.tensor([], dtype=torch.long)], TINY, window)
    dark = train.power.clone()
    dark[1] = 0
    with pytest.raises(InputError, match="remove those that have none"):
        fit_nerf2(replace(train, power=dark), TINY, window)


def test_a_loss_that_explodes_says_so():
    train = turned_spectra(2, 0, equirect_grid(16, 8))
    with pytest.raises(TrainingError, match="no longer finite after"):
        fit_nerf2(train, replace(TINY, lr=1e20, lr_final=1e19), window_of(train))


def test_cuda_where_there_is_none_is_refused(monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    train = turned_spectra(2, 0, equirect_grid(16, 8))
    with pytest.raises(InputError, match="use auto or cpu"):
        Nerf2(train, replace(TINY, device="cuda"), window_of(train))
