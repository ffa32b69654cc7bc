"""Where and at which angles planes reflect otherwise than their laws say: doors and windows in walls, told by peaks
and by photographs, and the interference in thin layers, which comes and goes with the angle.

What the peaks deviate from the laws is told apart into deviations at the places and at the angles of their reflections
by a Gaussian process. Deviations of one plane are alike near each other and where the photographs show like hues,
and at like angles. The former are painted onto a lattice over the plane, the latter onto one of cosines.
"""

from dataclasses import dataclass

import torch
from torch import Tensor

from rf3dgs.core.threads import on_threads
from rf3dgs.field.reflections import RIPPLE, Marks
from rf3dgs.field.sources import PointSources
from rf3dgs.geometry.patches import surface_points
from rf3dgs.splats.gaussians import Gaussians
from rf3dgs.splats.harmonics import C0
from rf3dgs.training.reflection import Glints, expected_db

PLACES = ((0.3, 0.0), (0.8, 0.0), (2.0, 0.06))  # widths [m] and differences of looks that are tried; 0: any
COSINES = (0.03, 0.06)  # of incidence: widths that are tried
BRUSH = 0.25  # m over which colours are averaged
AT_ONCE = 128  # places whose looks are asked together
DIM = 0.15  # red, green and blue together: darker colours are the greyer, the darker they are
BRIGHTNESS = 0.12  # what a difference of brightness counts beside one of hue, for how bright a wall is depends on lamps
LATTICE = 0.3  # m between marks
LEAST_MARKS = 10  # peaks of one reflection
WORTH_DB = 0.4
LEAST_DB = 0.5  # of deviation that is painted
DOUBTFUL_DB = 6.0
MOST_DB = 25.0
DEVIATION_DB, RIPPLE_DB = 8.0, 4.0  # standard deviations: of a place, and of an angle
NOISE_DB = 1.0  # of a peak's level for each reflection
ROUNDS = 3
NO_PLACE = (0.0, 0.0)
TRIALS = [
    (*place, cosine) for place in (NO_PLACE, *PLACES) for cosine in (0.0, *COSINES) if place != NO_PLACE or cosine
]
"""Of deviations by place and by angle."""
MOST_PEAKS = 1500


@dataclass(frozen=True, eq=False)
class Paint:
    """What Gaussians look like: means `[N, 3]` [m], plane `[N]`, colours `[N, 3]` in 0..1, weight `[N]` of each."""

    means: Tensor
    plane: Tensor
    colours: Tensor
    weight: Tensor

    @classmethod
    def of(cls, geometry: Gaussians, plane_of: Tensor) -> "Paint":
        """The colours of the Gaussians that belong to planes `plane_of` `[N]`, by the area that they show."""
        area = geometry.scales.sort(-1).values[:, 1:].prod(-1)
        parts = (geometry.means, plane_of, (0.5 + C0 * geometry.sh[:, 0]).clamp(0, 1), geometry.opacities * area)
        known = (plane_of >= 0) & (geometry.sh.abs().amax((-2, -1)) > 0)
        return cls(*(part.detach()[known] for part in parts))

    def at(self, points: Tensor, plane: Tensor) -> Tensor:
        """Looks `[n, 4]` around points `[n, 3]` [m] of planes `[n]`: hue, the shares of red, green and blue, and
        brightness times `BRIGHTNESS`; grey where nothing is painted."""
        result = torch.full((len(points), 3), 0.5)
        parts = []
        for number in plane.unique().tolist():
            own = self.plane == number
            known = self.means[own], self.colours[own], self.weight[own]
            parts += [(here, *known) for here in torch.nonzero(plane == number).squeeze(-1).split(AT_ONCE)]

        def painted(part: tuple[Tensor, Tensor, Tensor, Tensor]) -> None:
            here, means, colours, weight = part
            near = torch.cdist(points[here], means).square_().mul_(-0.5 / BRUSH**2).exp_().mul_(weight)
            whole = near.sum(-1, keepdim=True)
            result[here] = torch.where(whole > 1e-9, near @ colours / whole.clamp_min(1e-12), 0.5)

        on_threads(painted, parts)
        total = result.sum(-1, keepdim=True)
        return torch.cat((result / total.clamp_min(DIM), BRIGHTNESS / 3 * total), -1)


