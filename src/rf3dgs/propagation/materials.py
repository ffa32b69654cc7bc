"""Building materials by Recommendation ITU-R P.2040-3, table 3: permittivity and conductivity over frequency."""

from typing import NamedTuple

from rf3dgs.core.errors import InputError


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


def permittivity(name: str, frequency: float, *, owner: str = "an object") -> tuple[float, float]:
    """Relative permittivity (real part) and conductivity [S/m] of a material at `frequency` [Hz].

    Raises InputError, naming `owner`, for a material that is unknown or not defined at that frequency.
    """
    ghz = frequency / 1e9
    material = ITU.get(name)
    if material is None or not material.low_ghz <= ghz <= material.high_ghz:
        known = ", ".join(key for key, value in ITU.items() if value.low_ghz <= ghz <= value.high_ghz)
        raise InputError(
            f"{owner} has the material {name!r}, which ITU-R P.2040 does not define at {ghz:g} GHz; use one of {known}"
        )
    return material.a * ghz**material.b, material.c * ghz**material.d
