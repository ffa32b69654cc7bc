import dataclasses
import math

import pytest
import torch

from rf3dgs.core.errors import InputError
from rf3dgs.core.frames import Pose, matrix_from_quaternion
from rf3dgs.core.grids import Camera, pinhole_grid
from rf3dgs.data.photo import Photo
from rf3dgs.geometry.planes import find_planes, main_directions
from rf3dgs.splats.gaussians import Gaussians
from rf3dgs.splats.image_loss import psnr
from rf3dgs.training.config import VisualConfig
from rf3dgs.training.initial import camera_box, random_start, upright, views_of
from rf3dgs.training.photographs import blending_weights, clamp_needles, depth_error, render_photo
from rf3dgs.training.schedule import Schedule
from rf3dgs.training.sweep import Surfaces, View, swept_surfaces, upheld
from rf3dgs.training.visual import VisualStage, fit_geometry

SMALL = VisualConfig(
    steps=160, start_count=80, max_count=160, bounds=((-1, -1, -1), (1, 1, 1)), background="black", degree=1
)


def ring(count: int) -> list[Camera]:
    grid = pinhole_grid(32, 24, 60)
    turns = [2 * math.pi * index / count for index in range(count)]
    poses = [Pose.look_at((3 * math.cos(turn), 3 * math.sin(turn), 0.5), (0.0, 0.0, 0.0)) for turn in turns]
    return [Camera.of(pose, grid) for pose in poses]


def blobs(count: int = 30, seed: int = 3) -> Gaussians:
    random = Gaussians.random(count, (-1, -1, -1), (1, 1, 1), degree=0, seed=seed)
    return dataclasses.replace(random, logit_opacities=random.logit_opacities + 4)


@pytest.fixture(scope="module")
def photos() -> list[Photo]:
    return [Photo(f"p{index}", camera, pixels=render_photo(blobs(), camera)) for index, camera in enumerate(ring(6))]


def test_an_overfitted_view_is_reproduced(photos):
    config = dataclasses.replace(SMALL, steps=250, lr_sh=5e-3, lr_means=1.3e-3, prune_size=1.0)
    fitted = fit_geometry(photos[:1], config, initial=blobs(120, seed=9))
    assert psnr(render_photo(fitted, photos[0].camera), photos[0].load()) > 30


def test_fitting_photographs_explains_a_view_that_was_held_out(photos):
    config = dataclasses.replace(SMALL, steps=300)
    before = VisualStage(photos[1:], config).gaussians()
    fitted = fit_geometry(photos[1:], config)
    held_out = photos[0]
    gain = [float(psnr(render_photo(gaussians, held_out.camera), held_out.load())) for gaussians in (before, fitted)]
    assert gain[1] > gain[0] + 4


def test_the_same_seed_gives_the_same_gaussians(photos):
    first, second = (fit_geometry(photos, dataclasses.replace(SMALL, steps=40)) for _ in range(2))
    other = fit_geometry(photos, dataclasses.replace(SMALL, steps=40, seed=1))
    assert all(torch.equal(value, second.tensors()[name]) for name, value in first.tensors().items())
    assert not torch.equal(first.means[:20], other.means[:20])


def test_torch_works_on_one_thread_so_that_threads_do_not_change_the_bits(photos, torch_threads):
    fit_geometry(photos, dataclasses.replace(SMALL, steps=2), progress=torch_threads)
    assert torch_threads.seen == {1}


def test_growth_happens_where_the_gradient_is(photos):
    half_known = blobs()
    lost = dataclasses.replace(half_known, sh=half_known.sh.clone())
    lost.sh[half_known.means[:, 0] > 0] *= -1
    config = dataclasses.replace(
        SMALL, steps=40, densify_from=12, densify_every=12, densify_until=12, double_at=(0, 0), prune_unseen=0.0
    )
    stage = VisualStage(photos, config, lost)
    for iteration in range(11):
        stage.step(iteration)
    gradient = stage.trainer.density().mean_gradient
    stage.config = dataclasses.replace(config, grow_gradient=float(gradient.median()))
    quiet, means = gradient < gradient.median(), stage.gaussians().means
    stage.step(11)
    grown = stage.gaussians()
    added = len(grown) - len(means)
    assert abs(added - int((~quiet).sum())) <= 2
    parents = torch.cdist(grown.means[-added:], means).argmin(-1)
    assert float((~quiet)[parents].float().mean()) >= 0.6


def test_growth_stops_at_the_largest_count(photos):
    config = dataclasses.replace(SMALL, steps=120, max_count=90, grow_gradient=0.0)
    assert len(fit_geometry(photos, config)) <= 90


