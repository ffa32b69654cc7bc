"""Antenna arrays and subcarriers: where the elements sit and which frequencies are heard."""

from dataclasses import dataclass

import torch
from torch import Tensor

from rf3dgs.channel.patterns import pattern_name, peak_gain
from rf3dgs.core.errors import InputError


@dataclass(frozen=True)
class PlanarArray:
    """`rows` x `cols` equal elements in the device's y-z plane, centred on the device, looking along +x.

    pattern: the element, one of `patterns.PATTERNS`. vertical, horizontal: spacing [wavelengths].
    Element `row + col * rows` is Sionna's numbering: top-left first for someone facing the panel, down each column.
    """

    rows: int
    cols: int
    pattern: str = "patch"
    vertical: float = 0.5
    horizontal: float = 0.5

    def __post_init__(self) -> None:
        if self.rows < 1 or self.cols < 1:
            raise InputError(f"an array needs at least one row and one column; got {self.rows}x{self.cols}")
        if not (self.vertical > 0 and self.horizontal > 0):
            raise InputError(
                f"element spacing must be positive, in wavelengths; got {self.vertical} and {self.horizontal}"
            )
        object.__setattr__(self, "pattern", pattern_name(self.pattern))

    @property
    def count(self) -> int:
        """Number of elements."""
        return self.rows * self.cols

    @property
    def positions(self) -> Tensor:
        """Element positions `[element, 3]` in wavelengths, device frame, float64."""
        row = torch.arange(self.rows, dtype=torch.float64)
        col = torch.arange(self.cols, dtype=torch.float64)
        y = (col - (self.cols - 1) / 2) * self.horizontal
        z = -(row - (self.rows - 1) / 2) * self.vertical
        y, z = y.repeat_interleave(self.rows), z.repeat(self.cols)
        return torch.stack((torch.zeros_like(y), y, z), -1)

    @property
    def peak_gain(self) -> float:
        """Largest power gain of one element, linear."""
        return peak_gain(self.pattern)

    @property
    def label(self) -> str:
        """For people, such as "8x8 patch"."""
        return f"{self.rows}x{self.cols} {self.pattern}"


def planar_array(
    rows: int,
    cols: int,
    pattern: str = "patch",
    spacing: float = 0.5,
    *,
    vertical: float | None = None,
    horizontal: float | None = None,
) -> PlanarArray:
    """A planar array with `spacing` [wavelengths] both ways, unless `vertical` or `horizontal` says otherwise."""
    return PlanarArray(
        rows,
        cols,
        pattern,
        spacing if vertical is None else vertical,
        spacing if horizontal is None else horizontal,
    )


def ofdm(bandwidth: float, subcarriers: int) -> Tensor:
    """Frequencies of `subcarriers` [Hz] about the carrier, float64: spacing bandwidth / subcarriers, zero at n // 2."""
    if not bandwidth > 0 or subcarriers < 1:
        raise InputError(f"ofdm needs a positive bandwidth [Hz] and a subcarrier; got {bandwidth} and {subcarriers}")
    return (torch.arange(subcarriers, dtype=torch.float64) - subcarriers // 2) * (bandwidth / subcarriers)
