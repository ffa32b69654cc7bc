"""What the peaks of spectra say about mirrors: where known planes lie exactly, and planes that geometry lacks.

A mirror shows the transmitter at its image, a fixed point for all receivers, so that the bearings of its peaks meet
there. The plane is the bisector of transmitter and image.
"""

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from rf3dgs.core.angles import angle_between
from rf3dgs.core.threads import on_threads
from rf3dgs.field.images import image_chain, mirrored, sequences
from rf3dgs.field.rays import Rays
from rf3dgs.field.sources import PointSources
from rf3dgs.field.transmitter import bearing_error, closest_point, pairwise_meetings, pixel_of
from rf3dgs.geometry import Patches, Planes
from rf3dgs.geometry.patches import surface_points
from rf3dgs.spectra.peaks import find_peaks
from rf3dgs.spectra.spectrum import Spectrum
from rf3dgs.splats.obstacles import Obstacles
from rf3dgs.training.config import SourceConfig
from rf3dgs.training.line_of_sight import SEEN_OVER_RING, standing_out

PEAKS = 16
MATCH = math.radians(3.0)
BEARING = math.radians(0.3)
INDEPENDENT = 6  # bearings count as so many at most: what stands beside a peak pulls all of them alike
STEPS = 6
LEAST_SUPPORT, LEAST_SHARE = 5, 0.1
MOST_FOUND = 12
SAME_ANGLE, SAME_DISTANCE = math.cos(math.radians(5.0)), 0.2
SAME_BEARING = math.radians(2.5)
SPOT = 0.3
DISC = (0.4, 1.5)  # m of surface around a reflection that was seen, at least and at most
NEAREST_IMAGE = 0.3


@dataclass(frozen=True, eq=False)
class Peaks:
    """Peaks that stand 3 dB over their surroundings: position `[n]`, bearing `[n, 3]` (world) of each, and how many
    times the surroundings it is, `over` `[n]`."""

    position: Tensor
    bearing: Tensor
    over: Tensor

    def only(self, chosen: Tensor) -> "Peaks":
        """Some of them, by a mask or list."""
        return Peaks(self.position[chosen], self.bearing[chosen], self.over[chosen])


def peaks_of(spectra: Spectrum) -> Peaks:
    """The strongest peaks of spectra `[position, row, col]`."""

    def at(number: int) -> Peaks:
        one = spectra[number]
        found, _ = find_peaks(one.power, one.grid, count=PEAKS, separation=one.instrument.lobe)
        bearing = one.pose.to_world(found)
        shown = [standing_out(one, each) for each in bearing]
        power, ring = torch.tensor(shown, dtype=torch.float64).reshape(-1, 2).unbind(-1)
        every = Peaks(torch.full((len(bearing),), number), bearing, 1 + power / ring.clamp_min(1e-300))
        return every.only(every.over > SEEN_OVER_RING)

    parts = on_threads(at, range(len(spectra)))
    return Peaks(*(torch.cat([getattr(part, name) for part in parts]) for name in ("position", "bearing", "over")))


def refined_planes(
    sources: PointSources, rays: list[Rays], peaks: Peaks, positions: Tensor, config: SourceConfig
) -> Planes:
    """The planes, each moved to where the peaks of its image are, with what geometry says as a prior.

    Least squares over two tilts about the middle of the reflections and an offset; a peak belongs to the ray that is
    nearest to it, at most 3 degrees away. Planes of fewer than three such peaks stay.
    """
    matches: dict[int, list[tuple[Tensor, Tensor, Tensor]]] = {}
    for number, one in enumerate(rays):
        own = peaks.bearing[peaks.position == number]
        if not len(own) or not len(one):
            continue
        angle = angle_between(one.arrival[:, None], own[None])
        for ray in torch.nonzero(one.order == 1).squeeze(-1).tolist():
            nearest = int(angle[ray].argmin())
            if float(angle[ray, nearest]) < MATCH and int(angle[:, nearest].argmin()) == ray:
                plane = int(sources.sequence[one.index[ray], 0])
                matches.setdefault(plane, []).append((positions[number], own[nearest], one.points[ray, 0]))
    normals, offsets = sources.planes.normals.clone(), sources.planes.offsets.clone()
    for plane, rows in matches.items():
        if len(rows) >= 3:
            receivers, bearings, points = (torch.stack(part).double() for part in zip(*rows, strict=True))
            start = (normals[plane].double(), offsets[plane].double())
            normal, offset = _moved(start, sources.tx.double(), receivers, bearings, points.mean(0), config)
            normals[plane], offsets[plane] = normal.float(), offset.float()
    return Planes(normals, offsets)


