"""Clustered delay lines of 3GPP TR 38.901 (V16.1): what a channel is like on average, without any site.

A profile's clusters are 20 rays each. They are scaled to a K-factor, a delay spread and four angle spreads, and turned
so that the line of sight, or the mean direction where there is none, is the true one (section 7.7). Rays have random
phases; the tables' cross-polarisation is not used, since a path's gain is summed over polarisations here.
"""

import math
from dataclasses import dataclass, fields
from typing import Literal

import torch
from torch import Tensor

from rf3dgs.channel.paths import Paths
from rf3dgs.core.angles import angles_of
from rf3dgs.core.errors import InputError
from rf3dgs.core.frames import Pose
from rf3dgs.core.units import SPEED_OF_LIGHT

ProfileName = Literal["CDL-A", "CDL-D", "CDL-E"]
OFFSETS = (0.0447, 0.1413, 0.2492, 0.3715, 0.5129, 0.6797, 0.8844, 1.1481, 1.5195, 2.1551)
"""Table 7.5-3: the rays of a cluster stand at plus and minus these, times the cluster's spread."""


@dataclass(frozen=True)
class Profile:
    """One of the tables 7.7.1: clusters, and how wide each of them is.

    clusters: rows of normalised delay, power [dB], AoD, AoA, ZoD, ZoA [deg]. sight: whether the first row is the line
    of sight, a single ray. widths: c_ASD, c_ASA, c_ZSD, c_ZSA [deg].
    """

    clusters: tuple[tuple[float, float, float, float, float, float], ...]
    widths: tuple[float, float, float, float]
    sight: bool


PROFILES: dict[ProfileName, Profile] = {
    "CDL-A": Profile(
        (
            (0.0000, -13.4, -178.1, 51.3, 50.2, 125.4),
            (0.3819, 0.0, -4.2, -152.7, 93.2, 91.3),
            (0.4025, -2.2, -4.2, -152.7, 93.2, 91.3),
            (0.5868, -4.0, -4.2, -152.7, 93.2, 91.3),
            (0.4610, -6.0, 90.2, 76.6, 122.0, 94.0),
            (0.5375, -8.2, 90.2, 76.6, 122.0, 94.0),
            (0.6708, -9.9, 90.2, 76.6, 122.0, 94.0),
            (0.5750, -10.5, 121.5, -1.8, 150.2, 47.1),
            (0.7618, -7.5, -81.7, -41.9, 55.2, 56.0),
            (1.5375, -15.9, 158.4, 94.2, 26.4, 30.1),
            (1.8978, -6.6, -83.0, 51.9, 126.4, 58.8),
            (2.2242, -16.7, 134.8, -115.9, 171.6, 26.0),
            (2.1718, -12.4, -153.0, 26.6, 151.4, 49.2),
            (2.4942, -15.2, -172.0, 76.6, 157.2, 143.1),
            (2.5119, -10.8, -129.9, -7.0, 47.2, 117.4),
            (3.0582, -11.3, -136.0, -23.0, 40.4, 122.7),
            (4.0810, -12.7, 165.4, -47.2, 43.3, 123.2),
            (4.4579, -16.2, 148.4, 110.4, 161.8, 32.6),
            (4.5695, -18.3, 132.7, 144.5, 10.8, 27.2),
            (4.7966, -18.9, -118.6, 155.3, 16.7, 15.2),
            (5.0066, -16.6, -154.1, 102.0, 171.7, 146.0),
            (5.3043, -19.9, 126.5, -151.8, 22.7, 150.7),
            (9.6586, -29.7, -56.2, 55.2, 144.9, 156.1),
        ),
        (5.0, 11.0, 3.0, 3.0),
        False,
    ),
    "CDL-D": Profile(
        (
            (0.000, -0.2, 0.0, -180.0, 98.5, 81.5),
            (0.000, -13.5, 0.0, -180.0, 98.5, 81.5),
            (0.035, -18.8, 89.2, 89.2, 85.5, 86.9),
            (0.612, -21.0, 89.2, 89.2, 85.5, 86.9),
            (1.363, -22.8, 89.2, 89.2, 85.5, 86.9),
            (1.405, -17.9, 13.0, 163.0, 97.5, 79.4),
            (1.804, -20.1, 13.0, 163.0, 97.5, 79.4),
            (2.596, -21.9, 13.0, 163.0, 97.5, 79.4),
            (1.775, -22.9, 34.6, -137.0, 98.5, 78.2),
            (4.042, -27.8, -64.5, 74.5, 88.4, 73.6),
            (7.937, -23.6, -32.9, 127.7, 91.3, 78.3),
            (9.424, -24.8, 52.6, -119.6, 103.8, 87.0),
            (9.708, -30.0, -132.1, -9.1, 80.3, 70.6),
            (12.525, -27.7, 77.2, -83.8, 86.5, 72.9),
        ),
        (5.0, 8.0, 3.0, 3.0),
        True,
    ),
    "CDL-E": Profile(
        (
            (0.0000, -0.03, 0.0, -180.0, 99.6, 80.4),
            (0.0000, -22.03, 0.0, -180.0, 99.6, 80.4),
            (0.5133, -15.8, 57.5, 18.2, 104.2, 80.4),
            (0.5440, -18.1, 57.5, 18.2, 104.2, 80.4),
            (0.5630, -19.8, 57.5, 18.2, 104.2, 80.4),
            (0.5440, -22.9, -20.1, 101.8, 99.4, 80.8),
            (0.7112, -22.4, 16.2, 112.9, 100.8, 86.3),
            (1.9092, -18.6, 9.3, -155.5, 98.8, 82.7),
            (1.9293, -20.8, 9.3, -155.5, 98.8, 82.7),
            (1.9589, -22.6, 9.3, -155.5, 98.8, 82.7),
            (2.6426, -22.3, 19.0, -143.3, 100.8, 82.9),
            (3.7136, -25.6, 32.7, -94.7, 96.4, 88.0),
            (5.4524, -20.2, 0.5, 147.0, 98.9, 81.0),
            (12.0034, -29.8, 55.9, -36.2, 95.6, 88.6),
            (20.6419, -29.2, 57.6, -26.0, 104.6, 78.3),
        ),
        (5.0, 11.0, 3.0, 7.0),
        True,
    ),
}
"""Tables 7.7.1-1, -4 and -5."""


