"""The rasterizer in plain torch: the specification that every backend is measured against.

It is differentiable by autograd, works in the dtype of `means` (float64 for gradient checks), and needs memory for
every pair of a Gaussian and a pixel of a chunk. Zwicker et al., EWA volume splatting (2001); Kerbl et al., 3D Gaussian
splatting (2023), eqs. 3 to 6.
"""

import torch
from torch import Tensor

from rf3dgs.core.frames import matrix_from_quaternion
from rf3dgs.core.grids import Camera
from rf3dgs.splats.constants import ALPHA_MAX, ALPHA_MIN, BLUR, FIELD_CLAMP, NEAR, TRANSMITTANCE_STOP
from rf3dgs.splats.raster import Raster

_PAIRS_PER_CHUNK = 8_000_000


def rasterize_reference(
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    opacities: Tensor,
    values: Tensor,
    camera: Camera,
    *,
    background: Tensor | None = None,
    screen_offset: Tensor | None = None,
) -> Raster:
    """Blend `values` `[gaussian, channel]` front to back into the picture that `camera` sees.

    `means` `[gaussian, 3]` [m], `quats` `[gaussian, 4]` (wxyz, any length), `scales` `[gaussian, 3]` [m] and
    `opacities` `[gaussian]` are activated values. `background` `[channel]` fills what the Gaussians let through;
    `screen_offset` `[gaussian, 2]` [pixel] moves the projected centres. Gaussians that are not finite, have a zero
    quaternion, a negative scale or an opacity below 1/255, or lie before the near plane or beside the picture, are not
    drawn.
    """
    offset = means.new_zeros(len(means), 2) if screen_offset is None else screen_offset
    with torch.no_grad():
        centre, covariance, depth = project(means, quats, scales, camera)
        centre = centre + offset
        reach = extent(opacities)[:, None] * covariance.diagonal(dim1=-2, dim2=-1).clamp_min(0).sqrt()
        size = centre.new_tensor([camera.width, camera.height])
        drawn = (depth > NEAR) & (opacities >= ALPHA_MIN) & (scales >= 0).all(-1) & (torch.linalg.det(covariance) > 0)
        drawn &= ((centre + reach > 0) & (centre - reach < size)).all(-1)
        for tensor in (centre, covariance.flatten(1), opacities[:, None], values):
            drawn &= torch.isfinite(tensor).all(-1)
        radii = torch.where(drawn, extent(opacities) * largest_eigenvalue(covariance).sqrt(), 0.0)
        index = drawn.nonzero().squeeze(-1)
        index = index[torch.argsort(depth[index], stable=True)]

    centre, covariance, _ = project(means[index], quats[index], scales[index], camera)
    centre = centre + offset[index]
    inverse = torch.linalg.inv(covariance)
    row, col = torch.meshgrid(torch.arange(camera.height), torch.arange(camera.width), indexing="ij")
    pixels = torch.stack((col.flatten(), row.flatten()), -1).to(means.dtype) + 0.5
    picture, weight = [], []
    for pixel in pixels.split(max(1, _PAIRS_PER_CHUNK // max(1, len(index)))):
        offset_of = pixel[None] - centre[:, None]
        power = -0.5 * torch.einsum("gpi,gij,gpj->gp", offset_of, inverse, offset_of)
        alpha = (opacities[index, None] * torch.exp(power)).clamp_max(ALPHA_MAX)
        alpha = torch.where(alpha < ALPHA_MIN, 0.0, alpha)
        after = torch.cumprod(1 - alpha, 0)
        before = torch.cat((torch.ones_like(after[:1]), after[:-1]))
        blending = torch.where(after < TRANSMITTANCE_STOP, 0.0, before * alpha)
        picture.append(blending.mT @ values[index])
        weight.append(blending.sum(0))
    total = torch.cat(weight)
    result = torch.cat(picture)
    if background is not None:
        result = result + (1 - total)[:, None] * background
    shape = (camera.height, camera.width)
    return Raster(result.reshape(*shape, -1), total.reshape(shape), radii)


def project(means: Tensor, quats: Tensor, scales: Tensor, camera: Camera) -> tuple[Tensor, Tensor, Tensor]:
    """Centres `[gaussian, 2]` [pixel], covariances `[gaussian, 2, 2]` [pixel^2] and view depths `[gaussian]` [m].

    The covariance is J W Sigma W^T J^T plus the blur, where J is the Jacobian of the pinhole projection at a point
    whose x/z and y/z are kept within 1.3 times the field, each side measured from the principal point.
    """
    viewmat, K = camera.viewmat.to(means.dtype), camera.K.to(means.dtype)
    rotation = viewmat[:3, :3]
    x, y, z = (means @ rotation.mT + viewmat[:3, 3]).unbind(-1)
    fx, fy, cx, cy = K[0, 0], K[1, 1], K[0, 2], K[1, 2]
    centre = torch.stack((fx * x / z + cx, fy * y / z + cy), -1)
    u = torch.clamp(x / z, -FIELD_CLAMP * cx / fx, FIELD_CLAMP * (camera.width - cx) / fx)
    v = torch.clamp(y / z, -FIELD_CLAMP * cy / fy, FIELD_CLAMP * (camera.height - cy) / fy)
    zero = torch.zeros_like(z)
    first = torch.stack((fx / z, zero, -fx * u / z), -1)
    second = torch.stack((zero, fy / z, -fy * v / z), -1)
    spread = torch.stack((first, second), -2) @ rotation @ matrix_from_quaternion(quats) * scales[:, None, :]
    return centre, spread @ spread.mT + BLUR * torch.eye(2, dtype=means.dtype), z


def extent(opacities: Tensor) -> Tensor:
    """How many standard deviations `[gaussian]` a Gaussian reaches before its alpha falls below 1/255."""
    return torch.sqrt(2 * torch.log((opacities / ALPHA_MIN).clamp_min(1.0)))


def largest_eigenvalue(covariance: Tensor) -> Tensor:
    """The larger eigenvalue `[gaussian]` of symmetric `[gaussian, 2, 2]`."""
    middle = 0.5 * (covariance[:, 0, 0] + covariance[:, 1, 1])
    half = 0.5 * (covariance[:, 0, 0] - covariance[:, 1, 1])
    return middle + torch.sqrt(half**2 + covariance[:, 0, 1] ** 2)
