"""Planes of photographs made whole and square for mirrors.

Photographs leave walls in pieces that lie a little beside each other; for mirrors a wall is one plane, and none of the
Gaussians that stand for it may stand in the way of its own reflection.
"""

import math
from dataclasses import replace

import torch
from torch import Tensor

from rf3dgs.geometry import Patches, Planes, Surfaces
from rf3dgs.geometry.patches import surface_points, without_holes

PIECE_ANGLE = 0.985  # cosine of 10 degrees
PIECE_DISTANCE = 0.25  # m
SKIN, SKIN_ANGLE = 0.30, 0.7  # m, cosine of 45 degrees
SQUARE_ANGLE = math.cos(math.radians(7.0))
TOGETHER = 0.08  # m
HOLE = 1.0  # m^2


def consolidated(surfaces: Surfaces, means: Tensor) -> Surfaces:
    """The surfaces with pieces that lie on or near a large plane, within 25 cm and 10 degrees, made parts of it.

    Planes keep their numbers; one that became a part has no surface of its own any more. `means` `[N, 3]` [m] are the
    Gaussians'.
    """
    planes, patches = surfaces.planes, surfaces.patches
    if not len(planes):
        return surfaces
    points, areas, whole = surface_points(planes, patches), patches.areas, torch.arange(len(planes))
    for large in areas.argsort(descending=True, stable=True).tolist():
        if not bool(patches.large[large]) or int(whole[large]) != large:
            continue
        normal, offset = planes.normals[large], planes.offsets[large]
        for piece in range(len(planes)):
            if piece == large or int(whole[piece]) != piece or float(areas[piece]) >= float(areas[large]):
                continue
            if abs(float(planes.normals[piece] @ normal)) < PIECE_ANGLE or not len(points[piece]):
                continue
            height = points[piece] @ normal - offset
            if float(height.abs().median()) < PIECE_DISTANCE:
                points[large] = torch.cat((points[large], points[piece]))
                points[piece], whole[piece] = points[piece][:0], large
    plane_of = torch.where(surfaces.plane_of >= 0, whole[surfaces.plane_of.clamp_min(0)], -1)
    joined = replace(surfaces, patches=Patches.of(planes, points, patches.cell), plane_of=plane_of)
    return replace(joined, plane_of=with_skins(joined, means))


def with_skins(surfaces: Surfaces, means: Tensor) -> Tensor:
    """Labels `[N]` of the Gaussians at `means` `[N, 3]` [m]: those near a large plane and along it, too, are its own.

    Near is within 30 cm and 45 degrees, before or behind its surface.
    """
    labels = surfaces.plane_of.clone()
    for plane in surfaces.patches.areas.argsort(descending=True, stable=True).tolist():
        if not bool(surfaces.patches.large[plane]):
            continue
        normal = surfaces.planes.normals[plane]
        height = (means @ normal - surfaces.planes.offsets[plane]).abs()
        skin = (labels < 0) & (height < SKIN) & ((surfaces.normals @ normal).abs() > SKIN_ANGLE)
        near = torch.nonzero(skin).squeeze(-1)
        held = surfaces.patches.holds(means[near], torch.full_like(near, plane))
        labels[near[held]] = plane
    return labels


def squared(surfaces: Surfaces) -> Surfaces:
    """The surfaces with small planes along the walls: photographs leave the faces of columns, boards and boxes turned
    by some degrees, because they are narrow, and such things mostly stand square.

    A plane that is not large and whose normal is within 7 degrees of a large one's takes that direction, about the
    middle of its surface. Of those that then face one way and lie within 8 cm of each other the smaller become parts of
    the larger. Planes keep their numbers.
    """
    planes, patches = surfaces.planes, surfaces.patches
    areas, normals, offsets = patches.areas, planes.normals.clone(), planes.offsets.clone()
    points, large = surface_points(planes, patches), patches.large
    walls, whole = planes.normals[large], torch.arange(len(planes))
    order = areas.argsort(descending=True, stable=True)
    small = order[(areas[order] > 0) & ~large[order]].tolist()
    if not len(walls):
        return surfaces
    done: list[int] = []
    for plane in small:
        cosine = walls @ normals[plane]
        best = int(cosine.abs().argmax())
        if float(cosine[best].abs()) < SQUARE_ANGLE:
            continue
        normals[plane] = walls[best] * cosine[best].sign()
        offsets[plane] = (points[plane] @ normals[plane]).median()
        for other in done:
            apart = (points[plane] @ normals[other] - offsets[other]).median().abs()
            if float(normals[other] @ normals[plane]) > PIECE_ANGLE and float(apart) < TOGETHER:
                points[other], points[plane] = torch.cat((points[other], points[plane])), points[plane][:0]
                whole[plane] = other
                break
        else:
            done.append(plane)
    planes = Planes(normals, offsets)
    plane_of = torch.where(surfaces.plane_of >= 0, whole[surfaces.plane_of.clamp_min(0)], -1)
    return replace(surfaces, planes=planes, patches=Patches.of(planes, points, patches.cell), plane_of=plane_of)


def walls_whole(patches: Patches) -> Patches:
    """The patches with holes of large planes under a square metre closed.

    No door is so small, and behind boxes photographs and echoes leave such ones.
    """
    whole = replace(patches, cells=patches.cells.clone())
    for plane in torch.nonzero(patches.large).squeeze(-1).tolist():
        grid = whole.grid(plane)
        grid |= without_holes(grid, round(HOLE / patches.cell**2))
    return whole


def oblique_planes(planes: Planes, patches: Patches) -> Tensor:
    """True `[plane]` for planes that face no large one's way, within 7 degrees; none where no plane is large.

    Photographs make some where none is.
    """
    walls = planes.normals[patches.large]
    if not len(walls):
        return torch.zeros(len(planes), dtype=torch.bool)
    return ((planes.normals @ walls.mT).abs() < SQUARE_ANGLE).all(-1)
