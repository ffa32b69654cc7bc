"""Laws of the sphere's picture: no seam, no pole, and the tangent-plane Gaussian."""

import math

import pytest
import torch

from rf3dgs.core.angles import angle_between
from rf3dgs.core.frames import Pose
from rf3dgs.core.grids import Camera, Panorama, equirect_grid, pinhole_grid, sample_grid
from rf3dgs.core.native import native_core
from rf3dgs.splats.constants import BLUR
from rf3dgs.splats.projection import pixel_area, project_sphere, sphere_directions, tangent_axes
from rf3dgs.splats.raster import Raster
from rf3dgs.splats.rasterize import rasterize

F64 = torch.float64
BACKENDS = ["reference", "native"]


def draw(backend: str, tensors: list[torch.Tensor], view: Camera | Panorama) -> Raster:
    if backend == "native":
        tensors = [tensor.float() for tensor in tensors]
    return rasterize(*tensors, view, backend=backend)  # type: ignore[arg-type]


def room(spacing: float) -> list[torch.Tensor]:
    """Flat, nearly opaque Gaussians on the walls of a box of 8 x 6 x 3 m around the origin; their places are values."""
    size = torch.tensor([8.0, 6.0, 3.0], dtype=F64)
    generator = torch.Generator().manual_seed(0)
    means, scales = [], []
    for axis, (u, v) in enumerate(((1, 2), (0, 2), (0, 1))):
        steps = [int(size[side] / spacing) + 1 for side in (u, v)]
        across, along = torch.meshgrid(*(torch.linspace(-0.5, 0.5, n, dtype=F64) for n in steps), indexing="ij")
        for side in (-0.5, 0.5):
            wall = torch.zeros(across.numel(), 3, dtype=F64)
            wall[:, axis], wall[:, u], wall[:, v] = side, across.flatten(), along.flatten()
            wall += 1e-3 * torch.rand(wall.shape, generator=generator, dtype=F64)
            means.append(wall * size)
            spread = torch.full_like(wall, spacing)
            spread[:, axis] = 1e-3
            scales.append(spread)
    places = torch.cat(means)
    quats = torch.tensor([[1.0, 0.0, 0.0, 0.0]], dtype=F64).expand(len(places), 4).clone()
    return [places, quats, torch.cat(scales), torch.full((len(places),), 0.95, dtype=F64), 0.5 + places / size]


def test_tangent_axes_are_orthonormal_in_every_direction():
    directions = torch.nn.functional.normalize(torch.randn(500, 3, generator=torch.Generator().manual_seed(1)), dim=-1)
    directions = torch.cat((directions, torch.eye(3), -torch.eye(3))).double()
    directions = torch.nn.functional.normalize(directions, dim=-1)
    frame = torch.cat((tangent_axes(directions), directions[:, None]), 1)
    torch.testing.assert_close(frame @ frame.mT, torch.eye(3, dtype=F64).expand(506, 3, 3), atol=1e-12, rtol=0)


def test_pixels_look_where_the_grid_of_the_panorama_does():
    view = Panorama.of(Pose.look_at((1.0, 2.0, 3.0), (4.0, 3.0, 2.0)), equirect_grid(18, 9))
    camera = sphere_directions(view, torch.zeros(0)).reshape(9, 18, 3)
    expected = view.pose.to_world(view.grid.directions)
    torch.testing.assert_close(camera @ view.viewmat[:3, :3], expected, atol=1e-5, rtol=0)


@pytest.mark.parametrize("backend", BACKENDS)
def test_a_round_gaussian_has_the_profile_of_its_tangent_plane_wherever_it_lies(backend: str):
    view = Panorama.of(Pose((0.0, 0.0, 0.0)), equirect_grid(120, 60))
    directions = view.grid.directions.double()
    for at in ((3.0, 0.0, 0.0), (-2.0, 0.02, 0.3), (0.02, 0.01, 2.5), (0.3, -0.1, -2.0)):
        mean = torch.tensor([at], dtype=F64)
        quats, scales = torch.tensor([[1.0, 0.0, 0.0, 0.0]], dtype=F64), torch.full((1, 3), 0.3, dtype=F64)
        opacity = torch.tensor([0.6], dtype=F64)
        raster = draw(backend, [mean, quats, scales, opacity, torch.ones(1, 1, dtype=F64)], view)
        angle = angle_between(directions, mean[0].expand_as(directions))
        variance = (0.3 / float(mean.norm())) ** 2 + BLUR * pixel_area(view)
        expected = 0.6 * torch.exp(-0.5 * torch.tan(angle) ** 2 / variance) * (angle < 1.3)
        expected = torch.where(expected < 1 / 255, 0.0, expected)
        difference = (raster.weight.double() - expected).abs()
        assert int((difference > 1e-5).sum()) <= 2
        radius = math.sqrt(2 * math.log(255 * 0.6) * variance / pixel_area(view))
        assert float(raster.radii) == pytest.approx(radius, rel=1e-4)


