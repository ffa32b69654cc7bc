"""The compiled rasterizer called directly: threads, the depth gate, largest weights, and inputs nobody means."""

import itertools

import pytest
import torch
from torch import Tensor

from rf3dgs.core.frames import Pose
from rf3dgs.core.grids import Camera, pinhole_grid
from rf3dgs.core.native import native_core
from rf3dgs.splats.constants import ALPHA_MAX, ALPHA_MIN, BLUR, GATE_TRANSMITTANCE, TRANSMITTANCE_STOP
from rf3dgs.splats.projection import project

POSE = Pose.look_at(position=(-3.0, 0.5, 0.3), target=(0.0, 0.0, 0.0))
VIEW = Camera.of(POSE, pinhole_grid(37, 29, 90.0))


def cloud(count: int, channels: int = 3, *, size: float = 0.2, seed: int = 1) -> list[Tensor]:
    generator = torch.Generator().manual_seed(seed)
    return [
        (torch.rand(count, 3, generator=generator) - 0.5) * torch.tensor([6.0, 5.0, 3.0]),
        torch.randn(count, 4, generator=generator),
        size * torch.exp(0.7 * torch.randn(count, 3, generator=generator)),
        torch.rand(count, generator=generator),
        torch.rand(count, channels, generator=generator),
    ]


class Drawing:
    """One picture and, on demand, the gradients of `sum(picture * g) + sum(weight * h)`."""

    def __init__(
        self,
        tensors: list[Tensor],
        camera: Camera = VIEW,
        *,
        gate: float | None = None,
        threads: int = 1,
        max_weight: Tensor | None = None,
    ) -> None:
        core = native_core()
        assert core is not None
        self.core = core
        self.tensors, self.threads = tensors, threads
        self.picture = torch.full((camera.height, camera.width, tensors[4].shape[1]), torch.nan)
        self.weight = torch.full((camera.height, camera.width), torch.nan)
        self.radii = torch.full((len(tensors[0]),), torch.nan)
        matrices = (camera.viewmat.float().contiguous(), camera.K.float().contiguous())
        outputs = (self.picture, self.weight, self.radii, max_weight)
        self.scene = self.core.rasterize(*tensors, *matrices, None, None, BLUR, gate, *outputs, threads)

    def gradients(self, of_picture: Tensor, of_weight: Tensor) -> list[Tensor]:
        means, quats, scales, opacities, values = self.tensors
        found = [torch.zeros_like(tensor) for tensor in (values, opacities, means, quats, scales)]
        found.append(torch.zeros(len(means), 2))
        arguments = (means, quats, scales, opacities, None, self.picture, self.weight, of_picture, of_weight)
        self.core.rasterize_backward(self.scene, *arguments, *found, None, self.threads)
        return found


def slopes(drawing: Drawing) -> tuple[Tensor, Tensor]:
    generator = torch.Generator().manual_seed(5)
    of_picture = torch.randn(drawing.picture.shape, generator=generator)
    return of_picture, torch.randn(drawing.weight.shape, generator=generator)


def weights_one_by_one(tensors: list[Tensor], gate: float | None) -> tuple[Tensor, Tensor]:
    """Weights `[drawn, row, col]` front to back and the indices of the Gaussians, by a loop that does what is said."""
    means, quats, scales, opacities, _ = tensors
    centre, covariance, depth = project(means, quats, scales, VIEW)
    row, col = torch.meshgrid(torch.arange(VIEW.height), torch.arange(VIEW.width), indexing="ij")
    pixels = torch.stack((col, row), -1).to(means.dtype) + 0.5
    order = [int(index) for index in torch.argsort(depth.detach(), stable=True) if depth[index] > 0.05]
    product = torch.ones(VIEW.height, VIEW.width, dtype=means.dtype)
    limit = torch.full_like(product, torch.inf)
    weights = []
    for index in order:
        offset = pixels - centre[index]
        inverse = torch.linalg.inv(covariance[index])
        power = -0.5 * torch.einsum("hwi,ij,hwj->hw", offset, inverse, offset)
        alpha = (opacities[index] * torch.exp(power)).clamp_max(ALPHA_MAX)
        alpha = torch.where(alpha < ALPHA_MIN, 0.0, alpha)
        after = product * (1 - alpha)
        counts = (after >= TRANSMITTANCE_STOP) & (depth[index] <= limit)
        weights.append(torch.where(counts, product * alpha, 0.0))
        if gate is not None:
            sets_gate = counts & (after < GATE_TRANSMITTANCE) & torch.isinf(limit)
            limit = torch.where(sets_gate, depth[index] + gate, limit).detach()
        product = after
    return torch.stack(weights), torch.tensor(order)


