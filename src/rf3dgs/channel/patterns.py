"""Element patterns: power gain and vertical field amplitude per direction of the device frame.

All but "patch" are those of Sionna RT under the same names ("isotropic" is its "iso"). The gain of "isotropic",
"dipole" and "patch" averages to 1 over the sphere (lossless); "tr38901" keeps the peak of 8 dBi of its standard.
"""

import math
from collections.abc import Callable

import torch
from torch import Tensor

from rf3dgs.core.angles import angles_of
from rf3dgs.core.errors import InputError

ALIASES = {"iso": "isotropic"}


def power_pattern(name: str, directions: Tensor) -> Tensor:
    """Power gain G `[*batch]`, linear, of the element `name` towards device-frame unit vectors `[*batch, 3]`.

    InputError for an unknown name.
    """
    return PATTERNS[pattern_name(name)](directions)


def field_pattern(name: str, directions: Tensor) -> Tensor:
    """Field amplitude sqrt(G) `[*batch]` of a vertically polarised element: its zenith component, real and positive."""
    return power_pattern(name, directions).sqrt()


def peak_gain(name: str) -> float:
    """Power gain, linear, in the direction where the element is strongest (the horizon ahead, for all of them)."""
    return float(power_pattern(name, torch.tensor([1.0, 0.0, 0.0], dtype=torch.float64)))


def pattern_name(name: str) -> str:
    """The pattern's own name; InputError for an unknown one."""
    found = ALIASES.get(name, name)
    if found not in PATTERNS:
        raise InputError(f"pattern must be one of {', '.join(PATTERNS)}; got {name!r}")
    return found


def _isotropic(directions: Tensor) -> Tensor:
    """G = 1."""
    return torch.ones_like(directions[..., 0])


def _dipole(directions: Tensor) -> Tensor:
    """Short vertical dipole: G = 3/2 sin^2(zenith). Balanis, Antenna Theory, eq. 4-26a."""
    return 1.5 * directions[..., :2].square().sum(-1)


def _patch(directions: Tensor) -> Tensor:
    """Microstrip patch: G = 6 cos^2(angle off boresight) ahead (7.8 dBi, 90 degrees at half power), 0 behind."""
    return 6.0 * directions[..., 0].clamp_min(0.0).square()


def _tr38901(directions: Tensor) -> Tensor:
    """Base-station element of 3GPP TR 38.901, table 7.3-1: 65 degrees at half power, 30 dB front to back, 8 dBi."""
    zenith, azimuth = angles_of(directions)
    width = math.radians(65.0)
    vertical = (12.0 * ((zenith - math.pi / 2) / width) ** 2).clamp_max(30.0)
    horizontal = (12.0 * (azimuth / width) ** 2).clamp_max(30.0)
    return torch.pow(10.0, (8.0 - (vertical + horizontal).clamp_max(30.0)) / 10.0)


PATTERNS: dict[str, Callable[[Tensor], Tensor]] = {
    "isotropic": _isotropic,
    "dipole": _dipole,
    "patch": _patch,
    "tr38901": _tr38901,
}