@dataclass(frozen=True, eq=False)
class _Peaks:
    """n peaks and their m reflections on planes that may deviate.

    miss `[n]`: what is expected of them lacks [dB]. noise `[n]`: its variance. peak, plane `[m]`, point `[m, 3]` [m],
    cosine `[m]`, looks `[m, 4]`: of each reflection.
    """

    miss: Tensor
    noise: Tensor
    peak: Tensor
    plane: Tensor
    point: Tensor
    cosine: Tensor
    looks: Tensor

    def on(self, marked: Tensor) -> "_Peaks":
        """The peaks with their reflections on the planes that are `marked` `[P]`."""
        own = marked[self.plane]
        reflections = (self.peak, self.plane, self.point, self.cosine, self.looks)
        return _Peaks(self.miss, self.noise, *(each[own] for each in reflections))


def fit_deviations(
    found: Glints, sources: PointSources, paint: Paint | None = None
) -> tuple[Marks | None, Tensor | None]:
    """Where planes reflect otherwise than `sources` has it so far, and at which angles: a ripple `[P, RIPPLE]` [dB];
    None where that predicts no plane better.

    A plane deviates if its peaks are told `WORTH_DB` better by the other peaks than by none; those of two reflections
    count half for each plane. How near, and of how like looks in `paint`, places are alike, and how near angles, is for
    each plane what tells its peaks best. Deep losses that hardly stand over their surroundings tell nothing, nor do
    peaks of two reflections without a delay that says whose they are.
    """
    miss = found.level_db - expected_db(found, sources)
    doubtful = (miss < -DOUBTFUL_DB) & (found.level_db < found.limit_db + DOUBTFUL_DB)
    sure = found.timed | (found.order == 1)
    used = torch.nonzero(found.alone & found.seen & sure & ~doubtful).squeeze(-1)
    used = used[found.order[used].argsort(stable=True)[:MOST_PEAKS]]
    found, miss = found.only(used), miss[used].clamp(-MOST_DB, MOST_DB)
    planes = len(sources.planes)
    enough = torch.bincount(found.plane[found.order == 1, 0], minlength=planes) >= LEAST_MARKS
    peaks = _peaks(found, miss, paint).on(enough)
    part = 1 / found.order.double()[peaks.peak]
    weight = torch.zeros(planes, dtype=torch.float64).index_add_(0, peaks.plane, part)
    spread, gain = torch.zeros(planes, 3), torch.zeros(planes, dtype=torch.float64)

    def gained(trial: Tensor) -> Tensor:
        _, others = _explained(peaks, _features(peaks, trial.expand(planes, 3)))
        better = (miss.abs() - (miss - others).abs())[peaks.peak]
        return torch.zeros_like(gain).index_add_(0, peaks.plane, part * better) / weight.clamp_min(1)

    coloured = paint is not None and len(paint.means) > 0
    trials = [torch.tensor(trial) for trial in TRIALS if coloured or not trial[1]]
    for trial, mean in zip(trials, on_threads(gained, trials), strict=True):
        spread[mean > gain], gain = trial, torch.maximum(gain, mean)
    worth = gain > WORTH_DB
    if not bool(worth.any()):
        return None, None
    peaks = peaks.on(worth)
    features = _features(peaks, spread)
    share, _ = _explained(peaks, features)
    assert sources.patches is not None
    surface = surface_points(sources.planes, sources.patches)
    ripple, parts = torch.zeros(planes, RIPPLE), []
    for number in torch.nonzero(worth).squeeze(-1).tolist():
        own = peaks.plane == number
        known, told = features.only(own), share[peaks.peak[own]]
        if bool(spread[number, 2] > 0):
            angles = torch.linspace(0, 1, RIPPLE, dtype=torch.float64) / spread[number, 2]
            ripple[number] = (_alike(angles[:, None], known.angle, RIPPLE_DB) @ told).float()
        if bool(spread[number, 0] > 0):
            places = _lattice(surface[number], sources.patches.axes[number])
            plane = torch.full((len(places),), number)
            looks = _looks(paint, places, plane)
            level_db = _alike(_places(places, looks, spread[plane]), known.place, DEVIATION_DB) @ told
            loud = level_db.abs() > LEAST_DB  # and what is beside it, so that it ends there
            kept = (torch.cdist(places, places[loud]) < 2 * LATTICE).any(-1)
            parts.append((places[kept], plane[kept], level_db[kept].float()))
    marks = None
    if parts:
        where, plane, level_db = (torch.cat(column) for column in zip(*parts, strict=True))
        marks = Marks(where, plane, level_db, LATTICE / 2)
    return marks, ripple if bool((spread[:, 2] > 0)[worth].any()) else None