@pytest.mark.parametrize("channels", [1, 3, 11])
def test_pictures_and_gradients_do_not_depend_on_the_number_of_threads_by_a_single_bit(channels: int):
    tensors = cloud(6000, channels, size=0.05)
    view = Camera.of(POSE, pinhole_grid(150, 110, 90.0))
    drawings = [Drawing(tensors, view, threads=threads) for threads in (1, 2, 3, 4)]
    gradients = [drawing.gradients(*slopes(drawing)) for drawing in drawings]
    for drawing, found in zip(drawings[1:], gradients[1:], strict=True):
        assert torch.equal(drawing.picture, drawings[0].picture)
        assert torch.equal(drawing.weight, drawings[0].weight)
        assert torch.equal(drawing.radii, drawings[0].radii)
        assert all(torch.equal(mine, first) for mine, first in zip(found, gradients[0], strict=True))


def test_memory_that_was_used_before_leaves_no_trace():
    small, large = cloud(300), cloud(5000, 5, size=0.1)
    first = Drawing(small)
    expected = first.gradients(*slopes(first))
    for _ in range(3):
        Drawing(large).gradients(*slopes(Drawing(large)))
        again = Drawing(small)
        assert torch.equal(again.picture, first.picture)
        assert all(torch.equal(a, b) for a, b in zip(again.gradients(*slopes(again)), expected, strict=True))


def test_the_counts_of_a_scene_are_those_of_its_picture():
    drawing = Drawing(cloud(400))
    weights, order = weights_one_by_one([tensor.double() for tensor in cloud(400)], None)
    assert drawing.scene.visible == int((drawing.radii > 0).sum())
    reached = torch.nn.functional.pad(weights, (0, 3, 0, 3)).unfold(1, 4, 4).unfold(2, 4, 4).amax((-1, -2)) > 0
    assert int(reached.sum()) <= drawing.scene.pairs <= 16 * drawing.scene.entries
    assert drawing.scene.visible <= len(order)


@pytest.mark.parametrize("gate", [None, 0.3])
def test_largest_weights_are_running_maxima_over_pixels_and_pictures(gate: float | None):
    tensors = cloud(400)
    weights, order = weights_one_by_one([tensor.double() for tensor in tensors], gate)
    expected = torch.zeros(400, dtype=torch.float64)
    expected[order] = weights.amax((1, 2))
    found = torch.zeros(400)
    Drawing(tensors, gate=gate, max_weight=found)
    difference = (found - expected).abs()
    assert difference.max() < 2e-3
    assert difference.mean() < 1e-5
    floor = torch.full((400,), 0.4)
    Drawing(tensors, gate=gate, max_weight=floor)
    assert torch.equal(floor, found.clamp_min(0.4))


