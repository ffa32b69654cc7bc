import math

import pytest
import torch

from rf3dgs.core.frames import Pose
from rf3dgs.core.grids import Camera, pinhole_grid
from rf3dgs.splats.constants import ALPHA_MIN, BLUR
from rf3dgs.splats.projection import extent
from rf3dgs.splats.raster import Raster
from rf3dgs.splats.reference import rasterize_reference

F64 = torch.float64


def camera(width: int = 33, height: int = 25, fov_deg: float = 60) -> Camera:
    """At the origin, looking along the world's x axis, with y to the left and z up."""
    return Camera.of(Pose((0.0, 0.0, 0.0)), pinhole_grid(width, height, fov_deg))


def draw(*rows: tuple, view: Camera | None = None, values: torch.Tensor | None = None, **options: object) -> Raster:
    """Rows of (mean, scale, opacity) with round Gaussians; the default value of each is 1 in its own channel."""
    means = torch.tensor([row[0] for row in rows], dtype=F64)
    scales = torch.tensor([[row[1]] * 3 for row in rows], dtype=F64)
    opacities = torch.tensor([row[2] for row in rows], dtype=F64)
    quats = torch.tensor([[1.0, 0, 0, 0]], dtype=F64).expand(len(rows), 4)
    values = torch.eye(len(rows), dtype=F64) if values is None else values
    return rasterize_reference(means, quats, scales, opacities, values, view or camera(), **options)


def random_scene(count: int, seed: int = 0) -> list[torch.Tensor]:
    generator = torch.Generator().manual_seed(seed)
    means = torch.rand(count, 3, generator=generator, dtype=F64) * torch.tensor([2.0, 1.5, 1.0]) + torch.tensor(
        [2.0, -0.75, -0.5]
    )
    quats = torch.randn(count, 4, generator=generator, dtype=F64)
    scales = 0.05 + 0.15 * torch.rand(count, 3, generator=generator, dtype=F64)
    opacities = 0.2 + 0.5 * torch.rand(count, generator=generator, dtype=F64)
    return [means, quats, scales, opacities, torch.rand(count, 2, generator=generator, dtype=F64)]


def test_a_gaussian_to_the_left_lights_the_left_half() -> None:
    picture = draw(((3.0, 0.8, 0.4), 0.05, 0.9)).values[..., 0]
    row, col = divmod(int(picture.argmax()), picture.shape[1])
    assert col < 16
    assert row < 12


def test_the_peak_is_the_opacity_and_the_profile_a_gaussian() -> None:
    raster = draw(((3.0, 0.0, 0.0), 0.3, 0.6))
    view = camera()
    variance = (0.3 * float(view.K[0, 0]) / 3.0) ** 2 + BLUR
    assert float(raster.values[12, 16, 0]) == pytest.approx(0.6, rel=1e-6)
    assert float(raster.values[12, 19, 0]) == pytest.approx(0.6 * math.exp(-4.5 / variance), rel=1e-5)
    assert torch.equal(raster.weight, raster.values[..., 0])


def test_the_radius_is_where_alpha_falls_below_a_255th() -> None:
    raster = draw(((3.0, 0.0, 0.0), 0.1, 0.6))
    sigma = math.sqrt((0.1 * float(camera().K[0, 0]) / 3.0) ** 2 + BLUR)
    assert float(raster.radii) == pytest.approx(sigma * math.sqrt(2 * math.log(255 * 0.6)), rel=1e-5)
    lit = raster.weight[12].nonzero().squeeze(-1)
    assert int(lit.max()) - 16 == math.floor(float(raster.radii))
    assert float(extent(torch.tensor(ALPHA_MIN))) == 0.0


def test_the_nearer_one_hides_the_farther_whatever_their_order() -> None:
    far, near = ((4.0, 0.0, 0.0), 0.3, 0.9), ((2.0, 0.0, 0.0), 0.3, 0.7)
    one, other = draw(far, near), draw(near, far)
    assert float(one.values[12, 16, 1]) == pytest.approx(0.7)
    assert float(one.values[12, 16, 0]) == pytest.approx(0.3 * 0.9)
    assert torch.allclose(one.values, other.values.flip(-1))


def test_no_gaussian_is_fully_opaque_and_a_pixel_stops_before_losing_all_light() -> None:
    raster = draw(*(((2.0 + index, 0.0, 0.0), 0.5, 1.0) for index in range(4)))
    assert raster.values[12, 16].tolist() == pytest.approx([0.99, 0.0099, 0.0, 0.0])
    assert float(raster.weight[12, 16]) == pytest.approx(0.9999)


def test_a_stopped_pixel_ignores_all_that_follows() -> None:
    rows = [((2.0 + index, 0.0, 0.0), 0.5, opacity) for index, opacity in enumerate((0.99, 0.98, 0.9, 0.1))]
    raster = draw(*rows)
    assert raster.values[12, 16].tolist() == pytest.approx([0.99, 0.0098, 0.0, 0.0])


def test_the_background_shows_where_light_passes() -> None:
    background = torch.tensor([5.0], dtype=F64)
    raster = draw(((3.0, 0.0, 0.0), 0.2, 0.6), background=background)
    assert torch.allclose(raster.values[..., 0], raster.weight + 5.0 * (1 - raster.weight))


