"""What the mirror model's surface is fitted to: training spectra without their point sources, thrown back onto the
Gaussians in linear power.

For each view the rasterizer's own gradient gives every Gaussian the mean power of the pixels that it decides, their
mean delay and departure weighted by power, and how many pixels those are.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from rf3dgs.core.errors import InputError
from rf3dgs.core.grids import View, view_of
from rf3dgs.core.threads import on_threads
from rf3dgs.field.lit import BLENDING, LitSurface
from rf3dgs.field.radiance import NANOSECOND
from rf3dgs.field.rays import Rays
from rf3dgs.spectra.spectrum import Spectrum
from rf3dgs.splats.gaussians import Gaussians
from rf3dgs.splats.rasterize import Backend, rasterize
from rf3dgs.training.radio_views import ruled

LEAST_WEIGHT = 0.02  # [pixel]; what a view tells of fainter Gaussians is left out
LEAST_POWER = 1e-30
FARTHEST_DB = 15.0  # errors of pixels beyond this count as this
SHARP_DB = 6.0  # where errors of pixels turn from squares to absolute values: one in ten is an edge or a mirror path
SOFT_NS, SOFT_TURN = 1.0, 0.1  # errors of delay [ns] and departure [rad] that count as squares; absolutely beyond


@dataclass(frozen=True, eq=False)
class LitView:
    """One training spectrum without its point sources.

    view: what it shows. keep `[row, col]`: solid angle of the pixel relative to the picture's mean, zero where it says
    nothing of the surface, because point sources bring more than 30 % of the power. channels `[row, col, 1 (+ 4)]`: the
    rest of the power, linear, and that times delay [ns] and departure where the spectra have them. floor `[row, col]`:
    power up to which it says no more than "at most that"; zero where the spectra have none.
    """

    view: View
    keep: Tensor
    channels: Tensor
    floor: Tensor

    @property
    def certain(self) -> Tensor:
        """`keep` of the pixels whose power is more than "at most the floor"."""
        return self.keep * (self.channels[..., 0] > self.floor)


@dataclass(frozen=True, eq=False)
class Observations:
    """What views tell about Gaussians, one row for each pair: gaussian, view `[M]` long; weight `[M]` [pixel]; level_db
    `[M]`: mean power; delay `[M]` [ns] and departure `[M, 3]`, means weighted by power, or None. receivers `[V, 3]`.
    """

    gaussian: Tensor
    view: Tensor
    weight: Tensor
    level_db: Tensor
    csi: Tensor | None
    receivers: Tensor

    def __len__(self) -> int:
        return len(self.gaussian)


@dataclass(frozen=True, eq=False)
class Shortfall:
    """What a surface lacks, one row for each pair of Gaussian and view: gaussian, view `[M]` long; weight `[M]`: pixels
    times the Gaussian's share in their power; error_db `[M]`: mean of truth over model, weighted so.

    csi_weight `[M, 2]`, csi_error `[M, 4]`: the same of delay [ns] and of the departure vector, or None. Pixels of
    large errors count less, so that what is fitted are medians rather than means, the more so for the latter.
    """

    gaussian: Tensor
    view: Tensor
    weight: Tensor
    error_db: Tensor
    csi_weight: Tensor | None = None
    csi_error: Tensor | None = None

    def __len__(self) -> int:
        return len(self.gaussian)


def lit_views(spectra: Spectrum, rays: Sequence[Rays] | None) -> list[LitView]:
    """The views of `spectra` `[position, row, col]`; `rays`: what reaches each position from point sources."""
    if spectra.grid.kind == "list":
        raise InputError("the radio stage needs pinhole or equirectangular spectra; got a list of directions")
    return [_view(spectra[index], None if rays is None else rays[index]) for index in range(len(spectra))]


def _view(one: Spectrum, rays: Rays | None) -> LitView:
    area = one.grid.solid_angle / one.grid.solid_angle.mean()
    power = one.power.double()[..., None]
    channels = power
    if one.delay is not None and one.aod is not None:
        channels = torch.cat((power, power * one.delay.double()[..., None] / NANOSECOND, power * one.aod.double()), -1)
    keep = area.clone()
    dark = one.power <= 0  # which says that no surface shines there
    if rays is not None and len(rays):
        keep = area * (~ruled(one, rays)[1] | dark)
        place, ray, share = rays.shares(one.pose, one.grid, one.instrument)
        known = torch.cat((torch.ones(len(rays), 1), rays.delay[:, None] / NANOSECOND, rays.departure), -1)
        taken = (share[:, None] * known[ray])[:, : channels.shape[-1]].double()
        flat = channels.reshape(-1, channels.shape[-1]).index_add(0, place, -taken)
        channels = flat.reshape(channels.shape)
    floor = torch.zeros_like(one.power) if one.floor is None else torch.where(one.looked, one.floor, torch.zeros(()))
    told = one.looked & ((channels[..., 0] > 0) | (floor > 0) | dark)
    return LitView(view_of(one.pose, one.grid), keep * told, channels, floor)


def observe(geometry: Gaussians, views: Sequence[LitView], *, unit: float, backend: Backend = "auto") -> Observations:
    """What `views` tell about every Gaussian of `geometry`; `unit`: the power that counts as 1 on the way."""
    geometry = geometry.detach()
    shape = (geometry.means, geometry.quats, geometry.scales, geometry.opacities)
    has_csi = all(view.channels.shape[-1] == 5 for view in views)
    columns = 6 if has_csi else 2

    def told(one: LitView) -> tuple[Tensor, Tensor]:
        values = torch.zeros((len(geometry), columns)).requires_grad_()
        with torch.enable_grad():
            raster = rasterize(*shape, values, one.view, compositing=BLENDING, backend=backend)
            target = (one.channels[..., : columns - 1] / unit).float()
            target = torch.cat((torch.ones_like(target[..., :1]), target), -1) * one.certain[..., None]
            (sums,) = torch.autograd.grad(raster.values, values, target)
        chosen = ((sums[:, 0] > LEAST_WEIGHT) & (sums[:, 1] > 0)).nonzero().squeeze(-1)
        return chosen, sums[chosen]

    gaussian, view, sums = _joined(on_threads(told, views))
    power = sums[:, 1] / sums[:, 0] * unit
    return Observations(
        gaussian=gaussian,
        view=view,
        weight=sums[:, 0].contiguous(),
        level_db=10 * torch.log10(power.clamp_min(LEAST_POWER)),
        csi=sums[:, 2:] / sums[:, 1:2] if has_csi else None,
        receivers=torch.stack([one.view.position for one in views]),
    )


def shortfall(
    surface: LitSurface, views: Sequence[LitView], hits: Sequence[Tensor], floor_db: float, backend: Backend = "auto"
) -> Shortfall:
    """What `surface` lacks in `views`, thrown back onto the Gaussians by their share in each pixel's power.

    The share is the derivative of a pixel's level in a Gaussian's. hits: which Gaussians each view shows
    (`LitSurface.hit_in`). Levels under `floor_db`, or a pixel's own floor, count as that.
    """
    has_csi = all(view.channels.shape[-1] == 5 for view in views)

    def lacking(shown_to: tuple[LitView, Tensor]) -> tuple[Tensor, Tensor]:
        one, hit = shown_to
        part = surface.subset(hit)
        with torch.no_grad():
            values = part.values(one.view.position, csi=has_csi)
            sent = values[:, :1]
            # The weights do not depend on what is blended: channels beyond the model's own bring back more sums.
            values = torch.cat((values, sent.expand(-1, 3 if has_csi else 1)), -1).requires_grad_()
        with torch.enable_grad():
            shown = part.seen(values, one.view, backend)
            upstream = _lacking(shown.detach(), one, surface.unit, floor_db)
            (sums,) = torch.autograd.grad(shown, values, upstream)
        sums = sums * sent
        chosen = sums[:, 0] > LEAST_WEIGHT
        return hit.nonzero().squeeze(-1)[chosen], sums[chosen]

    gaussian, view, sums = _joined(on_threads(lacking, zip(views, hits, strict=True)))
    level = (gaussian, view, sums[:, 0].contiguous(), sums[:, 1] / sums[:, 0])
    if not has_csi:
        return Shortfall(*level)
    weight = sums[:, [2, 4]]
    error = torch.cat((sums[:, 3:4], sums[:, 5:]), -1) / weight.clamp_min(1e-9)[:, [0, 1, 1, 1]]
    return Shortfall(*level, weight, error)


def _lacking(shown: Tensor, one: LitView, unit: float, floor_db: float) -> Tensor:
    """Per unit of a Gaussian's weight `[row, col, 2 or 8]`: its robust share in a pixel, and that times the error in
    dB; and likewise of the delay; and of the departure."""
    power = shown[..., 0]
    floor = (one.floor / unit).float().clamp_min(10 ** (floor_db / 10) / unit)
    truth = (one.channels[..., 0] / unit).float()
    error = 10 * torch.log10(torch.maximum(truth, floor) / torch.maximum(power, floor))
    some = torch.where(power > 0, power, 1.0)
    share = one.keep * (power > 0) / some
    near = share / (1 + (error / SHARP_DB).square()).sqrt()
    level = (near, near * error.clamp(-FARTHEST_DB, FARTHEST_DB))
    if one.channels.shape[-1] == 1:
        return torch.stack(level, -1)
    reached = share * (truth >= floor) * (one.channels[..., 0] > one.floor)
    known = one.channels / torch.where(truth > 0, one.channels[..., 0], 1.0)[..., None]
    late = known[..., 1].float() - shown[..., 1] / some
    turned = torch.nn.functional.normalize(known[..., 2:].float(), dim=-1, eps=1e-9) - shown[..., 2:5] / some[..., None]
    slow = reached * SOFT_NS / late.abs().clamp_min(SOFT_NS)
    bent = reached * SOFT_TURN / torch.linalg.vector_norm(turned, dim=-1).clamp_min(SOFT_TURN)
    return torch.stack((*level, slow, slow * late, bent, *(bent[..., None] * turned).unbind(-1)), -1)


def _joined(rows: Sequence[tuple[Tensor, Tensor]]) -> tuple[Tensor, Tensor, Tensor]:
    """The Gaussians and sums of all views, one view after another, and the number of each one's view in between."""
    gaussian, sums = zip(*rows, strict=True)
    view = torch.arange(len(rows)).repeat_interleave(torch.tensor([len(part) for part in gaussian]))
    return torch.cat(gaussian), view, torch.cat(sums)
