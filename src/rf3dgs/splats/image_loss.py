"""How far one picture is from another: L1, structural similarity, and the loss both stages train on.

The torch functions are the specification; the native core computes the loss and its gradient in one pass when the
pictures are float32 on the CPU. Wang et al., Image quality assessment (2004); Kerbl et al. (2023), eq. 7.
"""

import torch
from torch import Tensor

from rf3dgs.core.errors import InputError
from rf3dgs.splats.backends import native
from rf3dgs.splats.constants import SSIM_C1, SSIM_C2, SSIM_RADIUS, SSIM_SIGMA


def l1_ssim(picture: Tensor, target: Tensor, *, ssim_weight: float = 0.2, weight: Tensor | None = None) -> Tensor:
    """`(1 - ssim_weight) L1 + ssim_weight (1 - SSIM)` of pictures `[row, col, channel]`; differentiable in `picture`.

    `weight` `[row, col]` (not negative) turns both means into weighted means; pixels of weight 0 count as equal in both
    pictures, also in the windows of their neighbours. SSIM is computed with values in 0..1, a window of 11x11 pixels
    and zeros outside the picture.
    """
    _check(picture, target, weight)
    if not 0.0 <= ssim_weight <= 1.0:
        raise InputError(f"ssim_weight must lie between 0 and 1; got {ssim_weight}")
    if not target.requires_grad and native.takes(picture, target, weight):
        return native.l1_ssim_native(picture, target, ssim_weight, weight)
    return l1_ssim_reference(picture, target, ssim_weight=ssim_weight, weight=weight)


def l1_ssim_reference(
    picture: Tensor, target: Tensor, *, ssim_weight: float = 0.2, weight: Tensor | None = None
) -> Tensor:
    """`l1_ssim` in plain torch: the specification."""
    if weight is not None:
        target = torch.where((weight > 0)[..., None], target, picture.detach())
    l1 = _mean((picture - target).abs(), weight)
    return (1 - ssim_weight) * l1 + ssim_weight * (1 - _mean(ssim_map(picture, target), weight))


def ssim(picture: Tensor, target: Tensor) -> Tensor:
    """Mean structural similarity (1 for equal pictures) of `[row, col, channel]` with values in 0..1."""
    _check(picture, target, None)
    return ssim_map(picture, target).mean()


def psnr(picture: Tensor, target: Tensor) -> Tensor:
    """Peak signal to noise ratio [dB] of pictures with values in 0..1; infinite for equal ones."""
    _check(picture, target, None)
    return -10 * torch.log10((picture - target).square().mean())


def ssim_map(picture: Tensor, target: Tensor) -> Tensor:
    """Structural similarity `[row, col, channel]` around each pixel: an 11x11 Gaussian window, zeros outside."""
    offset = torch.arange(-SSIM_RADIUS, SSIM_RADIUS + 1, dtype=picture.dtype, device=picture.device)
    window = torch.exp(-0.5 * (offset / SSIM_SIGMA) ** 2)
    window = window / window.sum()

    def blur(image: Tensor) -> Tensor:
        planes = image.permute(2, 0, 1)[:, None]
        planes = torch.nn.functional.conv2d(planes, window[None, None, None, :], padding=(0, SSIM_RADIUS))
        planes = torch.nn.functional.conv2d(planes, window[None, None, :, None], padding=(SSIM_RADIUS, 0))
        return planes[:, 0].permute(1, 2, 0)

    mean_a, mean_b = blur(picture), blur(target)
    variance_a = blur(picture * picture) - mean_a**2
    variance_b = blur(target * target) - mean_b**2
    covariance = blur(picture * target) - mean_a * mean_b
    likeness = (2 * mean_a * mean_b + SSIM_C1) * (2 * covariance + SSIM_C2)
    return likeness / ((mean_a**2 + mean_b**2 + SSIM_C1) * (variance_a + variance_b + SSIM_C2))


def _mean(values: Tensor, weight: Tensor | None) -> Tensor:
    if weight is None:
        return values.mean()
    return (values * weight[..., None]).sum() / (weight.sum() * values.shape[-1])


def _check(picture: Tensor, target: Tensor, weight: Tensor | None) -> None:
    if picture.dim() != 3 or picture.shape != target.shape or picture.numel() == 0:
        raise InputError(
            f"two pictures [row, col, channel] of one size are needed; got {list(picture.shape)} and "
            f"{list(target.shape)}"
        )
    if weight is None:
        return
    if weight.shape != picture.shape[:2]:
        raise InputError(f"weight must be [row, col] = {list(picture.shape[:2])}; got {list(weight.shape)}")
    if not float(weight.detach().sum()) > 0:
        raise InputError("weight must not be negative and must have a positive sum; all pixels are masked")
