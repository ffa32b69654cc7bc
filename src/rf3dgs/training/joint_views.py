"""What joint refinement looks at: training spectra as they were measured, what point sources send into them, and how
far a picture of both is off."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import normalize

from rf3dgs.core.grids import View, view_of
from rf3dgs.core.threads import on_threads
from rf3dgs.field.lit import LitSurface
from rf3dgs.field.radiance import NANOSECOND
from rf3dgs.field.rays import Rays
from rf3dgs.spectra.spectrum import Spectrum
from rf3dgs.splats.rasterize import Backend
from rf3dgs.training.lit_fit import SOFT_DB
from rf3dgs.training.lit_views import SOFT_NS, SOFT_TURN

LEAST_SHARE = 1e-3  # of the floor; where something was measured a picture counts as no less


@dataclass(frozen=True, eq=False)
class JointView:
    """One training spectrum as it was measured, and what point sources send into it.

    view: what it shows. worth `[row, col]`: solid angle of a pixel relative to the picture's mean, zero where nothing
    was measured. truth `[row, col, 1 (+ 4)]`: power over the surface's unit, delay [ns] and departure. floor
    `[row, col]`: power over the unit up to which levels are all one. sources `[row, col, 1 (+ 4)]`: power over the unit
    of point sources, and that times delay [ns] and departure. hit `[N]`: True for the Gaussians that it shows.
    """

    view: View
    hit: Tensor
    worth: Tensor
    truth: Tensor
    floor: Tensor
    sources: Tensor

    @property
    def has_csi(self) -> bool:
        """Whether delay and departure are known."""
        return self.truth.shape[-1] > 1


def joint_views(
    surface: LitSurface, spectra: Spectrum, rays: Sequence[Rays], *, floor_db: float, backend: Backend = "auto"
) -> list[JointView]:
    """The views of a `surface` as `spectra` `[position, row, col]` have them, with the `rays` to each; levels under
    `floor_db` are all one."""
    return on_threads(lambda each: _view(surface, spectra[each[0]], each[1], floor_db, backend), enumerate(rays))


def _view(surface: LitSurface, one: Spectrum, rays: Rays, floor_db: float, backend: Backend) -> JointView:
    unit, view = surface.unit, view_of(one.pose, one.grid)
    floor = torch.zeros_like(one.power) if one.floor is None else torch.where(one.looked, one.floor, torch.zeros(()))
    truth = (one.power / unit)[..., None]
    known = torch.ones(len(rays), 1)
    if one.delay is not None and one.aod is not None:
        truth = torch.cat((truth, one.delay[..., None] / NANOSECOND, one.aod), -1)
        known = torch.cat((known, rays.delay[:, None] / NANOSECOND, rays.departure), -1)
    place, ray, share = rays.shares(one.pose, one.grid, one.instrument)
    sent = (share / unit)[:, None] * known[ray]
    return JointView(
        view=view,
        hit=surface.hit_in(view, backend),
        worth=one.grid.solid_angle / one.grid.solid_angle.mean() * one.looked,
        truth=truth,
        floor=(floor / unit).clamp_min(10 ** (floor_db / 10) / unit),
        sources=torch.zeros_like(truth).flatten(0, 1).index_add(0, place, sent).reshape(truth.shape),
    )


def misfit(shown: Tensor, one: JointView) -> Tensor:
    """How far a picture is off, a sum over pixels: of level errors in dB, and of those of delay and departure."""
    level, truth = shown[..., 0], one.truth[..., 0]
    above = truth > one.floor
    least = torch.where(above, LEAST_SHARE * one.floor, one.floor)
    error = 10 * torch.log10(level.clamp_min(least) / truth.clamp_min(one.floor))
    cost = SOFT_DB**2 * _soft((error / SOFT_DB).square())
    if one.has_csi:
        hit = above & (level.detach() > least)
        some = torch.where(hit, level, 1.0)
        late = shown[..., 1] / some - one.truth[..., 1]
        turned = normalize(shown[..., 2:] / some[..., None], dim=-1, eps=1e-6) - one.truth[..., 2:]
        csi = _soft((late / SOFT_NS).square()) + _soft((turned / SOFT_TURN).square().sum(-1))
        cost = cost + torch.where(hit, csi, 0.0)
    return (one.worth * cost).sum()


def _soft(square: Tensor) -> Tensor:
    """Squares while they are small, twice their root when they are large."""
    return 2 * ((1 + square).sqrt() - 1)
