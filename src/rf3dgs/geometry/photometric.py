"""Planes moved to where photographs agree: what is flat shows the same picture from everywhere.

Each photograph that sees a plane is drawn onto it; where the plane is in the right place all drawings are alike, and
posters or tiles need not be matched one by one. Windows of local contrast are compared, so that light and exposure do
not matter. Collins (1996) with the plane itself as the space that is swept.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import adaptive_avg_pool2d, avg_pool2d, grid_sample

from rf3dgs.core.grids import Camera
from rf3dgs.geometry.patches import Patches
from rf3dgs.geometry.planes import Planes
from rf3dgs.splats.compositing import Compositing
from rf3dgs.splats.draw import draw
from rf3dgs.splats.gaussians import Gaussians

STEP = 0.06  # of the drawings on a plane [m]
WINDOW = 9  # steps
LEAST_CONTRAST = 0.015  # a flatter window says nothing
OPEN, NOTHING = 0.5, 1e4  # a pixel drawn with less weight hides nothing: its depth is this [m]
GRAZING = 0.2  # cosine below which a photograph sees a plane too flatly
OFF_DEPTH = 0.05  # a photograph that draws another depth, by this share, shows another colour
HIDDEN = 0.85  # what is drawn nearer than this share of the plane's distance hides it
MOST_PHOTOS = 16
LEVELS = 5  # of the pictures, each half as large as the one before
MARGIN = 0.5  # what lies this far beside a patch, within the site, is looked at too [m]
SWEEP = 0.06  # [m]
ROUNDS = 3
ALONE = ((-1, 0, 0), (1, 0, 0), (0, -1, 0), (0, 1, 0), (0, 0, -1), (0, 0, 1))
WAYS = (
    *ALONE,
    (-1, -1, 0),
    (-1, 1, 0),
    (1, -1, 0),
    (1, 1, 0),
)  # of offset and tilts; pictures hang to one side of walls
LARGEST = 8.0  # of larger planes the middle is looked at, up to this size [m]
LEAST_AGREEMENT = 0.005  # gain in agreement below which a plane stays where it is
TILT_COST = 0.004  # and what a tilt must gain for each degree: from afar and from one height tilts hardly show


@dataclass(frozen=True, eq=False)
class Sight:
    """A photograph as the refinement needs it: camera, picture (bytes `[row, col, 3]`), the same in grey (0 to 1,
    `[row, col]`) at full, half, quarter ... size, and the depth that is drawn there `[row, col]` [m].
    """

    camera: Camera
    picture: Tensor
    greys: tuple[Tensor, ...]
    depth: Tensor

    @classmethod
    def of(cls, gaussians: Gaussians, camera: Camera, picture: Tensor) -> "Sight":
        """The photograph, with the depth of the Gaussians."""
        raster = draw(gaussians, camera, depth=True, compositing=Compositing(depth_gate=0.3, normalise=True))
        depth = torch.where(raster.weight > OPEN, raster.values[..., -1], NOTHING)
        greys = [picture.float().mean(-1) / 255.0]
        while len(greys) < LEVELS:
            rows, columns = greys[-1].shape
            greys.append(adaptive_avg_pool2d(greys[-1][None], ((rows + 1) // 2, (columns + 1) // 2))[0])
        return cls(camera, picture, tuple(greys), depth)

    def grey_for(self, depth: Tensor) -> Tensor:
        """The picture in grey with pixels about as large as a `STEP` on what lies at depths `depth` [m]."""
        pixels = STEP * float(self.camera.K[0, 0]) / max(float(depth.median()), STEP)
        return self.greys[min(max(0, round(math.log2(pixels))), LEVELS - 1)]


def refine_planes(
    gaussians: Gaussians,
    planes: Planes,
    patches: Patches,
    cameras: Sequence[Camera],
    pictures: Sequence[Tensor],
    *,
    reach: float = 0.5,
    tilt_deg: float = 3.0,
    min_area: float = 4.0,
) -> tuple[Planes, Tensor]:
    """The planes moved along their normals (at most `reach` [m]) and tilted (`tilt_deg`) to where photographs agree.

    `pictures` are bytes `[row, col, 3]`. Planes with less than `min_area` [m^2] stay. Returns the planes and how well
    the photographs agree on each, 0 to 1, NaN where it was not tried or nothing is seen.
    """
    sights = [Sight.of(gaussians, camera, picture) for camera, picture in zip(cameras, pictures, strict=True)]
    normals, offsets = planes.normals.clone(), planes.offsets.clone()
    agreed = torch.full((len(planes),), math.nan)
    low, high = torch.quantile(gaussians.means, torch.tensor([0.01, 0.99]), dim=0)
    box = torch.cartesian_prod(*torch.stack((low, high), -1))
    areas = patches.areas
    for plane in range(len(planes)):
        if float(areas[plane]) < min_area:
            continue
        found = _refine(sights, patches, plane, normals[plane], offsets[plane], box, reach, tilt_deg)
        if found is not None:
            normals[plane], offsets[plane], agreed[plane] = found
    return Planes(normals, offsets), agreed


def _refine(
    sights: Sequence[Sight],
    patches: Patches,
    plane: int,
    normal: Tensor,
    offset: Tensor,
    box: Tensor,
    reach: float,
    tilt: float,
) -> tuple[Tensor, Tensor, float] | None:
    """The best plane near the given one by a coarse sweep of offsets and finer steps of offset and both tilts."""
    axes = patches.axes[plane]
    low = patches.low[plane]
    low, high = low - MARGIN, low + patches.shape[plane] * patches.cell + MARGIN
    low, high = torch.maximum(low, (box @ axes.mT).amin(0)), torch.minimum(high, (box @ axes.mT).amax(0))
    middle = 0.5 * (low + high)
    low, high = torch.maximum(low, middle - LARGEST / 2), torch.minimum(high, middle + LARGEST / 2)
    spans = [torch.arange(float(a), float(b), STEP) for a, b in zip(low, high, strict=True)]
    local = torch.stack(torch.meshgrid(*spans, indexing="ij"), -1)
    if local.numel() < 2 * WINDOW**2:
        return None
    centre = local.mean((0, 1))
    sights = _best_sights(sights, centre @ axes + offset * normal, normal)
    if len(sights) < 3:
        return None

    def agreement(move: Sequence[float]) -> float:
        turned = torch.nn.functional.normalize(
            normal + math.tan(move[1]) * axes[0] + math.tan(move[2]) * axes[1], dim=-1
        )
        pivot = centre @ axes + (offset + move[0]) * normal
        points = (local - centre) @ axes
        points = points - (points @ turned)[..., None] * turned + pivot
        return agreement_on(sights, points, turned) - TILT_COST * math.degrees(abs(move[1]) + abs(move[2]))

    best, move = agreement((0.0, 0.0, 0.0)), [0.0, 0.0, 0.0]
    first = best
    for value in torch.arange(-reach, reach + 1e-6, SWEEP).tolist():
        trial = agreement((value, 0.0, 0.0))
        if trial > best:
            best, move = trial, [value, 0.0, 0.0]
    step = [SWEEP / 2, math.radians(tilt) / 2, math.radians(tilt) / 2]
    limit = (reach, math.radians(tilt), math.radians(tilt))
    for _ in range(ROUNDS):
        before = -1.0
        while best > before + LEAST_AGREEMENT:
            before = best
            for way in WAYS:
                changed = [value + sign * size for value, sign, size in zip(move, way, step, strict=True)]
                allowed = all(abs(value) <= most + 1e-6 for value, most in zip(changed, limit, strict=True))
                trial = agreement(changed) if allowed else 0.0
                if trial > best:
                    best, move = trial, changed
        step = [value / 2 for value in step]
    if best < first + LEAST_AGREEMENT:
        return normal, offset, first
    turned = _tilted(normal, axes, move)
    return turned, turned @ (centre @ axes + (offset + move[0]) * normal), best


def _tilted(normal: Tensor, axes: Tensor, move: Sequence[float]) -> Tensor:
    """The normal tilted by `move[1]` and `move[2]` [rad] towards the plane's `axes` `[2, 3]`."""
    return torch.nn.functional.normalize(normal + math.tan(move[1]) * axes[0] + math.tan(move[2]) * axes[1], dim=-1)