@pytest.mark.parametrize("backend", BACKENDS)
def test_small_gaussians_look_the_same_to_a_camera_and_to_the_sphere(backend: str):
    generator = torch.Generator().manual_seed(2)
    offsets = 0.1 * (torch.rand(40, 2, generator=generator, dtype=F64) - 0.5)
    means = torch.cat((4.0 + 0.02 * torch.arange(40, dtype=F64)[:, None], offsets), -1)
    scales = 0.03 * torch.ones(40, 3, dtype=F64)
    opacities = torch.full((40,), 0.3, dtype=F64)
    tensors = [means, torch.randn(40, 4, generator=generator, dtype=F64), scales, opacities, 0.5 + offsets]
    pixel = 2 * math.pi / 720
    K = torch.tensor([[1 / pixel, 0, 8], [0, 1 / pixel, 6], [0, 0, 1.0]])
    flat = draw(backend, tensors, Camera.of(Pose((0.0, 0.0, 0.0)), pinhole_grid(16, 12, K=K)))
    whole = draw("reference", tensors, Panorama.of(Pose((0.0, 0.0, 0.0)), equirect_grid(720, 360)))
    torch.testing.assert_close(flat.values.double(), whole.values[174:186, 352:368], atol=5e-3, rtol=0)


@pytest.mark.parametrize("backend", BACKENDS)
def test_turning_the_device_about_its_vertical_rolls_the_picture(backend: str):
    tensors = room(0.6)
    grid = equirect_grid(54, 27)
    still = draw(backend, tensors, Panorama.of(Pose((0.3, 0.2, -0.1)), grid))
    turned = draw(backend, tensors, Panorama.of(Pose.from_yaw((0.3, 0.2, -0.1), 2 * math.pi * 20 / 54), grid))
    difference = (turned.values - still.values.roll(20, 1)).abs().amax(-1)
    assert float(difference.median()) < 1e-5
    assert float((difference > 1e-3).double().mean()) < 0.01


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("axis", [0, 1])
@pytest.mark.parametrize("turn", [0.4, 1.3])
def test_turning_the_device_about_any_axis_shows_the_same_world(backend: str, axis: int, turn: float):
    """What one pose has at its seam and poles, the other has elsewhere."""
    tensors, grid = room(0.4), equirect_grid(96, 48)
    upright = Pose((0.3, 0.2, -0.1))
    cosine, sine = math.cos(turn), math.sin(turn)
    rotation = torch.eye(3)
    first, second = (axis + 1) % 3, (axis + 2) % 3
    rotation[first, first], rotation[first, second] = cosine, -sine
    rotation[second, first], rotation[second, second] = sine, cosine
    tilted = Pose.from_matrix(upright.position, rotation)
    directions = upright.to_world(grid.directions)
    still = draw(backend, tensors, Panorama.of(upright, grid)).values
    turned = draw(backend, tensors, Panorama.of(tilted, grid)).values
    difference = (sample_grid(turned, grid, tilted.to_device(directions)) - still).abs().amax(-1)
    for part in (difference, difference[[0, -1]], difference[:, [0, -1]]):
        assert float(part.mean()) < 0.02
        assert float(part.max()) < 0.15


@pytest.mark.parametrize("backend", BACKENDS)
def test_a_closed_room_has_no_hole_at_the_poles_nor_at_the_seam(backend: str):
    for pose in (Pose((0.3, 0.2, -0.1)), Pose.look_at((-2.0, 1.0, 0.4), (0.0, 0.0, 2.0))):
        raster = draw(backend, room(0.35), Panorama.of(pose, equirect_grid(70, 35)))
        assert float(raster.weight.min()) > 0.99


