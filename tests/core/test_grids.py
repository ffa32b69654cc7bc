"""Laws of direction grids and views."""

import math

import pytest
import torch

from rf3dgs.core.angles import angle_between, direction_of
from rf3dgs.core.errors import InputError
from rf3dgs.core.frames import Pose
from rf3dgs.core.grids import (
    Camera,
    Panorama,
    equirect_grid,
    list_grid,
    pinhole_grid,
    sample_grid,
    view_of,
)

LEFT = torch.tensor([0.0, 1.0, 0.0])
UP = torch.tensor([0.0, 0.0, 1.0])


@pytest.mark.parametrize("grid", [pinhole_grid(60, 40, 90), equirect_grid(72, 36)])
def test_left_is_column_zero_and_up_is_row_zero(grid) -> None:
    assert bool(((grid.directions @ LEFT)[:, 0] > (grid.directions @ LEFT)[:, grid.width // 2]).all())
    if grid.kind == "equirect":
        front = grid.directions[grid.height // 2, grid.width // 4 : 3 * grid.width // 4] @ LEFT
        assert bool((front[:-1] > front[1:]).all())
    assert bool(((grid.directions @ UP)[0] > (grid.directions @ UP)[-1]).all())


def test_the_sphere_has_four_pi_and_a_cube_face_a_sixth_of_it() -> None:
    assert float(equirect_grid(180, 90).solid_angle.sum()) == pytest.approx(4 * math.pi, rel=1e-5)
    assert float(pinhole_grid(32, 32, 90).solid_angle.sum()) == pytest.approx(4 * math.pi / 6, rel=1e-5)


@pytest.mark.parametrize("grid", [pinhole_grid(30, 20, 90), equirect_grid(24, 12)])
def test_pixel_of_a_pixel_direction_is_its_centre(grid) -> None:
    pixel, inside = grid.pixel_of(grid.directions)
    row, col = torch.meshgrid(torch.arange(grid.height), torch.arange(grid.width), indexing="ij")
    torch.testing.assert_close(pixel, torch.stack((col, row), -1) + 0.5, atol=1e-3, rtol=0)
    assert bool(inside.all())


def test_what_is_behind_a_pinhole_is_outside() -> None:
    _, inside = pinhole_grid(30, 20, 90).pixel_of(torch.tensor([[-1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0]]))
    assert inside.tolist() == [False, False, True]


def test_a_camera_projects_a_point_where_its_grid_looks() -> None:
    pose = Pose.look_at((1.0, 2.0, 1.5), (5.0, 4.0, 1.0))
    camera = Camera.of(pose, pinhole_grid(64, 48, 80))
    point = pose.position + 3.0 * pose.to_world(camera.grid.directions[10, 20])
    seen = camera.viewmat[:3, :3] @ point + camera.viewmat[:3, 3]
    pixel = camera.K @ (seen / seen[2])
    torch.testing.assert_close(pixel[:2], torch.tensor([20.5, 10.5]), atol=1e-3, rtol=0)
    torch.testing.assert_close(camera.position, pose.position, atol=1e-5, rtol=0)
    torch.testing.assert_close(camera.resized(32, 24).K[0, 0], camera.K[0, 0] / 2)


def test_a_panorama_is_the_sphere_of_its_pose_and_grid() -> None:
    pose = Pose.look_at((1.0, 2.0, 1.5), (5.0, 4.0, 1.0))
    view = Panorama.of(pose, equirect_grid(24, 12))
    torch.testing.assert_close(view.position, pose.position, atol=1e-5, rtol=0)
    torch.testing.assert_close(view.pose.to_world(LEFT), pose.to_world(LEFT), atol=1e-5, rtol=0)
    assert view.grid.same_as(equirect_grid(24, 12))
    assert (view.resized(10, 5).width, view.resized(10, 5).height) == (10, 5)
    assert torch.equal(view.resized(10, 5).viewmat, view.viewmat)


def test_a_grid_decides_which_view_it_makes() -> None:
    pose = Pose((0.0, 0.0, 0.0))
    assert isinstance(view_of(pose, pinhole_grid(8, 6, 90)), Camera)
    assert isinstance(view_of(pose, equirect_grid(8, 4)), Panorama)
    with pytest.raises(InputError, match="a view needs a pinhole or equirectangular grid; got a list of directions"):
        view_of(pose, list_grid(torch.eye(3)))


@pytest.mark.parametrize("width", [16, 17])
def test_sampling_over_the_poles_meets_the_other_side_of_odd_and_even_widths(width: int) -> None:
    grid = equirect_grid(width, 9)
    picture = 1.0 + grid.directions[..., :1].double()
    azimuth = torch.linspace(-3.0, 3.0, 50, dtype=torch.float64)
    for zenith in (0.02, 0.12, math.pi - 0.05):
        directions = direction_of(torch.full_like(azimuth, zenith), azimuth)
        found = sample_grid(picture, grid, directions)[:, 0]
        torch.testing.assert_close(found, 1 + directions[:, 0], atol=6e-3, rtol=0)


def test_sampling_wraps_at_the_seam_and_over_the_poles() -> None:
    grid = equirect_grid(64, 32)
    sampled = sample_grid(
        grid.directions, grid, torch.tensor([[-1.0, 1e-4, 0.0], [-1.0, -1e-4, 0.0], [0.0, 1e-4, 1.0]])
    )
    torch.testing.assert_close(sampled[0], sampled[1], atol=1e-3, rtol=0)
    assert float(sampled[2] @ UP) > 0.99


def test_bad_grids_are_refused() -> None:
    with pytest.raises(InputError, match="fov_deg must lie between 0 and 180 degrees; got 200"):
        pinhole_grid(10, 10, 200)
    with pytest.raises(InputError, match="at least one pixel each way; got 0x5"):
        equirect_grid(0, 5)
    with pytest.raises(InputError, match="needs either fov_deg or K"):
        pinhole_grid(10, 10)
    with pytest.raises(InputError, match=r"a camera needs a pinhole grid; got equirect\. view_of makes"):
        Camera.of(Pose((0.0, 0.0, 0.0)), equirect_grid(8, 4))
    with pytest.raises(InputError, match="a panorama needs an equirectangular grid; got pinhole"):
        Panorama.of(Pose((0.0, 0.0, 0.0)), pinhole_grid(8, 4, 90))
    with pytest.raises(InputError, match=r"a view stands at one pose; got \[2\]"):
        Camera.of(Pose(torch.zeros(2, 3)), pinhole_grid(4, 4, 90))
    for K in (
        torch.eye(2),
        torch.diag(torch.tensor([float("nan"), 9.0, 1.0])),
        torch.diag(torch.tensor([9.0, 0.0, 1.0])),
    ):
        with pytest.raises(InputError, match=r"K must be \[3, 3\], finite, with positive focal lengths"):
            pinhole_grid(8, 6, K=K)
    with pytest.raises(InputError, match=r"solid_angle must be \[2\], one per direction \[sr\]; got \[3\]"):
        list_grid(torch.eye(3)[:2], torch.ones(3))
    with pytest.raises(InputError, match=r"directions must be \[direction, 3\]"):
        list_grid(torch.zeros(3))


@pytest.mark.parametrize("grid", [equirect_grid(50, 25), pinhole_grid(31, 40, 100.0)])
def test_blocks_hold_every_pixel_once_and_find_those_near(grid):
    blocks = grid.blocks
    real = blocks.pixels >= 0
    assert blocks.pixels[real].sort().values.tolist() == list(range(grid.height * grid.width))
    assert torch.equal(blocks.directions.mT[real], grid.directions.reshape(-1, 3)[blocks.pixels[real]])
    asked = torch.nn.functional.normalize(torch.randn(40, 3, generator=torch.Generator().manual_seed(2)), dim=-1)
    block, row = blocks.near(asked, 0.2)
    found = {(place, who) for at, who in zip(block, row.tolist(), strict=True) for place in blocks.pixels[at].tolist()}
    angle = angle_between(*torch.broadcast_tensors(grid.directions.reshape(-1, 1, 3), asked))
    assert {(int(place), int(who)) for place, who in torch.nonzero(angle <= 0.2)} <= found


@pytest.mark.parametrize("grid", [equirect_grid(30, 15), pinhole_grid(30, 20, 90.0), list_grid(torch.eye(3)[:1])])
def test_a_cone_holds_every_direction_and_is_no_wider(grid) -> None:
    middle, radius = grid.cone
    farthest = float((grid.directions @ middle).amin().clamp(-1.0, 1.0).arccos())
    if grid.kind == "equirect":
        assert radius == math.pi
    else:
        assert farthest == pytest.approx(radius, abs=1e-3)  # an arccos near 1 in float32


@pytest.mark.parametrize("grid", [pinhole_grid(30, 20, 90.0), list_grid(torch.eye(3))])
def test_a_pixel_that_does_not_exist_is_near_nothing(grid) -> None:
    missing = grid.blocks.directions.mT[grid.blocks.pixels < 0]
    assert len(missing)
    assert float(torch.linalg.vector_norm(missing, dim=-1).min()) > 3.0  # a chord of the sphere is 2 at most
