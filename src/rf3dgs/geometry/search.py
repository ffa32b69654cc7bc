"""The planes of a cloud of Gaussians: RANSAC on their normals, refined on what lies on them, each Gaussian on one.

A plane is real where its largest piece is large, wide and flat, where it covers its area, and where it is sharp: little
else with the same normal lies just beside it. Facets of a round column are too narrow or bend. Where a plane grows by
letting what lies on it stray farther, it is a rough one and does. What no normals agree on may still be a wall, badly
photographed: the last round looks for layers of the rest along directions that fit the planes found so far.
"""

import math
from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from rf3dgs.geometry.cloud import Cloud, Found, bends, fitted, sharpness
from rf3dgs.geometry.config import SurfaceConfig
from rf3dgs.geometry.layers import find_layers, without_haze
from rf3dgs.geometry.patches import Patches, plane_axes, widths
from rf3dgs.geometry.planes import Planes
from rf3dgs.splats.gaussians import Gaussians

SAMPLE = 8_000
NEARBY = 1.0  # every other candidate is judged by what lies within this distance [m]
TRIALS = 128
REFINEMENTS = 4
FAILURES = 40  # candidates in a row that may fail before the search ends
GROWTH = 1.1  # a rougher plane must be this much larger
SAME_DIRECTION = 0.996  # cosine of 5 degrees


def search_planes(
    gaussians: Gaussians, normals: Tensor, mass: Tensor, config: SurfaceConfig
) -> tuple[Planes, Tensor, Patches]:
    """Planes, largest first, the plane of each Gaussian `[gaussian]` (-1 none), and where the planes have surface.

    `normals` `[gaussian, 3]` point to the free side; `mass` `[gaussian]` [m^2] is how much surface each covers.
    """
    generator = torch.Generator().manual_seed(config.seed)
    cloud = Cloud.of(gaussians, normals, mass, config)
    rest = cloud.part(cloud.mass > 0)
    found: list[Found] = []
    failures = 0
    while len(found) < config.max_planes and failures < FAILURES and len(rest) >= 3:
        radius = NEARBY if failures % 2 else math.inf
        seed = _refined(rest, _best(rest, radius, config, generator))
        lies = rest.lies(seed)
        kept, main, area = rest.pieces(seed.normal, lies, config.min_width)
        if is_plane(cloud, seed, rest.part(main), area, config):
            plane = _loosened(cloud, rest, seed, area, config)
            found.append(plane)
            if plane.tolerance > seed.tolerance:
                kept = rest.pieces(plane.normal, rest.lies(plane), config.min_width)[0]
            rest = rest.part(~kept)
            failures = 0
        else:
            rest = rest.part(~(main if bool(main.any()) else lies))
            failures += 1
    layers = find_layers(cloud, rest, found, config)
    return settled(cloud, without_haze(cloud, found, layers), config)


def _best(rest: Cloud, radius: float, config: SurfaceConfig, generator: torch.Generator) -> Found:
    """The candidate, through a Gaussian along its normal, on which most mass lies within `radius` [m] of it."""
    points, directions, mass = rest.points, rest.normals, rest.mass
    if len(rest) > SAMPLE:
        index = torch.randperm(len(rest), generator=generator)[:SAMPLE]
        points, directions, mass = points[index], directions[index], mass[index]
    trial = torch.multinomial(mass, TRIALS, replacement=True, generator=generator)
    normals = directions[trial]
    offsets = (normals * points[trial]).sum(-1)
    lies = ((points @ normals.mT) - offsets).abs() < config.tolerance
    lies &= (directions @ normals.mT) > math.cos(math.radians(config.angle_deg))
    if radius < math.inf:
        lies &= torch.cdist(points, points[trial]) < radius
    best = int((mass @ lies.float()).argmax())
    return Found(normals[best], offsets[best], config.tolerance, config.angle_deg)


def _refined(rest: Cloud, plane: Found) -> Found:
    """The plane fitted to the largest piece that lies on it, weighted by mass, a few times over."""
    before = torch.zeros(0)
    for _ in range(REFINEMENTS):
        main = rest.pieces(plane.normal, rest.lies(plane))[1]
        if int(main.sum()) < 3 or torch.equal(main, before):
            break
        normal, offset = fitted(rest.points[main], rest.mass[main], plane.normal)
        plane, before = replace(plane, normal=normal, offset=offset), main
    return plane


def _loosened(cloud: Cloud, rest: Cloud, plane: Found, area: float, config: SurfaceConfig) -> Found:
    """The plane with twice the tolerance, again and again, as long as its largest piece grows by `GROWTH` that way."""
    while 2 * plane.tolerance <= config.max_tolerance:
        wider = _refined(rest, replace(plane, tolerance=2 * plane.tolerance))
        _, main, larger = rest.pieces(wider.normal, rest.lies(wider))
        same = float(wider.normal @ plane.normal) > SAME_DIRECTION
        if larger < GROWTH * area or not same or not is_plane(cloud, wider, rest.part(main), larger, config):
            break
        plane, area = wider, larger
    return plane


def is_plane(cloud: Cloud, plane: Found, main: Cloud, area: float, config: SurfaceConfig) -> bool:
    """Whether `main`, a piece of `area` [m^2] of the cloud, makes a surface; see the head of this file."""
    if len(main) < config.min_count or area < config.min_area:
        return False
    points, mass = main.points, main.mass
    if widths(points, plane_axes(plane.normal[None])[0])[1] < config.min_width:
        return False
    if float(mass.sum()) < config.min_cover * area:
        return False
    return sharpness(cloud, plane, main) > config.min_sharpness and not bends(points, mass, plane)


def settled(cloud: Cloud, found: Sequence[Found], config: SurfaceConfig) -> tuple[Planes, Tensor, Patches]:
    """Every Gaussian on the nearest plane, in its tolerances, that has a piece of surface there; planes by area."""
    plane_of = torch.full((len(cloud.points),), -1)
    nearest = torch.full((len(cloud.points),), math.inf)
    for index, plane in enumerate(found):
        distance = (cloud.points @ plane.normal - plane.offset).abs() / plane.tolerance
        kept = cloud.pieces(plane.normal, cloud.lies(plane) & (distance < nearest), config.min_width)[0]
        plane_of[kept], nearest[kept] = index, distance[kept]
    planes = Planes(
        torch.stack([plane.normal for plane in found]) if found else torch.zeros(0, 3),
        torch.stack([plane.offset for plane in found]) if found else torch.zeros(0),
    )
    return _by_area(cloud, planes, plane_of)


def _by_area(cloud: Cloud, planes: Planes, plane_of: Tensor) -> tuple[Planes, Tensor, Patches]:
    """Planes by the area of their patches, without those on which nothing lies."""
    spots = [cloud.spots[plane_of == index].flatten(0, 1) for index in range(len(planes))]
    areas = Patches.of(planes, spots, cloud.cell).areas
    order = [index for index in areas.argsort(descending=True, stable=True).tolist() if len(spots[index])]
    place = torch.full((len(planes) + 1,), -1)
    place[order] = torch.arange(len(order))
    planes = Planes(planes.normals[order], planes.offsets[order])
    return planes, place[plane_of], Patches.of(planes, [spots[index] for index in order], cloud.cell)
