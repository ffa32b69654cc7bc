"""Surfaces out of posed photographs by plane sweep: a better place to begin than random Gaussians.

A small copy of each photograph is compared with others from some way off on trial planes (normalised
cross-correlation of windows), in three rounds: planes that face the camera, in even steps of inverse depth; planes
along the three directions that most of what was found so far faces, on which floors, ceilings and walls seen at a flat
angle match as well; and the large planes that bound the site, which fill what is left between clear pixels. A depth
counts where more depth maps of other photographs have it than look past it. Collins (1996), "A space-sweep approach to
true multi-image matching"; Gallup et al. (2007), "Real-time plane-sweeping stereo with multiple sweeping directions".
"""

from collections.abc import Sequence
from dataclasses import dataclass, fields

import torch
from torch import Tensor
from torch.nn.functional import grid_sample

from rf3dgs.core.grids import Camera
from rf3dgs.core.threads import on_threads
from rf3dgs.geometry.planes import Planes, find_planes, main_directions
from rf3dgs.training.photographs import shrunk

PIXELS_ACROSS = 107
DEPTHS = 80
FINER = 4
NEAREST = 0.04
NEIGHBOURS, WITNESSES = 4, 16
BASELINE = 0.08
WINDOW = 7
CORRELATION = 0.7
LEAST_CONTRAST = 0.012
AGREEMENT = 0.05
PLANES = 8  # of one direction
POINTS, POINTS_OF_PLANES = 20_000, 6000
TOLERANCE = 0.005  # of the farthest depth
FILL_CORRELATION = 0.35
BEHIND, STRAY = 4.0, 0.05  # tolerances behind a plane, and share of what may be there
FACING = 0.9999  # cosine; what a round found has its direction itself


class View:
    """A small photograph as the sweep needs it."""

    def __init__(self, camera: Camera, picture: Tensor) -> None:
        self.camera, self.picture, self.grey = camera, picture, picture.mean(-1)
        row, col = torch.meshgrid(torch.arange(camera.height) + 0.5, torch.arange(camera.width) + 0.5, indexing="ij")
        pixel = torch.stack((col, row, torch.ones_like(row)))
        self.rays = torch.einsum("ij,jrc->irc", torch.linalg.inv(camera.K), pixel)
        self.mean = window(self.grey[None])
        self.spread = (window(self.grey[None].square()) - self.mean.square()).clamp_min(0.0)
        self.textured = self.spread[0] > LEAST_CONTRAST**2
        self.depth = torch.zeros_like(self.grey)
        self.normal = torch.zeros(*self.grey.shape, 3)
        self.score = torch.full_like(self.grey, -1.0)

    def unproject(self, depth: Tensor) -> Tensor:
        """World points `[row, col, 3]` of a depth map `[row, col]` [m] along the optical axis."""
        return (self.rays * depth).permute(1, 2, 0) @ self.camera.viewmat[:3, :3] + self.camera.position

    @property
    def world(self) -> Tensor:
        """The surface points `[row, col, 3]` [m] of the pixels."""
        return self.unproject(self.depth)

    def slopes(self, normals: Tensor) -> Tensor:
        """Each ray's component along world `normals` `[direction, 3]`: `[direction, row, col]`."""
        return torch.einsum("di,irc->drc", normals @ self.camera.viewmat[:3, :3].mT, self.rays)


