"""What the radio stage looks at: pictures of the training spectra as cameras see them, without the point sources.

A pinhole spectrum is one view; a sphere becomes six cube faces. Gains are brought into the field's dB window first and
interpolated there, so that a rendering, which is interpolated in the same way, can reach them.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from rf3dgs.core.angles import angle_between
from rf3dgs.core.errors import InputError
from rf3dgs.core.grids import Camera, device_from_faces, face_cameras, face_grid, sample_grid
from rf3dgs.field.sources import PointSource
from rf3dgs.spectra.codec import DbWindow
from rf3dgs.spectra.spectrum import Spectrum

MASKED_LOBES = 1.0
MASKED_SHARE = 0.3


@dataclass(frozen=True, eq=False)
class RadioView:
    """One picture to learn from.

    gain `[row, col]`: window units. keep `[row, col]`: solid angle of the pixel relative to the picture's mean, zero
    where a point source hides the surface. delay `[row, col]` [s] and aod `[row, col, 3]`, or None where the spectra
    have none.
    """

    camera: Camera
    gain: Tensor
    keep: Tensor
    delay: Tensor | None
    aod: Tensor | None


def radio_views(
    spectra: Spectrum,
    window: DbWindow,
    *,
    sources: Sequence[tuple[PointSource, Tensor]] = (),
    face_size: int | None = None,
) -> list[RadioView]:
    """The views of `spectra` `[position, row, col]`; `sources`: point sources and where each is seen `[position]`."""
    if spectra.grid.kind == "list":
        raise InputError("the radio stage needs pinhole or equirectangular spectra; got a list of directions")
    pinhole = spectra.grid.kind == "pinhole"
    size = face_size or max(8, round(spectra.grid.width / 4))
    grid = spectra.grid if pinhole else face_grid(size)
    area = grid.solid_angle / grid.solid_angle.mean()
    views = []
    for index in range(len(spectra)):
        one = spectra[index]
        channels = _channels(one, window, [source for source, seen in sources if bool(seen[index])])
        if pinhole:
            pictures, cameras = [channels], [Camera.of(one.pose, grid)]
        else:
            cameras = face_cameras(one.pose, size)
            pictures = [sample_grid(channels, one.grid, grid.directions @ turn.mT) for turn in device_from_faces()]
        for picture, camera in zip(pictures, cameras, strict=True):
            keep = area * (picture[..., 1] > 0.999)
            delay = aod = None
            if picture.shape[-1] > 2:
                power = picture[..., 2].clamp_min(1e-30)
                delay = torch.where(picture[..., 2] > 0, picture[..., 3] / power, torch.zeros_like(power))
                aod = torch.nn.functional.normalize(picture[..., 4:7] / power[..., None], dim=-1, eps=1e-9)
            views.append(RadioView(camera, picture[..., 0], keep, delay, aod))
    return views


def _channels(one: Spectrum, window: DbWindow, sources: Sequence[PointSource]) -> Tensor:
    """Window gain, 1 where the surface decides, power times (1, delay, aod) over the floor; sources taken out."""
    power = one.power.double()
    whole = torch.ones_like(power)
    floor = 10.0 ** (window.floor_db / 10.0)
    has_csi = one.delay is not None and one.aod is not None
    delay = one.delay.double() * power if one.delay is not None else power
    aod = one.aod.double() * power[..., None] if one.aod is not None else power[..., None]
    for source in sources:
        here = one.pose.position
        beam = source.beam(one.directions, here, one.instrument)
        share = (beam * source.gain(here, one.frequency)).double()
        angle = angle_between(one.directions, source.arrival(here).expand_as(one.directions))
        whole = whole * ((share < MASKED_SHARE * one.power) & (angle > MASKED_LOBES * one.instrument.lobe))
        power = power - share
        delay = delay - share * source.delay(here)
        aod = aod - share[..., None] * source.departure(here)
    power = power.clamp_min(0.0)
    parts = [window.encode(power.float())[..., None], whole[..., None]]
    if has_csi:
        reached = (power > 0) & (whole > 0)
        parts += [(reached * part / floor)[..., None] for part in (power, delay)]
        parts += [reached[..., None] * aod / floor]
    return torch.cat([part.float() for part in parts], -1)
