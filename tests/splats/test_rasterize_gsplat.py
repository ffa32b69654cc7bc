"""The gsplat adapter's call, against a stand-in for the module."""

from types import SimpleNamespace
from typing import Any, cast

import pytest
import torch

from rf3dgs.core.errors import InputError, MissingDependencyError
from rf3dgs.core.frames import CAMERA_FROM_DEVICE, Pose
from rf3dgs.core.grids import Camera, Panorama, equirect_grid, pinhole_grid
from rf3dgs.splats.backends.gsplat import load_gsplat, rasterize_gsplat


def view() -> Camera:
    return Camera.of(Pose.look_at(position=(-3.0, 0.0, 0.0), target=(0.0, 0.0, 0.0)), pinhole_grid(8, 6, 90.0))


def test_the_call_says_what_gsplat_expects():
    calls: list[dict[str, Any]] = []

    def rasterization(**options):
        calls.append(options)
        means2d = options["means"][None, :, :2] * 1.0
        picture = torch.zeros(1, 6, 8, 4) + means2d.sum() + options["colors"].sum()
        return picture, torch.ones(1, 6, 8, 1), {"radii": torch.full((1, 5, 2), 3), "means2d": means2d}

    means = torch.rand(5, 3, requires_grad=True)
    offset = torch.zeros(5, 2, requires_grad=True)
    values, background = torch.rand(5, 4), torch.rand(4)
    raster = rasterize_gsplat(
        means, torch.rand(5, 4), torch.rand(5, 3), torch.rand(5), values, view(), background=background,
        screen_offset=offset, module=cast(Any, SimpleNamespace(rasterization=rasterization)),
    )  # fmt: skip
    (call,) = calls
    assert call["colors"].shape == (1, 5, 4)
    assert torch.equal(call["viewmats"], view().viewmat[None])
    assert torch.equal(call["Ks"], view().K[None])
    assert (call["width"], call["height"]) == (8, 6)
    assert call["sh_degree"] is None
    assert call["packed"] is False
    assert (call["near_plane"], call["eps2d"]) == (0.05, 0.3)
    assert torch.equal(call["backgrounds"], background[None])
    assert raster.values.shape == (6, 8, 4)
    assert raster.weight.shape == (6, 8)
    assert raster.radii.tolist() == [3.0] * 5
    raster.values.sum().backward()
    assert offset.grad is not None
    assert torch.equal(offset.grad, torch.full((5, 2), 192.0))


def test_a_panorama_is_six_pictures_of_a_cube_that_agree_with_its_directions():
    """The stand-in paints the world direction that each pixel looks in, times a value."""

    def rasterization(**options):
        K, viewmat = options["Ks"][0], options["viewmats"][0]
        directions = pinhole_grid(options["width"], options["height"], K=K).directions @ CAMERA_FROM_DEVICE.mT
        picture = (directions @ viewmat[:3, :3])[None] * options["colors"][0, 0]
        weight = torch.full((1, options["height"], options["width"], 1), 0.5)
        return picture, weight, {"radii": torch.full((1, 5), 3), "means2d": torch.zeros(1, 5, 2)}

    values = torch.ones(5, 3, requires_grad=True)
    pose = Pose.look_at(position=(-3.0, 0.0, 0.0), target=(0.0, 1.0, 0.5))
    panorama = Panorama.of(pose, equirect_grid(48, 24))
    module = cast(Any, SimpleNamespace(rasterization=rasterization))
    gaussians = (torch.rand(5, 3), torch.rand(5, 4), torch.rand(5, 3), torch.rand(5), values)
    raster = rasterize_gsplat(*gaussians, panorama, module=module)
    torch.testing.assert_close(raster.values.detach(), pose.to_world(panorama.grid.directions), atol=5e-3, rtol=0)
    torch.testing.assert_close(raster.weight, torch.full((24, 48), 0.5))
    assert raster.radii.tolist() == [3.0] * 5
    raster.values.square().sum().backward()
    assert values.grad is not None
    assert float(values.grad[0].sum()) == pytest.approx(2 * 24 * 48, rel=1e-2)


def test_the_depth_gate_is_refused_and_other_backends_are_named():
    gaussians = (torch.rand(5, 3), torch.rand(5, 4), torch.rand(5, 3), torch.rand(5), torch.rand(5, 1))
    with pytest.raises(InputError, match='gsplat backend has no depth gate; use backend="native" or "reference"'):
        rasterize_gsplat(*gaussians, view(), depth_gate=0.3, module=cast(Any, SimpleNamespace()))


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a CUDA device")
def test_without_gsplat_or_cuda_the_error_says_what_to_install():
    with pytest.raises(MissingDependencyError, match=r'the "gsplat" backend needs'):
        load_gsplat()
