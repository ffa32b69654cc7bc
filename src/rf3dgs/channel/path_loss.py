"""Path loss by formula: what is lost between isotropic antennas over a distance, without any site.

Functions of arrays: distances [m] in, losses [dB] of the same shape out, larger is weaker. Medians, without shadowing;
its standard deviation is in the tables. Frequencies in hertz.
"""

import math
from dataclasses import dataclass
from typing import Literal, NamedTuple, get_args

import torch
from torch import Tensor

from rf3dgs.core.errors import InputError
from rf3dgs.core.units import db_from_power, friis_gain

Environment = Literal["office", "corridor", "industrial"]
Area = Literal["large city", "city", "suburb", "open"]


def free_space_loss(distance: Tensor, frequency: float) -> Tensor:
    """Loss [dB] in free space, `20 log10(4 pi d / lambda)` (Friis)."""
    return -db_from_power(friis_gain(_distance(distance), frequency))


@dataclass(frozen=True)
class LogDistance:
    """`loss_1m_db + 10 exponent log10(d / 1 m)`; `shadowing_db` is the standard deviation of what it was fitted to."""

    loss_1m_db: float
    exponent: float
    shadowing_db: float = 0.0

    def loss(self, distance: Tensor) -> Tensor:
        """Loss [dB] over `distance` [m]."""
        return self.loss_1m_db + 10.0 * self.exponent * torch.log10(_distance(distance))


def fit_log_distance(distance: Tensor, path_gain: Tensor) -> LogDistance:
    """The line of least squares through losses [dB] over log distance; `distance` [m] and linear gains `[n]`.

    InputError with fewer than two different distances, or without power.
    """
    distance, gain = _distance(distance).double(), torch.as_tensor(path_gain).double()
    if gain.shape != distance.shape or distance.dim() != 1 or not bool((gain > 0).all()):
        raise InputError(
            f"distance and path_gain must be [n], gains linear and positive; got {list(distance.shape)} and "
            f"{list(gain.shape)}. Leave out positions without power"
        )
    decades = torch.log10(distance)
    if len(distance) < 2 or float(decades.max() - decades.min()) < 1e-3:
        raise InputError(f"a log-distance fit needs two different distances; got {distance.tolist()}. Measure more")
    loss = -10.0 * torch.log10(gain)
    centred = decades - decades.mean()
    slope = (centred * loss).sum() / centred.square().sum()
    rest = loss - loss.mean() - slope * centred
    free = max(len(loss) - 2, 1)
    return LogDistance(
        float(loss.mean() - slope * decades.mean()), float(slope) / 10.0, math.sqrt(float(rest.square().sum()) / free)
    )


class SiteGeneral(NamedTuple):
    """`10 alpha log10(d) + beta + 10 gamma log10(f)` with d in metres and f in GHz, and where it was measured."""

    alpha: float
    beta: float
    gamma: float
    sigma_db: float
    ghz: tuple[float, float]
    metres: tuple[float, float]


P1238: dict[tuple[Environment, bool], SiteGeneral] = {
    ("office", True): SiteGeneral(1.46, 34.62, 2.03, 3.76, (0.3, 83.5), (2, 27)),
    ("office", False): SiteGeneral(2.46, 29.53, 2.38, 5.04, (0.3, 82.0), (4, 30)),
    ("corridor", True): SiteGeneral(1.63, 28.12, 2.25, 4.07, (0.3, 83.5), (2, 160)),
    ("corridor", False): SiteGeneral(2.77, 29.27, 2.48, 7.63, (0.625, 83.5), (4, 94)),
    ("industrial", True): SiteGeneral(2.31, 24.52, 2.06, 2.69, (0.625, 70.28), (2, 101)),
    ("industrial", False): SiteGeneral(3.79, 21.01, 1.34, 9.05, (0.625, 70.28), (5, 108)),
}
"""Recommendation ITU-R P.1238-11, table 2, by environment and whether there is a line of sight."""


def itu_indoor_loss(
    distance: Tensor, frequency: float, *, environment: Environment = "office", line_of_sight: bool = True
) -> Tensor:
    """Loss [dB] on one floor: the site-general model of ITU-R P.1238-11, eq. 1, with table 2.

    Distances outside the table's are extrapolated. InputError for a frequency outside it, or an unknown environment.
    """
    if environment not in get_args(Environment):
        raise InputError(f"environment must be one of {', '.join(get_args(Environment))}; got {environment!r}")
    row = P1238[environment, line_of_sight]
    _within("ITU-R P.1238", "a frequency [GHz]", frequency / 1e9, row.ghz, "free_space_loss")
    return 10.0 * (row.alpha * torch.log10(_distance(distance)) + row.gamma * math.log10(frequency / 1e9)) + row.beta