def _peaks(found: Glints, miss: Tensor, paint: Paint | None) -> _Peaks:
    """The peaks with all their reflections."""
    at = peak, _ = torch.nonzero(found.plane >= 0, as_tuple=True)
    noise = (NOISE_DB * found.order.double()) ** 2
    point, plane = found.point[at], found.plane[at]
    return _Peaks(miss, noise, peak, plane, point, found.cosine[at], _looks(paint, point, plane))


def _looks(paint: Paint | None, point: Tensor, plane: Tensor) -> Tensor:
    """`Paint.at`, or looks `[n, 4]` that are all alike."""
    return torch.zeros(len(point), 4) if paint is None else paint.at(point, plane)


@dataclass(frozen=True, eq=False)
class _Features:
    """What makes m reflections alike: place `[m, 7]`, where they are and how they look, in units of the width [m] and
    the difference of looks of each plane; angle `[m, 1]`, the cosine in units of its width. Where a plane does not
    deviate by places, or not by angles, by_place or by_angle `[m]` is 0, else 1."""

    place: Tensor
    angle: Tensor
    by_place: Tensor
    by_angle: Tensor

    def only(self, chosen: Tensor) -> "_Features":
        """Some of them, by a mask or list."""
        return _Features(self.place[chosen], self.angle[chosen], self.by_place[chosen], self.by_angle[chosen])


def _features(peaks: _Peaks, spread: Tensor) -> _Features:
    """The features of the peaks' reflections by the widths of each plane, `spread` `[P, 3]`: [m], of looks, of
    the cosine."""
    own = spread[peaks.plane]
    angle = (peaks.cosine / own[:, 2].clamp_min(1e-6)).double()[:, None]
    by_place, by_angle = (own[:, [0, 2]] > 0).double().unbind(-1)
    return _Features(_places(peaks.point, peaks.looks, own), angle, by_place, by_angle)


def _places(point: Tensor, looks: Tensor, spread: Tensor) -> Tensor:
    """`_Features.place` of places `[n, 3]` [m] with looks `[n, 4]`, by the widths `[n, 3]` of their planes."""
    width, unlike = spread[:, :2].clamp_min(1e-6).unbind(-1)
    told = torch.where((spread[:, 1] > 0)[:, None], looks / unlike[:, None], 0.0)
    return torch.cat((point / width[:, None], told), -1).double()


def _alike(first: Tensor, second: Tensor, std_db: float) -> Tensor:
    """The covariance `[n, m]` [dB^2] of deviations of one plane with features `[n, k]` and `[m, k]`."""
    return std_db**2 * torch.exp(-0.5 * torch.cdist(first, second) ** 2)


def _together(features: _Features) -> Tensor:
    """The covariance `[m, m]` [dB^2] of the deviations of reflections of one plane, of places and angles together."""
    place = _alike(features.place, features.place, DEVIATION_DB) * features.by_place
    return place + _alike(features.angle, features.angle, RIPPLE_DB) * features.by_angle


def _explained(peaks: _Peaks, features: _Features) -> tuple[Tensor, Tensor]:
    """The weights `[n]` of the peaks in every deviation, and what the other peaks say of each `[n]` [dB]; robust."""
    together = torch.zeros(len(peaks.miss), len(peaks.miss), dtype=torch.float64)
    for plane in peaks.plane.unique().tolist():
        own = torch.nonzero(peaks.plane == plane).squeeze(-1)
        rows = peaks.peak[own]
        together.index_put_((rows[:, None], rows), _together(features.only(own)), accumulate=True)
    noise, share, others = peaks.noise, peaks.miss, torch.zeros_like(peaks.miss)
    for _ in range(ROUNDS):
        inverse = torch.linalg.inv(together + torch.diag(noise))
        share = inverse @ peaks.miss
        others = peaks.miss - share / inverse.diagonal()
        noise = peaks.noise * ((peaks.miss - others).abs() / (3 * peaks.noise.sqrt())).clamp_min(1.0)
    return share, others


def _lattice(cells: Tensor, axes: Tensor) -> Tensor:
    """Places `[n, 3]` [m] all over `cells` `[cell, 3]` [m] of a plane, `LATTICE` apart along its `axes` `[2, 3]`."""
    _, place = torch.unique((cells @ axes.mT / LATTICE).floor().long(), dim=0, return_inverse=True)
    size = torch.bincount(place)
    return torch.zeros(len(size), 3).index_add_(0, place, cells) / size[:, None]