@dataclass(frozen=True)
class Spreads:
    """What a profile is scaled to: RMS delay spread [s], spreads of AoD, AoA, ZoD, ZoA [rad] and the K-factor [dB].

    `k_db` is the power of the line of sight over all the rest; of no meaning without a line of sight.
    """

    delay: float
    aod: float
    aoa: float
    zod: float
    zoa: float
    k_db: float = 0.0

    def __post_init__(self) -> None:
        values = {item.name: getattr(self, item.name) for item in fields(self)}
        if not all(math.isfinite(value) for value in values.values()) or min(list(values.values())[:-1]) < 0.0:
            raise InputError(f"spreads must be finite and not negative, in seconds and radians; got {values}")


def indoor_office_spreads(frequency: float, *, line_of_sight: bool = True) -> Spreads:
    """Medians of the indoor office at `frequency` [Hz], 0.5 to 100 GHz: table 7.5-6 (part 2), InH; below 6 GHz as at 6.

    InputError for other frequencies.
    """
    ghz = frequency / 1e9
    if not 0.5 <= ghz <= 100.0:
        raise InputError(f"TR 38.901 is made for 0.5 to 100 GHz; got {ghz:g} GHz. Use free_space_loss")
    decade = math.log10(1.0 + max(ghz, 6.0))
    if line_of_sight:
        logarithms = (
            -0.01 * decade - 7.692,
            1.60,
            -0.19 * decade + 1.781,
            -1.43 * decade + 2.228,
            -0.26 * decade + 1.44,
        )
    else:
        logarithms = (-0.28 * decade - 7.173, 1.62, -0.11 * decade + 1.863, 1.08, -0.15 * decade + 1.387)
    delay, *angles = (10.0**value for value in logarithms)
    return Spreads(delay, *(math.radians(angle) for angle in angles), k_db=7.0)


@dataclass(frozen=True, eq=False)
class Rays:
    """A scaled profile: shares of the power `[ray]` that sum to 1, excess delays `[ray]` [s], and angles `[ray]` [rad]
    relative to the line of sight or the mean direction. A line of sight comes first, with zero everywhere."""

    power: Tensor
    delay: Tensor
    aod: Tensor
    aoa: Tensor
    zod: Tensor
    zoa: Tensor


