"""The native core behind torch: rasterizer, harmonics and picture loss as autograd functions.

The core sees detached, contiguous float32 arrays on the CPU and computes only the gradients that are asked for. Second
derivatives are not available.
"""

from types import ModuleType
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from rf3dgs.core.errors import MissingDependencyError
from rf3dgs.core.grids import Camera, Panorama, View
from rf3dgs.core.native import native_core, native_failure
from rf3dgs.core.threads import thread_count
from rf3dgs.splats.constants import BLUR
from rf3dgs.splats.projection import project_sphere
from rf3dgs.splats.raster import Raster


def core() -> ModuleType:
    """The compiled module; raises MissingDependencyError where it cannot be loaded."""
    module = native_core()
    if module is None:
        raise MissingDependencyError(
            f"the native core cannot be loaded ({native_failure()}); install rf3dgs from a wheel, or with a C++20 "
            'compiler and CMake, or use backend="reference"'
        )
    return module


def takes(*tensors: Tensor | None) -> bool:
    """True when the core is there and all tensors are float32 on the CPU."""
    fits = all(
        tensor.dtype == torch.float32 and tensor.device.type == "cpu" for tensor in tensors if tensor is not None
    )
    return fits and native_core() is not None


def _plain(tensor: Tensor) -> Tensor:
    return tensor.detach().contiguous()


class _Rasterize(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        means: Tensor,
        quats: Tensor,
        scales: Tensor,
        opacities: Tensor,
        values: Tensor,
        background: Tensor | None,
        offset: Tensor | None,
        view: View,
        blur: float,
        gate: float | None,
    ) -> tuple[Tensor, Tensor, Tensor]:
        inputs = [None if tensor is None else _plain(tensor) for tensor in (means, quats, scales, opacities, values)]
        fill = None if background is None else _plain(background)
        shift = None if offset is None else _plain(offset)
        picture = torch.empty(view.height, view.width, values.shape[1])
        weight = torch.empty(view.height, view.width)
        radii = torch.empty(len(means))
        outputs = picture, weight, radii
        viewmat = _plain(view.viewmat).float()
        K = _plain(view.K).float() if isinstance(view, Camera) else None
        scene = core().rasterize(*inputs, viewmat, K, fill, shift, blur, gate, *outputs, None, thread_count())
        ctx.scene, ctx.view, ctx.blur = scene, view, blur
        ctx.save_for_backward(*inputs, shift, picture, weight)
        ctx.mark_non_differentiable(radii)
        ctx.set_materialize_grads(False)
        return picture, weight, radii

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *gradients: Tensor | None) -> tuple[Tensor | None, ...]:  # pyright: ignore[reportIncompatibleMethodOverride]
        of_picture, of_weight, _ = gradients
        *inputs, shift, picture, weight = ctx.saved_tensors
        if of_picture is None and of_weight is None:
            return (None,) * 10
        of_picture = torch.zeros_like(picture) if of_picture is None else _plain(of_picture)
        of_weight = None if of_weight is None else _plain(of_weight)
        needs = ctx.needs_input_grad
        means, quats, scales, opacities, values = inputs
        view = ctx.view
        flat = isinstance(view, Camera)
        to_means = torch.zeros_like(means) if needs[0] and flat else None
        to_quats = torch.zeros_like(quats) if needs[1] and flat else None
        to_scales = torch.zeros_like(scales) if needs[2] and flat else None
        to_sphere = torch.zeros(len(means), 9) if any(needs[:3]) and not flat else None
        to_opacities = torch.zeros_like(opacities) if needs[3] else None
        to_values = torch.zeros_like(values) if needs[4] else None
        to_offset = torch.zeros_like(shift) if needs[6] else None
        outputs = (to_values, to_opacities, to_means, to_quats, to_scales, to_offset, to_sphere)
        core().rasterize_backward(
            ctx.scene, *inputs[:4], shift, picture, weight, of_picture, of_weight, *outputs, thread_count()
        )
        if to_sphere is not None and isinstance(view, Panorama):
            to_means, to_quats, to_scales = _through_sphere(means, quats, scales, view, ctx.blur, to_sphere)
        to_background = None
        if needs[5]:
            to_background = torch.einsum("hwc,hw->c", of_picture, 1 - weight)
        result = (to_means, to_quats, to_scales, to_opacities, to_values, to_background, to_offset)
        return (*(gradient if need else None for gradient, need in zip(result, needs, strict=False)), None, None, None)