def test_gaussians_that_no_photograph_shows_are_removed(photos):
    hidden = Gaussians.random(7, (0, 0, 40), (1, 1, 41), degree=0, seed=1)
    stage = VisualStage(photos, dataclasses.replace(SMALL, steps=1), Gaussians.join([blobs(), hidden]))
    stage.step(0)
    assert float(stage.gaussians().means[:, 2].max()) < 10
    assert len(stage.gaussians()) <= 30


def test_blending_weights_add_up_to_the_pictures_coverage(photos):
    from rf3dgs.splats.rasterize import rasterize

    scene, cameras = blobs(), ring(3)
    args = scene.means, scene.quats, scene.scales, scene.opacities, torch.ones(len(scene), 1)
    coverage = sum(float(rasterize(*args, camera).weight.sum()) for camera in cameras)
    assert float(blending_weights(scene, cameras).sum()) == pytest.approx(coverage, rel=1e-4)


def test_harmonics_rise_one_degree_at_a_time_and_start_at_zero(photos):
    stage = VisualStage(photos, dataclasses.replace(SMALL, steps=60, degree=2, degree_every=5, densify_until=0))
    used = []
    for iteration in range(12):
        stage.step(iteration)
        used.append((stage.gaussians().sh != 0).any(-1).any(0).tolist())
    assert used == [[True] + [False] * 8] * 5 + [[True] * 4 + [False] * 5] * 5 + [[True] * 9] * 2


def test_pictures_begin_at_a_quarter_of_their_resolution():
    schedule = Schedule.of(VisualConfig())
    assert [schedule.shrink_at(iteration) for iteration in (0, 249, 250, 499, 500)] == [4, 4, 2, 2, 1]
    assert schedule.densify_from == 500
    assert (schedule.densify_every, schedule.densify_until, schedule.reset_every) == (100, 15_000, 3_000)
    assert [schedule.degree_at(iteration) for iteration in (999, 1000, 3000, 29_999)] == [0, 1, 3, 3]
    assert schedule.means_rate(0) == pytest.approx(1.6e-4)
    assert schedule.means_rate(29_999) == pytest.approx(1.6e-6)


def test_a_short_run_keeps_the_proportions():
    schedule = Schedule.of(VisualConfig(steps=1_000))
    assert schedule.double_at == (50, 100)
    assert (schedule.densify_from, schedule.densify_every, schedule.densify_until) == (100, 20, 500)
    assert (schedule.haste, Schedule.of(VisualConfig()).haste) == (4.0, 1.0)
    assert not any(schedule.resets_after(iteration) for iteration in range(1_000))


def test_random_gaussians_are_where_two_cameras_look():
    cameras = ring(6)
    low, high = camera_box(cameras)
    start = random_start(cameras, 500, low, high, degree=0, seed=0)
    assert 400 <= len(start) <= 500
    assert int(views_of(start.means, cameras).min()) >= 2
    assert low[0] < -3 < 3 < high[0]


def test_swept_points_lie_on_the_wall_that_was_photographed():
    grid = pinhole_grid(112, 84, 60)
    cameras = [Camera.of(Pose.look_at((0.0, 0.5 * side, 0.2 * side), (4.0, 0.0, 0.0)), grid) for side in (-2, -1, 1, 2)]
    waves = 9 * torch.randn(24, 2, generator=torch.Generator().manual_seed(1))
    pictures = []
    for camera in cameras:
        along = camera.pose.to_world(grid.directions)
        wall = camera.position + along * ((4.0 - camera.position[0]) / along[..., :1])
        shade = (0.5 + 0.08 * torch.sin(wall[..., 1:] @ waves.mT).sum(-1)).clamp(0, 1)
        pictures.append((shade[..., None].expand(-1, -1, 3) * 255).to(torch.uint8))
    found = Surfaces.of(*swept_surfaces(cameras, pictures, 10.0, torch.Generator().manual_seed(0)))
    assert len(found.points) == len(found.colours) > 1000
    assert float((found.points[:, 0] - 4.0).abs().quantile(0.9)) < 0.1
    assert float(found.normals[:, 0].abs().median()) > 0.95
    assert len(found.thinned(500, torch.Generator().manual_seed(0)).points) == 500


def test_a_depth_counts_where_other_photographs_see_it_and_not_past_it():
    views = []
    for side in (-0.5, 0.0, 0.5):
        camera = Camera.of(Pose.look_at((0.0, side, 0.0), (4.0, side, 0.0)), pinhole_grid(40, 30, 60))
        view = View(camera, torch.zeros(30, 40, 3))
        view.depth = torch.full((30, 40), 4.0)  # of the wall at x = 4
        views.append(view)
    everywhere = torch.ones(30, 40, dtype=torch.bool)
    middle = views[1]
    middle.depth[:15] = 2.0
    others = [(views[0], everywhere), (views[2], everywhere)]
    held = upheld(middle, everywhere, others)
    inner = torch.zeros_like(everywhere)
    inner[:, 6:34] = True  # what both others have in their pictures, too
    assert not bool(held[:15].any())
    assert bool(held[15:][inner[15:]].all())
    assert not bool(upheld(middle, everywhere, [(view, ~everywhere) for view, _ in others]).any())
    assert not bool(upheld(middle, ~everywhere, others).any())


