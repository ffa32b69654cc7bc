"""Laws of the published recipe: what its pictures show, how they are read, and that it learns."""

import math
from dataclasses import asdict, replace

import pytest
import torch
from benchmarks.quality.methods import published
from benchmarks.quality.methods.method import Task

from rf3dgs.core.errors import InputError
from rf3dgs.core.frames import Pose
from rf3dgs.core.grids import list_grid, pinhole_grid
from rf3dgs.evaluation import metrics
from rf3dgs.evaluation.baselines import Constant, PublishedConfig, fit_published
from rf3dgs.evaluation.baselines.scales import TARGETS, Scale
from rf3dgs.spectra.codec import DbWindow, PerViewLinear, window_of
from rf3dgs.spectra.spectrum import Instrument, Spectrum
from rf3dgs.splats.surface import sample_mesh

GRID = pinhole_grid(18, 12, fov_deg=90)
WINDOW = DbWindow(-120.0, -80.0)
HIGH = (6.0, 5.0, 3.0)


@pytest.fixture(scope="module")
def walls():
    corner = [[HIGH[axis] if i >> axis & 1 else 0.0 for axis in range(3)] for i in range(8)]
    quads = ((0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3))
    faces = [triangle for a, b, c, d in quads for triangle in ((a, b, c), (a, c, d))]
    return sample_mesh(torch.tensor(corner), torch.tensor(faces), spacing=0.3, thickness=0.01)


def seen(pose: Pose, *, gain_db: float = 0.0) -> Spectrum:
    """Walls whose level varies along them by 30 dB."""
    here = pose.position[:, None, None, :]
    direction = pose.to_world(GRID.directions.expand(len(pose), *GRID.shape, 3))
    ahead = torch.where(direction > 0, torch.tensor(HIGH) - here, -here) / direction
    reach = torch.where(direction.abs() > 1e-6, ahead, torch.full_like(ahead, 1e9)).amin(-1, keepdim=True)
    hit = here + reach * direction
    level = -100.0 + 15.0 * torch.sin(2 * hit[..., 0] + hit[..., 1]) + gain_db
    return Spectrum(10 ** (level / 10), GRID, pose, 60e9, Instrument.gaussian(math.radians(6)), tx=Pose((1.0, 1, 2)))


def around(count: int, seed: int) -> Pose:
    place = Pose.scatter(((1.5, 1.5, 1.0), (4.5, 3.5, 2.0)), count, seed).position.repeat_interleave(4, 0)
    return Pose.from_yaw(place, torch.arange(4).repeat(count) * (math.pi / 2))


def powers(seed: int = 0) -> torch.Tensor:
    level = -118 + 36 * torch.rand(5, *GRID.shape, generator=torch.Generator().manual_seed(seed))
    return 10 ** (level / 10)


def test_what_is_painted_in_the_window_is_read_back():
    power = powers()
    assert torch.allclose(Scale.of("db", WINDOW, power).read(Scale.of("db", WINDOW, power).paint(power)), power)
    jet = Scale.of("jet", WINDOW, power)
    off = 10 * torch.log10(jet.read(jet.paint(power)) / power)
    assert float(off.abs().max()) <= 2.51 * WINDOW.span_db / 255  # half a step of 8 bits, and two of a shared colour
    assert jet.channels == 3


@pytest.mark.parametrize("target", ["view-db", "view-linear"])
def test_a_picture_by_its_own_range_does_not_know_its_gain(target):
    power = powers()
    scale = Scale.of(target, WINDOW, power)
    louder = power.clamp_max(10**-8.5) * 1.5
    quiet = power.clamp_max(10**-8.5)
    torch.testing.assert_close(scale.paint(louder), scale.paint(quiet), rtol=0, atol=1e-4)
    assert float(scale.paint(power).amax()) == pytest.approx(1.0)
    assert scale.channels == 1


def test_per_view_pictures_are_read_by_the_mean_training_range():
    power = powers()
    scale = Scale.of("view-db", WINDOW, power)
    level = 10 * torch.log10(scale.read(torch.tensor([1e-6, 1.0]).reshape(1, 2, 1)))[0]
    ends = 10 * torch.log10(torch.stack((power.amin((-2, -1)), power.amax((-2, -1)))))
    torch.testing.assert_close(level, ends.mean(1), rtol=0, atol=1e-3)
    linear = Scale.of("view-linear", WINDOW, power)
    peak = 10 ** (ends[1].mean() / 10)
    torch.testing.assert_close(linear.read(linear.paint(power)), PerViewLinear().encode(power) * peak)