def agreement(view: View, partners: Sequence[View], inverse: Tensor) -> Tensor:
    """Correlation with the two best of the partners, -1 to 1, at inverse depths `[layer, row, col]` [1/m]."""
    scores = []
    camera = view.camera
    for other in partners:
        turn = other.camera.viewmat[:3, :3] @ camera.viewmat[:3, :3].mT
        shift = other.camera.K @ (other.camera.viewmat[:3, 3] - turn @ camera.viewmat[:3, 3])
        base = torch.einsum("ij,jrc->irc", other.camera.K @ turn, view.rays)
        z = torch.add(base[2], inverse, alpha=float(shift[2]))
        ahead = z > 1e-3
        scale = 2 / torch.where(ahead, z, 1.0)
        x = torch.add(base[0], inverse, alpha=float(shift[0])).mul_(scale / other.camera.width).sub_(1)
        y = torch.add(base[1], inverse, alpha=float(shift[1])).mul_(scale / other.camera.height).sub_(1)
        inside = ahead & (x.abs() < 1) & (y.abs() < 1)
        where = torch.stack((x, y), -1).reshape(1, -1, camera.width, 2)
        seen = grid_sample(other.grey[None, None], where, align_corners=False)[0, 0].reshape(inverse.shape)
        mean = window(seen)
        covariance = window(seen * view.grey) - mean * view.mean
        spread = (window(seen.square()) - mean.square()).clamp_min(0.0)
        score = covariance * torch.rsqrt(view.spread * spread + 1e-8)
        scores.append(torch.where(inside, score, -1.0))
    return torch.stack(scores).topk(min(2, len(scores)), 0).values.mean(0)


def sweep(view: View, partners: Sequence[View], inverse: Tensor, slope: Tensor, normal: Tensor | None) -> None:
    """Try planes of one direction at inverse distances `inverse` `[layer]`; the view keeps what beats its best.

    `slope` `[row, col]` is each ray's component along the direction.
    """
    score = agreement(view, partners, inverse[:, None, None] * slope)
    layer = score.argmax(0)
    fine = inverse[layer] + (inverse[1] - inverse[0]) / FINER * torch.arange(1 - FINER, FINER)[:, None, None]
    fine_best, fine_layer = agreement(view, partners, fine * slope).max(0)
    depth = 1 / (fine.gather(0, fine_layer[None])[0] * slope).clamp_min(1e-6)
    better = (fine_best > view.score) & (layer > 0) & (layer < len(inverse) - 1)
    facing = view.camera.viewmat[2, :3] if normal is None else normal
    view.score = torch.where(better, fine_best, view.score)
    view.depth = torch.where(better, depth, view.depth)
    view.normal = torch.where(better[..., None], facing, view.normal)


def confirmed(view: View, partners: Sequence[View]) -> Tensor:
    """Where `[row, col]` the view's depth is clear and another view has the same."""
    points = view.world.reshape(-1, 3)
    agrees = torch.zeros(len(points), dtype=torch.bool)
    for other in partners:
        inside, place, depth = met(other, points)
        same = (other.depth[place] - depth).abs() < AGREEMENT * depth
        agrees |= inside & same & (other.score[place] > CORRELATION)
    return agrees.reshape(view.depth.shape) & (view.score > CORRELATION) & view.textured


def upheld(view: View, known: Tensor, others: Sequence[tuple[View, Tensor]]) -> Tensor:
    """Where `[row, col]` what is `known` of the view's depth is seen by more of the others than look past it.

    The others come with what is known of theirs.
    """
    points = view.world.reshape(-1, 3)
    balance = torch.zeros(len(points))
    for other, mask in others:
        inside, place, depth = met(other, points)
        told, apart = inside & mask[place], other.depth[place] / depth.clamp_min(1e-6) - 1
        balance += (told & (apart.abs() < AGREEMENT)).float() - (told & (apart > 2 * AGREEMENT)).float()
    return known & (balance > 0).reshape(known.shape)


def met(other: View, points: Tensor) -> tuple[Tensor, tuple[Tensor, Tensor], Tensor]:
    """Who of world points `[point, 3]` is in another view's picture, in which row and column, and how deep [m]."""
    pixel, inside = project(other.camera, points)
    col, row = pixel.long().clamp_min(0).unbind(-1)
    place = row.clamp_max(other.camera.height - 1), col.clamp_max(other.camera.width - 1)
    return inside, place, points @ other.camera.viewmat[2, :3] + other.camera.viewmat[2, 3]