def _moved(
    plane: tuple[Tensor, Tensor], tx: Tensor, receivers: Tensor, bearings: Tensor, centre: Tensor, config: SourceConfig
) -> tuple[Tensor, Tensor]:
    """Normal and offset after Gauss and Newton's steps on the bearings of the image, robust against strangers."""
    normal, offset = plane
    lean = torch.linalg.cross(normal, torch.eye(3, dtype=normal.dtype)[normal.abs().argmin()])
    lean = lean / torch.linalg.vector_norm(lean)
    axes = torch.stack((lean, torch.linalg.cross(normal, lean)))
    away = normal @ centre - offset
    turn = math.radians(config.plane_error_deg)
    spread = torch.tensor([turn, turn, config.plane_error], dtype=normal.dtype)

    def placed(shift: Tensor) -> tuple[Tensor, Tensor]:
        turned = torch.nn.functional.normalize(normal + shift[:2] @ axes, dim=-1)
        return turned, turned @ centre - away + shift[2]

    def bearings_of(shift: Tensor) -> Tensor:
        turned, moved = placed(shift)
        return torch.nn.functional.normalize(mirrored(tx, turned, moved) - receivers, dim=-1)

    shift = torch.zeros(3, dtype=normal.dtype)
    for _ in range(STEPS):
        here = bearings_of(shift)
        miss = bearings - here
        step = 1e-4
        slope = torch.stack([(bearings_of(shift + step * one) - here) / step for one in torch.eye(3).double()], -1)
        size = torch.linalg.vector_norm(miss, dim=-1)
        weight = (BEARING / size.clamp_min(BEARING)) ** 2 / BEARING**2 * min(1.0, INDEPENDENT / len(size))
        left = torch.einsum("nik,n,nij->kj", slope, weight, slope) + torch.diag(1 / spread**2)
        right = torch.einsum("nik,n,ni->k", slope, weight, miss) - shift / spread**2
        shift = shift + torch.linalg.solve(left, right)
    return placed(shift)


@dataclass(frozen=True, eq=False)
class Mirror:
    """A plane that peaks imply: normal `[3]`, offset [m], where it was seen to reflect `[n, 3]` [m].

    image `[3]` is the point in which the bearings from receivers `[m, 3]` meet.
    """

    normal: Tensor
    offset: Tensor
    points: Tensor
    image: Tensor
    receivers: Tensor


def find_mirrors(
    sources: PointSources, rays: list[Rays], peaks: Peaks, spectra: Spectrum, obstacles: Obstacles
) -> list[Mirror]:
    """Mirrors implied by points in which bearings of peaks meet that no known source explains.

    A point counts where a tenth of the positions, and five at least, see a peak in it. Points on a surface that is in
    sight are bright spots and not images.
    """
    positions = spectra.pose.position
    limit = max(0.5 * spectra.instrument.lobe, pixel_of(spectra))
    free = torch.ones(len(peaks.position), dtype=torch.bool)
    for number, one in enumerate(rays):
        own = torch.nonzero(peaks.position == number).squeeze(-1)
        if len(own) and len(one):
            near = angle_between(peaks.bearing[own][:, None], one.arrival[None]).amin(-1)
            free[own] = near > 1.5 * spectra.instrument.lobe
    rest, mirrors = peaks.only(free), []
    least = max(LEAST_SUPPORT, math.ceil(LEAST_SHARE * len(spectra)))
    for _ in range(MOST_FOUND):
        if len(rest.position) < least:
            break
        origin, bearing = positions[rest.position].double(), rest.bearing.double()
        image, chosen = _meeting(origin, bearing, rest.position, limit)
        if len(rest.position[chosen].unique()) < least:
            break
        mirror = _implied(image.float(), sources.tx, positions[rest.position[chosen]], obstacles)
        if mirror is not None:
            mirrors.append(mirror)
        rest = rest.only(~chosen)
    return _of_one_reflection(mirrors, sources)


def _of_one_reflection(mirrors: list[Mirror], sources: PointSources) -> list[Mirror]:
    """The mirrors whose images are not images of images in the others and the large planes; weak ones go first."""
    kept = list(mirrors)
    large = torch.zeros(0, dtype=torch.bool) if sources.patches is None else sources.patches.large
    for mirror in reversed(mirrors):
        others = [one for one in kept if one is not mirror]
        normals = torch.cat((sources.planes.normals[large], *(one.normal[None] for one in others)))
        offsets = torch.cat((sources.planes.offsets[large], *(one.offset[None] for one in others)))
        rows = sequences(len(offsets), 2)
        rows = rows[rows[:, 1] >= 0]
        if not len(rows):
            continue
        images = image_chain(sources.tx, normals, offsets, rows)[:, -1]
        towards = angle_between((images[:, None] - mirror.receivers), (mirror.image - mirror.receivers)[None])
        if float(towards.median(-1).values.min()) < SAME_BEARING:
            kept = others
    return kept


