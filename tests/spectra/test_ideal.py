import math
import time
from dataclasses import replace

import pytest
import torch

from rf3dgs.channel.binning import stack_paths
from rf3dgs.core.angles import angle_between, direction_of
from rf3dgs.core.errors import InputError
from rf3dgs.core.frames import Pose
from rf3dgs.core.grids import equirect_grid, list_grid, pinhole_grid
from rf3dgs.core.units import db_from_power
from rf3dgs.spectra.config import ArrayProcessing
from rf3dgs.spectra.scan import spectrum_of
from rf3dgs.spectra.synthesis import default_lobe

SPHERE = equirect_grid(180, 90)


def _level(ratio):
    return abs(10 * math.log10(float(ratio)))


@pytest.mark.parametrize("grid", [SPHERE, pinhole_grid(60, 40, 90)], ids=["equirect", "pinhole"])
@pytest.mark.parametrize("yaw", [0.0, 2.5])
def test_a_source_to_the_left_lights_the_left_half(grid, yaw, paths_from):
    rx = Pose.from_yaw([3.0, 4.0, 1.0], yaw)
    power = spectrum_of(paths_from(rx.to_world(torch.tensor([0.8, 0.6, 0.0])), rx=rx), grid=grid).power
    half = grid.width // 2
    assert float(power[:, :half].sum()) > 1e3 * float(power[:, half:].sum())


def test_a_source_above_lights_the_upper_half(paths_from):
    power = spectrum_of(paths_from([0.8, 0.0, 0.6]), grid=SPHERE).power
    assert float(power[:45].sum()) > 1e3 * float(power[45:].sum())


def test_the_default_lobe_is_one_and_a_half_pixels():
    assert math.degrees(default_lobe(SPHERE)) == pytest.approx(3.0)
    assert math.degrees(default_lobe(pinhole_grid(300, 200, 90))) == pytest.approx(2.0)


@pytest.mark.parametrize(
    "zenith", [0.0, 1e-4, 0.01, 0.0174, 0.03, 0.0524, 0.5, math.pi / 2, 2.0, math.pi - 0.01, math.pi]
)
@pytest.mark.parametrize("azimuth", [0.0, 0.017, math.pi, -math.pi + 1e-3])
def test_path_gain_of_one_path_is_conserved_anywhere(zenith, azimuth, paths_from):
    direction = direction_of(torch.tensor(zenith), torch.tensor(azimuth))
    for grid in (SPHERE, equirect_grid(91, 45)):
        spectrum = spectrum_of(paths_from(direction, gains=[1e-9]), grid=grid)
        assert _level(spectrum.path_gain / 1e-9) < 0.1


def test_path_gain_of_a_million_diffuse_paths_is_conserved_in_seconds(random_paths):
    paths = random_paths(1_000_000)
    began = time.perf_counter()
    spectrum = spectrum_of(paths, grid=SPHERE)
    assert time.perf_counter() - began < 20
    assert _level(spectrum.path_gain / paths.total_gain) < 0.1


def test_many_paths_by_transform_agree_with_the_direct_sum(random_paths, monkeypatch):
    paths = random_paths(2500)
    for grid in (equirect_grid(120, 60), pinhole_grid(30, 20, 90)):
        fast = spectrum_of(paths, grid=grid)
        monkeypatch.setattr("rf3dgs.spectra.synthesis.EXACT_ALWAYS", 10**9)
        exact = spectrum_of(paths, grid=grid)
        monkeypatch.undo()
        error = fast.gain_db - exact.gain_db
        assert float(error.square().mean().sqrt()) < 0.1
        assert float(error.abs().max()) < 1.0
        assert float((fast.delay - exact.delay).abs().max()) < 2e-9
        strong = exact.power > exact.power.median()
        assert float(angle_between(fast.aod, exact.aod)[strong].rad2deg().median()) < 1.0


