"""Units: SI without prefixes inside, dB only where a name says so."""

import math
from typing import TypeVar

import numpy as np
import torch
from torch import Tensor

SPEED_OF_LIGHT = 299_792_458.0  # [m/s], exact
VACUUM_PERMITTIVITY = 8.8541878128e-12  # [F/m]
LONGEST_DELAY = 1e-3  # [s], the way of light over 300 km; what lies beyond is in another unit
Distance = TypeVar("Distance", float, np.ndarray)
Length = TypeVar("Length", np.ndarray, Tensor)


def wavelength(frequency: float) -> float:
    """Wavelength [m] of a frequency [Hz]."""
    return SPEED_OF_LIGHT / frequency


def db_from_power(power: Tensor, *, floor_db: float = -300.0) -> Tensor:
    """`10 log10(power)` [dB], elementwise; zero power gives `floor_db`."""
    return 10.0 * torch.log10(power.clamp_min(10.0 ** (floor_db / 10.0)))


def power_from_db(value_db: Tensor) -> Tensor:
    """Linear power of a level [dB], elementwise."""
    return torch.pow(10.0, value_db / 10.0)


def shortest_delay(distance: Distance) -> Distance:
    """The delay [s] below which no path over `distance` [m] is believed: light's, less 10 % and 5 cm; elementwise."""
    return (0.9 * distance - 0.05) / SPEED_OF_LIGHT


def friis_gain(distance: Length, frequency: float) -> Length:
    """Free-space path gain `(lambda / 4 pi d)^2` between isotropic antennas; distance [m]. Paper eq. 10."""
    return (wavelength(frequency) / (4.0 * math.pi * distance)) ** 2
