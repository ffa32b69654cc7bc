"""How far a field's levels may be off, told by what was learned about its errors where nobody had measured.

Ten numbers of a pixel (`NUMBERS`) give its standard deviation in dB,

    std = exp(w . x)

with weights w that, but for the first `SIGNED`, only widen, fitted to errors at positions that were left out
(`training.uncertainty_fit`). Widths of other shares than 68.3 % are multiples of it, counted at the same places: errors
have longer tails than a normal distribution. What paths are sure of has a law of its own (`path_uncertainty`). See
docs/how-to/uncertainty.md.
"""

import math
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from rf3dgs.core.errors import InputError
from rf3dgs.core.frames import Pose
from rf3dgs.core.grids import DirectionGrid, equirect_grid, list_grid, sample_grid, view_of
from rf3dgs.field.lit import BLENDING, LitSurface
from rf3dgs.field.path_uncertainty import PathDoubt, way_numbers, ways_of
from rf3dgs.splats.rasterize import rasterize

if TYPE_CHECKING:
    from rf3dgs.field.radio_field import RadioField

NUMBERS = ("level", "points", "spread", "away", "turn", "hole", "edge", "silhouette", "gate", "dark")
SIGNED = 2
SHARES = (0.25, 0.5, 0.6827, 0.8, 0.9, 0.95, 0.99)
"""Shares of errors whose widths are known, in units of the standard deviation."""
ONE_STD = 2
DEEPEST_DB = 90.0  # under the window's ceiling; darker levels count as that
LEAST_SPREAD_DB = 0.1
GATE_WIDTH = 1.0  # of the transmittance's logit about the threshold, in which a gate is in doubt
MOST_DARKENED = 0.01  # what is left at least when a way closes


@dataclass(frozen=True, eq=False)
class Uncertainty:
    """What a field knows of its errors.

    spread_db `[C]`: root mean square of errors, where nobody had measured, of each cell of the surface. source_db
    `[P + 1]`: of ways over each plane, the straight way last. receivers `[V, 3]` [m]: the training positions. seen
    `[C, V]`: which of them saw a cell. spacing [m]: median distance between neighbours among them. weights `[10]`: of
    `NUMBERS`. widths `[7]`: of `SHARES`, in standard deviations. paths: what is known of point sources; None where
    there was too little to learn from, and paths are as sure as their direction.
    """

    spread_db: Tensor
    source_db: Tensor
    receivers: Tensor
    seen: Tensor
    spacing: float
    weights: Tensor
    widths: Tensor
    paths: PathDoubt | None = None

    def __post_init__(self) -> None:
        cells, views = len(self.spread_db), len(self.receivers)
        shapes = {
            "receivers": (views, 3),
            "seen": (cells, views),
            "weights": (len(NUMBERS),),
            "widths": (len(SHARES),),
        }
        for name, shape in shapes.items():
            got = tuple(getattr(self, name).shape)
            if got != shape:
                raise InputError(f"{name} must be {list(shape)} for {cells} cells, {views} receivers; got {list(got)}")
        if not self.spacing > 0:
            raise InputError(f"the spacing of the training positions must be positive; got {self.spacing} m")

    def std_db(self, numbers: Tensor) -> Tensor:
        """The standard deviation `[*]` [dB] of pixels whose `NUMBERS` are `[*, 10]`."""
        return torch.exp(numbers @ self.weights.to(numbers.dtype))

    def width(self, share: float | None) -> float:
        """Half the width of the interval that holds `share` of the errors, in standard deviations; 1 for None."""
        if share is None:
            return 1.0
        if not 0.0 < share <= SHARES[-1]:
            raise InputError(f"share must lie in (0, {SHARES[-1]}]; got {share}. Further tails were not counted")
        return _between(share, self.widths.tolist())

    def path_level(self, share: float | None) -> float:
        """The value of the law of paths that holds `share` of the errors, 68.3 % for None."""
        assert self.paths is not None
        share = SHARES[ONE_STD] if share is None else share
        self.width(share)  # which refuses shares that were not counted
        return -math.expm1(-_between(share, (-torch.log1p(-self.paths.levels.double())).tolist()))

    @cached_property
    def typical_db(self) -> float:
        """Root mean square [dB] over the cells."""
        return float(self.spread_db.square().mean().sqrt())

    def away(self, receiver: Tensor) -> float:
        """Distance from a receiver `[3]` to the nearest training position, in units of their spacing."""
        return float(torch.cdist(receiver[None], self.receivers).min()) / self.spacing

    def turns(self, centres: Tensor, receiver: Tensor) -> Tensor:
        """Angle `[C]` [rad], seen from cells at `centres` `[C, 3]`, between a receiver `[3]` and the nearest training
        position that saw the cell; pi where none did."""
        to_all = torch.cdist(centres, self.receivers, compute_mode="donot_use_mm_for_euclid_dist").clamp_min(1e-3)
        to_one = torch.linalg.vector_norm(receiver - centres, dim=-1).clamp_min(1e-3)
        between = torch.linalg.vector_norm(receiver - self.receivers, dim=-1)
        cosine = (to_all.square() + to_one[:, None].square() - between.square()) / (2 * to_all * to_one[:, None])
        return torch.acos(torch.where(self.seen, cosine.clamp(-1, 1), -1.0).amax(-1))


