"""The residual of the mirror model's surface: what it lacks in the training views, from coarse to fine.

Each pass draws the views and throws their errors back onto the Gaussians. What one view says about one cell is one
observation: its pixels err alike, and a receiver close to a wall would outvote all others by its many pixels. On these
observations harmonics of segments, of cubes of about eight cells and of cells are solved for one after the other by
ridge regression, each on what the one before leaves over; what a Gaussian still lacks is a level of its own.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from rf3dgs.core.threads import on_threads
from rf3dgs.field.lit import CSI_DEGREE, LARGEST_RESIDUAL_DB, LitSurface
from rf3dgs.splats.harmonics import C0, basis, view_directions
from rf3dgs.splats.rasterize import Backend
from rf3dgs.training.lit_fit import BAND, worth
from rf3dgs.training.lit_views import LitView, Shortfall, shortfall

PASSES = 6
DEGREE = 3  # of the harmonics of levels
MOST_PIXELS = 5.0  # that one view may say about one cell
ROWS_AT_ONCE = 50_000


@dataclass(frozen=True)
class Ridge:
    """How strongly each level of the residual is drawn to zero, in pixels that say so."""

    segment: float
    cube: float
    cell: float
    level: float = 2.0


RIDGE = Ridge(segment=200.0, cube=60.0, cell=30.0)
DELAY_RIDGE = Ridge(segment=60.0, cube=20.0, cell=10.0)
DEPARTURE_RIDGE = Ridge(segment=60.0, cube=60.0, cell=60.0)


def refine_residual(
    surface: LitSurface, views: Sequence[LitView], *, passes: int = PASSES, floor_db: float, backend: Backend = "auto"
) -> LitSurface:
    """The surface with the residual that makes up for what it lacks in `views`, in so many passes.

    Levels under `floor_db` count as that.
    """
    receivers = torch.stack([one.view.position for one in views])
    groups = Groups.of(surface)
    hits = on_threads(lambda one: surface.hit_in(one.view, backend), views) if passes else []
    for _ in range(passes):
        surface = _corrected(surface, receivers, groups, shortfall(surface, views, hits, floor_db, backend))
    return surface


@dataclass(frozen=True, eq=False)
class Groups:
    """The segment and the cube, of twice the width of a cell, of each cell: both `[C]`."""

    segment: Tensor
    cube: Tensor

    @classmethod
    def of(cls, surface: LitSurface) -> "Groups":
        """Those of a surface; a cube holds cells of one segment."""
        cells, segment = len(surface.cell_sh), surface.segment_of_cell
        rows = surface.cell_of[:, None].expand(-1, 3)
        least = torch.full((cells, 3), torch.inf).scatter_reduce(0, rows, surface.means, "amin")
        most = torch.full((cells, 3), -torch.inf).scatter_reduce(0, rows, surface.means, "amax")
        width = 2 * float((most - least).max().clamp_min(1e-3))
        key = torch.cat((torch.floor((least + most) / (2 * width)).long(), segment[:, None]), -1)
        return cls(segment, torch.unique(key, dim=0, return_inverse=True)[1])


def _corrected(surface: LitSurface, receivers: Tensor, groups: Groups, lacking: Shortfall) -> LitSurface:
    told = _Told.of(surface, receivers, lacking)
    asked = [(lacking.weight, lacking.error_db[:, None], DEGREE, RIDGE)]
    if lacking.csi_weight is not None and lacking.csi_error is not None:
        late, turned = lacking.csi_error.split((1, 3), -1)
        slow, bent = lacking.csi_weight.unbind(-1)
        asked += [(slow, late, CSI_DEGREE, DELAY_RIDGE), (bent, turned, CSI_DEGREE, DEPARTURE_RIDGE)]
    (segment, cell, own), *csi = on_threads(lambda one: _solved(surface, groups, told, *one), asked)
    level = (surface.level + own[:, 0]).clamp(-LARGEST_RESIDUAL_DB, LARGEST_RESIDUAL_DB)
    surface = replace(
        surface,
        segment_sh=surface.segment_sh + segment[..., 0],
        cell_sh=surface.cell_sh + cell[..., 0],
        level=level,
    )
    if not csi:
        return surface
    segment, cell, own = (torch.cat(part, -1) for part in zip(*csi, strict=True))
    return replace(
        surface,
        segment_csi=surface.segment_csi + segment,
        cell_csi=surface.cell_csi + cell,
        own_csi=surface.own_csi + own,
    )


@dataclass(frozen=True, eq=False)
class _Told:
    """Which pair of cell and view, of R, each row of a shortfall belongs to: gaussian, pair `[M]`; the pairs' cell
    `[R]` and harmonics `[R, 16]` of the direction from the receiver to what it sees of the cell."""

    gaussian: Tensor
    pair: Tensor
    cell: Tensor
    harmonics: Tensor

    @classmethod
    def of(cls, surface: LitSurface, receivers: Tensor, lacking: Shortfall) -> "_Told":
        key = surface.cell_of[lacking.gaussian] * len(receivers) + lacking.view
        pairs, pair = torch.unique(key, return_inverse=True)
        seen = torch.cat((surface.means[lacking.gaussian], torch.ones(len(pair), 1)), -1) * lacking.weight[:, None]
        seen = torch.zeros(len(pairs), 4).index_add_(0, pair, seen)
        middle, cell = seen[:, :3] / seen[:, 3:], pairs // len(receivers)
        along = view_directions(middle - receivers[pairs % len(receivers)], torch.zeros(3))
        return cls(lacking.gaussian, pair, cell, basis(along, DEGREE))


def _solved(
    surface: LitSurface, groups: Groups, told: _Told, weight: Tensor, error: Tensor, degree: int, ridge: Ridge
) -> tuple[Tensor, Tensor, Tensor]:
    """What is lacking: coefficients `[S, K, c]` of segments, `[C, K, c]` of cells, constants `[N, c]` of Gaussians.

    weight `[M]`, error `[M, c]`: rows of the shortfall.
    """
    columns, channels, cells = (degree + 1) ** 2, error.shape[1], len(surface.cell_sh)
    harmonics, weight = told.harmonics[:, :columns], weight.clamp_min(0.0)
    sums = torch.cat((weight[:, None], weight[:, None] * error), -1)
    sums = torch.zeros(len(told.cell), 1 + channels).index_add_(0, told.pair, sums)
    pixels, mean = sums[:, 0], sums[:, 1:] / sums[:, :1].clamp_min(1e-9)
    counts = pixels / (1 + pixels / MOST_PIXELS)
    products = torch.zeros(cells, columns**2)
    for part in torch.arange(len(mean)).split(ROWS_AT_ONCE):
        weighted = harmonics[part] * counts[part, None]
        outer = (weighted[:, :, None] * harmonics[part][:, None, :]).flatten(1)
        products.index_add_(0, told.cell[part], outer)
    penalty = C0**2 * torch.diag((1.0 + BAND[:columns]) ** 2)
    left_over, found = mean, []
    every = torch.arange(cells)
    for group, strength in ((groups.segment, ridge.segment), (groups.cube, ridge.cube), (every, ridge.cell)):
        number = group[told.cell]
        count = int(group.max()) + 1
        left = torch.zeros(count, columns**2).index_add_(0, group, products).reshape(count, columns, columns)
        weighted = (harmonics * counts[:, None])[:, :, None] * left_over[:, None, :]
        right = torch.zeros(count, columns * channels).index_add_(0, number, weighted.flatten(1))
        solved = torch.linalg.solve(left + strength * penalty, right.reshape(count, columns, channels))
        left_over = left_over - (harmonics[:, :, None] * solved[number]).sum(1)
        found.append(solved)
    count = worth(weight)
    # What a Gaussian lacks beside what its cell was given.
    lacks = error - (mean - left_over)[told.pair]
    total = torch.zeros(len(surface)).index_add_(0, told.gaussian, count)
    own = torch.zeros(len(surface), channels).index_add_(0, told.gaussian, count[:, None] * lacks)
    segments = torch.zeros(len(surface.laws), columns, channels)
    segments[: len(found[0])] = found[0]
    return segments, found[1][groups.cube] + found[2], own / (total + ridge.level)[:, None]
