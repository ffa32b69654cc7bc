"""How physical values become 16-bit integers in files of spectra, and back."""

from dataclasses import dataclass

import numpy as np

from rf3dgs.core.errors import InputError

MISSING = 0
LAST = 65_535  # the largest code of uint16


@dataclass(frozen=True)
class Precision:
    """How finely spectra are stored."""

    gain_db: float = 0.005
    """Step of the gain [dB]; coarser where the span of the data needs it."""
    delay: float = 10e-12
    """Step of the delay [s]; coarser where the longest delay needs it."""
    aod: float = 1 / 2048
    """Step of the two octahedral components of the departure; 1/2048 keeps directions within 0.06 degrees."""
    floor_db: float | None = None
    """Power below this [dB] is stored as no power, without delay and departure; None stores all."""


@dataclass(frozen=True)
class Scale:
    """Values are `code * step + offset`; code 0 means that there is no value."""

    step: float
    offset: float

    @classmethod
    def over(cls, low: float, high: float, step: float) -> "Scale":
        """The scale whose codes 1 to 65535 hold `low` to `high`, in steps of `step` or as coarse as the span needs."""
        step = max(step, (high - low) / (LAST - 2))
        return cls(step, low - step)

    def encode(self, values: np.ndarray, some: np.ndarray, name: str) -> np.ndarray:
        """Codes (uint16) of `values` where `some`, missing elsewhere; InputError where one is beyond the scale."""
        codes = np.full(values.shape, MISSING, dtype=np.uint16)
        chosen = np.rint((values[some] - self.offset) / self.step)
        if chosen.size and not (chosen.min() >= 1 and chosen.max() <= LAST):
            low, high = (code * self.step + self.offset for code in (1, LAST))
            raise InputError(
                f"{name} must lie between {low:.6g} and {high:.6g} to be stored in steps of {self.step:.3g}; got "
                f"{values[some].min():.6g} to {values[some].max():.6g}. Give a coarser precision"
            )
        codes[some] = chosen.astype(np.uint16)
        return codes

    def values(self) -> np.ndarray:
        """The value of every code `[65536]`, float64; 0 where missing."""
        values = np.arange(LAST + 1) * self.step + self.offset
        values[MISSING] = 0.0
        return values


def octahedral_of(vector: np.ndarray) -> np.ndarray:
    """Octahedral components `[..., 2]` in [-1, 1] of vectors `[..., 3]`; zero vectors give (0, 0)."""
    vector = vector / np.maximum(np.abs(vector).sum(-1, keepdims=True), 1e-30)
    x, y, z = vector[..., 0], vector[..., 1], vector[..., 2]
    folded_x = (1 - np.abs(y)) * np.where(x >= 0, 1.0, -1.0)
    folded_y = (1 - np.abs(x)) * np.where(y >= 0, 1.0, -1.0)
    return np.stack((np.where(z < 0, folded_x, x), np.where(z < 0, folded_y, y)), -1)


def vector_of(octahedral: np.ndarray) -> np.ndarray:
    """Unit vectors `[..., 3]` of octahedral components `[..., 2]`."""
    x, y = octahedral[..., 0], octahedral[..., 1]
    z = 1 - np.abs(x) - np.abs(y)
    fold = np.maximum(-z, 0.0)
    x = x - np.where(x >= 0, fold, -fold)
    y = y - np.where(y >= 0, fold, -fold)
    vector = np.stack((x, y, z), -1)
    return vector / np.linalg.norm(vector, axis=-1, keepdims=True)