@dataclass(frozen=True)
class Surfaces:
    """Points `[point, 3]` [m] on surfaces, their unit normals and colours (0 to 1)."""

    points: Tensor
    normals: Tensor
    colours: Tensor
    areas: Tensor

    @classmethod
    def of(cls, views: Sequence[View], known: Sequence[Tensor]) -> "Surfaces":
        """What the pixels `known` `[row, col]` of each view show, with the area [m^2, up to a factor] of each."""
        points = [view.unproject(view.depth)[mask] for view, mask in zip(views, known, strict=True)]
        normals = [view.normal[mask] for view, mask in zip(views, known, strict=True)]
        colours = [view.picture[mask] for view, mask in zip(views, known, strict=True)]
        areas = [view.depth[mask].square() for view, mask in zip(views, known, strict=True)]
        return cls(torch.cat(points), torch.cat(normals), torch.cat(colours), torch.cat(areas))

    @classmethod
    def joined(cls, parts: Sequence["Surfaces"]) -> "Surfaces":
        """All of some parts, one after another."""
        none = cls(torch.zeros(0, 3), torch.zeros(0, 3), torch.zeros(0, 3), torch.zeros(0))
        return cls(*(torch.cat([getattr(part, field.name) for part in (none, *parts)]) for field in fields(cls)))

    def only(self, chosen: Tensor) -> "Surfaces":
        """Some of them, by a mask or list."""
        return Surfaces(*(getattr(self, field.name)[chosen] for field in fields(self)))

    def thinned(self, count: int, generator: torch.Generator) -> "Surfaces":
        """At most `count` of the points, evenly over the area."""
        kept = (self.areas / torch.rand(len(self.areas), generator=generator).log().neg()).argsort(descending=True)
        return self.only(kept[:count])


def swept_surfaces(
    cameras: Sequence[Camera], pictures: Sequence[Tensor], far: float, generator: torch.Generator
) -> tuple[list[View], list[Tensor]]:
    """Depths and normals of all photographs, and where they count.

    `pictures` are bytes `[row, col, 3]`; depths are tried from 4 % of `far` [m] to `far`.
    """
    views = [
        View(*shrunk(c, p, max(1, round(c.width / PIXELS_ACROSS)))) for c, p in zip(cameras, pictures, strict=True)
    ]
    inverse = torch.linspace(1 / far, 1 / (NEAREST * far), DEPTHS)
    near = on_threads(lambda view: beside(view.camera, views, far), views)
    partners = [[views[other] for other in others[:NEIGHBOURS]] for others in near]
    pairs = [(view, others) for view, others in zip(views, partners, strict=True) if others]

    def faced(pair: tuple[View, list[View]]) -> None:
        view, others = pair
        sweep(view, others, inverse, torch.ones_like(view.grey), None)

    on_threads(faced, pairs)
    found = Surfaces.of(views, [confirmed(view, others) for view, others in zip(views, partners, strict=True)])
    directions = main_directions(found.thinned(POINTS, generator).points, TOLERANCE * far, generator)

    def turned(pair: tuple[View, list[View]]) -> None:
        view, others = pair
        for direction in directions:
            sweep(view, others, inverse, view.slopes(direction[None])[0].abs().clamp_min(1e-3), direction)

    on_threads(turned, pairs)
    sure = [confirmed(view, others) for view, others in zip(views, partners, strict=True)]
    planes = _bounding_planes(directions, Surfaces.of(views, sure), 0.5 * TOLERANCE * far, generator)
    known = []
    for view, others, mask in zip(views, partners, sure, strict=True):
        known.append(mask | _fill(view, others, planes, mask, far) if others and len(planes) else mask)
    return views, [
        upheld(view, mask, [(views[other], known[other]) for other in others])
        for view, mask, others in zip(views, known, near, strict=True)
    ]


def _bounding_planes(directions: Tensor, found: Surfaces, tolerance: float, generator: torch.Generator) -> Planes:
    """The large planes of what faces each of the `directions` `[direction, 3]`, on one side of which nearly all lies.

    Others are small things' and would be drawn far beside them.
    """
    normals, offsets = [torch.zeros(0, 3)], [torch.zeros(0)]
    for direction in directions:
        facing = found.only((found.normals @ direction).abs() > FACING).thinned(POINTS_OF_PLANES, generator)
        planes = find_planes(facing.points, tolerance, PLANES, generator)
        height = (facing.points @ planes.normals.mT - planes.offsets) / tolerance
        beyond = torch.minimum((height > BEHIND).float().mean(0), (height < -BEHIND).float().mean(0))
        normals.append(planes.normals[beyond < STRAY])
        offsets.append(planes.offsets[beyond < STRAY])
    return Planes(torch.cat(normals), torch.cat(offsets))