@pytest.mark.parametrize(("gate", "channels"), [(0.0, 3), (0.3, 1), (1.0, 3)])
def test_nothing_counts_further_behind_the_surface_than_the_gate(gate: float, channels: int):
    tensors = cloud(300, channels, seed=2)
    tensors[3] = 0.2 + 0.5 * tensors[3]
    leaves = [tensor.double().requires_grad_() for tensor in tensors]
    weights, order = weights_one_by_one(leaves, gate)
    expected = torch.einsum("ghw,gc->hwc", weights, leaves[4][order])
    drawing = Drawing(tensors, gate=gate)
    difference = (drawing.picture - expected.detach()).abs().amax(-1)
    assert difference.mean() < 1e-5
    assert (drawing.weight - weights.detach().sum(0)).abs().mean() < 1e-5
    open_picture = Drawing(tensors).picture
    assert (drawing.picture - open_picture).abs().max() > 0.01
    # Pixels whose gate closes within rounding of a splat's depth say nothing about the gradient.
    of_picture, of_weight = slopes(drawing)
    of_picture[difference > 1e-4] = 0.0
    of_weight[difference > 1e-4] = 0.0
    ((expected * of_picture).sum() + (weights.sum(0) * of_weight).sum()).backward()
    means, quats, scales, opacities, values = (leaf.grad for leaf in leaves)
    for mine, theirs in zip(
        drawing.gradients(of_picture, of_weight), (values, opacities, means, quats, scales), strict=False
    ):
        assert theirs is not None
        assert (mine - theirs).norm() < 3e-4 * theirs.norm()


def test_a_gate_that_reaches_everything_changes_nothing():
    tensors = cloud(500)
    assert torch.equal(Drawing(tensors, gate=1e6).picture, Drawing(tensors).picture)


def strange(count: int, seed: int) -> list[Tensor]:
    """Gaussians whose numbers are replaced here and there by what breaks careless arithmetic."""
    generator = torch.Generator().manual_seed(seed)
    tensors = cloud(count, 2, seed=seed)
    odd = [torch.nan, torch.inf, -torch.inf, 0.0, -1.0, 1e-45, 1e-38, 1e-20, 1e20, 3e38, -3e38]
    for tensor in tensors:
        hit = torch.rand(tensor.shape, generator=generator) < 0.1
        pick = torch.randint(len(odd), tensor.shape, generator=generator)
        tensor[hit] = torch.tensor(odd)[pick][hit]
    tensors[1][:20] = 0.0
    tensors[2][20:60] *= torch.tensor([1e-8, 1.0, 1e3])  # needles and pancakes
    tensors[2][60:100] *= torch.tensor([1e4, 1e-6, 1e4])
    tensors[0][100:140] = POSE.position
    return tensors


@pytest.mark.parametrize(("seed", "gate"), list(itertools.product(range(4), [None, 0.3])))
def test_no_input_crashes_or_spoils_the_picture(seed: int, gate: float | None):
    tensors = strange(800, seed)
    for camera in (VIEW, Camera.of(POSE, pinhole_grid(1, 1, 60.0)), Camera.of(POSE, pinhole_grid(130, 3, 100.0))):
        most = torch.zeros(800)
        drawing = Drawing(tensors, camera, gate=gate, threads=2, max_weight=most)
        assert torch.isfinite(drawing.weight).all()
        assert ((drawing.weight >= 0) & (drawing.weight <= 1)).all()
        assert torch.isfinite(most).all()
        assert not torch.isnan(drawing.radii).any()
        usable = (tensors[4].abs() < 1e19).all(-1)
        tame = [tensor[usable].contiguous() for tensor in tensors]
        drawing = Drawing(tame, camera, gate=gate, threads=2)
        assert torch.isfinite(drawing.picture).all()
        drawing.gradients(*slopes(drawing))


def test_values_that_are_not_finite_take_their_gaussian_out():
    tensors = cloud(300)
    tensors[4][::3, 1] = torch.nan
    kept = torch.arange(300) % 3 != 0
    drawing = Drawing(tensors)
    assert torch.equal(drawing.picture, Drawing([tensor[kept].contiguous() for tensor in tensors]).picture)
    assert (drawing.radii[~kept] == 0).all()
    values, opacities, *_ = drawing.gradients(*slopes(drawing))
    assert (values[~kept] == 0).all()
    assert (opacities[~kept] == 0).all()


def test_no_gaussians_make_an_empty_picture():
    drawing = Drawing([tensor[:0].contiguous() for tensor in cloud(4)])
    assert (drawing.picture == 0).all()
    assert (drawing.weight == 0).all()
    drawing.gradients(*slopes(drawing))
