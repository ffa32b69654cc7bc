"""Walls that photographs show badly: layers of haze whose Gaussians' normals say nothing.

White walls come out of the visual stage as clouds of Gaussians before and behind them, turned any way. Their mass still
gathers at the wall, walls stand square to the floor, and there is next to nothing behind them: a layer is where the
mass most exceeds what lies beside it, along directions that fit the planes found so far. Such a wall is known to a
fifth of its thickness or so.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from rf3dgs.geometry.cloud import Cloud, Found, fitted
from rf3dgs.geometry.config import SurfaceConfig
from rf3dgs.geometry.patches import plane_axes

REFINEMENTS = 4
MOST_LAYERS = 8
BINS = 4  # of the histograms of mass, in half a layer
BEHIND = 0.06  # a wall has at most this share of all mass behind it
LAYER_SHARP = 0.4  # mass of a layer over that of thrice its thickness; an even haze has 0.33
SAME_DIRECTION = 0.996  # cosine of 5 degrees
HAZE_DIRECTION = 0.966  # cosine of 15 degrees


def find_layers(cloud: Cloud, rest: Cloud, found: Sequence[Found], config: SurfaceConfig) -> list[Found]:
    """Walls among `rest`, a part of the cloud whose normals say nothing: layers `config.layer` thick to either side.

    Directions are those of the planes found and a fan of those that are square to the largest. The offset at which the
    mass most exceeds what lies beside it is a layer, where it covers `config.min_layer_area` that way.
    """
    layers: list[Found] = []
    if not found or config.layer <= 0:
        return layers
    axes = [_Axis.of(cloud, direction, config.layer / BINS) for direction in _fan(found)]
    total = float(cloud.mass.sum())
    for _ in range(2 * MOST_LAYERS):
        if len(layers) == MOST_LAYERS or len(rest) < 3:
            break
        seed = _thickest(rest, axes, config.layer)
        if seed is None:
            break
        layer = seed
        for _ in range(REFINEMENTS):
            main = rest.pieces(layer.normal, rest.lies(layer))[0]
            if int(main.sum()) < 3:
                break
            points, mass = rest.points[main], rest.mass[main]
            normal = squared(fitted(points, mass, layer.normal)[0], found[0].normal)
            layer = replace(layer, normal=normal, offset=(mass * (points @ normal)).sum() / mass.sum())
        kept = rest.pieces(layer.normal, rest.lies(layer))[0]
        area = rest.area(layer.normal, kept)
        ahead = cloud.points @ layer.normal > layer.offset
        if float(cloud.mass[ahead].sum()) < 0.5 * total:
            layer = replace(layer, normal=-layer.normal, offset=-layer.offset)
        if area >= config.min_layer_area and _is_layer(cloud, layer, rest.part(kept), area, found, config):
            layers.append(layer)
            seed = layer
        reach = 2 * seed.tolerance if any(layer is other for other in layers) else seed.tolerance
        rest = rest.part(((rest.points @ seed.normal - seed.offset).abs() > reach) & ~kept)
    return layers


def _is_layer(
    cloud: Cloud, layer: Found, main: Cloud, area: float, found: Sequence[Found], config: SurfaceConfig
) -> bool:
    """Whether `main`, a part of the cloud, covers its `area` [m^2], bounds the site, stands out, and is no plane's
    haze."""
    behind = cloud.points @ layer.normal < layer.offset - 2 * layer.tolerance
    if float(cloud.mass[behind].sum()) > BEHIND * float(cloud.mass.sum()):
        return False
    mass = float(main.mass.sum())
    wide = cloud.lies(replace(layer, tolerance=3 * layer.tolerance)).nonzero().squeeze(-1)
    above = cloud.patch(layer.normal, main.points).holds(cloud.points[wide], torch.zeros_like(wide))
    centre = main.points.mean(0)
    for plane in found:
        alike = abs(float(plane.normal @ layer.normal)) > HAZE_DIRECTION
        near = abs(float(plane.normal @ centre - plane.offset)) < 2 * layer.tolerance
        if alike and near and int(cloud.lies(plane).sum()) > 0.5 * len(main):
            return False
    return mass >= config.min_cover * area and mass >= LAYER_SHARP * float(cloud.mass[wide[above]].sum())


def squared(normal: Tensor, largest: Tensor) -> Tensor:
    """The `normal` `[3]`, made square to that of the `largest` plane where it is so within 5 degrees."""
    along = float(normal @ largest)
    if abs(along) > (1 - SAME_DIRECTION**2) ** 0.5:
        return normal
    return torch.nn.functional.normalize(normal - along * largest, dim=-1)


def without_haze(cloud: Cloud, found: Sequence[Found], layers: Sequence[Found]) -> list[Found]:
    """Planes and layers without the planes that are a part of a layer's haze: small, near and turned like it."""
    kept = []
    for plane in found:
        main = cloud.lies(plane)
        centre = cloud.points[main].mean(0)
        kept += [plane] * all(
            abs(float(plane.normal @ layer.normal)) < HAZE_DIRECTION
            or abs(float(layer.normal @ centre - layer.offset)) > 2 * layer.tolerance
            or int(main.sum()) > 0.5 * int(cloud.lies(layer).sum())
            for layer in layers
        )
    return kept + list(layers)


