from dataclasses import replace

import numpy as np
import pytest
import torch

from rf3dgs.core.errors import InputError
from rf3dgs.core.frames import Pose
from rf3dgs.core.grids import Camera, equirect_grid, pinhole_grid
from rf3dgs.propagation.config import PhotoConfig
from rf3dgs.propagation.photographer import camera_tour, render_panorama, render_panoramas, render_photos
from rf3dgs.propagation.sites import shapes
from rf3dgs.propagation.sites.scene import SceneObject

QUICK = PhotoConfig(width=80, height=60, samples=8, bounces=3)


def glowing(name, low, high, colour):
    vertices, faces, _ = shapes.box(low, high)
    return SceneObject(name, vertices, faces, "metal", 0.5, colour=colour, glow=1.0)


@pytest.fixture(scope="module")
def marked(site, tracer):
    """A dark room with a red marker ahead to the left, a green one ahead to the right and a blue one above."""
    floor = replace(site["floor"], texture=None, colour=(0.05, 0.05, 0.05))
    markers = (
        glowing("red", (9.8, 8.8, 1.3), (10.2, 9.2, 1.7), (1.0, 0.0, 0.0)),
        glowing("green", (9.8, 5.8, 1.3), (10.2, 6.2, 1.7), (0.0, 1.0, 0.0)),
        glowing("blue", (9.8, 7.3, 2.6), (10.2, 7.7, 3.0), (0.0, 0.0, 1.0)),
    )
    return replace(site, objects=(floor, *markers))


@pytest.mark.parametrize("off_centre", [False, True])
def test_a_photograph_shows_things_where_its_camera_says(marked, off_centre):
    pose = Pose.look_at((5.0, 7.2, 1.4), (10.0, 7.6, 1.7))
    grid = pinhole_grid(80, 60, 80.0)
    if off_centre:
        K = grid.K + torch.tensor([[0.0, 0.0, 9.0], [0.0, 0.0, -6.0], [0.0, 0.0, 0.0]])
        grid = pinhole_grid(80, 60, K=K)
    camera = Camera.of(pose, grid)
    (photo,) = render_photos(marked, [camera], QUICK)
    assert photo.shape == (60, 80, 3)
    assert photo.dtype == np.uint8
    for channel, centre in enumerate(((10.0, 9.0, 1.5), (10.0, 6.0, 1.5), (10.0, 7.5, 2.8))):
        own = photo[..., channel].astype(int)
        rest = np.delete(photo, channel, axis=2).max(-1)
        rows, cols = np.nonzero((own > 150) & (rest < 80))
        direction = (torch.tensor(centre) - pose.position) @ pose.world_from_device
        pixel, inside = camera.grid.pixel_of(direction)
        assert bool(inside)
        assert (cols.mean() + 0.5, rows.mean() + 0.5) == pytest.approx(tuple(pixel.tolist()), abs=1.2)


def test_left_is_left_and_up_is_up(marked):
    camera = Camera.of(Pose.look_at((5.0, 7.5, 1.4), (10.0, 7.5, 1.4)), pinhole_grid(80, 60, 80.0))
    (photo,) = render_photos(marked, [camera], QUICK)
    red, green, blue = (np.argwhere(photo[..., channel] > 150).mean(0) for channel in range(3))
    assert red[1] < 40 < green[1]
    assert blue[0] < red[0]


@pytest.mark.parametrize("yaw", [0.0, 2.0])
def test_a_panorama_overlays_a_spectrum_of_the_same_pose(marked, yaw):
    pose = Pose.from_yaw((5.0, 7.2, 1.4), yaw)
    photo = render_panorama(marked, pose, 180, QUICK)
    assert photo.shape == (90, 180, 3)
    assert photo.dtype == np.uint8
    grid = equirect_grid(180, 90)
    for channel, centre in enumerate(((10.0, 9.0, 1.5), (10.0, 6.0, 1.5), (10.0, 7.5, 2.8))):
        own = photo[..., channel].astype(int)
        rest = np.delete(photo, channel, axis=2).max(-1)
        lamp = torch.from_numpy((own > 150) & (rest < 80))
        mean = torch.nn.functional.normalize(grid.directions[lamp].mean(0), dim=-1)
        towards = pose.to_device(torch.tensor(centre) - pose.position)
        angle = torch.rad2deg(torch.acos((mean * towards).sum() / towards.norm()))
        assert float(angle) < 1.5  # pixels are 2 degrees wide


def test_panoramas_follow_each_other_with_seeds_of_their_own(marked):
    poses = Pose([[5.0, 7.2, 1.4], [6.0, 7.2, 1.4]])
    both = list(render_panoramas(marked, poses, 32, QUICK))
    assert np.array_equal(both[0], render_panorama(marked, poses[0], 32, QUICK))
    assert not np.array_equal(both[0], both[1])


def test_panoramas_need_an_even_width_and_one_pose(site):
    with pytest.raises(InputError, match="even width of at least 8 pixels"):
        render_panorama(site, Pose((5.0, 7.0, 1.5)), 33)
    with pytest.raises(InputError, match="a panorama stands at one pose"):
        render_panorama(site, Pose([[5.0, 7.0, 1.5]]), 32)


