import math
from dataclasses import fields, replace

import pytest
import torch

from rf3dgs.core.angles import angle_between
from rf3dgs.core.errors import InputError
from rf3dgs.core.frames import Pose
from rf3dgs.core.grids import equirect_grid, pinhole_grid
from rf3dgs.core.units import SPEED_OF_LIGHT, friis_gain
from rf3dgs.spectra.peaks import main_peak
from rf3dgs.spectra.spectrum import Instrument, Spectrum
from rf3dgs.splats.gaussians import Gaussians
from rf3dgs.splats.surface import sample_mesh
from rf3dgs.training.config import PAPER_ONLY, PRESETS, RadioConfig
from rf3dgs.training.loop import TrainingStopped
from rf3dgs.training.radio import fit_radio
from rf3dgs.training.radio_views import radio_views

HIGH = (6.0, 5.0, 3.0)
TX = torch.tensor([1.0, 1.2, 2.4])
QUICK = RadioConfig(model="paper", steps=12, backend="reference")


def room(spacing: float = 0.4) -> Gaussians:
    corner = [[HIGH[axis] if i >> axis & 1 else 0.0 for axis in range(3)] for i in range(8)]
    quads = ((0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3))
    faces = [triangle for a, b, c, d in quads for triangle in ((a, b, c), (a, c, d))]
    return sample_mesh(torch.tensor(corner), torch.tensor(faces), spacing=spacing, thickness=0.01)


def measure(pose: Pose, grid=None, *, lobe: float = math.radians(12)) -> Spectrum:
    """Diffuse bounces whose level varies along the walls and with the viewing direction, plus the line of sight."""
    grid = equirect_grid(48, 24) if grid is None else grid
    instrument = Instrument.gaussian(lobe)
    here = pose.position[:, None, None, :]
    directions = pose.to_world(grid.directions.expand(len(pose), *grid.shape, 3))
    ahead = torch.where(directions > 0, torch.tensor(HIGH) - here, -here) / directions
    second = torch.where(directions.abs() > 1e-6, ahead, torch.full_like(ahead, 1e9)).amin(-1)
    hit = here + second[..., None] * directions
    outward = hit - TX
    first = torch.linalg.vector_norm(outward, dim=-1)
    diffuse = 1e-9 / first**2 * (1 + 0.5 * torch.sin(2 * hit[..., 0])) * (1.2 + directions[..., 1])
    straight = TX - here
    distance = torch.linalg.vector_norm(straight, dim=-1)
    line = instrument.kernel(angle_between(directions, straight.expand_as(directions))) * friis_gain(distance, 60e9)
    power = diffuse + line
    delay = (diffuse * (first + second) + line * distance) / power / SPEED_OF_LIGHT
    departure = (diffuse / first)[..., None] * outward - (line / distance)[..., None] * straight
    aod = torch.nn.functional.normalize(departure, dim=-1)
    return Spectrum(power, grid, pose, 60e9, instrument, "ideal", delay, aod, Pose(TX))


def positions(count: int, seed: int) -> Pose:
    return Pose.scatter(((1.0, 1.0, 0.8), (5.0, 4.0, 2.0)), count, seed)


def level_error(field, truth: Spectrum) -> float:
    rendered = field.render(truth.pose, truth.grid, csi=False)
    return float((rendered.gain_db - truth.gain_db).square().mean().sqrt())


@pytest.fixture(scope="module")
def training() -> Spectrum:
    return measure(positions(12, 0))


@pytest.fixture(scope="module")
def held_out() -> Spectrum:
    return measure(positions(4, 9))


@pytest.fixture(scope="module")
def trained(training):
    return fit_radio(room(), training, replace(QUICK, steps=48))


def test_the_field_beats_the_nearest_measurement_where_nobody_measured(trained, training, held_out):
    distance = torch.cdist(held_out.pose.position, training.pose.position)
    copied = training.gain_db[distance.argmin(-1)]
    copy_error = float((copied - held_out.gain_db).square().mean().sqrt())
    assert level_error(trained, held_out) < 2.0
    assert level_error(trained, held_out) < copy_error
    away = angle_between(
        main_peak(trained.render(held_out.pose, held_out.grid, csi=False)), TX - held_out.pose.position
    )
    assert math.degrees(float(away.max())) < 0.5


def test_paths_survive_training_with_the_transmitter_given(trained, held_out):
    paths = trained.paths(held_out.pose)
    line = paths.order == 0
    assert bool((line.sum(-1) == 1).all())
    straight = TX - held_out.pose.position
    distance = torch.linalg.vector_norm(straight, dim=-1)
    assert float((paths.delay[line] - distance / SPEED_OF_LIGHT).abs().max()) < 10e-12
    assert math.degrees(float(angle_between(paths.aoa[line], straight).max())) < 0.1
    level_db = 10 * torch.log10(paths.path_gain[line] / friis_gain(distance, 60e9))
    assert float(level_db.abs().max()) < 0.3


