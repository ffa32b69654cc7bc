"""`Paths`: the propagation paths between one transmitter and any number of receivers."""

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Literal

import torch
from torch import Tensor

from rf3dgs.core.angles import direction_of
from rf3dgs.core.errors import InputError
from rf3dgs.core.frames import Pose

if TYPE_CHECKING:
    from rf3dgs.channel.arrays import PlanarArray


@dataclass(frozen=True, eq=False)
class Paths:
    """Paths `[*batch, path]`, one row of them per receiver; entries that are not `valid` are padding.

    coeff: complex amplitude a at the carrier, without the carrier's phase e^{-j 2 pi f tau}; |a|^2 is the path gain.
        Of a dual-polarised trace it is the equivalent scalar: power = mean over transmit polarisations of the sum
        over receive polarisations, phase of the vertical-to-vertical entry.
    delay: tau [s]. aoa_*: where the wave comes from, seen from the receiver; aod_*: where it leaves to, seen from the
        transmitter; zenith and azimuth [rad] in the world frame.
    frequency [Hz]; tx one pose; rx `[*batch]` poses.
    order: number of interactions `[*batch, path]` (0 is the line of sight), or None when unknown.
    kind: bit set of the interactions `[*batch, path]` (1 specular, 2 diffuse, 4 refraction, 8 diffraction), or None.
    """

    coeff: Tensor
    delay: Tensor
    aoa_zenith: Tensor
    aoa_azimuth: Tensor
    aod_zenith: Tensor
    aod_azimuth: Tensor
    valid: Tensor
    frequency: float
    tx: Pose
    rx: Pose
    order: Tensor | None = None
    kind: Tensor | None = None

    def __post_init__(self) -> None:
        shape = self.coeff.shape
        for name in ("delay", "aoa_zenith", "aoa_azimuth", "aod_zenith", "aod_azimuth", "valid", "order", "kind"):
            value = getattr(self, name)
            if value is not None and value.shape != shape:
                raise InputError(f"{name} must have the shape of coeff {list(shape)}; got {list(value.shape)}")
        if self.rx.batch_shape != tuple(shape[:-1]):
            raise InputError(f"rx must be {list(shape[:-1])} poses, one per row of coeff; got {self.rx.batch_shape}")
        if not self.frequency > 0:
            raise InputError(f"frequency must be positive, in hertz; got {self.frequency}")

    @property
    def path_gain(self) -> Tensor:
        """|a|^2 `[*batch, path]`, linear; zero where not valid."""
        return torch.where(self.valid, self.coeff.abs() ** 2, torch.zeros_like(self.delay))

    @property
    def total_gain(self) -> Tensor:
        """Sum of the path gains `[*batch]`, linear: the path gain of uncorrelated paths."""
        return self.path_gain.sum(-1)

    @property
    def aoa(self) -> Tensor:
        """Unit vectors `[*batch, path, 3]`, world frame, from the receiver towards where each wave comes from."""
        return direction_of(self.aoa_zenith, self.aoa_azimuth)

    @property
    def aod(self) -> Tensor:
        """Unit vectors `[*batch, path, 3]`, world frame, from the transmitter towards where each wave leaves to."""
        return direction_of(self.aod_zenith, self.aod_azimuth)

    @property
    def count(self) -> Tensor:
        """Number of valid paths `[*batch]`."""
        return self.valid.sum(-1)

    def cfr(
        self,
        array_rx: "PlanarArray | None" = None,
        array_tx: "PlanarArray | None" = None,
        subcarriers: Tensor | None = None,
        *,
        phase: Literal["carrier", "zero", "random"] = "carrier",
        seed: int = 0,
    ) -> Tensor:
        """Channel frequency response `[*batch, rx_ant, tx_ant, subcarrier]`; see `channel.response.cfr`."""
        from rf3dgs.channel.response import cfr

        return cfr(self, array_rx, array_tx, subcarriers, phase=phase, seed=seed)

    def cir(
        self,
        array_rx: "PlanarArray | None" = None,
        array_tx: "PlanarArray | None" = None,
        *,
        phase: Literal["carrier", "zero", "random"] = "carrier",
        seed: int = 0,
    ) -> tuple[Tensor, Tensor]:
        """Amplitudes `[*batch, rx_ant, tx_ant, path]` and delays `[*batch, path]` [s]; see `channel.response.cir`."""
        from rf3dgs.channel.response import cir

        return cir(self, array_rx, array_tx, phase=phase, seed=seed)

    def __getitem__(self, index: int | slice | Tensor) -> "Paths":
        """The paths of some receivers."""
        if self.coeff.dim() < 2:
            raise InputError("these are the paths of one receiver; there is no receiver axis to index")
        return self._map(lambda value: value[index], rx=self.rx[index])

    def flat(self) -> "Paths":
        """The same paths with one receiver axis `[rx, path]`, however many batch axes there are."""
        shape = (math.prod(self.coeff.shape[:-1]), self.coeff.shape[-1])
        return self._map(lambda value: value.reshape(shape), rx=self.rx.flat())

    def strongest(self, count: int) -> "Paths":
        """The `count` strongest paths of each receiver, strongest first."""
        order = self.path_gain.argsort(dim=-1, descending=True, stable=True)[..., :count]
        return self._map(lambda value: value.gather(-1, order))

    def _map(self, function, *, rx: Pose | None = None) -> "Paths":
        names = ("coeff", "delay", "aoa_zenith", "aoa_azimuth", "aod_zenith", "aod_azimuth", "valid", "order", "kind")
        values = {name: getattr(self, name) for name in names}
        mapped = {name: None if value is None else function(value) for name, value in values.items()}
        return replace(self, rx=self.rx if rx is None else rx, **mapped)
