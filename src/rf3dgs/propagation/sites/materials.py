"""Building materials: permittivity and conductivity over frequency, and how rough their surfaces are.

Most are those of Recommendation ITU-R P.2040-3, table 3. What the recommendation lacks: dry skin by S. Gabriel, Lau and
C. Gabriel, "The dielectric properties of biological tissues: III. Parametric models for the dielectric spectrum of
tissues", Phys. Med. Biol. 41 (1996) 2271; and cloth, whose relative permittivity of 1.7 and loss tangent of 0.02 are a
choice of this package, in the middle of what is published for cotton and wool.
"""

import math
from typing import NamedTuple

from rf3dgs.core.errors import InputError
from rf3dgs.core.units import SPEED_OF_LIGHT, VACUUM_PERMITTIVITY


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

OWN = {"cloth": Material(1.7, 0.0, 0.00189, 1.0, 1.0, 100.0)}


class Tissue(NamedTuple):
    """`eta - j sigma / w e0` is `high` plus `strength / (1 + (j w time)^(1 - spread))` of each dispersion (Cole-Cole)
    plus `static / (j w e0)`; times [s], static conductivity [S/m]. Defined from `low_ghz` to `high_ghz`."""

    high: float
    dispersions: tuple[tuple[float, float, float], ...]
    static: float
    low_ghz: float
    high_ghz: float


TISSUES = {"skin": Tissue(4.0, ((32.0, 7.234e-12, 0.0), (1100.0, 32.481e-9, 0.2)), 0.0002, 1.0, 100.0)}
"""The published model; its two slower dispersions have no strength in dry skin."""


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
    if name in TISSUES:
        return _relaxed(TISSUES[name], frequency)
    material = (ITU | OWN)[name]
    return material.a * ghz**material.b, material.c * ghz**material.d


def names_at(frequency: float) -> list[str]:
    """The materials that are defined at `frequency` [Hz]."""
    ghz = frequency / 1e9
    return [name for name, value in (ITU | TISSUES | OWN).items() if value.low_ghz <= ghz <= value.high_ghz]


def _relaxed(tissue: Tissue, frequency: float) -> tuple[float, float]:
    w = 2 * math.pi * frequency
    eta = complex(tissue.high)
    for strength, time, spread in tissue.dispersions:
        eta += strength / (1 + (1j * w * time) ** (1 - spread))
    return eta.real, tissue.static - eta.imag * w * VACUUM_PERMITTIVITY


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