def test_values_are_blended_linearly() -> None:
    scene = random_scene(30)
    first = rasterize_reference(*scene, camera()).values
    second = rasterize_reference(*scene[:4], -3.0 * scene[4], camera()).values
    assert torch.allclose(second, -3.0 * first)


def test_turning_the_world_and_the_camera_changes_nothing() -> None:
    means, quats, scales, opacities, values = random_scene(30)
    first = rasterize_reference(means, quats, scales, opacities, values, camera())
    turn = Pose.from_yaw((1.0, 2.0, 3.0), 0.7)
    rotation = turn.world_from_device.double()
    w, x, y, z = turn.orientation.double()
    product = torch.stack(
        (
            torch.stack((w, -x, -y, -z)),
            torch.stack((x, w, -z, y)),
            torch.stack((y, z, w, -x)),
            torch.stack((z, -y, x, w)),
        )
    )
    moved = means @ rotation.mT + turn.position.double()
    view = Camera.of(turn, pinhole_grid(33, 25, 60))
    second = rasterize_reference(moved, quats @ product.mT, scales, opacities, values, view)
    assert torch.allclose(first.values, second.values, atol=2e-5)


def test_what_cannot_be_drawn_is_left_out_and_harms_nothing() -> None:
    scene = random_scene(12)
    for tensor in scene:
        tensor.requires_grad_()
    whole = rasterize_reference(*scene, camera())
    bad = [tensor.detach().clone() for tensor in random_scene(10, seed=1)]
    bad[0][0] = torch.nan
    bad[0][1] = torch.tensor([-2.0, 0.0, 0.0])
    bad[0][2] = torch.tensor([0.04, 0.0, 0.0])
    bad[0][3] = torch.tensor([3.0, 50.0, 0.0])
    bad[1][4] = 0.0
    bad[2][5] = torch.inf
    bad[2][6, 0] = -1.0
    bad[3][7] = 0.5 / 255
    bad[3][8] = torch.nan
    bad[4][9] = torch.nan
    mixed = [torch.cat((tensor, extra)) for tensor, extra in zip(scene, bad, strict=True)]
    raster = rasterize_reference(*mixed, camera())
    assert torch.allclose(raster.values, whole.values)
    assert torch.equal(raster.radii[12:], torch.zeros(10, dtype=F64))
    assert bool((raster.radii[:12] > 0).all())
    raster.values.sum().backward()
    assert all(bool(torch.isfinite(tensor.grad).all()) for tensor in scene)


def test_an_empty_scene_gives_the_background() -> None:
    scene = [tensor[:0] for tensor in random_scene(3)]
    raster = rasterize_reference(*scene, camera(), background=torch.tensor([1.0, 2.0], dtype=F64))
    assert raster.values.shape == (25, 33, 2)
    assert torch.equal(raster.values[0, 0], torch.tensor([1.0, 2.0], dtype=F64))


def test_gradients_agree_with_finite_differences() -> None:
    """Opacities are low and the pixels few, so that no alpha comes near a cut-off or the stop."""
    view = camera(6, 5, fov_deg=20)
    means, quats, scales, opacities, values = random_scene(4, seed=2)
    means[:, 1:] *= 0.3
    offset = torch.zeros(4, 2, dtype=F64)
    inputs = [means, quats, scales, opacities, values, offset]
    for tensor in inputs:
        tensor.requires_grad_()
    weights = torch.rand(5, 6, 2, generator=torch.Generator().manual_seed(3), dtype=F64)
    background = torch.tensor([0.3, 0.7], dtype=F64)

    def loss(m: torch.Tensor, q: torch.Tensor, s: torch.Tensor, o: torch.Tensor, v: torch.Tensor, d: torch.Tensor):
        raster = rasterize_reference(m, q, s, o, v, view, background=background, screen_offset=d)
        return (raster.values * weights).sum() + raster.weight.square().sum()

    assert torch.autograd.gradcheck(loss, inputs, atol=1e-6)


def test_the_screen_offset_moves_the_picture() -> None:
    row = ((3.0, 0.0, 0.0), 0.2, 0.6)
    moved = draw(row, screen_offset=torch.tensor([[3.0, -2.0]], dtype=F64)).values
    assert torch.allclose(moved[:-2, 3:], draw(row).values[2:, :-3])


def test_beside_the_picture_the_spread_is_kept_finite() -> None:
    raster = draw(((0.1, 3.0, 0.0), 0.05, 0.9), ((0.1, 0.25, 0.0), 0.05, 0.9))
    assert bool(torch.isfinite(raster.values).all())
    assert float(raster.radii[0]) == 0.0


def test_chunks_do_not_change_the_picture(monkeypatch: pytest.MonkeyPatch) -> None:
    scene = random_scene(30)
    whole = rasterize_reference(*scene, camera())
    monkeypatch.setattr("rf3dgs.splats.reference._PAIRS_PER_CHUNK", 1000)
    assert torch.allclose(whole.values, rasterize_reference(*scene, camera()).values, atol=1e-12)
