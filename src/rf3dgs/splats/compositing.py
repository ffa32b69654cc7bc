"""How Gaussians become a picture: blur, depth gate, division by the weight, an added picture, the channels' transfer.

The functions are the specification of every backend and of the fused training step. The order is: blend (with the
blur and the depth gate), divide by the accumulated weight, add, transfer.
"""

import math
from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor

from rf3dgs.core.errors import InputError
from rf3dgs.splats.constants import BLUR

Transfer = Literal["identity", "db_window"]


@dataclass(frozen=True)
class Compositing:
    """What is done to channels besides blending them front to back.

    depth_gate [m]: a contribution to a pixel counts only if its Gaussian is at most this much deeper than the one that
        brought the pixel's transmittance below three quarters; None for all. It stops what shines through gaps of a
        surface. Depth is what the Gaussians are sorted by: view z of a camera, distance of a panorama.
    normalise: channels are divided by the accumulated weight; they are zero where the weight is.
    transfer: one for all channels or one for each: "identity", or "db_window" for linear power to be shown in the
        window from floor_db (0) to ceil_db (1), see `db_window`.
    blur [pixel^2]: added to both variances of a projected Gaussian, so that none falls between the middles of pixels.
        What stands before something else is seen wider by it, which is much where pixels are wide.
    """

    depth_gate: float | None = None
    normalise: bool = False
    transfer: Transfer | tuple[Transfer, ...] = "identity"
    floor_db: float | None = None
    ceil_db: float | None = None
    blur: float = BLUR

    def __post_init__(self) -> None:
        if not (math.isfinite(self.blur) and self.blur > 0):
            raise InputError(f"blur must be a positive number of square pixels; got {self.blur}")
        if self.depth_gate is not None and not (math.isfinite(self.depth_gate) and self.depth_gate >= 0):
            raise InputError(f"depth_gate must be a length of 0 m or more, or None; got {self.depth_gate}")
        names = (self.transfer,) if isinstance(self.transfer, str) else self.transfer
        for name in names:
            if name not in ("identity", "db_window"):
                raise InputError(f'transfer must be "identity" or "db_window", or a tuple of these; got {name!r}')
        if "db_window" in names:
            low, high = self.floor_db, self.ceil_db
            sound = low is not None and high is not None and math.isfinite(low) and math.isfinite(high) and low < high
            if not sound:
                raise InputError(f"db_window needs floor_db < ceil_db in dB; got {low} and {high}")

    @property
    def window(self) -> tuple[float, float]:
        """floor_db and ceil_db of the channels in a dB window."""
        if self.floor_db is None or self.ceil_db is None:
            raise InputError("this compositing has no dB window; give floor_db and ceil_db")
        return self.floor_db, self.ceil_db

    def transfers(self, channels: int) -> tuple[Transfer, ...]:
        """The transfer of each channel; raises InputError where their number differs."""
        if isinstance(self.transfer, str):
            return (self.transfer,) * channels
        if len(self.transfer) != channels:
            raise InputError(
                f"transfer must be one name or one for each channel ({channels}); got {len(self.transfer)} names"
            )
        return self.transfer


def finish(blended: Tensor, weight: Tensor, compositing: Compositing, added: Tensor | None = None) -> Tensor:
    """The picture `[row, col, channel]` of `blended` channels and their accumulated `weight` `[row, col]`.

    `added` `[row, col, channel]` comes after the division and before the transfer, so that linear power adds up.
    """
    picture = normalise(blended, weight) if compositing.normalise else blended
    if added is not None:
        picture = picture + added
    return transfer(picture, compositing)


def normalise(blended: Tensor, weight: Tensor) -> Tensor:
    """Means over what was hit `[row, col, channel]`: blended channels over `weight` `[row, col]`, zero without any."""
    hit = weight > 0
    return torch.where(hit[..., None], blended / torch.where(hit, weight, 1.0)[..., None], 0.0)


def transfer(picture: Tensor, compositing: Compositing) -> Tensor:
    """Each channel `[row, col, channel]` through its transfer."""
    names = compositing.transfers(picture.shape[-1])
    windowed = torch.tensor([name == "db_window" for name in names], device=picture.device)
    if not bool(windowed.any()):
        return picture
    shown = db_window(picture, *compositing.window)
    return shown if bool(windowed.all()) else torch.where(windowed, shown, picture)


def db_window(power: Tensor, floor_db: float, ceil_db: float) -> Tensor:
    """`(10 log10(max(P, 0) + F) - floor_db) / (ceil_db - floor_db)` with the floor's own power F = 10^(floor_db/10).

    0 without power; at the ceiling 1, within 0.01 dB where the window has 30 dB or more. The slope at P = 0 is finite
    and not zero, so that what is dark can be trained to shine.
    """
    floor = 10.0 ** (floor_db / 10)
    return torch.log1p(power.clamp_min(0) / floor) * (10 / math.log(10) / (ceil_db - floor_db))


def db_window_inverse(value: Tensor, floor_db: float, ceil_db: float) -> Tensor:
    """Linear power of a `value` that `db_window` gives."""
    floor = 10.0 ** (floor_db / 10)
    return torch.expm1(value * (math.log(10) / 10 * (ceil_db - floor_db))) * floor