def _best_sights(sights: Sequence[Sight], centre: Tensor, normal: Tensor) -> list[Sight]:
    """At most `MOST_PHOTOS` that look at the front of a plane, the straightest and nearest first."""
    scores = []
    for sight in sights:
        away = sight.camera.position - centre
        distance = float(torch.linalg.vector_norm(away))
        facing = float(-sight.camera.viewmat[2, :3] @ normal)
        scores.append(facing / max(distance, 1.0) if float(away @ normal) > 0.2 and facing > 0 else 0.0)
    order = sorted(range(len(sights)), key=lambda index: -scores[index])[:MOST_PHOTOS]
    return [sights[index] for index in order if scores[index] > 0]


def agreement_on(sights: Sequence[Sight], points: Tensor, normal: Tensor) -> float:
    """How alike the photographs are on a plane's points `[row, col, 3]`: mean correlation of windows over all pairs."""
    total, squares, count, _ = _compared(sights, points, normal)
    several = count >= 2
    if int(several.sum()) < WINDOW**2:
        return 0.0
    pairs = (total.square() - squares)[several].sum()
    return float(pairs / ((count - 1) * squares)[several].sum().clamp_min(1e-6))


def agreement_at(sights: Sequence[Sight], points: Tensor, normal: Tensor) -> tuple[Tensor, Tensor]:
    """How alike the photographs are at each of a plane's points `[row, col, 3]`, and how many see it.

    The first is NaN where fewer than two photographs have anything to compare.
    """
    total, squares, count, seen = _compared(sights, points, normal)
    pairs, most = _window(total.square() - squares), _window((count - 1).clamp_min(0.0) * squares)
    return torch.where(most > 1e-6, pairs / most.clamp_min(1e-6), math.nan), seen