def numbers_of(field: "RadioField", doubt: Uncertainty, pose: Pose, grid: DirectionGrid) -> Tensor:
    """`NUMBERS` `[row, col, 10]` of one pose's pixels, by `doubt` about the `field`; see docs/how-to/uncertainty.md."""
    if grid.kind == "list":
        rows = max(8, math.ceil(2 * math.pi / field.instrument.lobe))
        sphere = equirect_grid(2 * rows, rows)
        return sample_grid(numbers_of(field, doubt, pose, sphere), sphere, grid.directions)
    surface = field.surface
    assert isinstance(surface, LitSurface)
    receiver = pose.position
    turns = doubt.turns(_centres(surface), receiver)[surface.cell_of]
    with torch.no_grad():
        power = surface.values(receiver, csi=False)[:, 0]
        distance = torch.linalg.vector_norm(surface.means - receiver, dim=-1)
        variance = doubt.spread_db.square()[surface.cell_of]
        values = torch.stack((power, power * variance, power * turns, distance), -1)
        shape = (surface.means, surface.quats, surface.scales, surface.opacities)
        raster = rasterize(*shape, values, view_of(pose, grid), compositing=BLENDING, backend=field.backend)
    sent, variance, turn, depth = raster.values.unbind(-1)
    reached = sent > 0
    ways = _Ways.of(field, doubt, pose, grid)
    total = sent * surface.unit + ways.power
    lit = torch.where(total > 0, total, 1.0)
    variance = torch.where(total > 0, (variance * surface.unit + ways.variance) / lit, doubt.typical_db**2)
    turn = torch.where(reached, turn * surface.unit / lit, torch.where(total > 0, 0.0, math.pi))
    level = 10 * torch.log10(total.clamp_min(10 ** (floor_db(surface) / 10)))
    slope = _steps(level, grid.kind == "equirect") * field.instrument.lobe / grid.spacing
    jump = _steps(torch.log(torch.where(reached, depth, 1.0)), grid.kind == "equirect")
    columns = (
        torch.ones_like(total),
        ways.power / lit,
        torch.log(variance.sqrt().clamp_min(LEAST_SPREAD_DB)),
        torch.full_like(total, math.log1p(doubt.away(receiver))),
        torch.log1p(turn / 0.1),
        1.0 - raster.weight.clamp(0, 1),
        torch.log1p(slope),
        torch.log1p(jump / 0.1),
        torch.log1p(ways.gate(total)),
        (level.max() - level) / 20.0,
    )
    return torch.stack(columns, -1)


def sizes_of(
    field: "RadioField", doubt: Uncertainty, pose: Pose, arrival: Tensor, delay: Tensor, share: float | None
) -> Tensor:
    """How far the levels of paths of `arrival` `[k, 3]` and `delay` `[k]` [s] to one `pose` may be off `[k]` [dB]."""
    numbers = numbers_of(field, doubt, pose, list_grid(pose.to_device(arrival))).reshape(-1, len(NUMBERS))
    std = doubt.std_db(numbers)
    size = doubt.width(share) * std
    if doubt.paths is None or field.sources is None:
        return size
    ways, passed, known = ways_of(field, pose.position, arrival, delay)
    told = way_numbers(field, doubt.paths, ways, passed, std[known], numbers[known, NUMBERS.index("points")])
    size[known] = doubt.paths.half(doubt.path_level(share), told)
    return size