def test_a_unit_path_at_a_pixel_gives_one_and_falls_to_half_at_half_the_lobe(paths_from):
    lobe = math.radians(4)
    offset = torch.tensor([[1.0, 0.0, 0.0], [math.cos(lobe / 2), math.sin(lobe / 2), 0.0]])
    spectrum = spectrum_of(paths_from([1.0, 0.0, 0.0]), grid=list_grid(offset), lobe=lobe)
    assert torch.allclose(spectrum.power, torch.tensor([[1.0, 0.5]]), atol=1e-5)


def test_line_of_sight_spectrum_equals_friis(line_of_sight):
    paths = line_of_sight(Pose([0.0, 0.0, 2.0]), Pose([5.0, 3.0, 1.0]))
    spectrum = spectrum_of(paths, grid=SPHERE)
    assert _level(spectrum.path_gain / paths.path_gain[0]) < 0.01
    lit = spectrum.power > 0
    assert torch.allclose(spectrum.delay[lit], paths.delay.expand(int(lit.sum())), rtol=1e-6)
    assert float(angle_between(spectrum.aod[lit], paths.aod.expand(int(lit.sum()), 3)).max()) < 1e-5


def test_delay_and_aod_are_power_weighted_means_and_zero_without_power(paths_from):
    paths = paths_from([[1.0, 0, 0], [1.0, 0, 0]], gains=[3.0, 1.0], delays=[1e-8, 2e-8])
    spectrum = spectrum_of(paths, grid=SPHERE)
    lit = spectrum.power > 0
    assert torch.allclose(spectrum.delay[lit], torch.tensor(1.25e-8))
    assert torch.allclose(spectrum.aod[lit].norm(dim=-1), torch.ones(()))
    assert bool((~lit).any())
    assert float(spectrum.delay[~lit].abs().max()) == 0.0
    assert float(spectrum.aod[~lit].abs().max()) == 0.0


def test_the_lobe_ends_below_minus_eighty_db(paths_from):
    spectrum = spectrum_of(paths_from([1.0, 0.0, 0.0]), grid=SPHERE)
    assert float(spectrum.power[spectrum.power > 0].min()) > 0.9e-8
    angle = angle_between(SPHERE.directions, torch.tensor([1.0, 0.0, 0.0]).expand(90, 180, 3))
    assert bool((spectrum.power[angle > math.radians(3) * 2.6] == 0).all())


def test_turning_the_world_turns_the_spectrum(random_paths):
    yaw = 40 * 2 * math.pi / 180
    paths = random_paths(3000)
    turned = replace(
        paths,
        aoa_azimuth=torch.remainder(paths.aoa_azimuth + yaw + math.pi, 2 * math.pi) - math.pi,
        aod_azimuth=torch.remainder(paths.aod_azimuth + yaw + math.pi, 2 * math.pi) - math.pi,
        rx=paths.rx.turned(yaw),
        tx=paths.tx.turned(yaw),
    )
    first, second = spectrum_of(paths, grid=SPHERE), spectrum_of(turned, grid=SPHERE)
    assert torch.allclose(first.gain_db, second.gain_db, atol=0.01)
    level = replace(turned, rx=Pose(turned.rx.position))
    columns = spectrum_of(level, grid=SPHERE).power.roll(40, -1)
    assert torch.allclose(db_from_power(columns), first.gain_db, atol=0.5)


def test_poses_may_differ_from_the_receivers(paths_from):
    paths = paths_from([1.0, 0.0, 0.0])
    ahead = spectrum_of(paths, grid=SPHERE, pose=Pose([3.0, 4.0, 1.0]))
    left = spectrum_of(paths, grid=SPHERE, pose=Pose.from_yaw([3.0, 4.0, 1.0], -math.pi / 2))
    assert torch.allclose(ahead.power.roll(-45, -1), left.power, atol=1e-3)
    with pytest.raises(InputError, match="pose must be one pose"):
        spectrum_of(paths, grid=SPHERE, pose=Pose([[0.0, 0, 0], [1, 0, 0]]))