def colours_at(sights: Sequence[Sight], points: Tensor, normal: Tensor) -> Tensor:
    """The colours `[point, 3]`, 0 to 1, of a plane's points `[point, 3]` in the photographs that see them.

    Near photographs count more, and those that draw the plane's own depth there; 0.5 where none sees a point.
    """
    total, weight = torch.full((len(points), 3), 1e-9 / 2), torch.full((len(points), 1), 1e-9)
    for sight in sights:
        where, z, drawn, seen = _seen(sight, points[None], normal)
        picture = sight.picture.permute(2, 0, 1)[None].float() / 255.0
        colour = grid_sample(picture, where[None], align_corners=False, padding_mode="border")[0, :, 0].mT
        off = ((drawn / z.clamp_min(1e-3) - 1) / OFF_DEPTH).clamp(-3, 3)
        share = torch.where(seen, 1 / (z.clamp_min(0.2).square() * (1 + off.square())), 0.0)[0, :, None]
        total, weight = total + share * colour, weight + share
    return total / weight


def _compared(sights: Sequence[Sight], points: Tensor, normal: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Sum and sum of squares of the photographs' normalised local contrast at points `[row, col, 3]`, how many have
    any there, and how many see them.
    """
    total, squares, count, views = (torch.zeros(points.shape[:2]) for _ in range(4))
    for sight in sights:
        where, z, _, seen = _seen(sight, points, normal)
        if not bool(seen.any()):
            continue
        grey = sight.grey_for(z[seen])[None, None]
        values = grid_sample(grey, where[None], align_corners=False, padding_mode="border")[0, 0]
        mean = _window(values)
        spread = (_window(values.square()) - mean.square()).clamp_min(0.0).sqrt()
        clear = seen & (spread > LEAST_CONTRAST) & (_window(seen.float()) > 0.99)
        signal = torch.where(clear, (values - mean) / spread.clamp_min(1e-6), 0.0).clamp(-3, 3)
        total, squares, count = total + signal, squares + signal.square(), count + clear
        views = views + seen
    return total, squares, count, views


def _seen(sight: Sight, points: Tensor, normal: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Where points `[row, col, 3]` are in a photograph (`grid_sample`'s two numbers), their depth and what is drawn
    there [m], and whether the photograph sees them.
    """
    camera = sight.camera
    x, y, z = (points @ camera.viewmat[:3, :3].mT + camera.viewmat[:3, 3]).unbind(-1)
    depth = z.clamp_min(1e-3)
    column = (camera.K[0, 0] * x / depth + camera.K[0, 2]) * (2 / camera.width) - 1
    row = (camera.K[1, 1] * y / depth + camera.K[1, 2]) * (2 / camera.height) - 1
    where = torch.stack((column, row), -1)
    drawn = grid_sample(sight.depth[None, None], where[None], align_corners=False, padding_mode="border")[0, 0]
    towards = camera.position - points
    cosine = (towards @ normal) / torch.linalg.vector_norm(towards, dim=-1).clamp_min(1e-6)
    inside = (where.abs() < 1).all(-1) & (z > 0.2)
    return where, z, drawn, inside & (cosine > GRAZING) & (drawn > HIDDEN * z)


def _window(values: Tensor) -> Tensor:
    half = WINDOW // 2
    return avg_pool2d(values[None, None], WINDOW, 1, half, count_include_pad=False)[0, 0]
