"""What an instrument's lobe makes of a picture of surfaces: the mean over the beam around each direction.

Point sources are spread over the lobe one by one (`Rays.shares`); what surfaces send fills the sphere and is
averaged here, along rows and then along columns. On a sphere that is the lobe but for its shape beside the poles; in a
camera's corners the lobe comes out narrower, by the cosine of the angle from the axis.
"""

import math
from functools import lru_cache

import torch
from torch import Tensor

from rf3dgs.core.grids import Camera, Panorama, View

HALF_POWER = 2 * math.sqrt(2 * math.log(2))  # half-power widths in a standard deviation
DARKEST = 1e-13  # of the brightest pixel; sums in float64 tell nothing apart below


def through_lobe(picture: Tensor, view: View, lobe: float) -> Tensor:
    """The `picture` `[row, col, channel]` of a `view` as a Gaussian lobe of half-power width `lobe` [rad] sees it.

    A mean weighted by solid angle, of what is in the picture; differentiable, and the picture itself where the lobe is
    0. The first channel is power: where it comes out under `DARKEST` of its largest value all channels are zero.
    """
    if lobe <= 0:
        return picture
    blurred = _on_sphere(picture, lobe) if isinstance(view, Panorama) else _in_camera(picture, view, lobe)
    power = blurred[..., :1].detach()
    return torch.where(power > DARKEST * power.amax(), blurred, 0.0)


def _in_camera(picture: Tensor, view: Camera, lobe: float) -> Tensor:
    """Along columns, then along rows."""
    sizes = (view.width, view.height)
    centres = ((float(view.K[axis, axis]), float(view.K[axis, 2])) for axis in (0, 1))
    along, down = (_camera_filter(size, *one, lobe) for size, one in zip(sizes, centres, strict=True))
    columns = torch.matmul(down.to(picture), picture.flatten(1)).reshape(picture.shape).transpose(0, 1)
    return torch.matmul(along.to(picture), columns.flatten(1)).reshape(columns.shape).transpose(0, 1).contiguous()


def _on_sphere(picture: Tensor, lobe: float) -> Tensor:
    """Rows as circles, columns as halves of great circles, which go on over the poles on the other side.

    By Fourier sums over the azimuth in float64: beside a bright pixel one 100 dB weaker keeps its level.
    """
    height, width, channels = picture.shape
    turn, straight, over = _sphere_filters(height, width, lobe)
    waves = torch.fft.rfft(picture.double(), dim=1) * turn[..., None]
    # Half a turn of the azimuth, which the other side of a pole is, changes the sign of every second wave.
    sign = 1.0 - 2.0 * (torch.arange(waves.shape[1]) % 2).double()
    parts = torch.view_as_real(waves)
    apart = torch.matmul(over, (parts * sign[:, None, None]).flatten(1))
    seen = (torch.matmul(straight, parts.flatten(1)) + apart).reshape(parts.shape)
    return torch.fft.irfft(torch.view_as_complex(seen), n=width, dim=1).reshape(height, width, channels).to(picture)


@lru_cache(maxsize=8)
def _sphere_filters(height: int, width: int, lobe: float) -> tuple[Tensor, Tensor, Tensor]:
    """What the lobe leaves of each wave of a row `[row, wave]`, and how rows see each other `[row, row]`, straight and
    over a pole."""
    sigma = lobe / HALF_POWER
    zenith = (torch.arange(height, dtype=torch.float64) + 0.5) * (math.pi / height)
    apart = torch.arange(width, dtype=torch.float64)
    apart = torch.minimum(apart, width - apart) * (2 * math.pi / width) * zenith.sin()[:, None]
    kernel = torch.exp(-0.5 * (apart / sigma).square())
    turn = torch.fft.rfft(kernel / kernel.sum(-1, keepdim=True), dim=-1).real
    to, of = zenith[:, None], zenith[None, :]
    straight, north, south = (
        torch.exp(-0.5 * (angle / sigma).square()) * of.sin() for angle in (to - of, to + of, 2 * math.pi - to - of)
    )
    over = north + south
    whole = (straight + over).sum(-1, keepdim=True)
    return turn, straight / whole, over / whole


@lru_cache(maxsize=16)
def _camera_filter(size: int, focal: float, centre: float, lobe: float) -> Tensor:
    """How pixels of a camera's row or column see each other `[pixel, pixel]`."""
    angle = torch.atan((torch.arange(size, dtype=torch.float64) + 0.5 - centre) / focal)
    apart = (angle[:, None] - angle[None, :]) * (HALF_POWER / lobe)
    kernel = torch.exp(-0.5 * apart.square()) * angle.cos().square()
    return kernel / kernel.sum(-1, keepdim=True)