def test_paths_survive_training_with_the_transmitter_estimated(training, held_out):
    unknown = replace(training, tx=None)
    field = fit_radio(room(), unknown, replace(QUICK, steps=1))
    assert field.meta["transmitter"] == "estimated"
    paths = field.paths(held_out.pose)
    line = paths.order == 0
    straight = TX - held_out.pose.position
    delay = torch.linalg.vector_norm(straight, dim=-1) / SPEED_OF_LIGHT
    assert float((paths.delay[line] - delay).abs().max()) < 0.1e-9
    assert math.degrees(float(angle_between(paths.aoa[line], straight).max())) < 0.5


def test_delay_and_departure_follow_the_truth(trained, held_out):
    rendered = trained.render(held_out.pose, held_out.grid)
    assert rendered.delay is not None
    assert held_out.delay is not None
    assert rendered.aod is not None
    assert held_out.aod is not None
    assert float((rendered.delay - held_out.delay).abs().median()) < 1.5e-9
    assert math.degrees(float(angle_between(rendered.aod, held_out.aod).median())) < 8


def test_planes_come_along_when_mirrors_are_asked_for(training, held_out):
    field = fit_radio(room(0.15), training, replace(QUICK, steps=0, mirror_order=1, detail="keep"))
    assert field.sources is not None
    assert len(field.sources.planes) >= 6
    assert field.plane_of is not None
    assert len(field.plane_of) == len(field.surface)
    assert bool((field.plane_of >= 0).float().mean() > 0.9)
    paths = field.paths(held_out.pose, parts="sources")
    assert paths.order is not None
    assert bool(((paths.order == 0) & paths.valid).any(-1).all())
    assert int(paths.order.max()) <= 1


def test_the_paper_s_own_encoding_learns_the_level(training, held_out):
    config = replace(RadioConfig.paper(steps=150), lr_level=2e-2, lr_csi=2e-2, backend="reference")
    field = fit_radio(room(), training, config)
    assert field.sources is None
    assert field.surface.csi_sh.shape[1:] == (16, 3)
    assert level_error(field, held_out) < 5.0
    rendered = field.render(held_out.pose, held_out.grid)
    assert rendered.delay is not None
    assert held_out.delay is not None
    assert float((rendered.delay - held_out.delay).abs().median()) < 10e-9


def test_spectra_without_delay_and_departure_are_enough(training, held_out):
    bare = replace(training, delay=None, aod=None)
    field = fit_radio(room(), bare, replace(QUICK, steps=6))
    assert level_error(field, held_out) < 2.5
    assert field.render(held_out.pose, held_out.grid).delay is not None


def test_pinhole_spectra_train_directly(training):
    poses = Pose.look_at(positions(16, 3).position, [3.0, 2.5, 1.2])
    spectra = measure(poses, pinhole_grid(24, 16, 90))
    field = fit_radio(room(), spectra, replace(QUICK, steps=30))
    assert level_error(field, spectra) < 2.5


def test_point_sources_are_masked_out_of_the_surface(training, trained):
    seen = torch.ones(len(training), dtype=torch.bool)
    rays = trained.sources.rays_each(training.pose.position, trained.obstacles, in_sight=seen)
    views = radio_views(training, trained.surface.window, rays=rays)
    assert len(views) == len(training)
    area = training.grid.solid_angle / training.grid.solid_angle.mean()
    for one in views:
        towards = one.view.pose.to_device((TX - one.view.position)[None])
        pixel, _ = training.grid.pixel_of(towards)
        col, row = pixel[0].long().tolist()
        assert float(one.keep[row, col]) == 0
        assert float((one.keep == 0).float().mean()) < 0.2
        assert torch.equal(one.keep, area * (one.keep > 0))


def test_a_spectrum_without_sources_is_learned_as_it_was_measured(training, trained):
    window = trained.surface.window
    for one, power, delay in zip(radio_views(training, window), training.power, training.delay, strict=True):
        assert torch.equal(one.gain, window.encode(power))
        torch.testing.assert_close(one.csi[..., 0], delay * 1e9)


def test_the_same_seed_gives_the_same_field_and_another_gives_another(training):
    fields = [fit_radio(room(), training, replace(QUICK, seed=seed)) for seed in (5, 5, 6)]
    assert torch.equal(fields[0].surface.gain_sh, fields[1].surface.gain_sh)
    assert torch.equal(fields[0].surface.csi_sh, fields[1].surface.csi_sh)
    assert not torch.equal(fields[0].surface.gain_sh, fields[2].surface.gain_sh)


class StopsAt:
    """A progress that interrupts the run after some iterations, as a kill would."""

    def __init__(self, iteration: int) -> None:
        self.iteration = iteration

    def start(self, label: str, total: int, done: int = 0) -> None: ...

    def update(self, done: int, note: str = "") -> None:
        if done == self.iteration:
            raise KeyboardInterrupt

    def finish(self, note: str = "") -> None: ...