def tr38901_indoor_loss(distance: Tensor, frequency: float, *, line_of_sight: bool = True) -> Tensor:
    """Loss [dB] in the indoor office of 3GPP TR 38.901, table 7.4.1-1 (InH): 0.5 to 100 GHz, 1 to 150 m (3D).

    Shadowing has a standard deviation of 3 dB with, 8.03 dB without a line of sight. InputError outside the ranges.
    """
    distance, ghz = _distance(distance), frequency / 1e9
    _within("TR 38.901 InH", "a frequency [GHz]", ghz, (0.5, 100.0), "free_space_loss")
    _all_within("TR 38.901 InH", "distances [m]", distance, (1.0, 150.0), "free_space_loss")
    seen = 32.4 + 17.3 * torch.log10(distance) + 20.0 * math.log10(ghz)
    if line_of_sight:
        return seen
    return torch.maximum(seen, 17.30 + 38.3 * torch.log10(distance) + 24.9 * math.log10(ghz))


def open_office_sight(distance_2d: Tensor) -> Tensor:
    """Probability that there is a line of sight over a horizontal distance [m], TR 38.901, table 7.4.2-1, open office.

    1 up to 5 m.
    """
    near, far = torch.exp(-(distance_2d - 5.0) / 70.8), 0.54 * torch.exp(-(distance_2d - 49.0) / 211.7)
    return torch.where(distance_2d <= 5.0, torch.ones_like(near), torch.where(distance_2d <= 49.0, near, far))


def okumura_hata_loss(
    distance: Tensor, frequency: float, *, base_height: float, mobile_height: float = 1.5, area: Area = "city"
) -> Tensor:
    """Loss [dB] from a mast over roofs to the street (Hata, IEEE Trans. Veh. Technol. 29 (1980) 317).

    150 to 1500 MHz, base 30 to 200 m and mobile 1 to 10 m high, 1 to 20 km; InputError outside.
    """
    if area not in get_args(Area):
        raise InputError(f"area must be one of {', '.join(get_args(Area))}; got {area!r}")
    name, mhz = "Okumura-Hata", frequency / 1e6
    _within(name, "a frequency [MHz]", mhz, (150.0, 1500.0), _INDOORS if mhz > 2000 else "cost231_hata_loss")
    loss = 69.55 + 26.16 * math.log10(mhz) + _hata(name, distance, mhz, base_height, mobile_height, area)
    if area == "suburb":
        return loss - 2.0 * math.log10(mhz / 28.0) ** 2 - 5.4
    return loss - 4.78 * math.log10(mhz) ** 2 + 18.33 * math.log10(mhz) - 40.94 if area == "open" else loss


def cost231_hata_loss(
    distance: Tensor,
    frequency: float,
    *,
    base_height: float,
    mobile_height: float = 1.5,
    area: Literal["large city", "city"] = "city",
) -> Tensor:
    """Loss [dB] of Hata's model carried on to 1500 to 2000 MHz (COST 231 final report, 1999, eq. 4.4.3).

    Heights and distances as `okumura_hata_loss`; a "large city" loses 3 dB more. InputError outside the ranges.
    """
    if area not in ("large city", "city"):
        raise InputError(f"area must be large city or city; got {area!r}. okumura_hata_loss knows suburbs")
    name, mhz = "COST 231-Hata", frequency / 1e6
    _within(name, "a frequency [MHz]", mhz, (1500.0, 2000.0), _INDOORS if mhz > 2000 else "okumura_hata_loss")
    metropolitan = 3.0 if area == "large city" else 0.0
    return 46.3 + 33.9 * math.log10(mhz) + _hata(name, distance, mhz, base_height, mobile_height, "city") + metropolitan


_INDOORS = "tr38901_indoor_loss or itu_indoor_loss"


def _hata(name: str, distance: Tensor, mhz: float, base: float, mobile: float, area: Area) -> Tensor:
    """What both of Hata's models have in common [dB]: heights and distance."""
    distance = _distance(distance)
    _within(name, "a base station's height [m]", base, (30.0, 200.0), _INDOORS)
    _within(name, "a mobile's height [m]", mobile, (1.0, 10.0), _INDOORS)
    _all_within(name, "distances [m]", distance, (1000.0, 20_000.0), _INDOORS)
    if area != "large city":
        correction = (1.1 * math.log10(mhz) - 0.7) * mobile - (1.56 * math.log10(mhz) - 0.8)
    elif mhz < 300.0:
        correction = 8.29 * math.log10(1.54 * mobile) ** 2 - 1.1
    else:
        correction = 3.2 * math.log10(11.75 * mobile) ** 2 - 4.97
    slope = 44.9 - 6.55 * math.log10(base)
    return -13.82 * math.log10(base) - correction + slope * torch.log10(distance / 1000.0)


def _distance(distance: Tensor) -> Tensor:
    distance = torch.as_tensor(distance)
    if not bool((torch.isfinite(distance) & (distance > 0)).all()):
        raise InputError(f"distances must be positive, in metres; got {distance.tolist()}")
    return distance


def _within(model: str, what: str, value: float, ends: tuple[float, float], instead: str) -> None:
    if not ends[0] <= value <= ends[1]:
        raise InputError(f"{model} takes {what} from {ends[0]:g} to {ends[1]:g}; got {value:g}. Use {instead}")


def _all_within(model: str, what: str, values: Tensor, ends: tuple[float, float], instead: str) -> None:
    if values.numel():
        for value in (float(values.min()), float(values.max())):
            _within(model, what, value, ends, instead)