def test_light_passes_a_glass_partition(tracer, marked):
    vertices, faces, _ = shapes.quad((8.0, 4.0, 3.4), (0.0, 7.0, 0.0), (0.0, 0.0, -3.4))
    pane = SceneObject("pane", vertices, faces, "glass", 0.1, colour=(0.05, 0.05, 0.05))
    camera = Camera.of(Pose.look_at((5.0, 7.5, 1.4), (10.0, 7.5, 1.4)), pinhole_grid(80, 60, 80.0))
    red = {}
    for transparency in (0.0, 0.9):
        scene = replace(marked, objects=(*marked.objects, replace(pane, transparency=transparency)))
        (photo,) = render_photos(scene, [camera], QUICK)
        red[transparency] = int((photo[..., 0] > 120).sum())
    assert red[0.0] == 0
    assert red[0.9] > 10


def test_the_lobby_is_well_exposed_and_the_same_on_every_run(site, tracer):
    cameras = camera_tour(site, 3, seed=5, config=QUICK)[:2]
    photos = list(render_photos(site, cameras, QUICK))
    for photo in photos:
        assert 60 < photo.mean() < 200
        assert photo.std() > 20
        assert (photo == 255).all(-1).mean() < 0.2
    (again,) = render_photos(site, cameras[:1], QUICK)
    assert np.array_equal(photos[0], again)


def test_a_room_without_lights_gets_a_lamp(tracer):
    from rf3dgs.propagation.sites.scenes import scene_of

    box = scene_of("box")
    (photo,) = render_photos(box, camera_tour(box, 1, seed=0, config=QUICK), QUICK)
    assert photo.mean() > 20


def test_tracing_works_after_photographing_and_the_other_way_round(site, tracer, marked):
    from rf3dgs.propagation.config import TraceConfig

    rx = site.receivers(1, seed=1)
    config = TraceConfig(rays=5_000, depth=1)
    camera = Camera.of(Pose.look_at((5.0, 7.2, 1.4), (10.0, 7.6, 1.7)), pinhole_grid(32, 24, 80.0))
    (before,) = tracer.trace_each(site, None, rx, config)
    photos = render_photos(marked, [camera, camera], QUICK)
    next(photos)
    (between,) = tracer.trace_each(site, None, rx, config)
    next(photos)
    (after,) = tracer.trace_each(site, None, rx, config)
    assert torch.equal(before.coeff, between.coeff)
    assert torch.equal(before.coeff, after.coeff)


def test_the_tour_stands_in_free_space_and_repeats(site):
    cameras = camera_tour(site, 60, seed=0)
    positions = torch.stack([camera.position for camera in cameras])
    low, high = torch.tensor(site.camera_bounds)
    assert bool(site.free(positions, 0.4).all())
    assert bool(((positions > low) & (positions < high)).all())
    again = camera_tour(site, 60, seed=0)
    assert all(torch.equal(a.viewmat, b.viewmat) for a, b in zip(cameras, again, strict=True))


def test_neighbours_of_the_tour_see_nearly_the_same_from_a_step_apart(site):
    cameras = camera_tour(site, 60, seed=0)
    positions = torch.stack([camera.position for camera in cameras])
    forward = torch.stack([camera.pose.world_from_device[:, 0] for camera in cameras])
    step = (positions - positions.roll(1, 0)).norm(dim=-1)
    turn = torch.rad2deg(torch.acos((forward * forward.roll(1, 0)).sum(-1)))
    assert 0.4 < float(step.min()) <= float(step.median()) < 0.8
    assert float(step.max()) < 1.5
    assert float(turn.max()) < 20


def test_the_tour_sees_each_square_metre_of_floor_ceiling_and_walls_from_several_places(site):
    cameras = camera_tour(site, 60, seed=0)
    low, high = torch.tensor(site.bounds)
    counts: dict[tuple[int, ...], int] = {}
    for camera in cameras:
        along = camera.resized(80, 60).pose.to_world(camera.resized(80, 60).grid.directions).reshape(-1, 3)
        ways = torch.where(along > 0, high - camera.position, low - camera.position) / along
        reach, axis = ways.min(-1)
        cell = (camera.position + reach[:, None] * along).floor().int()
        cell[torch.arange(len(axis)), axis] = torch.where(along.gather(1, axis[:, None])[:, 0] > 0, 99, -99).int()
        for seen in torch.unique(cell, dim=0).tolist():
            counts[tuple(seen)] = counts.get(tuple(seen), 0) + 1
    assert len(counts) > 2 * 14 * 15 + 2 * (14 + 15) * 3
    assert sum(count >= 5 for count in counts.values()) > 0.9 * len(counts)


def test_a_tour_goes_round_what_stands_in_the_middle():
    from rf3dgs.propagation.sites.scenes import scene_of

    street = scene_of("simple_street_canyon")
    positions = torch.stack([camera.position for camera in camera_tour(street, 12, seed=0)])
    assert bool(street.free(positions, 0.4).all())


def test_a_photograph_needs_light_paths(site):
    with pytest.raises(InputError, match="samples and bounces must be at least 1; got 0 and 6"):
        next(render_photos(site, [], PhotoConfig(samples=0)))
