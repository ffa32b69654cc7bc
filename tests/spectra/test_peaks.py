import math

import pytest
import torch

from rf3dgs.channel.binning import stack_paths
from rf3dgs.core.angles import angle_between, direction_of
from rf3dgs.core.errors import InputError
from rf3dgs.core.frames import Pose
from rf3dgs.core.grids import equirect_grid, list_grid, pinhole_grid
from rf3dgs.spectra.peaks import find_peaks, main_peak
from rf3dgs.spectra.resampling import resample
from rf3dgs.spectra.scan import spectrum_of

SPHERE = equirect_grid(180, 90)


def _degrees(first, second):
    return math.degrees(float(angle_between(first, second)))


@pytest.mark.parametrize("zenith", [0.0, 0.005, 0.0174, 0.04, 1.2, math.pi / 2, math.pi - 0.003, math.pi])
@pytest.mark.parametrize("azimuth", [0.0, 0.7, math.pi, -math.pi + 0.01])
def test_one_path_is_one_peak_far_below_the_pixel_anywhere_on_the_sphere(zenith, azimuth, paths_from):
    paths = paths_from(direction_of(torch.tensor(zenith), torch.tensor(azimuth)), rx=Pose([0.0, 0.0, 1.0]))
    spectrum = spectrum_of(paths, grid=SPHERE)
    directions, values = find_peaks(spectrum.power, SPHERE, count=5, separation=spectrum.instrument.lobe)
    assert len(directions) == 1
    assert _degrees(directions[0], paths.aoa[0]) < 0.01
    assert 10 * math.log10(float(values[0])) == pytest.approx(0.0, abs=0.6)


def test_peaks_of_a_pinhole_are_as_fine(paths_from):
    grid = pinhole_grid(90, 60, 90)
    source = torch.nn.functional.normalize(torch.tensor([1.0, 0.31, -0.17]), dim=-1)
    spectrum = spectrum_of(paths_from(source), grid=grid)
    directions, values = find_peaks(spectrum.power, grid, count=3, separation=spectrum.instrument.lobe)
    assert len(directions) == 1
    assert _degrees(directions[0], source) < 0.01
    assert float(values[0]) == pytest.approx(1.0, abs=0.01)


def test_several_paths_come_strongest_first(paths_from):
    sources = torch.nn.functional.normalize(torch.tensor([[1.0, 0, 0], [0, 1.0, 0.2], [-1.0, 0.01, 0.4]]), dim=-1)
    spectrum = spectrum_of(paths_from(sources, gains=[1e-9, 4e-9, 2e-9]), grid=SPHERE)
    directions, values = find_peaks(spectrum.power, SPHERE, count=8, separation=spectrum.instrument.lobe)
    assert len(directions) == 3
    for found, true in zip(directions, sources[[1, 2, 0]], strict=True):
        assert _degrees(found, true) < 0.01
    assert torch.allclose(values, torch.tensor([4e-9, 2e-9, 1e-9]), rtol=0.02)
    assert len(find_peaks(spectrum.power, SPHERE, count=2, separation=0.05)[0]) == 2


def test_peaks_keep_their_distance(random_paths):
    spectrum = spectrum_of(random_paths(500), grid=SPHERE)
    directions, _ = find_peaks(spectrum.power, SPHERE, count=40, separation=0.2)
    angle = angle_between(
        directions[:, None].expand(-1, len(directions), 3), directions[None].expand(len(directions), -1, 3)
    )
    assert len(directions) == 40
    assert float((angle + torch.eye(40)).min()) > 0.2 - 2 * 0.0524


def test_an_empty_or_constant_picture_is_survived():
    assert find_peaks(torch.zeros(90, 180), SPHERE, count=3, separation=0.05)[0].shape == (0, 3)
    directions, values = find_peaks(torch.ones(90, 180), SPHERE, count=3, separation=0.05)
    assert bool(torch.isfinite(directions).all())
    assert torch.allclose(values, torch.ones(3))


def test_a_list_of_directions_has_its_strongest(paths_from):
    grid = list_grid(torch.tensor([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]))
    directions, values = find_peaks(torch.tensor([[1.0, 2.0]]), grid, count=1, separation=0.1)
    assert torch.equal(directions, torch.tensor([[0.0, 1.0, 0.0]]))
    assert float(values[0]) == 2.0


def test_wrong_shapes_are_told():
    with pytest.raises(InputError, match=r"power must be \[90, 180\]"):
        find_peaks(torch.zeros(3, 3), SPHERE, count=1, separation=0.1)
    with pytest.raises(InputError, match="positive angle"):
        find_peaks(torch.zeros(90, 180), SPHERE, count=1, separation=0.0)


def test_the_main_peak_is_a_world_direction_per_pose(line_of_sight):
    tx = Pose([1.0, 1.0, 3.0])
    poses = [Pose.from_yaw([4.0, 2.0, 1.0], 0.9), Pose.look_at([8.0, 9.0, 1.5], [0.0, 5.0, 0.0])]
    spectrum = spectrum_of(stack_paths([line_of_sight(tx, rx) for rx in poses]), grid=SPHERE)
    found = main_peak(spectrum)
    assert found.shape == (2, 3)
    for direction, rx in zip(found, poses, strict=True):
        assert _degrees(direction, tx.position - rx.position) < 0.01


def test_resampling_to_a_pinhole_is_looking_through_it(random_paths):
    paths = random_paths(300)
    sphere, grid = equirect_grid(540, 270), pinhole_grid(60, 40, 90)
    lobe = math.radians(4)
    seen = resample(spectrum_of(paths, grid=sphere, lobe=lobe), grid)
    true = spectrum_of(paths, grid=grid, lobe=lobe)
    strong = true.power > 0.05 * true.power.max()
    assert float((seen.gain_db - true.gain_db)[strong].abs().max()) < 0.6
    assert float((seen.gain_db - true.gain_db)[strong].square().mean().sqrt()) < 0.25
    assert float((seen.delay - true.delay)[strong].square().mean().sqrt()) < 1e-9
    assert float(angle_between(seen.aod, true.aod)[strong].median()) < 0.02
    assert seen.grid is grid


def test_resampling_out_of_a_pinhole_leaves_the_rest_dark(random_paths):
    paths = stack_paths([random_paths(300), random_paths(200, seed=1)])
    spectrum = spectrum_of(paths, grid=pinhole_grid(90, 60, 90))
    sphere = resample(spectrum, SPHERE)
    assert sphere.power.shape == (2, 90, 180)
    assert float(sphere.power[..., SPHERE.directions[..., 0] < 0].max()) == 0.0
    assert torch.equal(resample(spectrum, spectrum.grid).power, spectrum.power)
