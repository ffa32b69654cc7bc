"""The surface part of the mirror model in closed form: laws of segments, and the ambient part's delay and departure.

The laws R, b, alpha, A, e of all segments are found together by Gauss-Newton steps on a soft-L1 loss in dB, first one
law for everything, then each segment's own, drawn to the common one as if that had been seen in `SHRINK` pixels. What
remains is the residual's (`training.residual`).
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from rf3dgs.core.threads import on_threads
from rf3dgs.core.units import SPEED_OF_LIGHT
from rf3dgs.field.lit import AMBIENT_DISTANCE, incidence
from rf3dgs.field.radiance import NANOSECOND, bounce
from rf3dgs.splats.harmonics import view_directions
from rf3dgs.training.lit_views import Observations

SOFT_DB = 3.0  # where soft-L1 turns from squares to absolute values
SHRINK = 30.0  # [pixel]
LAW_SPREAD = torch.tensor([5.0, 1.0, 3.0, 5.0, 1.0])
"""How far a segment's law usually is from the common one: the unit in which it is drawn to it."""
OFF_DB = -300.0  # the level of a part that is left out; so far down no step changes it
LAW_LOW = torch.tensor([OFF_DB, -6.0, 0.0, OFF_DB, -6.0])
LAW_HIGH = torch.tensor([100.0, 6.0, 60.0, 100.0, 6.0])
STEPS = 12
AMBIENT_ROUNDS = 3
DARK = 1e-4  # visibility below which nothing arrives straight
DB = 10 / 2.302585092994046
MOST, ROWS_AT_ONCE = 400_000, 50_000
UPPER = torch.triu_indices(5, 6)
"""Rows and columns of the upper triangle of a law's normal matrix, with the right-hand side as a sixth column."""
BAND = torch.tensor([degree for degree in range(4) for _ in range(2 * degree + 1)], dtype=torch.float32)


@dataclass(frozen=True, eq=False)
class Scattering:
    """The geometry of scattering: distance d `[N]` [m], cos_i `[N]`, mirrored directions `[N, 3]`, visibility `[N]`,
    and the numbers of segments and cells `[N]`."""

    means: Tensor
    normals: Tensor
    distance: Tensor
    cosine: Tensor
    mirrored: Tensor
    visibility: Tensor
    segment_of: Tensor
    cell_of: Tensor
    tx: Tensor

    @classmethod
    def of(
        cls, means: Tensor, normals: Tensor, visibility: Tensor, segment_of: Tensor, cell_of: Tensor, tx: Tensor
    ) -> "Scattering":
        """The geometry of Gaussians at `means` with unit `normals` `[N, 3]` under a transmitter at `tx` `[3]` [m]."""
        distance, cosine, mirrored = incidence(means, normals, tx)
        return cls(means, normals, distance, cosine, mirrored, visibility, segment_of, cell_of, tx)


def fit_laws(scattering: Scattering, seen: Observations, without: Sequence[str] = ()) -> Tensor:
    """The laws `[S, 5]` of all segments, "lit" or "ambient" part `without` which the rest is fitted."""
    chosen = _some(len(seen), MOST)
    g, level = seen.gaussian[chosen], seen.level_db[chosen]
    along = view_directions(scattering.means[g] - seen.receivers[seen.view[chosen]], torch.zeros(3))
    rows = _Rows(scattering.segment_of[g], _known(scattering, g, along), level, worth(seen.weight[chosen]))
    lit = scattering.visibility[g] > 0.5
    excess = (level - rows.known.lit_db)[lit]
    first = float(excess.median()) if len(excess) else float(level.median()) + 20
    start = torch.tensor([[first, 0.0, 1.0, float(level.median()) - 6.0, 0.0]])
    start[0, 0] = OFF_DB if "lit" in without else start[0, 0]
    start[0, 3] = OFF_DB if "ambient" in without else start[0, 3]
    count = int(scattering.segment_of.max()) + 1
    if "lit" in without and "ambient" in without:
        return start.expand(count, -1).clone()
    everyone = replace(rows, segment=torch.zeros_like(rows.segment))
    common = _refined(start, start, 0.0, everyone.parts())
    laws = _refined(common.expand(count, -1).clone(), common, SHRINK, rows.parts())
    if "ambient" in without:  # nothing tells how fast what is not there falls off
        laws[:, 3], laws[:, 4] = OFF_DB, 0.0
    return laws


