"""Codecs: physical values to the numbers between 0 and 1 that a field is trained on, and back."""

import math
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from rf3dgs.core.angles import angles_of, direction_of
from rf3dgs.core.errors import InputError
from rf3dgs.core.units import db_from_power, power_from_db
from rf3dgs.spectra.spectrum import Spectrum


@dataclass(frozen=True)
class DbWindow:
    """The one window of a field: `floor_db` maps to 0 and `ceil_db` to 1."""

    floor_db: float
    ceil_db: float

    def __post_init__(self) -> None:
        if not (math.isfinite(self.floor_db) and math.isfinite(self.ceil_db) and self.floor_db < self.ceil_db):
            raise InputError(f"a window needs floor_db below ceil_db; got {self.floor_db} and {self.ceil_db}")

    @property
    def span_db(self) -> float:
        """Width of the window [dB]."""
        return self.ceil_db - self.floor_db

    def encode(self, power: Tensor) -> Tensor:
        """clip((10 log10 P - floor_db) / (ceil_db - floor_db), 0, 1), elementwise; `power` is linear."""
        return ((db_from_power(power) - self.floor_db) / self.span_db).clamp(0.0, 1.0)

    def decode_db(self, value: Tensor) -> Tensor:
        """Level [dB] of encoded values, elementwise; values outside 0 to 1 continue the line."""
        return self.floor_db + value * self.span_db

    def decode(self, value: Tensor) -> Tensor:
        """Linear power of encoded values, elementwise."""
        return power_from_db(self.decode_db(value))


def window_of(spectra: Spectrum, *, headroom_db: float = 1.0, floor_percentile: float = 1.0) -> DbWindow:
    """The window of a set of spectra, in whole dB: no peak is clipped and little of the background.

    The ceiling lies at least `headroom_db` above the largest power, the floor at the given percentile of the levels
    that have power. InputError for spectra without power, with NaN, or equal everywhere.
    """
    power = spectra.power
    if not bool(torch.isfinite(power).all()):
        raise InputError("spectra have NaN or infinite power; remove those positions or mend their source")
    levels = db_from_power(power[power > 0]).double().numpy()
    if levels.size == 0:
        raise InputError("spectra have no power anywhere; expected at least one path. Check transmitter and receivers")
    if levels.size == power.numel() and levels.max() - levels.min() < 1e-6:
        raise InputError("spectra have the same power everywhere, so there is nothing to learn; check their source")
    ceil_db = math.ceil(float(levels.max()) + headroom_db)
    floor_db = math.floor(float(np.percentile(levels, floor_percentile)))
    return DbWindow(float(min(floor_db, ceil_db - 10)), float(ceil_db))


@dataclass(frozen=True)
class PerViewLinear:
    """Power relative to the strongest direction of the same view, linear, between 0 and 1.

    What the paper (and NeRF2) give CBF and TCBF, whose side lobes fill a dB scale. A view's level is lost, and one
    place looks different from every position: `decode` needs each view's peak back.
    """

    name = "linear per view"

    def encode(self, power: Tensor) -> Tensor:
        """P / max(P) of each view, `[*batch, row, col]`; zero where a view has no power."""
        peak = power.amax((-2, -1), keepdim=True)
        return torch.where(peak > 0, power / peak, torch.zeros_like(power))

    def decode(self, value: Tensor, peak: Tensor | float = 1.0) -> Tensor:
        """Linear power of encoded values `[*batch, row, col]`; `peak` `[*batch]` powers of the views' strongest."""
        return value * torch.as_tensor(peak)[..., None, None]


def paper_scale(spectra: Spectrum) -> PerViewLinear | DbWindow:
    """The paper's scale for a set of spectra: per view and linear for "bartlett" and "tapered", one dB window else.

    Paper, section II-D.
    """
    return PerViewLinear() if spectra.method in ("bartlett", "tapered") else window_of(spectra)


@dataclass(frozen=True)
class PaperEncoding:
    """The paper's own picture of CSI, for comparison: four channels between 0 and 1.

    gain: the encoded power. azimuth, zenith: angle of departure (0 to 360 and 0 to 180 degrees, world frame) as a share
    of its range, times the gain channel. delay: since the first arrival of the same spectrum, as a share of
    `delay_span` [s], clipped. Sections IV-B and VI of the paper. Azimuth has an edge at 0 = 360 degrees and the first
    arrival's own delay is lost: `decode` needs it back.
    """

    window: DbWindow
    delay_span: float

    name = "paper"

    @classmethod
    def of(cls, spectra: Spectrum) -> "PaperEncoding":
        """The encoding whose window and delay span hold all of `spectra`, which need delay."""
        delay = _delay_of(spectra)
        span = float((delay - first_arrival(spectra)[..., None, None])[spectra.power > 0].max())
        return cls(window_of(spectra), max(span, 1e-9))

    def encode(self, spectra: Spectrum) -> Tensor:
        """Channels `[*batch, row, col, 4]`: gain, azimuth, zenith, delay."""
        delay = _delay_of(spectra)
        if spectra.aod is None:
            raise InputError("the paper's encoding needs spectra with aod; use ideal spectra")
        gain = self.window.encode(spectra.power)
        zenith, azimuth = angles_of(spectra.aod)
        turn = torch.remainder(azimuth / (2 * math.pi), 1.0)
        late = ((delay - first_arrival(spectra)[..., None, None]) / self.delay_span).clamp(0.0, 1.0)
        late = torch.where(spectra.power > 0, late, torch.zeros_like(late))
        return torch.stack((gain, turn * gain, zenith / math.pi * gain, late), -1)

    def decode(self, channels: Tensor, first: Tensor | float = 0.0) -> tuple[Tensor, Tensor, Tensor]:
        """Power `[*batch, row, col]`, delay [s] and aod `[*batch, row, col, 3]`; `first` `[*batch]` first arrivals [s].

        The angles mean nothing where the gain channel is near zero.
        """
        gain, turn, tilt, late = channels.unbind(-1)
        divisor = gain.clamp_min(1e-3)
        azimuth = 2 * math.pi * (turn / divisor).clamp(0.0, 1.0)
        zenith = math.pi * (tilt / divisor).clamp(0.0, 1.0)
        delay = torch.as_tensor(first)[..., None, None] + late * self.delay_span
        return self.window.decode(gain), delay, direction_of(zenith, azimuth)


def first_arrival(spectra: Spectrum) -> Tensor:
    """Smallest delay [s] among the pixels that have power, `[*batch]`; 0 where none has."""
    delay = torch.where(spectra.power > 0, _delay_of(spectra), torch.inf).amin((-2, -1))
    return torch.where(torch.isfinite(delay), delay, torch.zeros_like(delay))


def _delay_of(spectra: Spectrum) -> Tensor:
    if spectra.delay is None:
        raise InputError(f"the paper's encoding needs spectra with delay; {spectra.method!r} spectra have none")
    return spectra.delay
