"""How exact pictures of the sphere are: projected Gaussians against the response of the 3D Gaussian along each ray.

    python -m benchmarks.quality.sphere

Exact is alpha = opacity * (largest density along the ray), composited in order of range. Compared with it are the
tangent planes of `Panorama` and the pinhole projection on the faces of a cube. The blur, an isotropic variance of the
projected Gaussian, is given to the exact one as the same variance in space at the Gaussian's range. Errors are of
alpha, over all pixels where either alpha is above 1/255, for single Gaussians of opacity 0.9 of one angular size (the
largest standard deviation seen from the receiver), flat and turned at random, anywhere, near the poles and near the
seam; and of a channel of many Gaussians together.
"""

import math

import torch
from torch import Tensor

from rf3dgs.core.cube import device_from_faces
from rf3dgs.core.frames import Pose, matrix_from_quaternion
from rf3dgs.core.grids import Camera, Panorama, equirect_grid, pinhole_grid
from rf3dgs.splats.constants import ALPHA_MAX, ALPHA_MIN, BLUR
from rf3dgs.splats.projection import pixel_area, project, project_sphere, sphere_directions

SIZES_DEG = (0.3, 1.0, 2.0, 5.0, 10.0, 20.0)
F64 = torch.float64
PLACES = {"anywhere": (1.0, 1.0, 1.0), "poles": (0.05, 0.05, 1.0), "seam": (1.0, 0.05, 0.6)}


def gaussians(count: int, size: float, place: str, generator: torch.Generator) -> list[Tensor]:
    """Means, quats and scales of Gaussians around the origin whose largest standard deviation is `size` [rad]."""
    squeeze = torch.tensor(PLACES[place], dtype=F64)
    direction = torch.randn(count, 3, generator=generator, dtype=F64) * squeeze
    if place == "seam":
        direction[:, 0] = -direction[:, 0].abs() - 1
    distance = 1 + 4 * torch.rand(count, 1, generator=generator, dtype=F64)
    shape = torch.tensor([1.0, 0.6, 0.1], dtype=F64)
    means = distance * torch.nn.functional.normalize(direction, dim=-1)
    return [means, torch.randn(count, 4, generator=generator, dtype=F64), size * distance * shape]


def exact(means: Tensor, quats: Tensor, scales: Tensor, directions: Tensor, blur: float) -> Tensor:
    """The exponent `[gaussian, ray]` at the largest density along each ray `[ray, 3]` from the origin."""
    spread = matrix_from_quaternion(quats) * scales[:, None, :]
    distance = torch.linalg.vector_norm(means, dim=-1)
    covariance = spread @ spread.mT + (blur * distance**2)[:, None, None] * torch.eye(3, dtype=F64)
    inverse = torch.linalg.inv(covariance)
    along = torch.einsum("rj,gjk->grk", directions, inverse)
    cross, square = torch.einsum("grk,gk->gr", along, means), torch.einsum("grk,rk->gr", along, directions)
    offset = torch.einsum("gi,gij,gj->g", means, inverse, means)[:, None]
    return -0.5 * torch.where(cross > 0, offset - cross**2 / square, offset)


def tangent(means: Tensor, quats: Tensor, scales: Tensor, view: Panorama) -> Tensor:
    """The exponent `[gaussian, pixel]` in the tangent planes."""
    direction, axes, covariance, _ = project_sphere(means, quats, scales, view)
    pixels = sphere_directions(view, means)
    cosine = direction @ pixels.mT
    away = torch.einsum("gip,gp->gpi", axes @ pixels.mT, 1 / cosine.clamp_min(0.2))
    exponent = -0.5 * torch.einsum("gpi,gij,gpj->gp", away, torch.linalg.inv(covariance), away)
    return torch.where(cosine > 0.2, exponent, -torch.inf)


def cube(means: Tensor, quats: Tensor, scales: Tensor, view: Panorama) -> Tensor:
    """The exponent `[gaussian, pixel]` of pinhole projections on six faces whose middle pixels are as wide."""
    directions = view.grid.directions.reshape(-1, 3).double()
    size = view.width / math.pi
    K = torch.tensor([[0.5 * size, 0.0, 0.5 * size], [0.0, 0.5 * size, 0.5 * size], [0.0, 0.0, 1.0]])
    grid = pinhole_grid(math.ceil(size), math.ceil(size), K=K)
    rotations = device_from_faces()
    face = (directions @ rotations[:, :, 0].double().mT).argmax(-1)
    result = torch.full((len(means), len(directions)), -torch.inf, dtype=F64)
    for number in range(6):
        pose = Pose.from_matrix(torch.zeros(3), rotations[number])
        centre, covariance, depth = project(means, quats, scales, Camera.of(pose, grid))
        chosen = (face == number).nonzero().squeeze(-1)
        pixel, _ = grid.pixel_of(pose.to_device(directions[chosen].float()))
        away = pixel.double()[None] - centre[:, None]
        exponent = -0.5 * torch.einsum("gpi,gij,gpj->gp", away, torch.linalg.inv(covariance), away)
        result[:, chosen] = torch.where(depth[:, None] > 0.05, exponent, -torch.inf)
    return result


def alpha_of(exponent: Tensor, opacity: float) -> Tensor:
    """Alpha with the rasterizer's limits."""
    alpha = (opacity * torch.exp(exponent)).clamp_max(ALPHA_MAX)
    return torch.where(alpha < ALPHA_MIN, 0.0, alpha)


def composited(exponent: Tensor, distance: Tensor, values: Tensor) -> Tensor:
    """Channels `[pixel, channel]` of Gaussians of opacity 0.9 in order of range."""
    order = torch.argsort(distance)
    alpha = alpha_of(exponent[order], 0.9)
    after = torch.cumprod(1 - alpha, 0)
    return (alpha * torch.cat((torch.ones_like(after[:1]), after[:-1]))).mT @ values[order]


def line_of(error: Tensor) -> str:
    median, high = torch.quantile(error[:: max(1, len(error) // 10**6)], torch.tensor([0.5, 0.95], dtype=F64))
    return f"{float(median):.4f} / {float(high):.4f} / {float(error.max()):.4f}"


def main() -> None:
    view = Panorama.of(Pose((0.0, 0.0, 0.0)), equirect_grid(180, 90))
    directions, blur = view.grid.directions.reshape(-1, 3).double(), BLUR * pixel_area(view)
    generator = torch.Generator().manual_seed(0)
    print("error of alpha, median / 95 % / largest\n\n| size [deg] | where | tangent plane | pinhole on cube faces |")
    print("|---|---|---|---|")
    for size in SIZES_DEG:
        for place in PLACES:
            shape = gaussians(60, math.radians(size), place, generator)
            truth = alpha_of(exact(*shape, directions, blur), 0.9)
            cells = []
            for way in (tangent, cube):
                alpha = alpha_of(way(*shape, view), 0.9)
                cells.append(line_of((alpha - truth)[(alpha > 0) | (truth > 0)].abs()))
            print(f"| {size} | {place} | {' | '.join(cells)} |")
    print("\n3000 Gaussians of 2 degrees, error of a channel between 0 and 1")
    shape = gaussians(3000, math.radians(2.0), "anywhere", generator)
    values = torch.rand(3000, 1, generator=generator, dtype=F64)
    distance = shape[0].norm(dim=-1)
    truth = composited(exact(*shape, directions, blur), distance, values)
    for name, way in (("tangent plane", tangent), ("pinhole on cube faces", cube)):
        error = (composited(way(*shape, view), distance, values) - truth).abs().flatten()
        print(f"{name}: {line_of(error)}")


if __name__ == "__main__":
    main()
