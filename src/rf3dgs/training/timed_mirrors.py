"""Mirrors told by single peaks: bearing, delay and departure of one peak say where the image stands and whether one
reflection made it.

A receiver at q that sees a mirror in direction u after the delay tau has the transmitter's image at s = q + c tau u. If
there was one reflection, the mirror is the bisector of the transmitter and s, and the wave left towards the point in
which the way from q to s meets it; after two reflections it left in another direction. Images of one mirror are one
point for all receivers.
"""

import math

import torch
from torch import Tensor

from rf3dgs.core.angles import angle_between
from rf3dgs.core.units import SPEED_OF_LIGHT
from rf3dgs.field.images import image_chain, sequences
from rf3dgs.field.sources import PointSources
from rf3dgs.geometry import Patches, Planes
from rf3dgs.geometry.patches import surface_points
from rf3dgs.spectra.spectrum import Spectrum
from rf3dgs.training.virtual import DISC, NEAREST_IMAGE, Mirror, Peaks, discs

STANDS_OUT = 4.0  # over the surroundings: a peak's delay is then nearly its own
DEPARTURE = math.radians(2.0)
SAME_IMAGE = 0.3  # m
LEAST_POSITIONS = 4
MOST_FOUND = 20
SAME_ANGLE, SAME_DISTANCE = math.cos(math.radians(10.0)), 0.5
BESIDE_AXIS = 0.1  # m
SEEN_ANGLE, SEEN_DISTANCE, BESIDE = math.cos(math.radians(15.0)), 0.15, 0.5  # of mirrors that few positions saw
FEW_DISC = (0.2, 0.2)  # m of surface around their reflections where there is no plane
SMALL_DISC = (0.2, 0.4)  # and around any where the plane is small: tops of a table and of benches lie in one
ROUNDS = 5


def timed_mirrors(peaks: Peaks, spectra: Spectrum, tx: Tensor, walls: Tensor) -> list[Mirror]:
    """The mirrors that `peaks` of `spectra` `[position, row, col]` tell of a transmitter at `tx` `[3]`, those that most
    positions see first; none where spectra have no delay or departure.

    An image counts that four positions see within 30 cm of one place, unless two or three reflections in the mirrors
    that more positions see put one there, too: three in floor and ceiling leave the transmitter as one does. Nor does
    it if one of those mirrors has it from where a board along one of the `walls` `[wall, 3]`, unit normals, would put
    it: what a board and the floor reflect seems to come from one tilted mirror over the edge between both. Of mirrors
    along walls, and inside the site, one position is witness enough: nothing else puts an image 10 cm beside an axis.
    """
    position, image = _images(peaks, spectra, tx)
    receivers, mirrors = spectra.pose.position, []
    while len(mirrors) < MOST_FOUND and len(position):
        mirror, near = _best(position, image, receivers, tx)
        if int(position[near].unique().numel()) < LEAST_POSITIONS:
            break
        twice = _is_image_of_image(mirror.image, tx, mirrors) or _is_image_of_board(mirror.image, tx, mirrors, walls)
        if len(mirror.points) and not twice:
            mirrors.append(mirror)
        position, image = position[~near], image[~near]
    bounds = [one for one in mirrors if bool((receivers @ one.normal > one.offset).all())]
    seldom: list[Mirror] = []
    while len(seldom) < MOST_FOUND and len(position):
        mirror, near = _best(position, image, receivers, tx)
        inside = all(bool((mirror.points @ one.normal > one.offset).all()) for one in bounds)
        along = _off_axis(tx - mirror.image, walls) < BESIDE_AXIS
        if len(mirror.points) and inside and along and not _is_image_of_image(mirror.image, tx, mirrors):
            seldom.append(mirror)
        position, image = position[~near], image[~near]
    return mirrors + seldom


def _best(position: Tensor, image: Tensor, receivers: Tensor, tx: Tensor) -> tuple[Mirror, Tensor]:
    """The mirror of the image that most positions see, and which of the images `[n]` are it."""
    near = torch.cdist(image, image) < SAME_IMAGE
    seen_by = torch.zeros(len(image), len(receivers)).index_add_(1, position, near.float()) > 0
    best = int(seen_by.sum(-1).argmax())
    chosen, middle = near[best], image[best]
    for _ in range(ROUNDS):
        middle = image[chosen].median(0).values
        chosen = torch.linalg.vector_norm(image - middle, dim=-1) < SAME_IMAGE
    normal, offset = _bisector(tx, middle)
    origin = receivers[position[chosen]]
    points, ahead = _crossing(origin, middle, tx, normal, offset)
    return Mirror(normal, offset, points[ahead], middle, origin[ahead]), chosen | near[best]