def test_receivers_are_batched_and_progress_is_told(random_paths):
    class Log:
        calls: list

        def start(self, label, total, done=0):
            self.calls = [(label, total)]

        def update(self, done, note=""):
            self.calls.append(done)

        def finish(self, note=""):
            self.calls.append("finished")

    log = Log()
    single = [random_paths(50, seed=s) for s in range(2)]
    both = spectrum_of(stack_paths(single), grid=SPHERE, progress=log)
    assert both.power.shape == (2, 90, 180)
    assert both.aod.shape == (2, 90, 180, 3)
    assert torch.equal(both.power[1], spectrum_of(single[1], grid=SPHERE).power)
    assert log.calls == [("ideal spectra", 2), 1, 2, "finished"]


def test_a_receiver_without_paths_has_an_empty_spectrum(random_paths):
    spectrum = spectrum_of(random_paths(0), grid=SPHERE)
    assert float(spectrum.power.sum()) == 0.0
    assert float(spectrum.delay.abs().sum()) == 0.0


def test_a_lobe_too_narrow_for_the_grid_is_refused(random_paths):
    with pytest.raises(InputError, match=r"at least 1\.4 pixels \(2\.80 degrees\).*got 2\.00 degrees"):
        spectrum_of(random_paths(1), grid=SPHERE, lobe=math.radians(2))
    with pytest.raises(InputError, match="in radians"):
        spectrum_of(random_paths(1), grid=SPHERE, lobe=4.0)
    assert spectrum_of(random_paths(1), grid=SPHERE, lobe=math.radians(2.8)).instrument.lobe < math.radians(2.9)


def test_an_ideal_spectrum_has_no_array_to_process(random_paths):
    with pytest.raises(InputError, match='no array to process; use processing with method="bartlett"'):
        spectrum_of(random_paths(1), grid=SPHERE, processing=ArrayProcessing(snr_db=20))


@pytest.mark.parametrize(
    "grid",
    [
        equirect_grid(12, 6),
        equirect_grid(50, 37),
        pinhole_grid(31, 17, 150),
        list_grid(torch.randn(77, 3, generator=torch.Generator().manual_seed(0))),
    ],
    ids=["coarse", "sphere", "pinhole", "list"],
)
@pytest.mark.parametrize("lobe_deg", [45.0, 100.0])
def test_lobes_reach_every_pixel_within_their_cut(grid, lobe_deg, random_paths):
    """Against the sum over all pairs of a pixel and a path, without blocks; spheres apart from their normalisation."""
    paths, lobe = random_paths(20), math.radians(lobe_deg)
    spectrum = spectrum_of(paths, grid=grid, lobe=lobe)
    angle = angle_between(grid.directions[..., None, :].double(), paths.aoa.double().expand(*grid.shape, 20, 3))
    kernel = torch.exp(-4 * math.log(2) * (angle / lobe) ** 2)
    kernel = torch.where(kernel >= 1e-8, kernel, torch.zeros_like(kernel))
    if grid.kind == "equirect":
        kernel = kernel * (math.pi * lobe**2 / (4 * math.log(2))) / (kernel * grid.solid_angle[..., None]).sum((0, 1))
    expected = (kernel * paths.path_gain.double()).sum(-1)
    assert torch.allclose(spectrum.power.double(), expected, rtol=1e-5, atol=1e-20)


def test_receivers_after_the_first_see_what_they_would_see_alone(random_paths):
    """What a grid and a lobe need is prepared once; another grid in between changes nothing."""
    grid, paths = equirect_grid(60, 30), random_paths(3000, seed=5)
    alone = spectrum_of(paths, grid=grid).power
    spectrum_of(random_paths(2000), grid=grid)
    assert torch.equal(spectrum_of(paths, grid=grid).power, alone)
    spectrum_of(paths, grid=pinhole_grid(30, 20, 90))
    assert torch.equal(spectrum_of(paths, grid=grid).power, alone)