def _between(share: float, values: list[float]) -> float:
    """What belongs to a `share`, between `values` that belong to `SHARES`; straight in the logarithm of the rest."""
    known = [(0.0, 0.0), *((-math.log1p(-at), value) for at, value in zip(SHARES, values, strict=True))]
    place = -math.log1p(-share)
    for (low, below), (high, above) in pairwise(known):
        if place <= high + 1e-9:
            return below + (above - below) * (place - low) / (high - low)
    return known[-1][1]


def floor_db(surface: LitSurface) -> float:
    """Under this level [dB] the surface was not taught, and its errors do not count."""
    return max(surface.window.floor_db, surface.window.ceil_db - DEEPEST_DB)


@dataclass(frozen=True, eq=False)
class _Ways:
    """What ways from point sources bring to the pixels: power `[row, col]` of those that are open, that times their
    variance [dB^2], and of every way that might be open: place, share of power and probability `[n]`."""

    power: Tensor
    variance: Tensor
    place: Tensor
    share: Tensor
    open_chance: Tensor
    is_open: Tensor

    @classmethod
    def of(cls, field: "RadioField", doubt: Uncertainty, pose: Pose, grid: DirectionGrid) -> "_Ways":
        """The ways to a receiver at one `pose` in the pixels of its `grid`."""
        nothing, sources = torch.zeros(grid.shape), field.sources
        if sources is None:
            empty = torch.zeros(0)
            return cls(nothing, nothing, empty.long(), empty, empty, empty.bool())
        every, passed = sources.candidates(pose.position, field.obstacles)
        planes = sources.sequence[every.index]
        square = doubt.source_db.square()
        variance = torch.where(planes >= 0, square[planes.clamp_min(0)], 0.0).sum(-1)
        variance = torch.where((planes >= 0).any(-1), variance, square[-1])
        threshold = torch.tensor(sources.open_above).logit(1e-6)
        chance = torch.sigmoid((passed.logit(1e-6) - threshold) / GATE_WIDTH)
        pixel, ray, share = every.shares(pose, grid, field.instrument)
        is_open = (passed > sources.open_above)[ray]
        known = torch.stack((share, share * variance[ray]), -1) * is_open[:, None]
        sums = torch.zeros(nothing.numel(), 2).index_add_(0, pixel, known)
        return cls(
            sums[:, 0].reshape(nothing.shape), sums[:, 1].reshape(nothing.shape), pixel, share, chance[ray], is_open
        )

    def gate(self, total: Tensor) -> Tensor:
        """Standard deviation `[row, col]` [dB] of a level, of `total` power, for ways that might be closed or open."""
        flat = total.flatten()[self.place].clamp_min(1e-30)
        other = torch.where(self.is_open, (flat - self.share).clamp_min(MOST_DARKENED * flat), flat + self.share)
        change = 10 * torch.log10((other / flat).clamp(MOST_DARKENED, 1 / MOST_DARKENED))
        variance = self.open_chance * (1 - self.open_chance) * change.square()
        return torch.zeros(total.numel()).index_add_(0, self.place, variance).sqrt().reshape(total.shape)


def _centres(surface: LitSurface) -> Tensor:
    """The mean place `[C, 3]` of each cell's Gaussians [m]."""
    cells = len(surface.cell_sh)
    total = torch.zeros(cells, 3).index_add_(0, surface.cell_of, surface.means)
    return total / torch.bincount(surface.cell_of, minlength=cells).clamp_min(1)[:, None]


def _steps(picture: Tensor, around: bool) -> Tensor:
    """Half the sum of the larger differences to a pixel's neighbours in its row and in its column, `[row, col]`."""
    ends = (picture[:, -1:], picture[:, :1]) if around else (picture[:, :1], picture[:, -1:])
    across = torch.cat((ends[0], picture, ends[1]), 1).diff(dim=1).abs()
    down = torch.cat((picture[:1], picture, picture[-1:]), 0).diff(dim=0).abs()
    return 0.5 * (torch.maximum(across[:, 1:], across[:, :-1]) + torch.maximum(down[1:], down[:-1]))
