"""Where planes reflect otherwise than their laws say: doors and windows in walls, told by peaks and by photographs.

What the peaks deviate from the laws is told apart into deviations at the places of their reflections by a Gaussian
process: deviations of one plane are alike near each other and where the photographs show like colours. The result is
painted onto a lattice over the plane.
"""

from dataclasses import dataclass

import torch
from torch import Tensor

from rf3dgs.core.threads import on_threads
from rf3dgs.field.sources import Marks
from rf3dgs.geometry import Patches, Planes
from rf3dgs.geometry.patches import surface_points
from rf3dgs.splats.gaussians import Gaussians
from rf3dgs.splats.harmonics import C0
from rf3dgs.training.reflection import Glints, law_levels

ALIKE = ((0.3, 0.0), (0.8, 0.0), (2.0, 0.2))  # widths [m] and differences of colour that are tried; 0: any colour
BRUSH = 0.25  # m over which colours are averaged
LATTICE = 0.3  # m between marks
LEAST_MARKS = 10  # peaks of one reflection
WORTH_DB = 0.4
LEAST_DB = 0.5  # of deviation that is painted
DOUBTFUL_DB = 6.0
MOST_DB = 25.0
DEVIATION_DB, NOISE_DB = 8.0, 1.0  # standard deviations: of a place, and of a peak's level for each reflection
ROUNDS = 3
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
        """Colours `[n, 3]` around points `[n, 3]` [m] of planes `[n]`; grey where nothing is painted."""
        result = torch.full((len(points), 3), 0.5)

        def painted(number: int) -> None:
            here, own = torch.nonzero(plane == number).squeeze(-1), self.plane == number
            near = torch.exp(-0.5 * torch.cdist(points[here], self.means[own]) ** 2 / BRUSH**2) * self.weight[own]
            total = near.sum(-1, keepdim=True)
            result[here] = torch.where(total > 1e-9, near @ self.colours[own] / total.clamp_min(1e-12), 0.5)

        on_threads(painted, plane.unique().tolist())
        return result


@dataclass(frozen=True, eq=False)
class _Peaks:
    """n peaks and their m reflections on planes that may have marks.

    miss `[n]`: what the laws lack [dB]. noise `[n]`: its variance. peak, plane `[m]`, point `[m, 3]` [m]: of each
    reflection.
    """

    miss: Tensor
    noise: Tensor
    peak: Tensor
    plane: Tensor
    point: Tensor


def fit_marks(
    found: Glints, reflection: Tensor, planes: Planes, patches: Patches, paint: Paint | None = None
) -> Marks | None:
    """Where planes reflect otherwise than `reflection` `[P, 3]` says, or None where that predicts no plane better.

    A plane has marks if its peaks of one reflection are told `WORTH_DB` better by the other peaks than by none. How
    near, and of how like a colour in `paint`, places are alike is for each plane what tells its peaks best. Deep losses
    that hardly stand over their surroundings tell nothing.
    """
    miss = found.level_db - law_levels(found, reflection)
    doubtful = (miss < -DOUBTFUL_DB) & (found.level_db < found.limit_db + DOUBTFUL_DB)
    used = torch.nonzero(found.alone & found.seen & ~doubtful).squeeze(-1)
    used = used[found.order[used].argsort(stable=True)[:MOST_PEAKS]]
    found, miss = found.only(used), miss[used].clamp(-MOST_DB, MOST_DB)
    single = found.order == 1
    first = found.plane[single, 0]
    count = torch.bincount(first, minlength=len(reflection))
    spread, gain = torch.zeros(len(reflection), 2), torch.zeros(len(reflection), dtype=torch.float64)
    peaks = _peaks(found, miss, count >= LEAST_MARKS)
    for trial in ALIKE:
        if trial[1] and (paint is None or not len(paint.means)):
            continue
        features = _features(peaks.point, peaks.plane, torch.tensor(trial).expand(len(reflection), 2), paint)
        _, others = _explained(peaks, features)
        gained = (miss.abs() - (miss - others).abs())[single]
        mean = torch.zeros_like(gain).index_add_(0, first, gained) / count.clamp_min(1)
        spread[mean > gain], gain = torch.tensor(trial), torch.maximum(gain, mean)
    worth = (count >= LEAST_MARKS) & (gain > WORTH_DB)
    if not bool(worth.any()):
        return None
    peaks = _peaks(found, miss, worth)
    features = _features(peaks.point, peaks.plane, spread, paint)
    share, _ = _explained(peaks, features)
    parts, surface = [], surface_points(planes, patches)
    for number in torch.nonzero(worth).squeeze(-1).tolist():
        places, own = _lattice(surface[number], patches.axes[number]), peaks.plane == number
        here = _features(places, torch.full((len(places),), number), spread, paint)
        level_db = _alike(here, features[own]) @ share[peaks.peak[own]]
        loud = level_db.abs() > LEAST_DB  # and what is beside it, so that it ends there
        kept = (torch.cdist(places, places[loud]) < 2 * LATTICE).any(-1)
        parts.append((places[kept], torch.full((int(kept.sum()),), number), level_db[kept].float()))
    where, plane, level_db = (torch.cat(column) for column in zip(*parts, strict=True))
    return Marks(where, plane, level_db, LATTICE / 2)


def _peaks(found: Glints, miss: Tensor, marked: Tensor) -> _Peaks:
    """The peaks with their reflections on the planes that are `marked` `[P]`."""
    peak, step = torch.nonzero((found.plane >= 0) & marked[found.plane], as_tuple=True)
    noise = (NOISE_DB * found.order.double()) ** 2
    return _Peaks(miss, noise, peak, found.plane[peak, step], found.point[peak, step])


def _features(point: Tensor, plane: Tensor, spread: Tensor, paint: Paint | None) -> Tensor:
    """What makes places `[n, 3]` [m] of planes `[n]` alike, `[n, 6]`: where they are and how they look, in units of the
    width [m] and the difference of colour of each plane, `spread` `[P, 2]`.
    """
    width, hue = spread[plane].clamp_min(1e-6).unbind(-1)
    colours = torch.zeros_like(point)
    if paint is not None:
        colours = torch.where((spread[plane, 1] > 0)[:, None], paint.at(point, plane) / hue[:, None], 0.0)
    return torch.cat((point / width[:, None], colours), -1).double()


def _alike(first: Tensor, second: Tensor) -> Tensor:
    """The covariance `[n, m]` [dB^2] of deviations at places of one plane, of features `[n, 6]` and `[m, 6]`."""
    return DEVIATION_DB**2 * torch.exp(-0.5 * torch.cdist(first, second) ** 2)


def _explained(peaks: _Peaks, features: Tensor) -> tuple[Tensor, Tensor]:
    """The weights `[n]` of the peaks in every deviation, and what the other peaks say of each `[n]` [dB]; robust."""
    together = torch.zeros(len(peaks.miss), len(peaks.miss), dtype=torch.float64)
    for plane in peaks.plane.unique().tolist():
        own = torch.nonzero(peaks.plane == plane).squeeze(-1)
        rows = peaks.peak[own]
        together.index_put_((rows[:, None], rows), _alike(features[own], features[own]), accumulate=True)
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