def scaled_rays(name: ProfileName, spreads: Spreads, *, seed: int = 0) -> Rays:
    """The rays of a profile, scaled as in 7.7.3 (delays), 7.7.5.1 (angles) and 7.7.6 (K-factor); float64.

    seed: which ray of arrival belongs to which of departure within a cluster (step 8 of 7.5). InputError for an unknown
    profile.
    """
    if name not in PROFILES:
        raise InputError(f"a profile is one of {', '.join(PROFILES)}; got {name!r}")
    profile = PROFILES[name]
    table = torch.tensor(profile.clusters, dtype=torch.float64)
    power = torch.pow(10.0, table[:, 1] / 10.0)
    if profile.sight:
        power[1:] *= power[0] / power[1:].sum() / 10.0 ** (spreads.k_db / 10.0)
    power = power / power.sum()
    delay = table[:, 0] - (power * table[:, 0]).sum()
    delay = table[:, 0] * (spreads.delay / float((power * delay.square()).sum().sqrt()))

    generator = torch.Generator().manual_seed(seed)
    offsets = torch.tensor([*OFFSETS, *(-value for value in OFFSETS)], dtype=torch.float64)
    first = 1 if profile.sight else 0
    count = len(table) - first
    shares = torch.cat((power[:first], (power[first:, None] / len(offsets)).expand(count, len(offsets)).reshape(-1)))
    delays = torch.cat((delay[:first], delay[first:].repeat_interleave(len(offsets))))
    angles = []
    for column, width, spread in zip(
        range(2, 6), profile.widths, (spreads.aod, spreads.aoa, spreads.zod, spreads.zoa), strict=True
    ):
        order = torch.rand(count, len(offsets), generator=generator).argsort(-1)
        rays = torch.deg2rad((table[first:, column, None] + width * offsets[order]).reshape(-1))
        rays = torch.cat((torch.deg2rad(table[:first, column]), rays))
        wave = (shares * torch.polar(torch.ones_like(rays), rays)).sum()
        own = math.sqrt(-2.0 * math.log(float(wave.abs())))  # annex A.1
        centre = rays[0] if profile.sight else wave.angle()
        relative = torch.remainder(rays - centre + math.pi, 2 * math.pi) - math.pi
        angles.append(relative * (spread / own))
    return Rays(shares, delays, *angles)


def cdl_paths(rays: Rays, tx: Pose, rx: Pose, frequency: float, gain: Tensor, *, seed: int = 0) -> Paths:
    """The rays as paths `[*batch, path]` from `tx` to receivers `rx` `[*batch]`, whose total gain is `gain` `[*batch]`.

    gain: linear. The rays' angles are added to the azimuth and zenith of the straight way, zeniths folded back into
    [0, pi]; the first delay is that of light. Phases are random by `seed`, that of the first ray zero.
    """
    away = torch.as_tensor(rx.position - tx.position, dtype=torch.float64)
    distance = torch.linalg.vector_norm(away, dim=-1)
    if not bool((distance > 0).all()):
        raise InputError("a receiver stands where the transmitter is; move one of them")
    gain = torch.as_tensor(gain, dtype=torch.float64)
    if tuple(gain.shape) != tuple(rx.batch_shape):
        raise InputError(f"gain must be {list(rx.batch_shape)}, one per receiver; got {list(gain.shape)}")
    zenith_out, azimuth_out = angles_of(away)
    zenith_in, azimuth_in = angles_of(-away)
    phase = (
        2 * math.pi * torch.rand(len(rays.power), generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    )
    phase[0] = 0.0
    amplitude = (gain[..., None] * rays.power).sqrt()
    return Paths(
        coeff=torch.polar(amplitude, phase.expand_as(amplitude)).to(torch.complex64),
        delay=(distance[..., None] / SPEED_OF_LIGHT + rays.delay).float(),
        aoa_zenith=_folded(zenith_in[..., None] + rays.zoa),
        aoa_azimuth=_wrapped(azimuth_in[..., None] + rays.aoa),
        aod_zenith=_folded(zenith_out[..., None] + rays.zod),
        aod_azimuth=_wrapped(azimuth_out[..., None] + rays.aod),
        valid=torch.ones(amplitude.shape, dtype=torch.bool),
        frequency=frequency,
        tx=tx,
        rx=rx,
    )


def _wrapped(azimuth: Tensor) -> Tensor:
    return (math.pi - torch.remainder(math.pi - azimuth, 2 * math.pi)).float()


def _folded(zenith: Tensor) -> Tensor:
    turn = torch.remainder(zenith, 2 * math.pi)
    return torch.where(turn > math.pi, 2 * math.pi - turn, turn).float()
