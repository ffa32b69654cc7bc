"""Laws of the second look: what photographs show and the Gaussians lack is found, and nothing else is."""

import dataclasses

import pytest
import torch
from tests.geometry.test_search import plain_wall

from rf3dgs.core.frames import Pose
from rf3dgs.core.grids import Camera, pinhole_grid
from rf3dgs.data.photo import Photo
from rf3dgs.geometry.planes import Planes
from rf3dgs.splats.gaussians import Gaussians
from rf3dgs.splats.harmonics import C0
from rf3dgs.splats.surface import sample_mesh
from rf3dgs.training.config import VisualConfig
from rf3dgs.training.flat import Flats
from rf3dgs.training.photographs import render_photo
from rf3dgs.training.schedule import RESERVE, Schedule
from rf3dgs.training.second_look import ACROSS, missing_surfaces
from rf3dgs.training.visual import VisualStage

SIGN = torch.tensor([[2.6, 1.5, 0.6], [3.4, 1.5, 1.9]])  # lowest and highest corner [m]
FAR = 8.0


def painted(bare: Gaussians, seed: int) -> Gaussians:
    """The Gaussians in patches of 20 cm, each of its own grey."""
    greys = torch.rand(64, 64, generator=torch.Generator().manual_seed(seed))
    patch = (bare.means[:, [0, 2]] / 0.2).long() % 64
    sh = torch.zeros(len(bare), 1, 3)
    sh[:, 0] = ((greys[patch[:, 0], patch[:, 1]] - 0.5) / C0)[:, None]
    return dataclasses.replace(bare, sh=sh)


def wall() -> Gaussians:
    return painted(plain_wall(0.0), seed=1)


def sign() -> Gaussians:
    """A board in front of the wall, 0.8 m wide."""
    (x, y, z), (right, _, top) = SIGN.tolist()
    corners = torch.tensor([[x, y, z], [right, y, z], [right, y, top], [x, y, top]])
    board = sample_mesh(corners, torch.tensor([[0, 2, 1], [0, 3, 2]]), spacing=0.03)
    return painted(board, seed=2)


def pictures_of(gaussians: Gaussians, cameras: list[Camera]) -> list[torch.Tensor]:
    return [(255 * render_photo(gaussians, camera)).to(torch.uint8) for camera in cameras]


@pytest.fixture(scope="module")
def scene() -> tuple[list[Camera], list[torch.Tensor], list[torch.Tensor]]:
    """Cameras, and what they see of the wall with the sign and of the wall alone."""
    grid = pinhole_grid(160, 110, fov_deg=70.0)
    places = [(0.4, 5.8), (1.6, 6.2), (2.6, 6.0), (3.8, 6.1), (4.9, 5.9), (5.6, 6.0)]
    cameras = [Camera.of(Pose.look_at((x, y, 1.6), (3.0, 0.0, 1.4)), grid) for x, y in places]
    both = Gaussians.join((wall(), sign()))
    return cameras, pictures_of(both, cameras), pictures_of(wall(), cameras)


def away(points: torch.Tensor) -> torch.Tensor:
    """How far `[point]` points are from the sign [m]."""
    outside = torch.maximum(SIGN[0] - points, points - SIGN[1]).clamp_min(0.0)
    return torch.linalg.vector_norm(outside, dim=-1)


def test_a_sign_that_the_gaussians_lack_is_found_where_it_stands(scene) -> None:
    cameras, pictures, _ = scene
    found = missing_surfaces(wall(), cameras, pictures, FAR)
    assert len(found.points) > 100
    assert float(away(found.points).quantile(0.8)) < 0.15  # a pixel is 6 cm wide there
    row, col = ((found.points - SIGN[0]) / (SIGN[1] - SIGN[0]))[:, [2, 0]].clamp(0, 0.999).mul(4).long().unbind(-1)
    assert len(torch.unique(4 * row + col)) >= 12  # of 16 parts of the sign


def test_what_is_drawn_as_it_is_photographed_is_left_alone(scene) -> None:
    cameras, with_sign, without = scene
    assert len(missing_surfaces(wall(), cameras, without, FAR).points) == 0
    assert len(missing_surfaces(Gaussians.join((wall(), sign())), cameras, with_sign, FAR).points) == 0


def test_what_one_photograph_alone_shows_is_not_found(scene) -> None:
    cameras, with_sign, without = scene
    pictures = [with_sign[2] if number == 2 else picture for number, picture in enumerate(without)]
    assert len(missing_surfaces(wall(), cameras, pictures, FAR).points) == 0


def test_one_photograph_has_no_depth(scene) -> None:
    cameras, pictures, _ = scene
    assert len(missing_surfaces(wall(), cameras[:1], pictures[:1], FAR).points) == 0


def test_large_photographs_are_looked_at_in_copies(scene) -> None:
    large = [camera.resized(6 * camera.width, 6 * camera.height) for camera in scene[0]]
    assert large[0].width > 1.5 * ACROSS
    both = Gaussians.join((wall(), sign()))
    found = missing_surfaces(wall(), large, pictures_of(both, large), FAR)
    assert len(found.points) > 100
    assert float(away(found.points).quantile(0.8)) < 0.15


CONFIG = VisualConfig(steps=20, max_count=20_000, degree=0, ssim_weight=0.0, background="black", walls="free")


def near_sign(gaussians: Gaussians) -> int:
    return int((away(gaussians.means) < 0.1).sum())


@pytest.mark.parametrize("look_again", [True, False])
def test_training_looks_again_once(scene, look_again: bool) -> None:
    cameras, pictures, _ = scene
    photos = [
        Photo(str(i), camera, pixels=p.float() / 255)
        for i, (camera, p) in enumerate(zip(cameras, pictures, strict=True))
    ]
    config = dataclasses.replace(CONFIG, look_again=look_again)
    schedule = Schedule.of(config)
    looks = [step for step in range(config.steps) if schedule.looks_again_after(step)]
    assert looks == ([3] if look_again else [])
    stage = VisualStage(photos, config, wall())
    for step in range(3):
        stage.step(step)
    before = near_sign(stage.gaussians())
    plane = Planes(torch.tensor([[0.0, 1.0, 0.0]]), torch.zeros(1))
    stage.flats = Flats(plane, torch.zeros(len(stage.gaussians()), dtype=torch.long))
    stage.step(3)
    assert (near_sign(stage.gaussians()) > before + 30) == look_again
    assert stage.flats is not None
    assert len(stage.flats.plane_of) == len(stage.gaussians())
    assert bool((stage.flats.plane_of < 0).any()) == look_again


def test_growth_leaves_room_for_the_second_look(scene) -> None:
    config = VisualConfig(steps=1000, max_count=5000)
    schedule = Schedule.of(config)
    assert schedule.reserve_at(0) == 5000 // RESERVE
    assert schedule.reserve_at(schedule.look_again_at or 0) == 0
    assert Schedule.of(dataclasses.replace(config, look_again=False)).reserve_at(0) == 0
    cameras, pictures, _ = scene
    photos = [Photo(str(i), c, pixels=p.float() / 255) for i, (c, p) in enumerate(zip(cameras, pictures, strict=True))]
    start = wall()
    stage = VisualStage(photos, dataclasses.replace(CONFIG, max_count=len(start) + 40), start)
    for step in range(4):
        stage.step(step)
    assert len(start) < len(stage.gaussians()) <= len(start) + 40
