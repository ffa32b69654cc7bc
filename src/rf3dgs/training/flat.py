"""Surfaces that are flat while photographs train them: planes found in the present Gaussians, and what belongs to them.

Photographs are content with haze where a wall is far from all cameras. So the large planes of the Gaussians are moved
to where the photographs agree, and what lies on them is put flat there and held there, while colours, opacities, sizes
and places along the plane go on training. A plane with all cameras before it and nothing behind bounds the site: where
photographs look at it and do not disagree, its holes are filled, and what floats close before it or behind is dimmed,
so that the photographs bring back what they need.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from rf3dgs.core.errors import InputError
from rf3dgs.core.frames import matrix_from_quaternion
from rf3dgs.core.grids import Camera
from rf3dgs.geometry.flatten import THICKNESS, TRUSTED, onto_planes
from rf3dgs.geometry.layers import squared
from rf3dgs.geometry.patches import Patches, footprints, plane_axes
from rf3dgs.geometry.photometric import STEP, Sight, agreement_at, colours_at, refine_planes
from rf3dgs.geometry.planes import Planes
from rf3dgs.geometry.surfaces import Surfaces, find_surfaces
from rf3dgs.splats.density import Change
from rf3dgs.splats.gaussians import Gaussians
from rf3dgs.splats.harmonics import C0
from rf3dgs.training.initial import upright

LEAST = 100  # fewer Gaussians have no planes
SAME_DIRECTION, SAME_PLACE = 0.996, 0.10  # planes within 5 degrees and so many metres of each other are one
PULL = 0.10  # what lies so near a plane, turned like it, belongs to it [m]
PULL_COSINE = 0.5
AHEAD = 0.2  # all cameras are so far before a plane that bounds the site [m]
BEHIND, LAYER = 0.02, 0.3  # and at most this share of what lies on other planes is so far behind it [m]
FLOATS = 0.3  # before a plane that bounds the site: what is nearer and on no plane is dimmed [m]
DIM = 0.05  # to this opacity
MARGIN = 0.5  # planes are filled up to this far beyond what lies on any [m]
EDGE = 0.05  # and this far beyond one another [m]
MOST_PLACES = 250_000  # of larger planes the drawings are coarser
OPAQUE, LARGEST_SPOT = 0.3, 0.3  # what covers a plane: fainter Gaussians do not, and only so far from their centre [m]
STRIDE = 3  # fillings stand so many steps of the drawings apart
FILLED_OPACITY = 0.7
SEEN = 3  # photographs that must look at a place that is filled
DISAGREE = 0.2  # a place on which photographs agree less than this is not on the plane
MOST_SIGHTS = 100  # photographs that are compared, evenly spread over all


@dataclass(frozen=True, eq=False)
class Flats:
    """Planes with normals to the free side, and on which of them each Gaussian lies `[gaussian]`, -1 for none."""

    planes: Planes
    plane_of: Tensor

    def followed(self, change: Change) -> "Flats":
        """The same planes for the Gaussians after a change: copies and parts lie where the old ones did."""
        return Flats(self.planes, self.plane_of[change.source])

    def held(self, gaussians: Gaussians) -> Gaussians:
        """The Gaussians, those of planes moved back onto them along the normal, turned back and made thin again.

        A turn takes the axis nearest to the normal to it by the shortest way, so that the axes keep their order and an
        optimiser's state its meaning.
        """
        mine = self.plane_of >= 0
        normal, offset = self.planes.normals[self.plane_of[mine]], self.planes.offsets[self.plane_of[mine]]
        means, quats, log_scales = (t.clone() for t in (gaussians.means, gaussians.quats, gaussians.log_scales))
        means[mine] -= ((means[mine] * normal).sum(-1) - offset)[:, None] * normal
        old = torch.nn.functional.normalize(quats[mine], dim=-1)
        axes = matrix_from_quaternion(old)
        axis = (normal[:, None] @ axes).squeeze(1).abs().argmax(-1, keepdim=True)
        across = axes.gather(-1, axis[:, None].expand(-1, 3, 1)).squeeze(-1)
        normal = torch.where((across * normal).sum(-1, keepdim=True) < 0, -normal, normal)
        cosine = (across * normal).sum(-1, keepdim=True)
        turn = torch.cat((1 + cosine, torch.linalg.cross(across, normal, dim=-1)), -1)
        quats[mine] = _product(torch.nn.functional.normalize(turn, dim=-1), old)
        thin = log_scales[mine]
        log_scales[mine] = thin.scatter(-1, axis, thin.gather(-1, axis).clamp_max(math.log(THICKNESS)))
        return replace(gaussians, means=means, quats=quats, log_scales=log_scales)

    def tensors(self) -> dict[str, Tensor]:
        """The tensors by name, for a checkpoint."""
        return {"normals": self.planes.normals, "offsets": self.planes.offsets, "plane_of": self.plane_of}

    @classmethod
    def from_tensors(cls, tensors: dict[str, Tensor]) -> "Flats":
        """The planes of a mapping as `tensors()` gives it."""
        return cls(Planes(tensors["normals"], tensors["offsets"]), tensors["plane_of"])


def flatten_walls(
    gaussians: Gaussians, cameras: Sequence[Camera], pictures: Sequence[Tensor]
) -> tuple[Change, Flats] | None:
    """Find the planes on which photographs agree, and make the Gaussians into their surfaces; None where there is none.

    `pictures` are bytes `[row, col, 3]` of the `cameras`.
    """
    if len(gaussians) < LEAST:
        return None
    eyes = torch.stack([camera.position for camera in cameras])
    try:
        surfaces = find_surfaces(gaussians, eyes)
    except InputError:  # planes of a square kilometre: the world is not in metres, and no distance here means anything
        return None
    spread = slice(None, None, -(-len(cameras) // MOST_SIGHTS))
    cameras, pictures = cameras[spread], pictures[spread]
    planes, agreed = refine_planes(gaussians, _squared(gaussians, surfaces), surfaces.patches, cameras, pictures)
    trusted = agreed > TRUSTED
    if not bool(trusted.any()):
        return None
    surfaces = replace(surfaces, plane_of=_merged(gaussians, surfaces.plane_of, planes, agreed))
    trusted &= torch.bincount(surfaces.plane_of[surfaces.plane_of >= 0], minlength=len(planes)) > 0
    plane_of = _pulled(gaussians, surfaces, planes, trusted)
    flat = onto_planes(gaussians, plane_of, planes)
    bounds = trusted & _bounds(flat, planes, plane_of, eyes)
    untried = torch.cat((agreed.isnan(), agreed.new_zeros(1, dtype=torch.bool)))[surfaces.plane_of]
    flat = _dimmed(flat, planes, (plane_of < 0) & ~untried, bounds)
    sights = [Sight.of(flat, camera, picture) for camera, picture in zip(cameras, pictures, strict=True)]
    filling, on = _filling(flat, sights, planes, plane_of, bounds)
    source = torch.cat((torch.arange(len(flat)), torch.zeros(len(on), dtype=torch.long)))
    change = Change(Gaussians.join([flat, filling]), source, torch.arange(len(source)) >= len(flat))
    return change, Flats(planes, torch.cat((plane_of, on)))


def _squared(gaussians: Gaussians, surfaces: Surfaces) -> Planes:
    """The planes, those nearly square to the largest turned about their middles until they are."""
    planes = surfaces.planes
    normals, offsets = planes.normals.clone(), planes.offsets.clone()
    for plane in range(1, len(planes)):
        normals[plane] = squared(planes.normals[plane], planes.normals[0])
        offsets[plane] = gaussians.means[surfaces.plane_of == plane].mean(0) @ (normals[plane] - planes.normals[plane])
    offsets[1:] += planes.offsets[1:]
    return Planes(normals, offsets)


def _merged(gaussians: Gaussians, plane_of: Tensor, planes: Planes, agreed: Tensor) -> Tensor:
    """The plane of each Gaussian, where photographs moved planes to one place that on which they agree best."""
    plane_of = plane_of.clone()
    kept: list[int] = []
    for plane in agreed.nan_to_num(-1.0).argsort(descending=True, stable=True).tolist():
        if not bool(agreed[plane] > TRUSTED):
            break
        normal, mine = planes.normals[plane], plane_of == plane
        middle = gaussians.means[mine].mean(0)
        middle = middle + (planes.offsets[plane] - middle @ normal) * normal
        alike = (planes.normals[kept] @ normal > SAME_DIRECTION) & (
            (planes.normals[kept] @ middle - planes.offsets[kept]).abs() < SAME_PLACE
        )
        if bool(alike.any()):
            plane_of[mine] = kept[int(alike.nonzero()[0])]
        else:
            kept.append(plane)
    return plane_of


def _pulled(gaussians: Gaussians, surfaces: Surfaces, planes: Planes, trusted: Tensor) -> Tensor:
    """The plane `[gaussian]` of the Gaussians on trusted planes, and of those off all planes that are near one."""
    plane_of = torch.where(torch.cat((trusted, trusted.new_zeros(1)))[surfaces.plane_of], surfaces.plane_of, -1)
    nearest = torch.full((len(gaussians),), PULL)
    for plane in trusted.nonzero().squeeze(-1).tolist():
        away = (gaussians.means @ planes.normals[plane] - planes.offsets[plane]).abs()
        near = (surfaces.plane_of < 0) & (away < nearest)
        near &= (surfaces.normals @ planes.normals[plane]).abs() > PULL_COSINE
        near[near.clone()] = surfaces.patches.holds(gaussians.means[near], torch.tensor(plane))
        plane_of[near], nearest[near] = plane, away[near]
    return plane_of


def _bounds(gaussians: Gaussians, planes: Planes, plane_of: Tensor, eyes: Tensor) -> Tensor:
    """Which planes `[plane]` have every camera before them and next to nothing of the other planes behind."""
    ahead = (eyes @ planes.normals.mT - planes.offsets > AHEAD).all(0)
    placed = plane_of >= 0
    behind = gaussians.means[placed] @ planes.normals.mT < planes.offsets - LAYER
    return ahead & (behind.float().mean(0) < BEHIND)


def _dimmed(gaussians: Gaussians, planes: Planes, loose: Tensor, bounds: Tensor) -> Gaussians:
    """The Gaussians, the `loose` ones `[gaussian]` faint where they are close before or behind a plane of `bounds`."""
    away = gaussians.means @ planes.normals[bounds].mT - planes.offsets[bounds]
    dim = loose & (away < FLOATS).any(-1)
    ceiling = math.log(DIM / (1 - DIM))
    logits = torch.where(dim, gaussians.logit_opacities.clamp_max(ceiling), gaussians.logit_opacities)
    return replace(gaussians, logit_opacities=logits)


def _filling(
    gaussians: Gaussians, sights: Sequence[Sight], planes: Planes, plane_of: Tensor, bounds: Tensor
) -> tuple[Gaussians, Tensor]:
    """New Gaussians where planes that bound the site have holes, and the plane of each."""
    walls = bounds.nonzero().squeeze(-1).tolist()
    site = gaussians.means[plane_of >= 0]
    parts, on = [gaussians.subset(torch.zeros(0, dtype=torch.long))], [torch.zeros(0, dtype=torch.long)]
    for plane in walls:
        one = Planes(planes.normals[[plane]], planes.offsets[[plane]])
        normal, axes = one.normals[0], plane_axes(one.normals)[0]
        low, high = (site @ axes.mT).amin(0) - MARGIN, (site @ axes.mT).amax(0) + MARGIN
        step = max(STEP, math.sqrt(float((high - low).prod()) / MOST_PLACES))
        spans = [torch.arange(float(a), float(b), step) for a, b in zip(low, high, strict=True)]
        place = torch.stack(torch.meshgrid(*spans, indexing="ij"), -1) @ axes + planes.offsets[plane] * normal
        alike, seen = agreement_at(sights, place, normal)
        others = [wall for wall in walls if wall != plane]
        inside = (place @ planes.normals[others].mT - planes.offsets[others] > -EDGE).all(-1)
        empty = inside & (seen >= SEEN) & ~(alike < DISAGREE)
        chosen = place[1::STRIDE, 1::STRIDE][empty[1::STRIDE, 1::STRIDE]]
        chosen = chosen[~Patches.of(one, [_spots(gaussians, plane_of == plane)]).holds(chosen, torch.tensor(0))]
        colours = colours_at(sights, chosen, normal)
        parts.append(_pieces(chosen, normal, 0.6 * STRIDE * step, colours, gaussians.sh.shape[1]))
        on.append(torch.full((len(chosen),), plane))
    return Gaussians.join(parts), torch.cat(on)


def _spots(gaussians: Gaussians, mine: Tensor) -> Tensor:
    """Points `[point, 3]` over the footprints of the flat Gaussians `mine` that are opaque."""
    part = gaussians.subset(mine & (gaussians.opacities >= OPAQUE))
    axes = matrix_from_quaternion(part.quats)[:, :, :2]  # `onto_planes` puts the thin one last
    return footprints(part.means, axes, part.scales[:, :2].clamp_max(LARGEST_SPOT)).flatten(0, 1)


def _pieces(points: Tensor, normal: Tensor, size: float, colours: Tensor, coefficients: int) -> Gaussians:
    """Flat Gaussians of a `size` [m] on points `[point, 3]` of a plane, of the `colours` `[point, 3]`."""
    log_scales = torch.tensor([size, size, THICKNESS]).log().repeat(len(points), 1)
    sh = torch.zeros(len(points), coefficients, 3)
    sh[:, 0] = (colours - 0.5) / C0
    logits = torch.full((len(points),), math.log(FILLED_OPACITY / (1 - FILLED_OPACITY)))
    return Gaussians(points, upright(normal.expand(len(points), 3)), log_scales, logits, sh)


def _product(first: Tensor, second: Tensor) -> Tensor:
    """Hamilton's product of quaternions `[n, 4]` (wxyz): the rotation `second`, then `first`."""
    a, b, c, d = first.unbind(-1)
    w, x, y, z = second.unbind(-1)
    parts = (
        a * w - b * x - c * y - d * z,
        a * x + b * w + c * z - d * y,
        a * y - b * z + c * w + d * x,
        a * z + b * y - c * x + d * w,
    )
    return torch.stack(parts, -1)