def _fan(found: Sequence[Found]) -> Tensor:
    """Unit directions `[direction, 3]`: normals of the planes, and all around the first one's in steps of 3 degrees."""
    across = plane_axes(found[0].normal[None])[0]
    angle = torch.arange(0, 180, 3) * (math.pi / 180)
    fan = angle.cos()[:, None] * across[0] + angle.sin()[:, None] * across[1]
    return torch.cat((torch.stack([plane.normal for plane in found]), fan))


@dataclass(frozen=True, eq=False)
class _Axis:
    """A direction `[3]`, where a cloud begins along it [m], the width of bins [m], and the cloud's mass below each."""

    direction: Tensor
    first: float
    width: float
    whole: Tensor

    @classmethod
    def of(cls, cloud: Cloud, direction: Tensor, width: float) -> "_Axis":
        away = cloud.points @ direction
        first = float(away.min())
        return cls(direction, first, width, _sums(((away - first) / width).long(), cloud.mass.double()))

    def below(self, part: Cloud, mass: Tensor) -> Tensor:
        """The `mass` of a part of the cloud below each bin."""
        own = _sums(((part.points @ self.direction - self.first) / self.width).long(), mass)
        return torch.cat((own, own[-1:].expand(len(self.whole) - len(own))))


def _thickest(rest: Cloud, axes: Sequence[_Axis], half: float) -> Found | None:
    """The layer of +-`half` [m] at the site's bounds whose mass most exceeds that of its two neighbours' mean."""
    best, layer = 0.0, None
    mass = rest.mass.double()
    edge = 2 * BINS  # of the layer around bin k: sums up to k - BINS and k + BINS; neighbours as wide
    for axis in axes:
        whole = axis.whole
        k = torch.arange(3 * BINS, len(whole) - 3 * BINS)
        if not len(k):
            continue
        own = axis.below(rest, mass)
        inside = own[k + BINS] - own[k - BINS]
        beside = own[k + 3 * BINS] - own[k + BINS] + own[k - BINS] - own[k - 3 * BINS]
        behind = torch.minimum(whole[k - edge], whole[-1] - whole[k + edge])
        excess = torch.where(behind < BEHIND * whole[-1], inside - 0.5 * beside, 0.0)
        if float(excess.max()) > best:
            best = float(excess.max())
            offset = axis.first + (int(k[excess.argmax()]) - 3 * BINS) * axis.width
            layer = Found(axis.direction, torch.tensor(offset), half, 180.0)
    return layer


def _sums(bins: Tensor, mass: Tensor) -> Tensor:
    """Mass below each bin, `[bin]`, with three widths of a layer of nothing at both ends."""
    total = torch.bincount(bins, mass).cumsum(0) if len(bins) else mass.new_zeros(1)
    return torch.cat((total.new_zeros(3 * BINS + 1), total, total[-1:].expand(3 * BINS)))
