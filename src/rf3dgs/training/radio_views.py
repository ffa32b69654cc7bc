"""What the radio stage looks at: pictures of the training spectra as cameras see them, without the point sources.

A pinhole spectrum is one view; a sphere becomes six cube faces. Gains are brought into the field's dB window first and
interpolated there, so that a rendering, which is interpolated in the same way, can reach them.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from rf3dgs.core.angles import angle_between
from rf3dgs.core.cube import device_from_faces, face_cameras, face_grid
from rf3dgs.core.errors import InputError
from rf3dgs.core.grids import Camera, sample_grid
from rf3dgs.field.sources import PointSource
from rf3dgs.spectra.codec import DbWindow, PaperEncoding
from rf3dgs.spectra.spectrum import Spectrum

MASKED_LOBES = 1.0
MASKED_SHARE = 0.3


@dataclass(frozen=True, eq=False)
class RadioView:
    """One picture to learn from.

    gain `[row, col]`: window units. keep `[row, col]`: solid angle of the pixel relative to the picture's mean, zero
    where a point source hides the surface. csi `[row, col, C]`: the channels of the surface's encoding (delay [ns] and
    departure, or the paper's three), or None where the spectra have none.
    """

    camera: Camera
    gain: Tensor
    keep: Tensor
    csi: Tensor | None


def radio_views(
    spectra: Spectrum,
    window: DbWindow,
    *,
    sources: Sequence[tuple[PointSource, Tensor]] = (),
    encoding: PaperEncoding | None = None,
    face_size: int | None = None,
) -> list[RadioView]:
    """The views of `spectra` `[position, row, col]`; `sources`: point sources and where each is seen `[position]`.

    `encoding` asks for the paper's CSI channels; None for delay [ns] and the departure vector.
    """
    if spectra.grid.kind == "list":
        raise InputError("the radio stage needs pinhole or equirectangular spectra; got a list of directions")
    pinhole = spectra.grid.kind == "pinhole"
    size = face_size or max(8, round(spectra.grid.width / 4))
    grid = spectra.grid if pinhole else face_grid(size)
    area = grid.solid_angle / grid.solid_angle.mean()
    views = []
    for index in range(len(spectra)):
        one = spectra[index]
        channels = _channels(one, window, [source for source, seen in sources if bool(seen[index])], encoding)
        if pinhole:
            pictures, cameras = [channels], [Camera.of(one.pose, grid)]
        else:
            cameras = face_cameras(one.pose, size)
            pictures = [sample_grid(channels, one.grid, grid.directions @ turn.mT) for turn in device_from_faces()]
        for picture, camera in zip(pictures, cameras, strict=True):
            keep = area * (picture[..., 1] > 0.999)
            csi = picture[..., 2:] if encoding else _weighted_mean(picture[..., 2:])
            views.append(RadioView(camera, picture[..., 0], keep, csi if picture.shape[-1] > 2 else None))
    return views


def _weighted_mean(sums: Tensor) -> Tensor:
    """Delay and unit departure of interpolated power times (1, delay, departure)."""
    mean = sums[..., 1:] / sums[..., :1].clamp_min(1e-30) * (sums[..., :1] > 0)
    return torch.cat((mean[..., :1], torch.nn.functional.normalize(mean[..., 1:], dim=-1, eps=1e-9)), -1)


def _channels(
    one: Spectrum, window: DbWindow, sources: Sequence[PointSource], encoding: PaperEncoding | None
) -> Tensor:
    """Window gain, 1 where the surface decides, and the paper's CSI channels or power over the floor times (1, delay
    [ns], departure). Point sources are taken out, and the pixels that they rule are marked by 0.
    """
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
    if has_csi and encoding is not None:
        parts += [encoding.encode(one)[..., 1:]]
    elif has_csi:
        reached = (power > 0) & (whole > 0)
        parts += [(reached * part / floor)[..., None] for part in (power, delay * 1e9)]
        parts += [reached[..., None] * aod / floor]
    return torch.cat([part.float() for part in parts], -1)
