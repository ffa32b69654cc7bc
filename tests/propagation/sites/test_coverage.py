from dataclasses import replace

import pytest
import torch

from rf3dgs.core.errors import InputError
from rf3dgs.core.frames import Pose
from rf3dgs.core.grids import Camera, pinhole_grid
from rf3dgs.propagation.config import PhotoConfig
from rf3dgs.propagation.sites import shapes
from rf3dgs.propagation.sites.coverage import coverage
from rf3dgs.propagation.sites.scene import Scene, SceneObject
from rf3dgs.propagation.sites.walks import camera_tour

GRID = pinhole_grid(80, 80, 90.0)


def scene_with(*meshes):
    bounds = ((-10.0, -10.0, -10.0), (10.0, 10.0, 10.0))
    objects = [SceneObject(f"part-{number}", *mesh[:2], "metal", 0.5) for number, mesh in enumerate(meshes)]
    return Scene("stage", tuple(objects), Pose((0.0, 0.0, 9.0)), bounds, bounds, bounds, 60e9)


FLOOR = shapes.quad((-4, 4, 0), (8, 0, 0), (0, -8, 0))
ABOVE = Camera.of(Pose.look_at((0.0, 0.0, 2.0), (0.0, 0.0, 0.0)), GRID)


def test_one_camera_covers_its_own_square_of_the_floor(tracer):
    # 90 degrees from 2 m above see 4 m x 4 m of 8 m x 8 m; its corners lie 54.7 degrees off the normal.
    found = coverage(scene_with(FLOOR), [ABOVE], views=1)
    assert found.share == pytest.approx(0.25, abs=0.015)  # 4 standard errors of 20,000 samples
    # Within 30 degrees: a disc of radius 2 tan 30.
    disc = torch.pi * (2 * 3**-0.5) ** 2 / 64
    assert coverage(scene_with(FLOOR), [ABOVE], views=1, angle_deg=30).share == pytest.approx(disc, abs=0.01)


def test_photographs_are_counted_and_must_be_near_and_unobstructed(tracer):
    scene = scene_with(FLOOR)
    assert coverage(scene, [ABOVE, ABOVE], views=3).share == 0.0
    assert coverage(scene, [ABOVE] * 3, views=3).share == pytest.approx(0.25, abs=0.015)
    assert coverage(scene, [ABOVE], views=1, distance=1.9).share == 0.0
    shade = shapes.quad((-1, 1, 1.0), (2, 0, 0), (0, -2, 0))
    assert coverage(scene_with(FLOOR, shade), [ABOVE], views=1).by_object["part-0"][1] < 0.01


def test_a_camera_behind_a_surface_does_not_see_it(tracer):
    below = Camera.of(Pose.look_at((0.0, 0.0, -2.0), (0.0, 0.0, 0.0)), GRID)
    assert coverage(scene_with(FLOOR), [below], views=1).share == 0.0


def test_what_stands_on_the_floor_hides_its_own_foot(tracer):
    found = coverage(scene_with(FLOOR, shapes.box((-1, -1, 0.01), (1, 1, 1))), [ABOVE], views=1)
    area, _ = found.by_object["part-0"]
    assert area == pytest.approx(64 - 4, abs=0.7)
    assert found.by_object["part-1"][0] == pytest.approx(4 + 8, abs=0.7)


def test_the_walk_for_coverage_sees_floor_and_ceiling(tracer, site):
    shares = {}
    for walk in ("level", "coverage"):
        cameras = camera_tour(site, 120, 0, PhotoConfig(walk=walk))
        assert len(cameras) == 120
        assert bool(site.free(torch.stack([camera.position for camera in cameras]), 0.4).all())
        found = coverage(site, cameras, samples=4000)
        shares[walk] = (found.share_of("floor"), found.share_of("ceiling"), found.share)
    assert all(new > old + 0.2 for old, new in zip(shares["level"], shares["coverage"], strict=True))


def test_few_photographs_and_unknown_walks(site):
    for count in (0, 1, 2, 5):
        assert len(camera_tour(site, count, 0, PhotoConfig(walk="coverage"))) == count
    with pytest.raises(InputError, match='the walk must be "level" or "coverage"; got \'spiral\''):
        camera_tour(site, 3, 0, replace(PhotoConfig(), walk="spiral"))  # pyright: ignore[reportArgumentType]


def test_impossible_coverage_is_refused(site):
    with pytest.raises(InputError, match=r"coverage needs views .* got 0, 20000, 60\.0 and 8\.0"):
        coverage(site, [], views=0)