def test_large_planes_are_found_among_scattered_points():
    generator = torch.Generator().manual_seed(0)
    floor, wall = torch.rand(2, 1500, 3, generator=generator) * 6
    floor[:, 2] = 0.02 * torch.randn(1500, generator=generator)
    wall[:, 0] = 5 + 0.02 * torch.randn(1500, generator=generator)
    scattered = torch.rand(500, 3, generator=generator) * 6
    planes = find_planes(torch.cat((floor, wall, scattered)), 0.05, 2, generator)
    normals = planes.normals * planes.normals.sum(-1, keepdim=True).sign()
    order = normals[:, 2].argsort(descending=True)
    assert torch.allclose(normals[order], torch.tensor([[0.0, 0, 1], [1, 0, 0]]), atol=0.02)
    assert torch.allclose(planes.offsets.abs()[order], torch.tensor([0.0, 5.0]), atol=0.05)


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_main_directions_are_those_of_a_turned_room(seed):
    generator = torch.Generator().manual_seed(seed)
    turn = torch.linalg.qr(torch.randn(3, 3, generator=generator)).Q
    points = torch.rand(8000, 3, generator=generator) * torch.tensor([9.0, 7.0, 3.0])
    wall = torch.randint(5, (8000,), generator=generator)  # the fifth are scattered
    for number, (axis, height) in enumerate(((0, 0.0), (1, 0.0), (1, 7.0), (2, 0.0))):
        points[wall == number, axis] = height
    points = (points + 0.1 * torch.randn(points.shape, generator=generator)) @ turn
    found = main_directions(points, 0.1, generator)
    assert torch.allclose(found @ found.mT, torch.eye(3), atol=1e-5)
    assert float((found @ turn.mT).abs().amax(-1).min()) > math.cos(math.radians(0.5))
    assert torch.equal(main_directions(points[:30], 0.1, generator), torch.zeros(0, 3))


def test_flattened_gaussians_turn_their_shortest_axis_to_the_normal():
    directions = torch.nn.functional.normalize(torch.randn(50, 3, generator=torch.Generator().manual_seed(0)), dim=-1)
    axes = matrix_from_quaternion(upright(directions))[:, :, 2]
    assert torch.allclose((axes * directions).sum(-1).abs(), torch.ones(50), atol=1e-5)


def test_needles_are_shortened_and_discs_stay():
    scales = torch.tensor([[0.9, 0.02, 0.01], [0.2, 0.2, 0.01]])
    clamp_needles(logs := scales.log(), 0.5)
    assert torch.allclose(logs.exp(), torch.tensor([[0.06, 0.02, 0.01], [0.2, 0.2, 0.01]]))


def test_the_drawn_depth_is_compared_where_the_sweep_knows_it():
    known = torch.tensor([[2.0, 0.0], [4.0, 4.0]])
    drawn = known.repeat_interleave(2, 0).repeat_interleave(2, 1)
    assert float(depth_error(drawn, known)) == 0.0
    drawn[0, 0], drawn[0, 3] = 3.0, 9.0
    assert float(depth_error(drawn, known)) == pytest.approx(0.5 / 16)


def test_points_are_a_place_to_begin(photos):
    points = torch.rand(40, 3, generator=torch.Generator().manual_seed(0)) * 2 - 1
    stage = VisualStage(photos, SMALL, points)
    assert torch.equal(stage.gaussians().means, points)


def test_no_photographs_are_refused():
    with pytest.raises(InputError, match="needs at least one photograph; got none"):
        fit_geometry([], SMALL)


def test_a_photograph_that_does_not_fit_its_camera_is_refused_by_name(photos):
    wrong = Photo("hall 7", photos[0].camera, pixels=torch.zeros(10, 32, 3))
    with pytest.raises(InputError, match=r"photo hall 7.*24, 32, 3.*got \[10, 32, 3\]"):
        fit_geometry([photos[1], wrong], SMALL)


def test_a_photograph_with_nan_is_refused_by_name(photos):
    pixels = photos[0].load().clone()
    pixels[3, 4, 1] = float("nan")
    with pytest.raises(InputError, match="photo dark 1 or its camera has NaN"):
        fit_geometry([Photo("dark 1", photos[0].camera, pixels=pixels)], SMALL)


def test_counts_that_make_no_sense_are_refused(photos):
    with pytest.raises(InputError, match="steps, start_count and max_count must be at least 1; got 0"):
        fit_geometry(photos, dataclasses.replace(SMALL, steps=0))