def _through_sphere(
    means: Tensor, quats: Tensor, scales: Tensor, view: Panorama, blur: float, gradients: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Gradients of means, quats and scales from those `[gaussian, 9]` of what the sphere's splats are drawn with.

    These are of M = E^T Sigma2^-1 E (xx, xy, xz, yy, yz, zz of a symmetric matrix) and of the direction, and go on
    through `projection.project_sphere` for the Gaussians that have any.
    """
    index = (gradients != 0).any(-1).nonzero().squeeze(-1)
    means_of, quats_of, scales_of = inputs = [
        tensor[index].double().requires_grad_() for tensor in (means, quats, scales)
    ]
    with torch.enable_grad():
        direction, axes, covariance, _ = project_sphere(means_of, quats_of, scales_of, view, blur)
        shape = axes.mT @ torch.linalg.inv(covariance) @ axes
        upper = gradients[index][:, [0, 1, 2, 1, 3, 4, 2, 4, 5]].double().reshape(-1, 3, 3)
        loss = (upper * shape).sum() + (gradients[index][:, 6:].double() * direction).sum()
    of_means, of_quats, of_scales = torch.autograd.grad(loss, inputs)
    return (
        torch.zeros_like(means).index_copy_(0, index, of_means.float()),
        torch.zeros_like(quats).index_copy_(0, index, of_quats.float()),
        torch.zeros_like(scales).index_copy_(0, index, of_scales.float()),
    )


def rasterize_native(
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    opacities: Tensor,
    values: Tensor,
    view: View,
    *,
    background: Tensor | None = None,
    screen_offset: Tensor | None = None,
    blur: float = BLUR,
    depth_gate: float | None = None,
) -> Raster:
    """Blended channels of `rasterize` by the native core; see there."""
    arguments = (means, quats, scales, opacities, values, background, screen_offset, view, blur, depth_gate)
    return Raster(*_Rasterize.apply(*arguments))  # type: ignore[misc]


def raise_to_weights_native(largest: Tensor, shape: tuple[Tensor, Tensor, Tensor, Tensor], view: View) -> None:
    """Raise `largest` `[gaussian]` in place to the largest blending weight that each Gaussian has in one picture.

    `shape` are activated means, quats, scales and opacities.
    """
    inputs = [_plain(tensor) for tensor in shape]
    viewmat = _plain(view.viewmat).float()
    K = _plain(view.K).float() if isinstance(view, Camera) else None
    size = view.height, view.width
    outputs = torch.empty(*size, 1), torch.empty(size), torch.empty_like(largest), largest
    values = torch.zeros(len(largest), 1)
    core().rasterize(*inputs, values, viewmat, K, None, None, BLUR, None, *outputs, thread_count())


class _Harmonics(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, sh: Tensor, directions: Tensor) -> Tensor:
        directions = _plain(directions)
        values = torch.empty(sh.shape[0], sh.shape[2])
        core().harmonics_forward(_plain(sh), directions, values, thread_count())
        ctx.save_for_backward(directions)
        ctx.shape = sh.shape
        return values

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, None]:  # pyright: ignore[reportIncompatibleMethodOverride]
        (directions,) = ctx.saved_tensors
        result = torch.empty(ctx.shape)
        core().harmonics_backward(_plain(gradients[0]), directions, result, thread_count())
        return result, None


def evaluate_harmonics(sh: Tensor, directions: Tensor) -> Tensor:
    """`sum_k sh_k Y_k(d)` `[gaussian, channel]` of `[gaussian, k, channel]`; differentiable in `sh` only."""
    return _Harmonics.apply(sh, directions)  # type: ignore[return-value]


class _L1Ssim(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, picture: Tensor, target: Tensor, weight: Tensor | None, ssim_weight: float) -> Tensor:
        gradient = torch.empty_like(picture, memory_format=torch.contiguous_format) if picture.requires_grad else None
        share = None if weight is None else _plain(weight)
        loss = core().l1_ssim(_plain(picture), _plain(target), share, ssim_weight, None, gradient, thread_count())
        ctx.gradient = gradient
        return torch.tensor(loss, dtype=torch.float32)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, None, None, None]:  # pyright: ignore[reportIncompatibleMethodOverride]
        return ctx.gradient * gradients[0], None, None, None


def l1_ssim_native(picture: Tensor, target: Tensor, ssim_weight: float, weight: Tensor | None) -> Tensor:
    """`image_loss.l1_ssim` by the native core; differentiable in `picture` only."""
    return _L1Ssim.apply(picture, target, weight, ssim_weight)  # type: ignore[return-value]