def test_gradients_on_the_sphere_agree_with_finite_differences():
    """Wide Gaussians of low opacity around the sphere: no alpha comes near a cut-off but where it is smooth to both."""
    generator = torch.Generator().manual_seed(4)
    view = Panorama.of(Pose((0.0, 0.0, 0.0)), equirect_grid(8, 4))
    means = torch.randn(4, 3, generator=generator, dtype=F64) * 2
    inputs = [
        means,
        torch.randn(4, 4, generator=generator, dtype=F64),
        1.0 + torch.rand(4, 3, generator=generator, dtype=F64),
        0.2 + 0.3 * torch.rand(4, generator=generator, dtype=F64),
        torch.rand(4, 2, generator=generator, dtype=F64),
    ]
    for tensor in inputs:
        tensor.requires_grad_()
    weights = torch.rand(4, 8, 2, generator=generator, dtype=F64)

    def loss(*tensors: torch.Tensor) -> torch.Tensor:
        raster = rasterize(*tensors, view, backend="reference")
        return (raster.values * weights).sum() + raster.weight.square().sum()

    assert torch.autograd.gradcheck(loss, inputs, atol=1e-5)


def test_the_projection_turns_with_the_world():
    view = Panorama.of(Pose.look_at((1.0, 2.0, 3.0), (4.0, 3.0, 2.0)), equirect_grid(18, 9))
    means = torch.randn(30, 3, generator=torch.Generator().manual_seed(3), dtype=F64)
    direction, axes, covariance, distance = project_sphere(
        means, torch.ones(30, 4, dtype=F64), torch.ones(30, 3, dtype=F64), view
    )
    away = means - view.position.double()
    torch.testing.assert_close(distance, away.norm(dim=-1), rtol=1e-5, atol=0)
    torch.testing.assert_close(direction @ view.viewmat[:3, :3].double(), away / distance[:, None], atol=1e-5, rtol=0)
    round_one = (1 / distance**2 + BLUR * pixel_area(view))[:, None, None] * torch.eye(2, dtype=F64)
    torch.testing.assert_close(covariance, round_one, rtol=1e-5, atol=1e-7)
    assert float((axes @ direction[:, :, None]).abs().max()) < 1e-9


@pytest.mark.skipif(native_core() is None, reason="the native core was not built")
@pytest.mark.parametrize(("width", "height"), [(360, 180), (97, 33), (54, 27), (7, 3), (40, 200)])
def test_no_contribution_above_the_cut_is_lost_by_the_lists_of_tiles(width: int, height: int):
    """Gaussians of all sizes and shapes, also over the poles and the seam, one by one against all pixels."""
    generator = torch.Generator().manual_seed(width)
    view = Panorama.of(Pose.look_at((0.3, 0.2, 0.1), (1.0, 0.7, 0.4)), equirect_grid(width, height))
    count = 120
    directions = torch.randn(count, 3, generator=generator)
    directions[0::4] *= torch.tensor([0.05, 1.0, 0.05])
    directions[1::4] *= torch.tensor([0.002, 1.0, 0.002])
    directions[2::4] = directions[2::4] * torch.tensor([0.02, 1.0, 0.0]) - torch.tensor([0.0, 0.0, 1.0])
    distance = 10 ** (2 * torch.rand(count, 1, generator=generator) - 1)
    away = distance * torch.nn.functional.normalize(directions, dim=-1)
    spread = 10 ** (3.5 * torch.rand(count, 1, generator=generator) - 3) * distance
    tensors = [
        away @ view.viewmat[:3, :3] + view.position,
        torch.randn(count, 4, generator=generator),
        spread * torch.exp(1.2 * torch.randn(count, 3, generator=generator)),
        0.01 + 0.99 * torch.rand(count, generator=generator),
        torch.ones(count, 1),
    ]
    for index in range(count):
        one = [tensor[index : index + 1] for tensor in tensors]
        found = rasterize(*one, view, backend="native").weight
        expected = rasterize(*(tensor.double() for tensor in one), view, backend="reference").weight
        clear = (expected - 1 / 255).abs() > 1e-6
        torch.testing.assert_close(found[clear].double(), expected[clear], atol=3e-5, rtol=0)