@dataclass(frozen=True, eq=False)
class _Known:
    """Of each observation: lit_db `[M]`: 10 log10(V / d^2); cosine `[M]`; lobe_db `[M]`: 10 log10((1 + r . v) / 2);
    far_db `[M]`: 10 log10(d / 5 m)."""

    lit_db: Tensor
    cosine: Tensor
    lobe_db: Tensor
    far_db: Tensor


def _known(scattering: Scattering, g: Tensor, along: Tensor) -> _Known:
    """The parts of the laws that are known, for Gaussians `[M]` seen along `[M, 3]`."""
    distance = scattering.distance[g]
    visible = 10 * torch.log10(scattering.visibility[g].clamp_min(DARK * DARK))
    psi = -(scattering.mirrored[g] * along).sum(-1)
    return _Known(
        lit_db=visible - 20 * torch.log10(distance),
        cosine=scattering.cosine[g],
        lobe_db=10 * torch.log10((0.5 + 0.5 * psi).clamp_min(1e-6)),
        far_db=10 * torch.log10(distance / AMBIENT_DISTANCE),
    )


def law_db(laws: Tensor, known: _Known) -> tuple[Tensor, Tensor]:
    """Lit and ambient level `[M]` [dB] by `laws` `[M, 5]`."""
    level, slope, lobe, ambient, falloff = laws.unbind(-1)
    lit = level + known.lit_db + DB * slope * known.cosine + lobe * known.lobe_db
    return lit, ambient + falloff * known.far_db


@dataclass(frozen=True, eq=False)
class _Rows:
    """Observations as laws see them: segment `[M]`, what is known, level `[M]` [dB] and weight `[M]`."""

    segment: Tensor
    known: _Known
    level: Tensor
    weight: Tensor

    def parts(self) -> "list[_Rows]":
        """The rows in parts that threads share."""
        columns = (self.segment, *vars(self.known).values(), self.level, self.weight)
        split = zip(*(column.split(ROWS_AT_ONCE) for column in columns), strict=True)
        return [_Rows(segment, _Known(*known), level, weight) for segment, *known, level, weight in split]

    def sums(self, laws: Tensor) -> Tensor:
        """The soft-L1 cost of `laws` `[S, 5]`, the upper triangle of its normal matrix by rows, and the right-hand
        side, `[S, 1 + 15 + 5]`."""
        lit, ambient = law_db(laws[self.segment], self.known)
        total = torch.logaddexp(lit / DB, ambient / DB) * DB
        error = self.level - total
        root = (1 + (error / SOFT_DB).square()).sqrt()
        share = 10 ** ((lit - total) / 10)
        cosine, lobe_db, far_db = self.known.cosine, self.known.lobe_db, self.known.far_db
        columns = (share, share * DB * cosine, share * lobe_db, 1 - share, (1 - share) * far_db)
        jacobian = torch.stack((*columns, error), -1)
        weighted = jacobian[:, :5] * (self.weight / root)[:, None]
        products = weighted[:, UPPER[0]] * jacobian[:, UPPER[1]]
        cost = self.weight * SOFT_DB**2 * 2 * (root - 1)
        rows = torch.cat((cost[:, None], products), -1).double()
        return torch.zeros(len(laws), rows.shape[1], dtype=torch.float64).index_add_(0, self.segment, rows)


