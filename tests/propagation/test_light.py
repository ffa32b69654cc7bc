"""Our path tracer against Mitsuba's integrator, and what it promises by itself."""

import math
from dataclasses import replace

import numpy as np
import pytest

from rf3dgs.core.frames import Pose
from rf3dgs.core.grids import Camera, pinhole_grid
from rf3dgs.propagation.config import PhotoConfig
from rf3dgs.propagation.light import Light, is_matte
from rf3dgs.propagation.light_tables import light_tables
from rf3dgs.propagation.llvm import mitsuba_variant
from rf3dgs.propagation.photographer import render_by_mitsuba
from rf3dgs.propagation.scene_files import linear_from_srgb, write_visual_scene

REPEATS = 8


@pytest.fixture(scope="module")
def compiled(tracer):
    """Mitsuba, computing with the variant that Light needs."""
    import mitsuba

    from rf3dgs.propagation.llvm import prepare

    prepare()
    with mitsuba_variant("llvm_ad_rgb"):
        yield mitsuba


@pytest.fixture(scope="module")
def camera(site):
    return Camera.of(Pose.look_at((4.0, 6.0, 1.5), (10.0, 9.0, 2.0)), pinhole_grid(24, 16, 90.0))


@pytest.fixture(scope="module")
def lobby_light(compiled, site):
    return Light(site)


def blocks(pictures):
    """Mean and its standard error of each of 4 x 6 blocks `[block, 3]` over the pictures `[repeat, 16, 24, 3]`."""
    mean = np.stack(pictures).reshape(REPEATS, 4, 4, 6, 4, 3).mean((2, 4)).reshape(REPEATS, -1, 3)
    return mean.mean(0), mean.std(0, ddof=1) / math.sqrt(REPEATS)


def differences(compiled, scene, camera, bounces, folder, light=None):
    """z of each block and channel: ours against Mitsuba's."""
    loaded = compiled.load_file(str(write_visual_scene(scene, folder)), optimize=False)
    config = PhotoConfig(samples=64, bounces=bounces)
    light = Light(scene) if light is None else light
    ours = blocks([light.picture(camera, 64, bounces, seed) for seed in range(REPEATS)])
    theirs = blocks([render_by_mitsuba(compiled, loaded, camera, config, 100 + seed) for seed in range(REPEATS)])
    # Blocks without noise (an even lamp fills them) still differ by the digits with which the scene file is written.
    return (ours[0] - theirs[0]) / np.hypot(np.hypot(ours[1], theirs[1]), 1e-4 * theirs[0] + 1e-7)


def assert_no_more_than_chance(z):
    """72 values of Student's t with some fourteen degrees of freedom: above 5 once in a hundred thousand."""
    assert z.size == 72
    assert np.abs(z).max() < 5.5
    assert z.std() < 1.6
    assert abs(z.mean()) < 0.6


@pytest.mark.parametrize("bounces", [1, 2, 3, 6])
def test_the_expected_picture_is_that_of_mitsubas_integrator(compiled, site, camera, lobby_light, bounces, tmp_path):
    z = differences(compiled, site, camera, bounces, tmp_path, lobby_light)
    if bounces == 1:
        assert np.abs(z).max() < 5.5  # most of it is dark
    else:
        assert_no_more_than_chance(z)


@pytest.mark.parametrize("sky", [0.0, 0.8])
def test_a_lamp_and_an_open_sky_shine_as_in_mitsuba(compiled, site, camera, sky, tmp_path):
    objects = tuple(replace(item, glow=0.0) for item in site.objects if item.name not in ("ceiling", "wall-east"))
    assert_no_more_than_chance(differences(compiled, replace(site, objects=objects, sky=sky), camera, 4, tmp_path))


def test_the_same_seed_gives_the_same_light_on_one_thread_and_on_two(compiled, camera, lobby_light):
    import drjit as dr

    before, pictures = dr.thread_count(), []
    try:
        for threads in (1, 2):
            dr.set_thread_count(threads)
            pictures.append(lobby_light.picture(camera, 3, 4, 7))
    finally:
        dr.set_thread_count(before)
    assert np.array_equal(pictures[0], pictures[1])
    assert not np.array_equal(pictures[0], lobby_light.picture(camera, 3, 4, 8))


@pytest.mark.parametrize("seed", [0, 1, 12345])
def test_sixteen_points_are_in_boxes_of_their_own(compiled, seed):
    """Every box of 1/16 whose sides are powers of two holds one of the first 16 points: a (0, 4, 2)-net."""
    from rf3dgs.propagation.light_points import hashed, point

    number = compiled.UInt32(np.arange(16, dtype=np.uint32))
    across, down = (np.array(value) for value in point(number, hashed(compiled.UInt32(seed))))
    for power in range(5):
        wide = 2**power
        boxes = set(zip((across * wide).astype(int), (down * (16 // wide)).astype(int), strict=True))
        assert len(boxes) == 16
        assert 0 <= min(across.min(), down.min()) <= max(across.max(), down.max()) < 1


def test_every_light_is_picked_as_often_as_it_is_bright_and_none_never(site):
    tables = light_tables(site)
    lights = [item for item in site.objects if item.glow > 0]
    assert (tables.chance > 0).sum() == sum(len(item.faces) for item in lights)
    assert tables.chance.sum() == pytest.approx(1.0, abs=1e-5)
    power = tables.mean * tables.triangles[:, 12]
    assert np.abs(tables.chance - power / power.sum()).max() < 2 / len(tables.picks) + 0.01
    owner = np.concatenate([np.full(len(item.faces), place) for place, item in enumerate(site.objects)])
    lamp = next(place for place, item in enumerate(site.objects) if item.name == "light-1")
    expected = 20.0 * linear_from_srgb(site["light-1"].texture.reshape(-1, 3).mean(0) / 255).mean()
    assert tables.mean[owner == lamp] == pytest.approx(expected, rel=1e-4)


def test_transparent_things_are_left_to_mitsuba(site):
    assert is_matte(site)
    assert not is_matte(replace(site, objects=(replace(site["floor"], transparency=0.5),)))