@pytest.mark.parametrize("target", TARGETS)
def test_black_has_no_power(target):
    scale = Scale.of(target, WINDOW, powers())
    assert float(scale.read(torch.tensor([[[0.0, 0.0, 0.5][: scale.channels]]])).max()) == 0.0


def test_the_published_rates_are_the_defaults():
    expected = {"target": "jet", "steps": 10_000, "degree": 3, "lr_sh": 2.5e-3, "lr_opacity": 5e-2, "ssim_weight": 0.2}
    config = asdict(PublishedConfig())
    assert {name: config[name] for name in expected} == expected


@pytest.mark.parametrize("target", ["jet", "db"])
def test_the_recipe_learns_and_moves_nothing(walls, target):
    train, held = seen(around(6, 0)), seen(around(3, 1))
    window = window_of(train)
    rates = {"lr_sh": 2e-2}  # a short run in place of ten thousand iterations
    config = PublishedConfig(target=target, steps=150, **rates)
    field = fit_published(walls, train, config, window=window)
    weight = metrics.pixel_weight(GRID)

    def error(predictor) -> float:
        found = predictor.render(held.pose, GRID)
        assert found.delay is None or predictor is not field
        return float(metrics.rmse_db(held.power, found.power, window, weight).mean())

    assert error(field) < 0.5 * error(Constant(train))
    for name in ("means", "quats", "log_scales"):
        assert torch.equal(getattr(field.gaussians, name), getattr(walls, name)), name
    assert not torch.equal(field.gaussians.logit_opacities, walls.logit_opacities)
    again = fit_published(walls, train, config, window=window)
    assert torch.equal(again.gaussians.sh, field.gaussians.sh)


def test_what_the_recipe_cannot_use_is_refused(walls):
    train = seen(around(1, 0))
    with pytest.raises(InputError, match="steps must be at least 1; got 0"):
        fit_published(walls, train, PublishedConfig(steps=0), window=WINDOW)
    with pytest.raises(InputError, match="target must be one of jet, db, view-db, view-linear; got 'grey'"):
        fit_published(walls, train, PublishedConfig(target="grey"), window=WINDOW)  # type: ignore[arg-type]
    for power, message in ((-train.power, "negative, NaN or infinite"), (0 * train.power, "no power anywhere")):
        with pytest.raises(InputError, match=message):
            fit_published(walls, replace(train, power=power), window=WINDOW)
    with pytest.raises(InputError, match=r"needs spectra \[picture, row, col\]; got power \[12, 18\]"):
        fit_published(walls, train[0], window=WINDOW)
    listed = list_grid(GRID.directions.reshape(-1, 3))
    flat = Spectrum(train.power.reshape(4, *listed.shape), listed, train.pose, 60e9, train.instrument)
    with pytest.raises(InputError, match="needs pinhole or equirectangular spectra; got a list"):
        fit_published(walls, flat, PublishedConfig(steps=1), window=WINDOW)


@pytest.mark.parametrize("target", TARGETS)
def test_a_dark_picture_among_others_is_learned_as_dark(walls, target):
    train = seen(around(2, 0))
    power = train.power.clone()
    power[3] = 0.0
    field = fit_published(walls, replace(train, power=power), PublishedConfig(target=target, steps=10), window=WINDOW)
    assert bool(torch.isfinite(field.gaussians.sh).all())


def test_every_method_of_the_file_answers_and_needs_geometry(walls):
    train = seen(around(2, 0))
    task = Task(train, window_of(train), scale="smoke", geometry=walls)
    for method in published.METHODS:
        answer = method.made(task).render(train.pose[1], GRID)
        assert answer.power.shape == GRID.shape
        assert bool(torch.isfinite(answer.power).all())
        assert method.settings(task)["steps"] == published.STEPS["smoke"]
        with pytest.raises(InputError, match=f"'{method.name}' needs a task with geometry"):
            method.made(Task(train, window_of(train)))
