"""What a mirror field's errors are where nobody measured: training positions are left out in turn, the surface is
fitted to the others, and `field.uncertainty` learns from the errors at those left out.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from rf3dgs.core.errors import InputError
from rf3dgs.core.progress import Progress, Silent
from rf3dgs.core.threads import one_torch_thread
from rf3dgs.field.lit import LitSurface
from rf3dgs.field.radio_field import RadioField
from rf3dgs.field.rays import Rays
from rf3dgs.field.sources import PointSources
from rf3dgs.field.uncertainty import NUMBERS, SHARES, Uncertainty, floor_db, numbers_of
from rf3dgs.spectra.spectrum import Spectrum
from rf3dgs.splats.gaussians import Gaussians
from rf3dgs.training.calibration import calibrate
from rf3dgs.training.line_of_sight import fit_line_of_sight
from rf3dgs.training.lit_fit import Scattering, fit_laws
from rf3dgs.training.lit_views import LitView, Observations, lit_views, observe
from rf3dgs.training.path_uncertainty_fit import (
    fit_path_doubt,
    known_places,
    left_out_ways,
    measured_ways,
    sources_without,
)
from rf3dgs.training.radio import check_spectra
from rf3dgs.training.residual import refine_residual
from rf3dgs.training.source_fit import cleared_by

LEAST_POSITIONS = 8
RANDOM_FOLDS, STRIPS = 4, 3
SHRINK = 200.0  # [pixel]; a cell is drawn to its segment, and that to all, as if that had been seen in so many
RAY_SHRINK = 20.0  # the same of a plane's ways
FARTHEST_DB = 30.0
LEAST_SEEN = 0.5  # [pixel]; a position saw a cell that decides as much of its picture
MOST = 300_000


@dataclass(frozen=True, eq=False)
class LeftOut:
    """A field that was fitted without some positions, and its errors there.

    places: the numbers of the positions. error_db, counts `[place, row, col]`: truth over model, and solid angle of the
    pixel relative to the picture's mean, zero where both are under the floor.
    """

    field: RadioField
    places: list[int]
    error_db: Tensor
    counts: Tensor


@one_torch_thread()
def fit_uncertainty(field: RadioField, spectra: Spectrum, *, progress: Progress | None = None) -> RadioField:
    """The mirror `field` with `uncertainty`, learned by leaving out the `spectra` `[position, row, col]` it was
    trained on, in turn.

    Raises InputError for a field of another model, for less than eight positions, and for what `fit_radio` refuses.
    """
    progress = Silent() if progress is None else progress
    surface = field.surface
    if not isinstance(surface, LitSurface):
        raise InputError('uncertainty needs a field of the mirror model; train it with model="mirror"')
    check_spectra(spectra)
    if len(spectra) < LEAST_POSITIONS:
        raise InputError(
            f"uncertainty needs {LEAST_POSITIONS} training positions or more, to leave some out; got {len(spectra)}"
        )
    folds = folds_of(spectra.pose.position, seed=int(field.meta.get("seed", 0)))
    progress.start("uncertainty", len(folds))
    in_sight = _in_sight(field, spectra)
    views = lit_views(replace(spectra, delay=None, aod=None), _rays(field, spectra, in_sight))
    shape = (surface.means, surface.quats, surface.log_scales, surface.logit_opacities)
    observed = observe(
        Gaussians(*shape, torch.zeros(len(surface), 1, 1)), views, unit=surface.unit, backend=field.backend
    )
    observed = replace(observed, level_db=observed.level_db.clamp_min(floor_db(surface)))
    tables = _Tables.empty(len(views), len(surface.cell_sh), _planes(field) + 1)
    measured = measured_ways(field, spectra)
    missed = []
    for number, places in enumerate(folds):
        without = replace(field, sources=sources_without(field.sources, measured, places))
        without = replace(without, solidity=_solidity_without(field, spectra, in_sight, places))
        left_out = _left_out(without, views, observed, spectra, places, tables, bake=number < RANDOM_FOLDS)
        missed.append(left_out)
        progress.update(number + 1)
    seen = torch.zeros(len(surface.cell_sh), len(views))
    seen.index_put_((surface.cell_of[observed.gaussian], observed.view), observed.weight, accumulate=True)
    rows, ways = [], []
    for one in missed:
        others = [place for place in range(len(spectra)) if place not in one.places]
        doubt = _doubt(surface, tables, spectra, others, seen > LEAST_SEEN)
        rows.append(_rows(one, doubt, spectra))
        known = known_places(measured, one.places)
        for place, error_db in zip(one.places, one.error_db, strict=True):
            ways.append(left_out_ways(one.field, doubt, known, spectra[place], error_db))
    numbers, error, counts = (torch.cat(part) for part in zip(*rows, strict=True))
    weights, widths = calibrate(numbers, error, counts)
    paths = fit_path_doubt(ways, weights, known_places(measured, [])) if field.sources is not None else None
    doubt = _doubt(surface, tables, spectra, list(range(len(views))), seen > LEAST_SEEN)
    progress.finish()
    return replace(field, doubt=replace(doubt, weights=weights, widths=widths, paths=paths))


def folds_of(positions: Tensor, *, seed: int) -> list[list[int]]:
    """Numbers of the positions `[n, 3]` that are left out together: four random quarters, and three strips across
    the longer side of their box, so that every position is left out with few and with all of its neighbours."""
    order = torch.randperm(len(positions), generator=torch.Generator().manual_seed(seed))
    longest = int((positions.amax(0) - positions.amin(0)).argmax())
    along = positions[:, longest].argsort(stable=True)
    parts = (*order.tensor_split(RANDOM_FOLDS), *along.tensor_split(STRIPS))
    return [part.sort().values.tolist() for part in parts]


@dataclass(frozen=True, eq=False)
class _Tables:
    """Sums over the pixels of each position when it was left out, of shares and shares times error^2 [dB^2]: of cells
    `[V, C, 2]` and of planes, the straight way last, `[V, P + 1, 2]`."""

    cells: Tensor
    planes: Tensor

    @classmethod
    def empty(cls, views: int, cells: int, planes: int) -> "_Tables":
        return cls(torch.zeros(views, cells, 2), torch.zeros(views, planes, 2))


def _doubt(surface: LitSurface, tables: _Tables, spectra: Spectrum, places: list[int], seen: Tensor) -> Uncertainty:
    """What the errors at `places` tell, before the weights are known."""
    cells = tables.cells[places].sum(0)
    everywhere = cells.sum(0)
    typical = everywhere[1] / everywhere[0].clamp_min(1e-9)
    segments = torch.zeros(len(surface.laws), 2).index_add_(0, surface.segment_of_cell, cells)
    segment = _drawn(segments, typical, SHRINK)
    planes = tables.planes[places].sum(0)
    receivers = spectra.pose.position[places]
    apart = torch.cdist(receivers, receivers) + torch.diag(torch.full((len(receivers),), torch.inf))
    return Uncertainty(
        spread_db=_drawn(cells, segment[surface.segment_of_cell], SHRINK).sqrt(),
        source_db=_drawn(planes, planes[:, 1].sum() / planes[:, 0].sum().clamp_min(1e-9), RAY_SHRINK).sqrt(),
        receivers=receivers,
        seen=seen[:, places],
        spacing=max(float(apart.amin(-1).median()), 1e-3),
        weights=torch.zeros(len(NUMBERS)),
        widths=torch.ones(len(SHARES)),
    )


def _drawn(sums: Tensor, to: Tensor, shrink: float) -> Tensor:
    """Means `[n]` of `sums` `[n, 2]`, drawn to `to` as if that had been seen in `shrink` pixels."""
    return (sums[:, 1] + shrink * to) / (sums[:, 0] + shrink)


def _in_sight(field: RadioField, spectra: Spectrum) -> Tensor:
    """Which training positions see the transmitter `[V]`, as the spectra tell."""
    return fit_line_of_sight(PointSources.line_of_sight(field.tx.position, field.frequency), spectra)[1]


def _rays(field: RadioField, spectra: Spectrum, in_sight: Tensor) -> list[Rays] | None:
    """What reaches the training positions from point sources; the spectra decide the line of sight."""
    if field.sources is None:
        return None
    return field.sources.rays_each(spectra.pose.position, field.obstacles, in_sight=in_sight)


def _solidity_without(field: RadioField, spectra: Spectrum, in_sight: Tensor, places: list[int]) -> Tensor:
    """How far the Gaussians stop rays `[N]` when some positions did not tell which ways are free."""
    surface = field.surface
    if field.sources is None or not bool((field.solidity > 0).any()):
        return field.solidity
    others = torch.tensor([place for place in range(len(spectra)) if place not in places])
    before = replace(field.obstacles, opacities=surface.opacities)
    once = replace(field.sources, sequence=field.sources.sequence[field.sources.order <= 1])
    return cleared_by(once, spectra[others], in_sight[others], before).opacities


def _planes(field: RadioField) -> int:
    return 0 if field.sources is None else len(field.sources.planes)


def _left_out(
    field: RadioField,
    views: Sequence[LitView],
    observed: Observations,
    spectra: Spectrum,
    places: list[int],
    tables: _Tables,
    *,
    bake: bool,
) -> LeftOut:
    """The field fitted without `places`; with `bake` its errors there go into the `tables`."""
    surface = field.surface
    assert isinstance(surface, LitSurface)
    kept = [view for number, view in enumerate(views) if number not in places]
    used = ~torch.isin(observed.view, torch.tensor(places))
    rows = ("gaussian", "view", "weight", "level_db")
    some = replace(observed, csi=None, **{name: getattr(observed, name)[used] for name in rows})
    numbers = (surface.segment_of, surface.cell_of, surface.tx)
    scattering = Scattering.of(surface.means, surface.normals, surface.visibility, *numbers)
    bare = replace(surface.without_residual(), laws=fit_laws(scattering, some), ambient_shift=None)
    fitted = refine_residual(bare, kept, floor_db=floor_db(surface), backend=field.backend)
    without = replace(field, surface=fitted)
    errors, counts = [], []
    for place in places:
        error, count = _errors(without, spectra[place], views[place], tables, place if bake else None)
        errors.append(error)
        counts.append(count)
    return LeftOut(without, places, torch.stack(errors), torch.stack(counts))


def _errors(
    field: RadioField, truth: Spectrum, view: LitView, tables: _Tables, row: int | None
) -> tuple[Tensor, Tensor]:
    """Errors and counts `[row, col]` at one position; sums by the shares that cells and planes have in the power."""
    surface = field.surface
    assert isinstance(surface, LitSurface)
    receiver = truth.pose.position
    with torch.no_grad():
        sent = surface.values(receiver, csi=False)
    values = sent.expand(-1, 2).contiguous().requires_grad_()
    with torch.enable_grad():
        drawn = surface.seen(values, view.view, field.backend)
        shown = drawn.detach()[..., 0] * surface.unit
        rays = None if field.sources is None else field.sources.rays(receiver, field.obstacles)
        if rays is not None:
            shown = shown + rays.picture(truth.pose, truth.grid, truth.instrument)
        floor = torch.full_like(shown, 10 ** (floor_db(surface) / 10))
        floor = floor if truth.floor is None else torch.maximum(floor, truth.floor)
        error = 10 * torch.log10(torch.maximum(truth.power, floor) / torch.maximum(shown, floor)).nan_to_num(0.0)
        square = error.clamp(-FARTHEST_DB, FARTHEST_DB).square()
        area = truth.grid.solid_angle / truth.grid.solid_angle.mean()
        counts = area * ((truth.power > floor) | (shown > floor))
        if row is None:
            return error, counts
        upstream = counts * surface.unit / torch.where(shown > 0, shown, 1.0)
        upstream = torch.stack((upstream, upstream * square), -1)
        (sums,) = torch.autograd.grad(drawn, values, upstream)
    tables.cells[row].index_add_(0, surface.cell_of, sums * sent)
    if rays is not None and field.sources is not None:
        place, ray, power = rays.shares(truth.pose, truth.grid, truth.instrument)
        share = (counts / torch.where(shown > 0, shown, 1.0)).flatten()[place] * power
        known = torch.stack((share, share * square.flatten()[place]), -1)
        planes = field.sources.sequence[rays.index[ray]]
        planes[:, 0] = torch.where(planes[:, 0] < 0, tables.planes.shape[1] - 1, planes[:, 0])
        for step in planes.unbind(-1):
            tables.planes[row].index_add_(0, step.clamp_min(0), known * (step >= 0)[:, None])
    return error, counts


def _rows(one: LeftOut, doubt: Uncertainty, spectra: Spectrum) -> tuple[Tensor, Tensor, Tensor]:
    """Numbers `[n, 10]`, errors and counts `[n]` of pixels at positions that were left out, by what the others tell."""
    numbers = [numbers_of(one.field, doubt, spectra.pose[place], spectra.grid).flatten(0, 1) for place in one.places]
    every = max(1, len(spectra) * 2 * spectra.grid.solid_angle.numel() // MOST)
    chosen = torch.arange(0, one.error_db.numel(), every)
    error = one.error_db.flatten()[chosen].clamp(-FARTHEST_DB, FARTHEST_DB)
    return torch.cat(numbers)[chosen], error, one.counts.flatten()[chosen]
