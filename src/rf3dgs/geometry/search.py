"""The planes of a cloud of Gaussians: RANSAC on their normals, refined on what lies on them, each Gaussian on one."""

import math

import torch
from torch import Tensor

from rf3dgs.core.frames import matrix_from_quaternion
from rf3dgs.geometry.config import SurfaceConfig
from rf3dgs.geometry.patches import CELL, Patches, footprints, widths
from rf3dgs.geometry.planes import Planes
from rf3dgs.splats.gaussians import Gaussians

SAMPLE = 16_000
TRIALS = 256
REFINEMENTS = 4
FAILURES = 12  # candidates that may fail in a row before the search ends


def search_planes(
    gaussians: Gaussians, normals: Tensor, mass: Tensor, config: SurfaceConfig
) -> tuple[Planes, Tensor, Patches]:
    """Planes, largest first, the plane of each Gaussian `[gaussian]` (-1 none), and where the planes have surface.

    `normals` `[gaussian, 3]` may have either sign; `mass` `[gaussian]` [m^2] is how much surface each covers.
    """
    generator = torch.Generator().manual_seed(config.seed)
    points, directions = gaussians.means.double(), normals.double()
    opaque = gaussians.opacities >= config.min_opacity
    weight = torch.where(opaque, mass.clamp_max(mass.quantile(0.98)), 0.0).double()
    spots, owner = _spots(gaussians)
    rest = opaque.clone()
    found: list[tuple[Tensor, Tensor]] = []
    failures = 0
    while len(found) < config.max_planes and failures < FAILURES and bool(rest.any()):
        index = rest.nonzero().squeeze(-1)
        if len(index) > SAMPLE:
            index = index[torch.randperm(len(index), generator=generator)[:SAMPLE]]
        plane = _best(points[index], directions[index], weight[index], config, generator)
        normal, offset = _refined(points, directions, weight, rest, plane, config)
        lies = rest & _lies(points, directions, normal, offset, config)
        if not _is_surface(gaussians.means, spots, owner, lies, normal, config):
            failures += 1
            rest &= ~(lies & _lies(points, directions, normal, offset, config))
            continue
        failures = 0
        found.append((normal, offset))
        rest &= ~lies
    if not found:
        none = Planes(torch.zeros(0, 3), torch.zeros(0))
        return none, torch.full((len(points),), -1), Patches.of(none, [])
    planes = Planes(torch.stack([item[0] for item in found]).float(), torch.stack([item[1] for item in found]).float())
    return _settled(gaussians, normals, planes, spots, owner, config)


def _best(
    points: Tensor, directions: Tensor, weight: Tensor, config: SurfaceConfig, generator: torch.Generator
) -> tuple[Tensor, Tensor]:
    """The candidate plane, through a Gaussian along its normal, on which most mass lies."""
    trial = torch.multinomial(weight.clamp_min(1e-12), TRIALS, replacement=True, generator=generator)
    normals = directions[trial]
    offsets = (normals * points[trial]).sum(-1)
    near = ((points @ normals.mT) - offsets).abs() < config.tolerance
    alike = (directions @ normals.mT).abs() > math.cos(math.radians(config.angle_deg))
    score = weight @ (near & alike).double()
    best = int(score.argmax())
    return normals[best], offsets[best]


def _refined(
    points: Tensor,
    directions: Tensor,
    weight: Tensor,
    rest: Tensor,
    plane: tuple[Tensor, Tensor],
    config: SurfaceConfig,
) -> tuple[Tensor, Tensor]:
    """The plane fitted to what lies on it, weighted by mass, a few times over."""
    normal, offset = plane
    for _ in range(REFINEMENTS):
        lies = rest & _lies(points, directions, normal, offset, config)
        part, share = points[lies], weight[lies][:, None]
        if len(part) < 3:
            break
        centre = (share * part).sum(0) / share.sum()
        centred = part - centre
        fitted = torch.linalg.eigh(centred.mT @ (share * centred)).eigenvectors[:, 0]
        normal = fitted if float(fitted @ normal) > 0 else -fitted
        offset = normal @ centre
    return normal, offset


def _lies(points: Tensor, directions: Tensor, normal: Tensor, offset: Tensor, config: SurfaceConfig) -> Tensor:
    near = (points @ normal - offset).abs() < config.tolerance
    return near & ((directions @ normal).abs() > math.cos(math.radians(config.angle_deg)))


def _is_surface(
    means: Tensor, spots: Tensor, owner: Tensor, lies: Tensor, normal: Tensor, config: SurfaceConfig
) -> bool:
    """Whether what lies on a plane covers enough of it, in both directions."""
    part = spots[lies[owner]]
    if int(lies.sum()) < 3:
        return False
    patch = Patches.of(Planes(normal[None].float(), torch.zeros(1)), [part])
    if float(patch.cells.sum()) * CELL**2 < config.min_area:
        return False
    return widths(means[lies], patch.axes[0])[1] > config.min_width


def _settled(
    gaussians: Gaussians, normals: Tensor, planes: Planes, spots: Tensor, owner: Tensor, config: SurfaceConfig
) -> tuple[Planes, Tensor, Patches]:
    """Every Gaussian on the nearest plane that has surface there, planes by area."""
    distance = (gaussians.means @ planes.normals.mT - planes.offsets).abs()
    alike = (normals @ planes.normals.mT).abs() > math.cos(math.radians(config.angle_deg))
    opaque = (gaussians.opacities >= config.min_opacity)[:, None]
    near, plane = torch.where((distance < config.tolerance) & alike & opaque, distance, math.inf).min(-1)
    plane_of = torch.where(near < math.inf, plane, -1)
    patches = Patches.of(planes, [spots[plane_of[owner] == index] for index in range(len(planes))])
    order = patches.areas.argsort(descending=True)
    planes = Planes(planes.normals[order], planes.offsets[order])
    place = torch.empty_like(order)
    place[order] = torch.arange(len(order))
    plane_of = torch.where(plane_of >= 0, place[plane_of.clamp_min(0)], -1)
    patches = Patches.of(planes, [spots[plane_of[owner] == index] for index in range(len(planes))])
    return planes, plane_of, patches


def _spots(gaussians: Gaussians) -> tuple[Tensor, Tensor]:
    """Points `[spot, 3]` over the Gaussians' footprints and the Gaussian `[spot]` of each."""
    axes = matrix_from_quaternion(gaussians.quats)
    order = gaussians.log_scales.argsort(-1, descending=True)[:, :2]
    longer = axes.gather(-1, order[:, None].expand(-1, 3, -1))
    scales = gaussians.scales.gather(-1, order).clamp_max(0.3)
    spots = footprints(gaussians.means, longer, scales)
    return spots.flatten(0, 1), torch.arange(len(spots)).repeat_interleave(spots.shape[1])
