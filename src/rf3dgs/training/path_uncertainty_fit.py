"""What the levels of a field's paths are off by at positions that were left out: the laws of
`field.path_uncertainty`, by expectation and maximisation.
"""

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from rf3dgs.core.grids import list_grid
from rf3dgs.field.path_uncertainty import FARTHEST_DROP, TAIL, PathDoubt, way_numbers, ways_of
from rf3dgs.field.radio_field import RadioField
from rf3dgs.field.sources import PointSources
from rf3dgs.field.uncertainty import NUMBERS, SHARES, Uncertainty, numbers_of
from rf3dgs.spectra.spectrum import Spectrum
from rf3dgs.training.calibration import minimum
from rf3dgs.training.levels import TOLD_BY, fit_levels
from rf3dgs.training.reflection import Glints, glints

STRONGEST = 8  # paths of a position
LEAST_WAYS = 24
ROUNDS, STEPS = 40, 20
LEAST_ERROR_DB = 1e-3
WRONG_DB = 3.0  # and half the drop: what is off by more is taken for wrong in the first round
USUAL = (-2.0, 0.0, 0.0)  # b where nothing tells
STIFF = 1.0  # how firmly


@dataclass(frozen=True, eq=False)
class LeftOutWays:
    """Ways to positions that were left out, n of them: the ten numbers of their directions `[n, 10]`, those of the ways
    `[n, 4]` but for the first, and errors `[n]` [dB]."""

    directions: Tensor
    ways: Tensor
    error_db: Tensor


def measured_ways(field: RadioField, spectra: Spectrum) -> Glints | None:
    """What the training positions tell of what each plane reflects; None without planes."""
    sources = field.sources
    if sources is None or not len(sources.planes):
        return None
    telling = replace(sources, sequence=sources.sequence[sources.order <= TOLD_BY])
    return glints(telling, telling.rays_each(spectra.pose.position, field.obstacles), spectra)


def sources_without(sources: PointSources | None, measured: Glints | None, places: list[int]) -> PointSources | None:
    """The sources with what planes reflect, and their marks by place alone, fitted without some positions."""
    if sources is None or measured is None or sources.patches is None:
        return sources
    some = measured.only(~torch.isin(measured.position, torch.tensor(places)))
    return fit_levels(sources, some)


def known_places(measured: Glints | None, without: list[int]) -> PathDoubt:
    """Where the positions but for some measured what planes reflect; the laws are not known yet."""
    points, plane = torch.zeros(0, 3), torch.zeros(0, dtype=torch.long)
    if measured is not None:
        left = ~torch.isin(measured.position, torch.tensor(without, dtype=torch.long))
        some = measured.only(left & measured.alone & (measured.order == 1))
        points, plane = some.point[:, 0], some.plane[:, 0]
    return PathDoubt(points, plane, torch.tensor([0.0, 1.0]), torch.tensor(USUAL), torch.tensor(SHARES))


def left_out_ways(
    field: RadioField, doubt: Uncertainty, places: PathDoubt, truth: Spectrum, error_db: Tensor
) -> LeftOutWays:
    """The strongest ways to one position of `truth` `[row, col]` that the `field` was fitted without; its errors there
    are `error_db` `[row, col]`."""
    pose, grid = truth.pose, truth.grid
    paths = field.paths(pose, strongest=STRONGEST, parts="sources")
    arrival, delay = paths.aoa[paths.valid], paths.delay[paths.valid]
    pixel, inside = grid.pixel_of(pose.to_device(arrival))
    arrival, delay, (col, row) = arrival[inside], delay[inside], pixel[inside].long().unbind(-1)
    row, col = row.clamp(0, grid.height - 1), col.clamp(0, grid.width - 1)
    numbers = torch.zeros(0, len(NUMBERS))
    if len(arrival):
        numbers = numbers_of(field, doubt, pose, list_grid(pose.to_device(arrival))).reshape(-1, len(NUMBERS))
    ways, passed, known = ways_of(field, pose.position, arrival, delay)
    numbers, error = numbers[known], error_db[row, col][known]
    told = way_numbers(field, places, ways, passed, torch.ones(len(error)), numbers[:, NUMBERS.index("points")])
    return LeftOutWays(numbers, told, error)


def fit_path_doubt(found: list[LeftOutWays], weights: Tensor, places: PathDoubt) -> PathDoubt | None:
    """The laws of paths and the levels that hold each share, once the `weights` `[10]` of directions are known; None
    where too few ways tell."""
    directions, ways, error = (
        torch.cat([getattr(one, name) for one in found]) for name in ("directions", "ways", "error_db")
    )
    if len(error) < LEAST_WAYS:
        return None
    numbers = torch.cat(((directions @ weights)[:, None], ways[:, 1:]), -1).double()
    size = error.double().abs().clamp_min(LEAST_ERROR_DB)
    off, wrong = fit_laws_of_ways(numbers, size)
    fitted = replace(places, off=off, wrong=wrong)
    inside = fitted.inside(size, numbers)
    levels = inside.quantile(torch.tensor(SHARES, dtype=torch.float64))
    return replace(fitted, levels=levels.clamp(0.0, 1.0 - 1e-6).float())


def fit_laws_of_ways(numbers: Tensor, size_db: Tensor) -> tuple[Tensor, Tensor]:
    """a `[2]` and b `[3]` of `field.path_uncertainty` for |errors| `[n]` [dB] of ways with its `NUMBERS` `[n, 4]`.

    The tail of ways that are there is a mixture of exponentials, which makes each round a fit of weighted ones.
    """
    one = torch.ones(len(numbers), 1, dtype=torch.float64)
    design, odds = torch.cat((one, numbers[:, :1]), -1), torch.cat((one, numbers[:, 1:3]), -1)
    reach = FARTHEST_DROP * numbers[:, 3]
    usual = torch.tensor(USUAL, dtype=torch.float64)
    gone = ((size_db > 0.5 * numbers[:, 3]) & (size_db > WRONG_DB)).double().clamp(0.02, 0.92)
    slower, wrong = torch.ones_like(size_db), usual
    off = torch.zeros(2, dtype=torch.float64)
    for _ in range(ROUNDS):
        there = 1 - gone
        off = minimum(design, slower * size_db, there / there.sum())
        wrong = _logistic(odds, gone, wrong, usual)
        scale, chance = torch.exp(design @ off), torch.sigmoid(odds @ wrong)
        near = (1 - chance) * (1 + size_db / (TAIL * scale)) ** (-TAIL - 1) / scale
        far = chance * torch.where(size_db < reach, 2 * size_db / reach.square(), 0.0)
        gone = far / (near + far)
        slower = (TAIL + 1) / (TAIL + size_db / scale)
    return off.float(), wrong.float()


def _logistic(odds: Tensor, share: Tensor, start: Tensor, usual: Tensor) -> Tensor:
    """Weights `[3]` of the logistic regression of `share` `[n]` on `odds` `[n, 3]`, drawn to the `usual` ones."""
    weights = start
    for _ in range(STEPS):
        chance = torch.sigmoid(odds @ weights)
        slope = odds.mT @ (chance - share) + STIFF * (weights - usual)
        curve = (odds * (chance * (1 - chance))[:, None]).mT @ odds + STIFF * torch.eye(len(usual)).to(odds)
        weights = weights - torch.linalg.solve(curve, slope)
    return weights
