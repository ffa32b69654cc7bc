"""How far the levels of a field's paths may be off.

The level in the direction of a point source goes wrong in two manners. It may be somewhat off, or the whole way may not
be there: what the geometry does not show stands in it, or the plane mirrors nothing where nobody looked. Then what is
seen in its direction falls by about `drop`, what the level loses without point sources:

    P(|error| < h) = (1 - q) (1 - (1 + h / (k s))^-k) + q min(1, h / (1.25 drop))^2,   k = 2.5
    s = exp(a . (1, log std)),   q = 1 / (1 + exp(-b . (1, gate, apart)))

std is that of the direction (`field.uncertainty`), gate the logit of the transmittance that decides whether the way is
open, apart = log(1 + x / 0.2 m) with x the distance from where the way is reflected to the nearest place where a
training position measured the same plane, the largest of its reflections. a and b are fitted where positions were left
out, and shares are counted there (`training.path_uncertainty_fit`). Other paths, peaks of the surface, are as sure as
their direction. See docs/how-to/uncertainty.md.
"""

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from rf3dgs.core.angles import angle_between
from rf3dgs.core.errors import InputError
from rf3dgs.field.rays import Rays

if TYPE_CHECKING:
    from rf3dgs.field.radio_field import RadioField

NUMBERS = ("log std", "gate", "apart", "drop")
TAIL = 2.5  # k; smaller is heavier
FARTHEST_DROP = 1.25  # of the drop, that a wrong way is off by
LEAST_DROP_DB = 0.5
FARTHEST_LOGIT = 7.0  # of a transmittance
APART_UNIT = 0.2  # m
FARTHEST_APART = 10.0  # m; also where nobody measured the plane at all
SAME_ANGLE, SAME_DELAY = 1e-3, 1e-10  # rad, s; a path this near to a way is that way
LEAST_DB, MOST_DB = 1e-3, 300.0
HALVINGS = 50


@dataclass(frozen=True, eq=False)
class PathDoubt:
    """What a field knows of the errors of its point sources.

    points `[M, 3]` [m], plane `[M]`: where training positions measured what planes reflect. off `[2]`: a; wrong `[3]`:
    b of the module's page. levels `[7]`: the value of P that holds each of `uncertainty.SHARES`.
    """

    points: Tensor
    plane: Tensor
    off: Tensor
    wrong: Tensor
    levels: Tensor

    def __post_init__(self) -> None:
        for name, shape in (("points", (len(self.plane), 3)), ("off", (2,)), ("wrong", (3,))):
            got = tuple(getattr(self, name).shape)
            if got != shape:
                raise InputError(f"{name} must be {list(shape)}; got {list(got)}")

    def inside(self, size_db: Tensor, numbers: Tensor) -> Tensor:
        """P(|error| < size) `[n]` of ways with `NUMBERS` `[n, 4]`."""
        scale, chance, reach = self.laws(numbers)
        near, gone = near_inside(size_db, scale), gone_inside(size_db, reach)
        return (1 - chance) * near + chance * gone

    def laws(self, numbers: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """s [dB], q, and how far a wrong way is off at most [dB], each `[n]`."""
        one = torch.ones_like(numbers[:, :1])
        scale = torch.exp(torch.cat((one, numbers[:, :1]), -1) @ self.off.to(numbers.dtype))
        chance = torch.sigmoid(torch.cat((one, numbers[:, 1:3]), -1) @ self.wrong.to(numbers.dtype))
        return scale, chance, FARTHEST_DROP * numbers[:, 3]

    def half(self, level: float, numbers: Tensor) -> Tensor:
        """The size `[n]` [dB] that P gives `level`."""
        numbers = numbers.double()
        low = torch.full((len(numbers),), math.log(LEAST_DB), dtype=torch.float64)
        high = torch.full_like(low, math.log(MOST_DB))
        for _ in range(HALVINGS):
            middle = 0.5 * (low + high)
            less = self.inside(middle.exp(), numbers) < level
            low, high = torch.where(less, middle, low), torch.where(less, high, middle)
        return high.exp().float()


def near_inside(size_db: Tensor, scale: Tensor) -> Tensor:
    """P(|error| < size) of ways that are there: a distribution whose tail is a power."""
    return 1 - (1 + size_db / (TAIL * scale)) ** -TAIL


def gone_inside(size_db: Tensor, reach: Tensor) -> Tensor:
    """P(|error| < size) of ways that are not there."""
    return (size_db / reach).clamp(max=1.0).square()


def ways_of(field: "RadioField", receiver: Tensor, arrival: Tensor, delay: Tensor) -> tuple[Rays, Tensor, Tensor]:
    """The ways to a receiver `[3]` that its paths of `arrival` `[k, 3]` and `delay` `[k]` [s] are.

    Rays `[n]` in the order of these paths, what each lets pass `[n]`, and which paths they are `[k]`; paths that come
    from no point source have none.
    """
    assert field.sources is not None
    every, passed = field.sources.candidates(receiver, field.obstacles)
    if not len(every):
        return every, passed, torch.zeros(len(arrival), dtype=torch.bool)
    angle = angle_between(arrival[:, None], every.arrival[None])
    late = (delay[:, None] - every.delay[None]).abs()
    best = (angle / SAME_ANGLE + late / SAME_DELAY).argmin(-1)
    row = torch.arange(len(arrival))
    known = (angle[row, best] < SAME_ANGLE) & (late[row, best] < SAME_DELAY)
    return every.only(best[known]), passed[best[known]], known


def way_numbers(
    field: "RadioField", doubt: PathDoubt, ways: Rays, passed: Tensor, std_db: Tensor, points_share: Tensor
) -> Tensor:
    """`NUMBERS` `[n, 4]` of `ways` that let `passed` `[n]` through, in whose directions the standard deviation is
    `std_db` `[n]` and point sources bring `points_share` `[n]` of the power."""
    assert field.sources is not None
    reflected = field.sources.sequence[ways.index]
    far = torch.zeros(len(ways))
    for step in range(reflected.shape[1]):
        apart = torch.cdist(ways.points[:, step], doubt.points, compute_mode="donot_use_mm_for_euclid_dist")
        apart = torch.where(reflected[:, step, None] == doubt.plane, apart, torch.inf)
        nearest = torch.cat((apart, torch.full((len(ways), 1), FARTHEST_APART)), -1).amin(-1)
        far = torch.where(reflected[:, step] >= 0, torch.maximum(far, nearest), far)
    return torch.stack(
        (
            std_db.log(),
            passed.double().logit(1e-6).clamp(-FARTHEST_LOGIT, FARTHEST_LOGIT).float(),
            torch.log1p(far / APART_UNIT),
            (-10 * torch.log10((1 - points_share).clamp_min(1e-6))).clamp_min(LEAST_DROP_DB),
        ),
        -1,
    )
