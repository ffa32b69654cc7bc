"""What the radio stage looks at: the training spectra as pictures, without the point sources.

Every spectrum is one picture on its own grid, a pinhole's or the whole sphere's. Gains are in the field's dB window.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from rf3dgs.core.angles import angle_between
from rf3dgs.core.errors import InputError
from rf3dgs.core.grids import View, view_of
from rf3dgs.field.rays import Rays
from rf3dgs.spectra.codec import DbWindow, PaperEncoding
from rf3dgs.spectra.spectrum import Spectrum

MASKED_LOBES = 1.0
MASKED_SHARE = 0.3


@dataclass(frozen=True, eq=False)
class RadioView:
    """One picture to learn from.

    view: what it shows. gain `[row, col]`: window units. keep `[row, col]`: solid angle of the pixel relative to the
    picture's mean, zero where a point source hides the surface. csi `[row, col, C]`: the channels of the surface's
    encoding (delay [ns] and departure, or the paper's three), or None where the spectra have none.
    """

    view: View
    gain: Tensor
    keep: Tensor
    csi: Tensor | None


def radio_views(
    spectra: Spectrum,
    window: DbWindow,
    *,
    rays: Sequence[Rays] | None = None,
    encoding: PaperEncoding | None = None,
) -> list[RadioView]:
    """The views of `spectra` `[position, row, col]`; `rays`: what reaches each position from point sources.

    `encoding` asks for the paper's CSI channels; None for delay [ns] and the departure vector.
    """
    if spectra.grid.kind == "list":
        raise InputError("the radio stage needs pinhole or equirectangular spectra; got a list of directions")
    each = [None] * len(spectra) if rays is None else rays
    return [_view(spectra[index], window, each[index], encoding) for index in range(len(spectra))]


def ruled(one: Spectrum, rays: Rays) -> tuple[Tensor, Tensor]:
    """Power `[row, col]` that point sources send into a spectrum `[row, col]`, and the pixels that they rule: where it
    is 30 % of the spectrum's or more, and a lobe around the line of sight.
    """
    share = rays.picture(one.pose, one.grid, one.instrument).double()
    rule = share >= MASKED_SHARE * one.heard
    for arrival in rays.arrival[rays.order == 0]:
        angle = angle_between(one.directions, arrival.expand_as(one.directions))
        rule = rule | (angle <= MASKED_LOBES * one.instrument.lobe)
    return share, rule


def _view(one: Spectrum, window: DbWindow, rays: Rays | None, encoding: PaperEncoding | None) -> RadioView:
    """The picture of one spectrum: point sources are taken out, and the pixels that they rule do not count."""
    area = one.grid.solid_angle / one.grid.solid_angle.mean()
    power, whole = one.power.double(), torch.ones_like(one.power, dtype=torch.bool)
    has_csi = one.delay is not None and one.aod is not None
    delay = one.delay.double() * power if one.delay is not None else power
    aod = one.aod.double() * power[..., None] if one.aod is not None else power[..., None]
    if rays is not None and len(rays):
        sent, rule = ruled(one, rays)
        whole, power = ~rule, power - sent
        if has_csi:
            place, ray, share = rays.shares(one.pose, one.grid, one.instrument)
            late, turned = share * rays.delay[ray], share[:, None] * rays.departure[ray]
            delay = delay.flatten().index_add(0, place, -late.double()).reshape(delay.shape)
            aod = aod.reshape(-1, 3).index_add(0, place, -turned.double()).reshape(aod.shape)
    csi = None
    if has_csi and encoding is not None:
        csi = encoding.encode(one)[..., 1:]
    elif has_csi:
        reached = (power > 0) & whole
        late = torch.where(reached, delay / torch.where(reached, power, 1.0) * 1e9, 0.0)
        turned = torch.nn.functional.normalize(aod / torch.where(reached, power, 1.0)[..., None], dim=-1, eps=1e-9)
        csi = torch.cat((late[..., None], turned * reached[..., None]), -1).float()
    keep = area * (whole & one.looked)
    return RadioView(view_of(one.pose, one.grid), window.encode(power.clamp_min(0.0).float()), keep, csi)
