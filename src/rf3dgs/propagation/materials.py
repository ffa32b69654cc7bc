"""Building materials: permittivity and conductivity over frequency, and how rough their surfaces are.

Most are those of Recommendation ITU-R P.2040-3, table 3. `OWN` has what the recommendation lacks: skin by Gabriel, Lau
and Gabriel, "The dielectric properties of biological tissues: III", Phys. Med. Biol. 41 (1996), dry skin; and cloth,
whose relative permittivity of 1.7 and loss tangent of 0.02 are a choice of this package, in the middle of what is
published for cotton and wool.
"""

import math
from itertools import pairwise
from typing import NamedTuple

from rf3dgs.core.errors import InputError
from rf3dgs.core.units import SPEED_OF_LIGHT


class Material(NamedTuple):
    """`eta = a f^b` and `sigma = c f^d` [S/m] with f in GHz, defined from `low_ghz` to `high_ghz`."""

    a: float
    b: float
    c: float
    d: float
    low_ghz: float
    high_ghz: float


ITU = {
    "concrete": Material(5.24, 0.0, 0.0462, 0.7822, 1.0, 100.0),
    "brick": Material(3.91, 0.0, 0.0238, 0.16, 1.0, 40.0),
    "plasterboard": Material(2.73, 0.0, 0.0085, 0.9395, 1.0, 100.0),
    "wood": Material(1.99, 0.0, 0.0047, 1.0718, 0.001, 100.0),
    "glass": Material(6.31, 0.0, 0.0036, 1.3394, 0.1, 100.0),
    "ceiling_board": Material(1.48, 0.0, 0.0011, 1.0750, 1.0, 100.0),
    "chipboard": Material(2.58, 0.0, 0.0217, 0.7800, 1.0, 100.0),
    "plywood": Material(2.71, 0.0, 0.33, 0.0, 1.0, 40.0),
    "marble": Material(7.074, 0.0, 0.0055, 0.9262, 1.0, 60.0),
    "floorboard": Material(3.66, 0.0, 0.0044, 1.3515, 50.0, 100.0),
    "metal": Material(1.0, 0.0, 1e7, 0.0, 1.0, 100.0),
}

OWN = {
    "skin": ((2.4, 38.1, 1.44), (10.0, 31.3, 8.01), (28.0, 16.6, 25.8), (60.0, 7.98, 36.4), (100.0, 5.60, 39.4)),
    "cloth": ((1.0, 1.7, 0.00189), (100.0, 1.7, 0.189)),
}
"""(f [GHz], relative permittivity, conductivity [S/m]), straight lines between them on logarithmic axes."""


class Surface(NamedTuple):
    """How a surface scatters: height of its roughness (RMS) [m], the amplitude S that a smooth one of it would have
    because it is not homogeneous, and the width alpha_R of its scattering lobe."""

    roughness: float
    inherent: float
    alpha_r: int


SURFACES = {
    "concrete": Surface(0.40e-3, 0.20, 4),
    "brick": Surface(0.80e-3, 0.30, 4),
    "plasterboard": Surface(0.20e-3, 0.15, 8),
    "wood": Surface(0.15e-3, 0.15, 8),
    "glass": Surface(0.001e-3, 0.05, 30),
    "ceiling_board": Surface(0.80e-3, 0.20, 4),
    "chipboard": Surface(0.15e-3, 0.15, 8),
    "plywood": Surface(0.15e-3, 0.15, 8),
    "marble": Surface(0.005e-3, 0.05, 30),
    "floorboard": Surface(0.10e-3, 0.15, 12),
    "metal": Surface(0.01e-3, 0.05, 30),
    "skin": Surface(0.50e-3, 0.30, 4),
    "cloth": Surface(0.50e-3, 0.30, 4),
}
"""Plausible values for finished indoor surfaces, chosen by this package; P.2040 has none."""

REFERENCE_ANGLE = math.radians(45)
"""Angle of incidence at which `scattering_amplitude` is taken: the tracer knows one S for all angles."""


def permittivity(name: str, frequency: float, *, owner: str = "an object") -> tuple[float, float]:
    """Relative permittivity (real part) and conductivity [S/m] of a material at `frequency` [Hz].

    Raises InputError, naming `owner`, for a material that is unknown or not defined at that frequency.
    """
    ghz = frequency / 1e9
    if name not in names_at(frequency):
        known = ", ".join(names_at(frequency))
        raise InputError(
            f"{owner} has the material {name!r}, which ITU-R P.2040 does not define at {ghz:g} GHz; use one of {known}"
        )
    if name in OWN:
        return _between(OWN[name], ghz)
    material = ITU[name]
    return material.a * ghz**material.b, material.c * ghz**material.d


def names_at(frequency: float) -> list[str]:
    """The materials that are defined at `frequency` [Hz]."""
    ghz = frequency / 1e9
    ranges = {name: (value.low_ghz, value.high_ghz) for name, value in ITU.items()}
    ranges |= {name: (points[0][0], points[-1][0]) for name, points in OWN.items()}
    return [name for name, (low, high) in ranges.items() if low <= ghz <= high]


def _between(points: tuple[tuple[float, float, float], ...], ghz: float) -> tuple[float, float]:
    for (f0, eta0, sigma0), (f1, eta1, sigma1) in pairwise(points):
        if f0 <= ghz <= f1:
            share = math.log(ghz / f0) / math.log(f1 / f0)
            return eta0 * (eta1 / eta0) ** share, sigma0 * (sigma1 / sigma0) ** share
    raise AssertionError("names_at lets no frequency through that lies outside the points")


def mirror_loss(roughness: float, frequency: float, angle: float) -> float:
    """What roughness leaves of a mirror's amplitude: exp(-g^2 / 2) with g = 4 pi h cos(angle) / lambda (Rayleigh).

    roughness: RMS height h [m]; frequency [Hz]; angle of incidence from the normal [rad].
    """
    phase = 4 * math.pi * roughness * math.cos(angle) * frequency / SPEED_OF_LIGHT
    return math.exp(-0.5 * phase**2)


def scattering_amplitude(surface: Surface, frequency: float) -> float:
    """S at `frequency` [Hz]: S^2 = S_0^2 + (1 - S_0^2) (1 - mirror_loss^2), at the reference angle."""
    scattered = 1 - mirror_loss(surface.roughness, frequency, REFERENCE_ANGLE) ** 2
    return math.sqrt(surface.inherent**2 + (1 - surface.inherent**2) * scattered)


def smooth_height(frequency: float, angle: float, *, parts: int = 8) -> float:
    """Largest height [m] of roughness that still mirrors at `frequency` [Hz] and `angle` of incidence [rad]:
    lambda / (parts cos(angle)), with 8 `parts` by Rayleigh's criterion and 32 by Fraunhofer's. Infinite when grazing.
    """
    cosine = math.cos(angle)
    return SPEED_OF_LIGHT / frequency / (parts * cosine) if cosine > 1e-12 else math.inf