def test_a_stopped_run_ends_like_a_calm_one(training, tmp_path):
    config = replace(QUICK, checkpoint_every=3)
    calm = fit_radio(room(), training, config)
    with pytest.raises((KeyboardInterrupt, TrainingStopped)):
        fit_radio(room(), training, config, progress=StopsAt(8), checkpoint_dir=tmp_path)
    resumed = fit_radio(room(), training, config, checkpoint_dir=tmp_path)
    for name in ("gain_sh", "csi_sh", "logit_opacities"):
        assert torch.equal(getattr(calm.surface, name), getattr(resumed.surface, name))


def test_a_checkpoint_of_other_measurements_is_refused(training, tmp_path):
    config = replace(QUICK, steps=2)
    fit_radio(room(), training, config, checkpoint_dir=tmp_path)
    turned = Pose.from_yaw(training.pose.position, torch.full((len(training),), 0.3))
    for other in (
        replace(training, delay=training.delay + 1e-9),
        replace(training, pose=turned),
        replace(training, frequency=61e9),
        replace(training, instrument=Instrument.gaussian(0.3)),
    ):
        with pytest.raises(InputError, match=r"was made with another (data|frequency|instrument)"):
            fit_radio(room(), other, config, checkpoint_dir=tmp_path)


def test_frozen_geometry_stays_and_opacity_follows_only_when_asked(training):
    geometry = room()
    moved = fit_radio(geometry, training, QUICK)
    still = fit_radio(geometry, training, replace(QUICK, train_opacity=False))
    for field in (moved, still):
        for name in ("means", "quats", "log_scales"):
            assert torch.equal(getattr(field.surface, name), getattr(geometry, name))
    assert torch.equal(still.surface.logit_opacities, geometry.logit_opacities)
    assert not torch.equal(moved.surface.logit_opacities, geometry.logit_opacities)


def test_bad_spectra_are_refused_by_position(training):
    def spoiled(value):
        power = training.power.clone()
        power[3] = value
        return replace(training, power=power)

    for value, message in (
        (float("nan"), "position 3 has NaN"),
        (-1.0, "position 3 has negative power"),
        (0.0, "position 3 is empty"),
        (2e-9, "position 3 is constant"),
    ):
        with pytest.raises(InputError, match=message):
            fit_radio(room(), spoiled(value), QUICK)
    with pytest.raises(InputError, match="list of positions"):
        fit_radio(room(), training[0], QUICK)
    with pytest.raises(InputError, match="floor_db < ceil_db"):
        fit_radio(room(), training, replace(QUICK, floor_db=-10.0))
    with pytest.raises(InputError, match=r"steps must be 0 .* or more; got -1"):
        fit_radio(room(), training, replace(QUICK, steps=-1))


def test_merged_geometry_renders_what_the_whole_one_does():
    geometry, truth = room(0.08), measure(positions(16, 5))
    whole = fit_radio(geometry, truth, replace(QUICK, steps=0, backend="auto", detail="auto"))
    merged = fit_radio(geometry, truth, replace(QUICK, steps=0, backend="auto", detail="merge"))
    assert len(whole.surface) == len(geometry)
    assert merged.meta["Gaussians given"] == len(geometry)
    assert len(merged.surface) == len(merged.solidity) == len(merged.colour) < 0.5 * len(geometry)
    held_out = measure(positions(4, 6))
    errors = [level_error(field, held_out) for field in (whole, merged)]
    assert errors[1] < 1.1 * errors[0]
    assert torch.equal(merged.sees_transmitter(held_out.pose), whole.sees_transmitter(held_out.pose))


def test_presets_have_names_and_keep_the_seed():
    assert RadioConfig.preset("paper", seed=4) == RadioConfig.paper(seed=4)
    assert RadioConfig.preset("fast", steps=7).steps == 7
    assert {RadioConfig.preset(name).model for name in PRESETS} == {"paper"}
    assert RadioConfig.fast().steps < RadioConfig().steps < RadioConfig.best().steps
    with pytest.raises(InputError, match="presets of the radio stage are fast, paper, best; got 'quick'"):
        RadioConfig.preset("quick")


def test_settings_of_the_papers_model_are_refused_by_the_mirror_model(training):
    for changes in ({"steps": 5}, {"degree": 2, "ssim_weight": 0.5}):
        with pytest.raises(InputError, match=rf"^{', '.join(changes)}: settings of the paper's model; choose model="):
            fit_radio(room(), training, RadioConfig(**changes))
    assert set(PAPER_ONLY) < {item.name for item in fields(RadioConfig)}


def test_the_core_and_its_specification_train_the_same_field(training):
    """On Gaussians of which no two are equally deep: the order of those is rounding's."""
    geometry = Gaussians.random(300, (0.2, 0.2, 0.2), (5.8, 4.8, 2.8), degree=0, seed=2)
    config = replace(QUICK, steps=24)
    fields = [fit_radio(geometry, training, replace(config, backend=backend)) for backend in ("native", "reference")]
    for name in ("gain_sh", "csi_sh", "logit_opacities"):
        found, expected = (getattr(field.surface, name) for field in fields)
        assert (found - expected).norm() < 1e-4 * expected.norm(), name
