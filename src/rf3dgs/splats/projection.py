"""Where Gaussians lie in a picture and how far they spread: the specification of both kinds of view.

A camera sees a Gaussian as the normal distribution that the linearised projection makes of it (Zwicker et al., EWA
volume splatting, 2001). A panorama sees it through the plane that touches the unit sphere in the Gaussian's own
direction, where the same linearisation needs no limits: there is no edge of a field, and no direction is worse than
another.
"""

import math

import torch
from torch import Tensor

from rf3dgs.core.frames import matrix_from_quaternion
from rf3dgs.core.grids import Camera, Panorama
from rf3dgs.splats.constants import ALPHA_MIN, BLUR, FIELD_CLAMP


def project(
    means: Tensor, quats: Tensor, scales: Tensor, camera: Camera, blur: float = BLUR
) -> tuple[Tensor, Tensor, Tensor]:
    """Centres `[gaussian, 2]` [pixel], covariances `[gaussian, 2, 2]` [pixel^2] and view depths `[gaussian]` [m].

    The covariance is J W Sigma W^T J^T plus the `blur` [pixel^2], where J is the Jacobian of the pinhole projection at
    a point whose x/z and y/z are kept within 1.3 times the field, each side measured from the principal point.
    """
    viewmat, K = camera.viewmat.to(means), camera.K.to(means)
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
    return centre, spread @ spread.mT + blur * torch.eye(2, dtype=means.dtype, device=means.device), z


def project_sphere(
    means: Tensor, quats: Tensor, scales: Tensor, view: Panorama, blur: float = BLUR
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Directions `[gaussian, 3]`, tangent axes `[gaussian, 2, 3]`, covariances `[gaussian, 2, 2]` [rad^2], ranges [m].

    Unit vectors in the camera frame. With m the direction at range r and E the two axes, any that are orthonormal and
    at right angles to m, the covariance in the tangent plane is E W Sigma W^T E^T / r^2 plus the blur, which is as many
    square radians as `blur` square pixels have at the equator, the same in all directions.
    """
    viewmat = view.viewmat.to(means)
    rotation = viewmat[:3, :3]
    seen = means @ rotation.mT + viewmat[:3, 3]
    distance = torch.linalg.vector_norm(seen, dim=-1)
    direction = seen / distance[:, None]
    axes = tangent_axes(direction)
    spread = axes @ rotation @ matrix_from_quaternion(quats) * (scales / distance[:, None])[:, None, :]
    widened = spread @ spread.mT + blur * pixel_area(view) * torch.eye(2, dtype=means.dtype, device=means.device)
    return direction, axes, widened, distance


def tangent_axes(direction: Tensor) -> Tensor:
    """Two unit vectors `[*batch, 2, 3]` at right angles to unit vectors `[*batch, 3]` and to each other.

    Without a branch that loses digits: Duff et al., Building an orthonormal basis, revisited (2017).
    """
    x, y, z = direction.unbind(-1)
    sign = torch.where(z < 0, -1.0, 1.0).to(direction)
    a = -1 / (sign + z)
    b = x * y * a
    first = torch.stack((1 + sign * x * x * a, sign * b, -sign * x), -1)
    return torch.stack((first, torch.stack((b, sign + y * y * a, -y), -1)), -2)


def pixel_area(view: Panorama) -> float:
    """The solid angle of a pixel at the equator, d phi times d theta [rad^2]."""
    return 2 * math.pi / view.width * math.pi / view.height


def sphere_directions(view: Panorama, like: Tensor) -> Tensor:
    """Unit directions `[pixel, 3]` of a panorama's pixels, row by row, in the camera frame, in the dtype of `like`."""
    turn = (torch.arange(view.width, dtype=torch.float64) + 0.5) * (2 * math.pi / view.width)
    zenith = (torch.arange(view.height, dtype=torch.float64) + 0.5) * (math.pi / view.height)
    zenith, turn = torch.meshgrid(zenith, turn, indexing="ij")
    sine = torch.sin(zenith)
    grid = torch.stack((-sine * torch.sin(turn), -torch.cos(zenith), -sine * torch.cos(turn)), -1)
    return grid.reshape(-1, 3).to(like)


def extent(opacities: Tensor) -> Tensor:
    """How many standard deviations `[gaussian]` a Gaussian reaches before its alpha falls below 1/255."""
    return torch.sqrt(2 * torch.log((opacities / ALPHA_MIN).clamp_min(1.0)))


def largest_eigenvalue(covariance: Tensor) -> Tensor:
    """The larger eigenvalue `[gaussian]` of symmetric `[gaussian, 2, 2]`."""
    middle = 0.5 * (covariance[:, 0, 0] + covariance[:, 1, 1])
    half = 0.5 * (covariance[:, 0, 0] - covariance[:, 1, 1])
    return middle + torch.sqrt(half**2 + covariance[:, 0, 1] ** 2)