def _meeting(origin: Tensor, bearing: Tensor, position: Tensor, limit: float) -> tuple[Tensor, Tensor]:
    """The point `[3]` in which bearings of most positions meet, and which bearings do `[n]`."""
    candidates = pairwise_meetings(origin, bearing)
    best, most = candidates[0], -1
    for chunk in candidates.split(2048):
        inlier = bearing_error(chunk[:, None], origin, bearing) < limit
        votes = torch.zeros(len(chunk), int(position.max()) + 1, dtype=torch.bool)
        for number in position.unique().tolist():
            votes[:, number] = inlier[:, position == number].any(-1)
        count = votes.sum(-1)
        if int(count.max()) > most:
            best, most = chunk[int(count.argmax())], int(count.max())
    for _ in range(10):
        chosen = bearing_error(best[None], origin, bearing) < limit
        if int(chosen.sum()) < 3:
            break
        best = closest_point(origin[chosen], bearing[chosen], best)
    return best, bearing_error(best[None], origin, bearing) < limit


def _implied(image: Tensor, tx: Tensor, receivers: Tensor, obstacles: Obstacles) -> Mirror | None:
    """The bisector of transmitter and image, or None where the point is the transmitter or a spot on a surface."""
    link = image - tx
    length = torch.linalg.vector_norm(link)
    if float(length) < NEAREST_IMAGE:
        return None
    normal = -link / length
    offset = normal @ (0.5 * (image + tx))
    height = receivers @ normal - offset
    if float((height > 0).double().mean()) < 0.8:
        return None
    towards = torch.nn.functional.normalize(image - receivers, dim=-1)
    short, beyond = image - SPOT * towards, image + SPOT * towards
    in_sight = obstacles.transmittance(receivers, short) > 0.5
    hit = obstacles.transmittance(short, beyond, stop_short=0.0) < 0.5
    if float((in_sight & hit).double().mean()) > 0.3:
        return None
    good = height > 0
    share = height[good] / (height[good] + (tx @ normal - offset))
    points = receivers[good] + share[:, None] * (image - receivers[good])
    return Mirror(normal, offset, points, image, receivers[good])


def with_mirrors(sources: PointSources, mirrors: list[Mirror]) -> tuple[Planes, Patches]:
    """Planes and patches completed by mirrors.

    A mirror that lies in a known plane gives it surface where it was seen to reflect; any other is a new plane.
    """
    assert sources.patches is not None
    normals, offsets = list(sources.planes.normals), list(sources.planes.offsets)
    points = surface_points(sources.planes, sources.patches)
    for mirror in mirrors:
        middle = mirror.points.mean(0)
        for plane, (normal, offset) in enumerate(zip(normals, offsets, strict=True)):
            same = abs(float(normal @ mirror.normal)) > SAME_ANGLE
            if same and abs(float(normal @ middle - offset)) < SAME_DISTANCE:
                place = plane
                break
        else:
            place = len(points)
            normals.append(mirror.normal)
            offsets.append(mirror.offset)
            points.append(torch.zeros(0, 3))
        points[place] = torch.cat((points[place], discs(mirror, sources.patches, place)))
    planes = Planes(torch.stack(normals), torch.stack(offsets))
    return planes, Patches.of(planes, points, sources.patches.cell)


def discs(mirror: Mirror, patches: Patches, plane: int, reaches: tuple[float, float] = DISC) -> Tensor:
    """Points `[n, 3]`, a cell apart, all over discs of surface around where a mirror was seen to reflect.

    Discs reach as far as the third nearest such place, so that sparse observations still close to one surface, from the
    least to the most of `reaches` [m]. Where the `plane`, if it is one of the `patches`, has surface already there is
    none: its outline stays.
    """
    missing = torch.ones(len(mirror.points), dtype=torch.bool)
    if plane < len(patches):
        missing = ~patches.holds(mirror.points, torch.tensor(plane))
    lean = torch.linalg.cross(mirror.normal, torch.eye(3)[mirror.normal.abs().argmin()])
    lean = lean / torch.linalg.vector_norm(lean)
    axes = torch.stack((lean, torch.linalg.cross(mirror.normal, lean)))
    apart = torch.cdist(mirror.points, mirror.points).sort(-1).values
    reach = apart[:, min(3, len(apart) - 1)].clamp(*reaches)
    cells = round(reaches[1] / patches.cell)
    steps = torch.arange(-cells, cells + 1.0) * patches.cell
    spots = torch.cartesian_prod(steps, steps)
    inside = (spots.norm(dim=-1) <= reach[:, None]) & missing[:, None]
    return (mirror.points[:, None] + spots @ axes)[inside]


def completed(sources: PointSources, planes: Planes, patches: Patches) -> PointSources:
    """The sources over other planes: reflections of new planes are those of the mean plane; images are left out."""
    new = len(planes) - len(sources.planes)
    mean = sources.reflection.mean(0, keepdim=True) if len(sources.reflection) else torch.zeros(1, 3)
    reflection = torch.cat((sources.reflection, mean.expand(new, 3)))
    return replace(sources, planes=planes, patches=patches, reflection=reflection, sequence=sources.sequence[:1])
