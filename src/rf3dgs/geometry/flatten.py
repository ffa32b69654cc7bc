"""Gaussians put flat onto their planes: haze in front of a wall becomes a wall."""

from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from rf3dgs.core.errors import InputError
from rf3dgs.core.frames import matrix_from_quaternion, quaternion_from_matrix
from rf3dgs.core.grids import Camera
from rf3dgs.geometry.config import SurfaceConfig
from rf3dgs.geometry.photometric import refine_planes
from rf3dgs.geometry.planes import Planes
from rf3dgs.geometry.surfaces import Surfaces, find_surfaces
from rf3dgs.splats.gaussians import Gaussians

THICKNESS = 0.007  # largest scale across the plane [m], as that of Gaussians on a mesh
TRUSTED = 0.5  # least agreement of the photographs on a plane that Gaussians are moved to


def flatten(
    gaussians: Gaussians,
    viewpoints: Tensor,
    cameras: Sequence[Camera] = (),
    pictures: Sequence[Tensor] = (),
    config: SurfaceConfig | None = None,
) -> Gaussians:
    """The Gaussians, those on planes flat on them; with photographs, on the planes as the photographs have them.

    `viewpoints` `[view, 3]` [m] as for `find_surfaces`, `pictures` bytes `[row, col, 3]` of `cameras`. With photographs
    only planes on which they agree count. Raises InputError where cameras and pictures differ in number.
    """
    if len(cameras) != len(pictures):
        raise InputError(f"flatten needs a picture for each camera; got {len(cameras)} and {len(pictures)}")
    surfaces = find_surfaces(gaussians, viewpoints, config)
    if not cameras:
        return flattened(gaussians, surfaces, surfaces.planes, torch.ones(len(surfaces.planes), dtype=torch.bool))
    planes, agreement = refine_planes(gaussians, surfaces.planes, surfaces.patches, cameras, pictures)
    return flattened(gaussians, surfaces, planes, agreement > TRUSTED)


def flattened(gaussians: Gaussians, surfaces: Surfaces, planes: Planes, chosen: Tensor) -> Gaussians:
    """The Gaussians, those on the planes `chosen` `[plane]` moved onto `planes`, which may differ from the surfaces'.

    Each is moved along the normal; its two longer axes are projected onto the plane, and across it it becomes thin.
    """
    chosen = torch.cat((chosen, chosen.new_zeros(1)))  # the last one is that of plane -1
    return onto_planes(gaussians, torch.where(chosen[surfaces.plane_of], surfaces.plane_of, -1), planes)


def onto_planes(gaussians: Gaussians, plane_of: Tensor, planes: Planes) -> Gaussians:
    """The Gaussians, each moved along the normal onto its plane `plane_of` `[gaussian]` (-1: none) and made flat there.

    Its two longer axes are projected onto the plane; across it it is `THICKNESS` thin.
    """
    mine = plane_of >= 0
    if not bool(mine.any()):
        return gaussians
    normal, offset = planes.normals[plane_of[mine]], planes.offsets[plane_of[mine]]
    means = gaussians.means.clone()
    means[mine] -= ((means[mine] * normal).sum(-1) - offset)[:, None] * normal
    axes = matrix_from_quaternion(gaussians.quats[mine]) * gaussians.scales[mine][:, None]
    across = axes - normal[:, :, None] * (normal[:, None] @ axes)
    along, spread, _ = torch.linalg.svd(across, full_matrices=True)
    turn = torch.stack((along[..., 0], torch.linalg.cross(normal, along[..., 0], dim=-1), normal), -1)
    scales = torch.cat((spread[:, :2].clamp_min(1e-4), spread.new_full((len(spread), 1), THICKNESS)), 1)
    scales[:, 2] = torch.minimum(scales[:, 2], scales[:, 1])
    quats, log_scales = gaussians.quats.clone(), gaussians.log_scales.clone()
    quats[mine], log_scales[mine] = quaternion_from_matrix(turn), scales.log()
    return replace(gaussians, means=means, quats=quats, log_scales=log_scales)