def with_timed(sources: PointSources, mirrors: list[Mirror]) -> tuple[Planes, Patches]:
    """Planes and patches put right by mirrors.

    A plane within 10 degrees and 50 cm of a mirror, at the places where that was seen to reflect, is moved into it and
    has surface there, the largest such plane alone; a mirror without one is a new plane. Of a mirror that few positions
    saw it is the plane with most surface within 50 cm of those places, within 15 degrees and 15 cm.
    """
    assert sources.patches is not None
    normals, offsets = list(sources.planes.normals), list(sources.planes.offsets)
    points = surface_points(sources.planes, sources.patches)
    areas, large = sources.patches.areas, sources.patches.large.tolist()
    taken: set[int] = set()
    for mirror in mirrors:
        middle = mirror.points.median(0).values
        few = len(mirror.points) < LEAST_POSITIONS
        angle, distance = (SEEN_ANGLE, SEEN_DISTANCE) if few else (SAME_ANGLE, SAME_DISTANCE)
        surface = (
            [float((torch.cdist(part, middle[None]) < BESIDE).sum()) for part in points] if few else areas.tolist()
        )
        alike = [
            plane
            for plane in range(len(areas))
            if plane not in taken
            and abs(float(normals[plane] @ mirror.normal)) > angle
            and abs(float(normals[plane] @ middle - offsets[plane])) < distance
            and surface[plane] > 0
        ]
        plane = max(alike, key=surface.__getitem__, default=len(points))
        if alike:
            side = float((normals[plane] @ mirror.normal).sign())
            normals[plane], offsets[plane] = side * mirror.normal, side * mirror.offset
        else:
            normals.append(mirror.normal)
            offsets.append(mirror.offset)
            points.append(torch.zeros(0, 3))
        taken.add(plane)
        wide, narrow = (large[plane], SMALL_DISC) if alike else (not few, FEW_DISC)
        reaches = DISC if wide else narrow
        points[plane] = torch.cat((points[plane], discs(mirror, sources.patches, plane, reaches)))
    planes = Planes(torch.stack(normals), torch.stack(offsets))
    return planes, Patches.of(planes, points, sources.patches.cell)


def _is_image_of_image(image: Tensor, tx: Tensor, mirrors: list[Mirror]) -> bool:
    """Whether two or three reflections in `mirrors` put the transmitter beside `image` `[3]`."""
    count = len(mirrors)
    if not count:
        return False
    rows = torch.cat((sequences(count, 2), sequences(0, 0, third=torch.arange(count))[1:]))
    rows = rows[rows[:, 1] >= 0]
    normals, offsets = (torch.stack([getattr(one, name) for one in mirrors]) for name in ("normal", "offset"))
    apart = image_chain(tx, normals, offsets, rows)[:, -1] - image
    return bool((torch.linalg.vector_norm(apart, dim=-1) < 2 * SAME_IMAGE).any())


def _is_image_of_board(image: Tensor, tx: Tensor, mirrors: list[Mirror], walls: Tensor) -> bool:
    """Whether one of the `mirrors` has `image` `[3]` from the transmitter's in a board along one of the `walls`."""
    if _off_axis(tx - image, walls) < SAME_IMAGE:
        return False
    before = [image + 2 * (one.offset - one.normal @ image) * one.normal for one in mirrors]
    return any(_off_axis(tx - place, walls) < 2 * SAME_IMAGE for place in before)


def _off_axis(way: Tensor, axes: Tensor) -> float:
    """How far the end of a `way` `[3]` lies off the nearest of the `axes` `[axis, 3]` through its start [m]."""
    aside = way - (axes @ way)[:, None] * axes
    return min(torch.linalg.vector_norm(aside, dim=-1).tolist(), default=math.inf)


def _images(peaks: Peaks, spectra: Spectrum, tx: Tensor) -> tuple[Tensor, Tensor]:
    """Positions `[n]` and images `[n, 3]` [m] of the peaks that one reflection explains."""
    positions, images = [], []
    if spectra.delay is None or spectra.aod is None:
        return torch.zeros(0, dtype=torch.long), torch.zeros(0, 3)
    peaks = peaks.only(peaks.over > STANDS_OUT)
    for number in range(len(spectra)):
        one = spectra[number]
        assert one.delay is not None
        assert one.aod is not None
        directions = one.directions.reshape(-1, 3)
        for bearing in peaks.bearing[peaks.position == number]:
            pixel = int((directions @ bearing).argmax())
            way = float(one.delay.flatten()[pixel]) * SPEED_OF_LIGHT
            image = one.pose.position + way * bearing
            if float(torch.linalg.vector_norm(image - tx)) < NEAREST_IMAGE:
                continue
            normal, offset = _bisector(tx, image)
            point, ahead = _crossing(one.pose.position[None], image, tx, normal, offset)
            left = one.aod.reshape(-1, 3)[pixel]
            if (
                bool(ahead)
                and float(angle_between(left, torch.nn.functional.normalize(point[0] - tx, dim=-1))) < DEPARTURE
            ):
                positions.append(number)
                images.append(image)
    where = torch.tensor(positions, dtype=torch.long)
    return where, torch.stack(images) if images else torch.zeros(0, 3)


def _bisector(tx: Tensor, image: Tensor) -> tuple[Tensor, Tensor]:
    """Normal `[3]`, towards the transmitter, and offset [m] of the plane in which `tx` is mirrored to `image`."""
    normal = torch.nn.functional.normalize(tx - image, dim=-1)
    return normal, normal @ (0.5 * (image + tx))


def _crossing(origin: Tensor, image: Tensor, tx: Tensor, normal: Tensor, offset: Tensor) -> tuple[Tensor, Tensor]:
    """Where ways from `origin` `[n, 3]` to an image cross its mirror `[n, 3]`, and which begin before it `[n]`."""
    height = origin @ normal - offset
    share = height / (height + (tx @ normal - offset)).clamp_min(1e-6)
    return origin + share[:, None] * (image - origin), height > 0
