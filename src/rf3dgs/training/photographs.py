"""Photographs as the visual stage sees them, and Gaussians as a camera sees them."""

import math
from collections.abc import Sequence
from typing import Literal

import torch
from torch import Tensor

from rf3dgs.core.errors import InputError
from rf3dgs.core.grids import Camera
from rf3dgs.data.photo import Photo
from rf3dgs.splats.draw import draw
from rf3dgs.splats.gaussians import Gaussians
from rf3dgs.splats.rasterize import rasterize

LONGEST = 3.0
BackendName = Literal["auto", "native", "reference", "gsplat"]


def render_photo(gaussians: Gaussians, camera: Camera, *, backend: BackendName = "auto") -> Tensor:
    """The photograph `[row, col, 3]`, 0 to 1, that `camera` would take of the Gaussians, on black."""
    return draw(gaussians, camera, backend=backend).values.clamp(0.0, 1.0)


def blending_weights(gaussians: Gaussians, cameras: Sequence[Camera], *, backend: BackendName = "auto") -> Tensor:
    """How much of all pictures each Gaussian makes `[gaussian]`: its blending weights summed, in pixels."""
    unit = torch.ones(len(gaussians), 1, requires_grad=True)
    now = gaussians.detach()
    args = now.means, now.quats, now.scales, now.opacities, unit
    for camera in cameras:
        rasterize(*args, camera, backend=backend).values.sum().backward()
    return torch.zeros(len(gaussians)) if unit.grad is None else unit.grad[:, 0]


def picture_of(photo: Photo) -> Tensor:
    """The photograph as bytes `[row, col, 3]`, which take a quarter of the memory; checked against its camera."""
    camera, picture = photo.camera, photo.load()
    expected = [camera.height, camera.width, 3]
    if list(picture.shape) != expected:
        raise InputError(f"photo {photo.name} must be {expected} as its camera says; got {list(picture.shape)}")
    if not all(bool(torch.isfinite(tensor).all()) for tensor in (camera.viewmat, camera.K, picture)):
        raise InputError(f"photo {photo.name} or its camera has NaN or infinite values; remove it or mend its source")
    return (picture.clamp(0.0, 1.0) * 255.0).round().to(torch.uint8)


def shrunk(camera: Camera, picture: Tensor, factor: int) -> tuple[Camera, Tensor]:
    """Camera and picture `[row, col, 3]`, 0 to 1, at a `factor`th of the resolution: pixels are means over areas."""
    target = picture.float() / 255.0
    if factor == 1:
        return camera, target
    size = max(1, round(camera.height / factor)), max(1, round(camera.width / factor))
    smaller = torch.nn.functional.interpolate(target.permute(2, 0, 1)[None], size=size, mode="area")
    return camera.resized(size[1], size[0]), smaller[0].permute(1, 2, 0).contiguous()


def depth_error(drawn: Tensor, known: Tensor) -> Tensor:
    """Mean relative error of a drawn depth map `[row, col]` where a smaller one is known (above 0)."""
    expected = torch.nn.functional.interpolate(known[None, None], size=drawn.shape, mode="nearest")[0, 0]
    counts = expected > 0
    relative = torch.where(counts, drawn / expected.clamp_min(1e-6) - 1, 0.0)
    return relative.abs().clamp_max(1.0).sum() / drawn.numel()


def clamp_needles(log_scales: Tensor, largest: float) -> None:
    """Bound scales in place: none above `largest` [m], the longest at most three times the middle one."""
    log_scales.clamp_max_(math.log(largest))
    torch.minimum(log_scales, log_scales.median(-1, keepdim=True).values + math.log(LONGEST), out=log_scales)
