"""`Sounding`: what a channel sounder measures between the elements of two arrays, over a comb of frequencies."""

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from rf3dgs.channel.arrays import PlanarArray
from rf3dgs.channel.paths import Paths
from rf3dgs.channel.patterns import power_pattern
from rf3dgs.channel.response import Phase, coefficients, delay_phase, manifold
from rf3dgs.core.errors import InputError
from rf3dgs.core.frames import Pose

AT_ONCE = 2**22  # complex numbers of an intermediate result
DEAF = 0.01  # share of the element's peak gain below which a direction counts as not seen


@dataclass(frozen=True, eq=False)
class Sounding:
    """Channel frequency responses measured by a sounder, one per receiver pose.

    response: `[*batch, rx_ant, tx_ant, frequency]`, complex128, H(f_c + f) of each pair of elements.
    offsets: `[frequency]` f [Hz] from the carrier, float64, evenly spaced and rising. frequency: the carrier f_c [Hz].
    tx one pose, rx `[*batch]` poses; the arrays stand in their devices' y-z planes. None is one isotropic element.
    noise_power: mean |noise|^2 of one entry `[*batch]`, linear, float64 (a number is taken for all); None is unknown.
    fov_rx, fov_tx: vertical field of view of the elements [rad], the full angle about the device's horizon; waves
        outside are not seen. pi is no limit.
    delay_offset: True where the clocks of both ends are not synchronised: all delays of one receiver are late by one
        unknown amount.
    InputError for shapes, spacings and units that do not fit.
    """

    response: Tensor
    offsets: Tensor
    frequency: float
    tx: Pose
    rx: Pose
    array_rx: PlanarArray | None = None
    array_tx: PlanarArray | None = None
    noise_power: Tensor | float | None = None
    fov_rx: float = math.pi
    fov_tx: float = math.pi
    delay_offset: bool = False

    def __post_init__(self) -> None:
        response = torch.as_tensor(self.response, dtype=torch.complex128)
        offsets = torch.as_tensor(self.offsets, dtype=torch.float64)
        object.__setattr__(self, "response", response)
        object.__setattr__(self, "offsets", offsets)
        if not self.frequency > 0:
            raise InputError(f"frequency must be positive, in hertz; got {self.frequency}")
        _check_offsets(offsets, self.frequency)
        expected = (elements_of(self.array_rx), elements_of(self.array_tx), len(offsets))
        if response.dim() < 3 or tuple(response.shape[-3:]) != expected:
            raise InputError(
                f"response must be [*batch, rx_ant, tx_ant, frequency] with {list(expected)} last, as the arrays and "
                f"offsets have; got {list(response.shape)}"
            )
        batch = tuple(response.shape[:-3])
        if self.tx.batch_shape or self.rx.batch_shape != batch:
            raise InputError(
                f"tx must be one pose and rx {list(batch)} poses, one per response; got {list(self.tx.batch_shape)} "
                f"and {list(self.rx.batch_shape)}"
            )
        if not bool(torch.isfinite(torch.view_as_real(response)).all()):
            raise InputError("response has NaN or infinite values; leave such measurements out")
        for name in ("fov_rx", "fov_tx"):
            if not 0 < getattr(self, name) <= math.pi + 1e-9:
                raise InputError(f"{name} must be an angle in radians, above 0 and up to pi; got {getattr(self, name)}")
        if self.noise_power is not None:
            noise = torch.as_tensor(self.noise_power, dtype=torch.float64)
            if noise.dim() > len(batch) or not bool((torch.isfinite(noise) & (noise >= 0)).all()):
                raise InputError(f"noise_power must be {list(batch)} powers of at least 0, or None; got {noise}")
            object.__setattr__(self, "noise_power", noise.expand(batch).clone())

    @property
    def bandwidth(self) -> float:
        """Spacing times number of frequencies [Hz]; its inverse is the resolution in delay."""
        return self.spacing * len(self.offsets)

    @property
    def spacing(self) -> float:
        """Distance of neighbouring frequencies [Hz]; delays repeat after its inverse. One frequency has none: 0."""
        return float(self.offsets[-1] - self.offsets[0]) / max(len(self.offsets) - 1, 1)

    @property
    def period(self) -> float:
        """Longest span of delays [s] that the comb tells apart, 1 / spacing; infinite for one frequency."""
        return 1.0 / self.spacing if self.spacing > 0 else math.inf

    def taps(self) -> tuple[Tensor, Tensor]:
        """Impulse response: taps `[*batch, rx_ant, tx_ant, tap]` and their delays `[tap]` [s], 1 / bandwidth apart.

        H(f) = sum over taps of h e^{-j 2 pi f delay} at every frequency of the comb, exactly.
        """
        delay = torch.arange(len(self.offsets), dtype=torch.float64) / (self.bandwidth or 1.0)
        first = torch.polar(torch.ones_like(delay), 2 * math.pi * torch.remainder(delay * self.offsets[0], 1.0))
        return torch.fft.ifft(self.response, dim=-1) * first, delay

    @classmethod
    def from_taps(cls, taps: Tensor, delay_step: float, frequency: float, tx: Pose, rx: Pose, **known) -> "Sounding":
        """A sounding of taps h `[*batch, rx_ant, tx_ant, tap]` at delays 0, delay_step, 2 delay_step ... [s].

        The band is 1 / delay_step wide and centred on the carrier. `known`: the other fields by name.
        """
        if not 0 < delay_step < 1:
            raise InputError(f"delay_step must be a positive time in seconds; got {delay_step}")
        taps = torch.as_tensor(taps, dtype=torch.complex128)
        count = taps.shape[-1]
        offsets = (torch.arange(count, dtype=torch.float64) - count // 2) / (delay_step * count)
        response = torch.fft.fftshift(torch.fft.fft(taps, dim=-1), dim=-1)
        return cls(response, offsets, frequency, tx, rx, **known)

    def __getitem__(self, index: int | slice | Tensor) -> "Sounding":
        """The soundings of some receivers."""
        if self.response.dim() < 4:
            raise InputError("this is the sounding of one receiver; there is no receiver axis to index")
        noise = self.noise_power
        return replace(
            self,
            response=self.response[index],
            rx=self.rx[index],
            noise_power=noise[index] if isinstance(noise, Tensor) else noise,
        )

    def flat(self) -> "Sounding":
        """The same with one receiver axis, however many batch axes there are."""
        noise = self.noise_power
        return replace(
            self,
            response=self.response.reshape(-1, *self.response.shape[-3:]),
            rx=self.rx.flat(),
            noise_power=noise.reshape(-1) if isinstance(noise, Tensor) else noise,
        )


def elements_of(array: PlanarArray | None) -> int:
    """Number of elements; None is one isotropic element."""
    return 1 if array is None else array.count


def seen(array: PlanarArray | None, fov: float, directions: Tensor) -> Tensor:
    """True where device-frame unit vectors `[*batch, 3]` are in the vertical field of view `fov` [rad] and not deaf.

    An element counts as deaf where its gain is 20 dB or more below its peak.
    """
    height = math.sin(0.5 * fov) if fov < math.pi else 2.0
    inside = directions[..., 2].abs() <= height
    if array is None:
        return inside
    return inside & (power_pattern(array.pattern, directions) > DEAF * array.peak_gain)


def sounder_response(
    paths: Paths,
    array_rx: PlanarArray | None,
    array_tx: PlanarArray | None,
    offsets: Tensor,
    *,
    fov_rx: float = math.pi,
    fov_tx: float = math.pi,
    phase: Phase = "carrier",
    seed: int = 0,
) -> Tensor:
    """Noise-free responses `[*batch, rx_ant, tx_ant, frequency]`, complex128, that a sounder measures of `paths`.

    `channel.response.cfr` in double precision, without the paths outside either field of view [rad].
    """
    batch, length = paths.coeff.shape[:-1], paths.coeff.shape[-1]
    coeff = coefficients(paths, phase, seed=seed)
    arrival, departure = device_directions(paths)
    coeff = torch.where(_in_view(arrival, fov_rx) & _in_view(departure, fov_tx), coeff, torch.zeros_like(coeff))
    shape = (elements_of(array_rx), elements_of(array_tx), len(offsets))
    total = torch.zeros(*batch, shape[0] * shape[1], shape[2], dtype=torch.complex128)
    step = max(1, AT_ONCE // (math.prod(batch) * (shape[0] * shape[1] + shape[2])))
    for first in range(0, length, step):
        part = slice(first, first + step)
        a = _manifold(array_rx, arrival[..., part, :]) * coeff[..., part, None]
        b = _manifold(array_tx, departure[..., part, :])
        pairs = (a[..., :, None] * b[..., None, :]).flatten(-2)
        total = total + pairs.mT @ delay_phase(paths.delay[..., part], offsets.double())
    return total.reshape(*batch, *shape)


def device_directions(paths: Paths) -> tuple[Tensor, Tensor]:
    """Arrivals in the receivers' frames and departures in the transmitter's, `[*batch, path, 3]`, float64."""
    arrival = paths.aoa.double() @ paths.rx.world_from_device.double()
    departure = paths.aod.double() @ paths.tx.world_from_device.double()
    return arrival, departure


def _in_view(directions: Tensor, fov: float) -> Tensor:
    return seen(None, fov, directions)


def _manifold(array: PlanarArray | None, directions: Tensor) -> Tensor:
    if array is None:
        return torch.ones(*directions.shape[:-1], 1, dtype=torch.complex128)
    return manifold(array, directions)


def _check_offsets(offsets: Tensor, frequency: float) -> None:
    if offsets.dim() != 1 or not len(offsets) or not bool(torch.isfinite(offsets).all()):
        raise InputError(f"offsets must be [frequency] finite numbers [Hz]; got shape {list(offsets.shape)}")
    if float(offsets.abs().max()) >= frequency:
        raise InputError(
            f"offsets must be in hertz from the carrier, smaller than its {frequency:g} Hz; got up to "
            f"{float(offsets.abs().max()):g}. Subtract the carrier"
        )
    step = offsets.diff()
    if len(step) and not (bool((step > 0).all()) and float(step.max() - step.min()) <= 1e-4 * float(step.mean())):
        raise InputError("offsets must rise in even steps [Hz]; sort them, or measure on an even comb")
