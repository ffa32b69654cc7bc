"""The rasterizer in plain torch: the specification that every backend is measured against.

It is differentiable by autograd, works in the dtype of `means` (float64 for gradient checks), and needs memory for
every pair of a Gaussian and a pixel of a chunk. Where Gaussians lie is `splats.projection`; blending is Kerbl et al.,
3D Gaussian splatting (2023), eq. 3. What becomes of the blended channels is `splats.compositing`.
"""

from collections.abc import Callable

import torch
from torch import Tensor

from rf3dgs.core.grids import Camera, Panorama, View
from rf3dgs.splats.constants import (
    ALPHA_MAX,
    ALPHA_MIN,
    BLUR,
    GATE_TRANSMITTANCE,
    NEAR,
    SPHERE_FIELD,
    TRANSMITTANCE_STOP,
)
from rf3dgs.splats.projection import (
    extent,
    largest_eigenvalue,
    pixel_area,
    project,
    project_sphere,
    sphere_directions,
)
from rf3dgs.splats.raster import Raster

_PAIRS_PER_CHUNK = 8_000_000


def rasterize_reference(
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
    """Blend `values` `[gaussian, channel]` front to back into the picture that `view` sees.

    `means` `[gaussian, 3]` [m], `quats` `[gaussian, 4]` (wxyz, any length), `scales` `[gaussian, 3]` [m] and
    `opacities` `[gaussian]` are activated values. `background` `[channel]` fills what the Gaussians let through;
    `screen_offset` `[gaussian, 2]` [pixel] moves the projected centres of a camera's view; `blur` [pixel^2] and
    `depth_gate` [m] are `Compositing`'s. Gaussians that are not finite, have a zero quaternion, a negative scale or an
    opacity below 1/255, or lie before the near plane or beside the picture, are not drawn.
    """
    index, radii = _drawn(means, quats, scales, opacities, values, view, screen_offset, blur)
    shape = means[index], quats[index], scales[index]
    if isinstance(view, Camera):
        pixels, depth, power = _on_camera(*shape, view, None if screen_offset is None else screen_offset[index], blur)
    else:
        pixels, depth, power = _on_sphere(*shape, view, blur)
    picture, weight = [], []
    for pixel in pixels.split(max(1, _PAIRS_PER_CHUNK // max(1, len(index)))):
        alpha = (opacities[index, None] * torch.exp(power(pixel))).clamp_max(ALPHA_MAX)
        alpha = torch.where(alpha < ALPHA_MIN, 0.0, alpha)
        if depth_gate is not None and len(index):
            alpha = torch.where(depth[:, None] > _last_depth(alpha, depth) + depth_gate, 0.0, alpha)
        after = torch.cumprod(1 - alpha, 0)
        before = torch.cat((torch.ones_like(after[:1]), after[:-1]))
        blending = torch.where(after < TRANSMITTANCE_STOP, 0.0, before * alpha)
        picture.append(blending.mT @ values[index])
        weight.append(blending.sum(0))
    total = torch.cat(weight)
    result = torch.cat(picture)
    if background is not None:
        result = result + (1 - total)[:, None] * background
    size = (view.height, view.width)
    return Raster(result.reshape(*size, -1), total.reshape(size), radii)


def _on_camera(
    means: Tensor, quats: Tensor, scales: Tensor, camera: Camera, offset: Tensor | None, blur: float
) -> tuple[Tensor, Tensor, Callable[[Tensor], Tensor]]:
    """Pixels, depths, and the function of pixels that gives each Gaussian's exponent `[gaussian, pixel]`."""
    centre, covariance, depth = project(means, quats, scales, camera, blur)
    centre = centre if offset is None else centre + offset
    inverse = torch.linalg.inv(covariance)
    row, col = torch.meshgrid(torch.arange(camera.height), torch.arange(camera.width), indexing="ij")
    pixels = torch.stack((col.flatten(), row.flatten()), -1).to(means) + 0.5

    def power(pixel: Tensor) -> Tensor:
        away = pixel[None] - centre[:, None]
        return -0.5 * torch.einsum("gpi,gij,gpj->gp", away, inverse, away)

    return pixels, depth, power


def _on_sphere(
    means: Tensor, quats: Tensor, scales: Tensor, view: Panorama, blur: float
) -> tuple[Tensor, Tensor, Callable[[Tensor], Tensor]]:
    """The same on the sphere, where pixels are directions `[pixel, 3]` and meet each Gaussian's tangent plane."""
    direction, axes, covariance, distance = project_sphere(means, quats, scales, view, blur)
    inverse = torch.linalg.inv(covariance)

    def power(pixel: Tensor) -> Tensor:
        cosine = direction @ pixel.mT
        faces = cosine > SPHERE_FIELD
        away = torch.einsum("gip,gp->gpi", axes @ pixel.mT, 1 / torch.where(faces, cosine, 1.0))
        exponent = -0.5 * torch.einsum("gpi,gij,gpj->gp", away, inverse, away)
        return torch.where(faces, exponent, -torch.inf)

    return sphere_directions(view, means), distance, power


def _drawn(
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    opacities: Tensor,
    values: Tensor,
    view: View,
    offset: Tensor | None,
    blur: float,
) -> tuple[Tensor, Tensor]:
    """Indices of the Gaussians that are drawn, front to back, and everyone's radius `[gaussian]` [pixel]."""
    with torch.no_grad():
        if isinstance(view, Camera):
            centre, covariance, depth = project(means, quats, scales, view, blur)
            centre = centre if offset is None else centre + offset
            reach = extent(opacities)[:, None] * covariance.diagonal(dim1=-2, dim2=-1).clamp_min(0).sqrt()
            inside = ((centre + reach > 0) & (centre - reach < centre.new_tensor([view.width, view.height]))).all(-1)
            pixel = 1.0
        else:
            centre, _, covariance, depth = project_sphere(means, quats, scales, view, blur)
            inside = torch.ones_like(depth, dtype=torch.bool)
            pixel = pixel_area(view) ** 0.5
        drawn = inside & (depth > NEAR) & (opacities >= ALPHA_MIN) & (scales >= 0).all(-1)
        drawn &= torch.linalg.det(covariance) > 0
        for tensor in (centre, covariance.flatten(1), depth[:, None], opacities[:, None], values):
            drawn &= torch.isfinite(tensor).all(-1)
        radii = torch.where(drawn, extent(opacities) * largest_eigenvalue(covariance).sqrt() / pixel, 0.0)
        index = drawn.nonzero().squeeze(-1)
        return index[torch.argsort(depth[index], stable=True)], radii


def _last_depth(alpha: Tensor, depth: Tensor) -> Tensor:
    """Depth `[pixel]` of the Gaussian that brings the transmittance below a half; infinite where none does."""
    with torch.no_grad():
        below = torch.cumprod(1 - alpha, 0) < GATE_TRANSMITTANCE
        first = depth[below.to(torch.uint8).argmax(0)]
        return torch.where(below[-1], first, torch.inf)
