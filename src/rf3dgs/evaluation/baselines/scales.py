"""What the published recipe paints: a spectrum as colours in 0..1, and how a painted colour is read.

"jet": the level in the dB window in jet colours of 8 bits, which is what was published. "db": the level itself.
"view-db", "view-linear": every picture by its own range, the level from its weakest to its strongest direction, or the
power relative to its strongest. A picture does not show its range: it is read by the training pictures' mean one.
"""

from dataclasses import dataclass
from typing import Literal, get_args

from torch import Tensor

from rf3dgs.core.errors import InputError
from rf3dgs.field.radiance import surface_power
from rf3dgs.spectra.codec import DbWindow, PerViewLinear
from rf3dgs.spectra.jet import jet_level, jet_picture

Target = Literal["jet", "db", "view-db", "view-linear"]
TARGETS: tuple[Target, ...] = get_args(Target)


@dataclass(frozen=True)
class Scale:
    """How pictures are painted in a dB `window`; `low` and `high` [dB] are the mean range of the training pictures."""

    target: Target
    window: DbWindow
    low: float
    high: float

    @classmethod
    def of(cls, target: Target, window: DbWindow, power: Tensor) -> "Scale":
        """The scale whose range is the mean one of training pictures `[picture, row, col]` (linear power)."""
        if target not in TARGETS:
            raise InputError(f"target must be one of {', '.join(TARGETS)}; got {target!r}")
        low, high = own_range(power, window)
        return cls(target, window, float(low.mean()), float(high.mean()))

    @property
    def channels(self) -> int:
        """Of a picture: three colours, or one level."""
        return 3 if self.target == "jet" else 1

    def paint(self, power: Tensor) -> Tensor:
        """Pictures `[*batch, row, col, channel]` in 0..1 of linear power `[*batch, row, col]`."""
        if self.target == "jet":
            return jet_picture(self.window.encode(power))
        if self.target == "db":
            return self.window.encode(power)[..., None]
        if self.target == "view-linear":
            return PerViewLinear().encode(power)[..., None]
        low, high = (end[..., None, None] for end in own_range(power, self.window))
        level = self.window.decode_db(self.window.encode(power))
        return ((level - low) / (high - low).clamp_min(1e-6))[..., None]

    def read(self, picture: Tensor) -> Tensor:
        """Linear power `[*batch, row, col]` of pictures `[*batch, row, col, channel]`; zero where black.

        Colours are first clipped to 0..1, and jet colours read by the nearest of the map.
        """
        picture = picture.clamp(0.0, 1.0)
        if self.target == "jet":
            return surface_power(jet_level(picture), self.window)
        if self.target == "view-linear":
            return PerViewLinear().decode(picture[..., 0], 10.0 ** (self.high / 10.0))
        range_db = self.window if self.target == "db" else DbWindow(self.low, max(self.high, self.low + 1e-3))
        return surface_power(picture[..., 0], range_db)


def own_range(power: Tensor, window: DbWindow) -> tuple[Tensor, Tensor]:
    """The lowest and highest level [dB] of each picture `[*batch, row, col]`, both clipped to the window."""
    level = window.decode_db(window.encode(power))
    return level.amin((-2, -1)), level.amax((-2, -1))
