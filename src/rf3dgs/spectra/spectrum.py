"""`Spectrum`: what an instrument sees, power per direction."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from rf3dgs.channel.arrays import PlanarArray
from rf3dgs.core.errors import InputError
from rf3dgs.core.frames import Pose
from rf3dgs.core.grids import DirectionGrid
from rf3dgs.core.units import db_from_power


@dataclass(frozen=True)
class Instrument:
    """What the spectrum was taken with.

    name: for people, such as "ideal lobe 3.0 deg" or "8x8 patch capon". lobe: half-power width of the beam [rad].
    beam_solid_angle: integral of the beam's power pattern (1 at its peak) over the sphere [sr].
    array: what took the pictures, or None for an ideal lobe and where it is not known. fov: vertical field of view of
    its elements [rad], the full angle about the device's horizon; pi is no limit.
    """

    name: str
    lobe: float
    beam_solid_angle: float
    array: PlanarArray | None = None
    fov: float = math.pi

    @classmethod
    def gaussian(cls, lobe: float) -> "Instrument":
        """The narrow Gaussian lobe `exp(-4 ln 2 (angle / lobe)^2)` of ideal spectra; `lobe` [rad] at half power."""
        return cls(f"ideal lobe {math.degrees(lobe):.1f} deg", lobe, math.pi * lobe**2 / (4.0 * math.log(2.0)))

    def kernel(self, angle: Tensor) -> Tensor:
        """Relative power `K_beam` seen `angle` [rad] off a point source (Gaussian lobe); 1 at zero."""
        return torch.exp(-4.0 * math.log(2.0) * (angle / self.lobe) ** 2)


@dataclass(frozen=True, eq=False)
class Spectrum:
    """Power `[*batch, row, col]`, linear, per direction of `grid` as seen at `pose` `[*batch]`.

    A single unit-gain path seen at the beam's centre gives power 1. `delay` `[*batch, row, col]` [s] and `aod`
    `[*batch, row, col, 3]` (unit vectors, world frame) are power-weighted means per direction; ideal spectra and fields
    have them, array pictures do not. Where power is zero no path arrives and delay and aod mean nothing.
    `tx` is the transmitter's pose when known; `method` one of "ideal", "bartlett", "tapered", "capon", "field", ...

    `floor` `[*batch, row, col]`: power up to it, zero too, says no more than "at most that"; infinite where the
    instrument does not look. None: every power is meant. `noise` `[*batch]`, of array pictures: mean power of the noise
    in an element over its peak gain, Capon's loading included; None where not known.
    """

    power: Tensor
    grid: DirectionGrid
    pose: Pose
    frequency: float
    instrument: Instrument
    method: str = "ideal"
    delay: Tensor | None = None
    aod: Tensor | None = None
    tx: Pose | None = None
    floor: Tensor | None = None
    noise: Tensor | None = None

    def __post_init__(self) -> None:
        expected = (*self.pose.batch_shape, *self.grid.shape)
        if tuple(self.power.shape) != expected:
            raise InputError(f"power must be {list(expected)} (poses, then the grid); got {list(self.power.shape)}")
        if self.delay is not None and self.delay.shape != self.power.shape:
            raise InputError(f"delay must be {list(self.power.shape)} [s]; got {list(self.delay.shape)}")
        if self.aod is not None and self.aod.shape != (*self.power.shape, 3):
            raise InputError(f"aod must be {[*self.power.shape, 3]}; got {list(self.aod.shape)}")
        if self.floor is not None and self.floor.shape != self.power.shape:
            raise InputError(f"floor must be {list(self.power.shape)}, a power for each; got {list(self.floor.shape)}")
        if self.noise is not None and tuple(self.noise.shape) != self.pose.batch_shape:
            raise InputError(
                f"noise must be {list(self.pose.batch_shape)}, one power a pose; got {list(self.noise.shape)}"
            )

    @property
    def looked(self) -> Tensor:
        """True `[*batch, row, col]` where the instrument looks, whatever it finds there."""
        return torch.ones_like(self.power, dtype=torch.bool) if self.floor is None else torch.isfinite(self.floor)

    @property
    def heard(self) -> Tensor:
        """The power `[*batch, row, col]`, at least the floor; zero where the instrument does not look."""
        if self.floor is None:
            return self.power
        return torch.where(self.looked, torch.maximum(self.power, self.floor), torch.zeros_like(self.power))

    @property
    def gain_db(self) -> Tensor:
        """The power in dB `[*batch, row, col]`; -300 where it is zero."""
        return db_from_power(self.power)

    @property
    def path_gain(self) -> Tensor:
        """Sum of power times solid angle over the beam's solid angle `[*batch]`, linear."""
        return (self.power * self.grid.solid_angle).sum((-2, -1)) / self.instrument.beam_solid_angle

    @property
    def directions(self) -> Tensor:
        """World-frame directions `[*batch, row, col, 3]` of the pixels."""
        return self.pose.to_world(self.grid.directions.expand(*self.pose.batch_shape, *self.grid.shape, 3))

    def __getitem__(self, index: int | slice | Tensor) -> "Spectrum":
        """The spectra of some poses."""
        if not self.pose.batch_shape:
            raise InputError("this is the spectrum of one pose; there is no pose axis to index")
        return replace(
            self,
            power=self.power[index],
            pose=self.pose[index],
            delay=None if self.delay is None else self.delay[index],
            aod=None if self.aod is None else self.aod[index],
            floor=None if self.floor is None else self.floor[index],
            noise=None if self.noise is None else self.noise[index],
        )

    def __len__(self) -> int:
        return self.power.shape[0] if self.pose.batch_shape else 1


def stack_spectra(spectra: Sequence[Spectrum]) -> Spectrum:
    """One spectrum `[n, row, col]` of n spectra `[row, col]` or `[1, row, col]` that share grid and instrument."""
    if not spectra:
        raise InputError("there are no spectra to stack")
    first = spectra[0]
    if not all(spectrum.grid.same_as(first.grid) for spectrum in spectra):
        raise InputError("spectra on different grids cannot be stacked; resample them to one grid first")
    shape = first.grid.shape

    def joined(values: list[Tensor | None], *tail: int) -> Tensor | None:
        present = [value.reshape(-1, *tail) for value in values if value is not None]
        return torch.cat(present) if len(present) == len(spectra) else None

    power = joined([spectrum.power for spectrum in spectra], *shape)
    assert power is not None
    pose = Pose(
        torch.cat([spectrum.pose.position.reshape(-1, 3) for spectrum in spectra]),
        torch.cat([spectrum.pose.orientation.reshape(-1, 4) for spectrum in spectra]),
    )
    delay = joined([spectrum.delay for spectrum in spectra], *shape)
    aod = joined([spectrum.aod for spectrum in spectra], *shape, 3)
    floor, noise = joined([one.floor for one in spectra], *shape), joined([one.noise for one in spectra])
    if floor is None and any(spectrum.floor is not None for spectrum in spectra):
        raise InputError("some of the spectra have a floor and others none; give all of them one, or none")
    return replace(first, power=power, pose=pose, delay=delay, aod=aod, floor=floor, noise=noise)
