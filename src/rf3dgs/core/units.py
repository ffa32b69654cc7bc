"""Units: SI without prefixes inside, dB only where a name says so."""

import math

import torch
from torch import Tensor

SPEED_OF_LIGHT = 299_792_458.0  # [m/s], exact


def wavelength(frequency: float) -> float:
    """Wavelength [m] of a frequency [Hz]."""
    return SPEED_OF_LIGHT / frequency


def db_from_power(power: Tensor, *, floor_db: float = -300.0) -> Tensor:
    """`10 log10(power)` [dB], elementwise; zero power gives `floor_db`."""
    return 10.0 * torch.log10(power.clamp_min(10.0 ** (floor_db / 10.0)))


def power_from_db(value_db: Tensor) -> Tensor:
    """Linear power of a level [dB], elementwise."""
    return torch.pow(10.0, value_db / 10.0)


def friis_gain(distance: Tensor, frequency: float) -> Tensor:
    """Free-space path gain `(lambda / 4 pi d)^2` between isotropic antennas; distance [m]. Paper eq. 10."""
    return (wavelength(frequency) / (4.0 * math.pi * distance)) ** 2