def _refined(laws: Tensor, common: Tensor, shrink: float, parts: Sequence[_Rows]) -> Tensor:
    """Damped Gauss-Newton on all segments at once, whose laws `[S, 5]` are drawn to the `common` one."""
    prior = torch.diag(shrink / LAW_SPREAD.square() * SOFT_DB).double() + 1e-6 * torch.eye(5, dtype=torch.float64)
    damping = torch.full((len(laws),), 1e-2, dtype=torch.float64)

    def told(trial: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        sums = torch.stack(on_threads(lambda rows: rows.sums(trial), parts)).sum(0)
        away = (trial - common).double()
        left = sums.new_zeros(len(laws), 5, 6)
        left[:, UPPER[0], UPPER[1]] = sums[:, 1:]
        right, upper = left[..., 5] - away @ prior, left[..., :5]
        left = upper + upper.triu(1).mT + prior
        return sums[:, 0] + (away @ prior * away).sum(-1), left, right

    cost, left, right = told(laws)
    for _ in range(STEPS):
        diagonal = torch.diag_embed(left.diagonal(dim1=-2, dim2=-1) * damping[:, None] + 1e-9)
        step = torch.linalg.solve(left + diagonal, right)
        trial = (laws + step.float()).clamp(LAW_LOW, LAW_HIGH)
        new_cost, new_left, new_right = told(trial)
        better = new_cost < cost
        damping = torch.where(better, damping * 0.2, damping * 5).clamp(1e-6, 1e6)
        laws, right = (torch.where(better[:, None], *pair) for pair in ((trial, laws), (new_right, right)))
        left = torch.where(better[:, None, None], new_left, left)
        cost = torch.where(better, new_cost, cost)
    return laws


def fit_ambient(scattering: Scattering, seen: Observations, laws: Tensor, ridge: float = 1.0) -> Tensor:
    """Delay [ns] up to the Gaussian and departure vector `[N, 4]` of the ambient part: what is left of the observed
    means when the lit part's own are taken out, segment, cell, then Gaussian."""
    count = len(scattering.means)
    start = bounce(scattering.means, scattering.tx)
    if seen.csi is None:
        return start
    g = seen.gaussian
    along = _along(scattering, seen)
    lit, ambient = law_db(laws[scattering.segment_of[g]], _known(scattering, g, along))
    share = 1 - torch.sigmoid((lit - ambient) / DB)
    late = torch.linalg.vector_norm(scattering.means[g] - seen.receivers[seen.view], dim=-1)
    own = seen.csi.clone()
    own[:, 0] -= late / (SPEED_OF_LIGHT * NANOSECOND)
    straight = start[g]
    weight = worth(seen.weight)
    groups = (scattering.segment_of, scattering.cell_of, torch.arange(count))
    total = torch.zeros(count, 4)
    for _ in range(AMBIENT_ROUNDS):
        # An observed departure is a unit vector; the model's is shorter where its parts disagree.
        blended = straight[:, 1:] + share[:, None] * total[g, 1:]
        target = torch.cat((own[:, :1], own[:, 1:] * torch.linalg.vector_norm(blended, dim=-1, keepdim=True)), -1)
        left_over = target - straight - share[:, None] * total[g]
        for group in groups:
            number, size = group[g], int(group.max()) + 1
            left = torch.zeros(size).index_add_(0, number, weight * share * share)
            right = torch.zeros(size, 4).index_add_(0, number, (weight * share)[:, None] * left_over)
            found = right / (left + ridge)[:, None]
            left_over = left_over - share[:, None] * found[number]
            total += found[group]
    return start + total


def _along(scattering: Scattering, seen: Observations) -> Tensor:
    return view_directions(scattering.means[seen.gaussian] - seen.receivers[seen.view], torch.zeros(3))


def worth(weight: Tensor) -> Tensor:
    """What an observation counts: its pixels, at most a few, since neighbours in a picture are not independent."""
    return weight / (1 + 0.25 * weight)


def _some(count: int, most: int) -> Tensor:
    """At most `most` of `count` rows, evenly spread and the same every time."""
    return torch.arange(count) if count <= most else torch.linspace(0, count - 1, most, dtype=torch.float64).long()