def _fill(view: View, partners: Sequence[View], planes: Planes, sure: Tensor, far: float) -> Tensor:
    """Give pixels that are not sure the plane on which the photographs agree best; returns where they do."""
    heights = planes.offsets - planes.normals @ view.camera.position
    inverse = view.slopes(planes.normals) / heights[:, None, None]
    possible = (inverse > 1 / far) & (inverse < 1 / (0.5 * NEAREST * far))
    score = torch.where(possible, agreement(view, partners, inverse.clamp_min(1 / far)), -1.0)
    best, plane = window(score).max(0)
    filled = ~sure & (best > FILL_CORRELATION)
    depth = 1 / inverse.gather(0, plane[None])[0].clamp_min(1e-6)
    view.depth = torch.where(filled, depth, view.depth)
    view.normal = torch.where(filled[..., None], planes.normals[plane], view.normal)
    return filled


def beside(own: Camera, views: Sequence[View], far: float) -> list[int]:
    """At most `WITNESSES` of the views that share most with what a camera sees, counted over a coarse grid of depths.

    Those nearer than `BASELINE` of `far` [m] show depth less: they count by the square of their distance.
    """
    probe = View(own.resized(12, 9), torch.zeros(9, 12, 3))
    depths = [torch.full((9, 12), share * far) for share in (0.1, 0.2, 0.35, 0.6)]
    points = torch.cat([probe.unproject(depth).reshape(-1, 3) for depth in depths])
    scores = []
    for view in views:
        moved = float(torch.linalg.vector_norm(view.camera.position - own.position))
        facing = float(view.camera.viewmat[2, :3] @ own.viewmat[2, :3])
        inside = project(view.camera, points)[1].float().mean()
        apart = min(1.0, moved / (BASELINE * far)) ** 2
        scores.append(apart * float(inside) if facing > 0.3 else 0.0)
    order = sorted(range(len(views)), key=lambda other: -scores[other])[:WITNESSES]
    return [other for other in order if scores[other] > 0.05]


def window(maps: Tensor) -> Tensor:
    """Means over square windows of `[map, row, col]`, at the rim over what of the window is there."""
    return _means_along(_means_along(maps, 1), 2)


def _means_along(maps: Tensor, dim: int) -> Tensor:
    """Means over `WINDOW` neighbours along one dimension, each the sum of shifted maps: torch's pooling is slower."""
    half, size = WINDOW // 2, maps.shape[dim]
    total = torch.zeros_like(maps)
    for shift in range(-half, half + 1):
        first, last = max(0, -shift), min(size, size - shift)
        if first < last:
            total.narrow(dim, first, last - first).add_(maps.narrow(dim, first + shift, last - first))
    place = torch.arange(size)
    count = (place + half).clamp_max(size - 1) - (place - half).clamp_min(0) + 1
    return total.div_(count.to(maps.dtype).reshape((-1, 1) if dim == 1 else (-1,)))


def project(camera: Camera, points: Tensor) -> tuple[Tensor, Tensor]:
    """Pixel coordinates `[point, 2]` of world points, and who is inside the picture."""
    x, y, z = (points @ camera.viewmat[:3, :3].mT + camera.viewmat[:3, 3]).unbind(-1)
    ahead = z > 1e-3
    z = torch.where(ahead, z, 1.0)
    pixel = torch.stack((camera.K[0, 0] * x / z + camera.K[0, 2], camera.K[1, 1] * y / z + camera.K[1, 2]), -1)
    inside = ahead & (pixel >= 0).all(-1) & (pixel < torch.tensor([camera.width, camera.height])).all(-1)
    return torch.where(inside[:, None], pixel, -1e3), inside
