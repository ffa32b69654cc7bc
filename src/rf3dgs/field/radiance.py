"""What a surface sends to a receiver: the paper's model, harmonics in a dB window on frozen Gaussians.

Pure functions of arrays that training and rendering share, and `Surface`, which only remembers. A picture of a surface
has the channels

    0      gain in the field's dB window, 0 at the floor, composited over an empty (zero) background
    1      accumulated weight sum T alpha
    2..    CSI, composited: delay [ns] and departure vector (encoding "vector"), or the paper's own three channels

and `decode` makes power, delay and departure of it. The line of sight is not here: see `field.sources`.
"""

from dataclasses import dataclass

import torch
from torch import Tensor

from rf3dgs.core.errors import InputError
from rf3dgs.core.grids import View
from rf3dgs.core.units import SPEED_OF_LIGHT
from rf3dgs.spectra.codec import DbWindow, PaperEncoding
from rf3dgs.splats.gaussians import Gaussians
from rf3dgs.splats.harmonics import evaluate, view_directions
from rf3dgs.splats.rasterize import Backend, rasterize

NANOSECOND = 1e-9
CSI_CHANNELS = {"vector": 4, "paper": 3}
CSI_DEGREE = {"vector": 1, "paper": 3}


@dataclass(frozen=True, eq=False)
class Surface:
    """Gaussians that send radio power: geometry, harmonics and the window they are expressed in.

    means `[N, 3]` [m], quats `[N, 4]`, log_scales `[N, 3]`, logit_opacities `[N]`: as in `Gaussians`, without colour.
    gain_sh `[N, K]`: the gain in window units is 0.5 + SH(view direction), not below 0.
    csi_sh: encoding "vector" `[N, 4, 4]`, degree 1: residuals of the delay [ns] and the departure (world x, y, z) over
        the single-bounce prior; encoding "paper" `[N, 16, 3]`, degree 3: its three channels as 0.5 + SH.
    tx `[3]`: the transmitter's position [m], for the prior. delay_span [s]: what 1 means in the paper's delay channel.
    """

    means: Tensor
    quats: Tensor
    log_scales: Tensor
    logit_opacities: Tensor
    gain_sh: Tensor
    csi_sh: Tensor
    tx: Tensor
    window: DbWindow
    encoding: str = "vector"
    delay_span: float = 1e-7

    def __post_init__(self) -> None:
        if self.encoding not in CSI_CHANNELS:
            raise InputError(f'encoding must be "vector" or "paper"; got {self.encoding!r}')
        count = len(self.means)
        csi = (count, (CSI_DEGREE[self.encoding] + 1) ** 2, CSI_CHANNELS[self.encoding])
        if self.gain_sh.dim() != 2 or len(self.gain_sh) != count or self.gain_sh.shape[1] not in (1, 4, 9, 16):
            raise InputError(f"gain_sh must be [{count}, 1|4|9|16]; got {list(self.gain_sh.shape)}")
        if tuple(self.csi_sh.shape) != csi:
            raise InputError(f"csi_sh must be {list(csi)} for {self.encoding!r}; got {list(self.csi_sh.shape)}")

    def __len__(self) -> int:
        return len(self.means)

    @property
    def scales(self) -> Tensor:
        """Standard deviations `[N, 3]` [m]."""
        return self.log_scales.exp()

    @property
    def opacities(self) -> Tensor:
        """Opacities `[N]` in 0..1."""
        return torch.sigmoid(self.logit_opacities)

    def picture(self, view: View, *, csi: bool = True, backend: Backend = "auto") -> Tensor:
        """The channels of a view; see `picture_of`."""
        return picture_of(self, view, csi=csi, backend=backend)

    def radiance(self, channels: Tensor, receiver: Tensor) -> "Radiance":
        """Physical values of composited channels; see `decode`."""
        return decode(channels, self, receiver)

    @classmethod
    def bare(
        cls,
        geometry: Gaussians,
        *,
        tx: Tensor,
        window: DbWindow,
        encoding: str = "vector",
        degree: int = 3,
        delay_span: float = 1e-7,
    ) -> "Surface":
        """The surface before any spectrum is seen: all harmonics zero, so that every Gaussian is at mid-window.

        `tx` `[3]` [m], `degree` of the gain's harmonics; the others as in the class.
        """
        count = len(geometry)
        if encoding not in CSI_CHANNELS:
            raise InputError(f'encoding must be "vector" or "paper"; got {encoding!r}')
        csi_shape = (count, (CSI_DEGREE[encoding] + 1) ** 2, CSI_CHANNELS[encoding])
        return cls(
            geometry.means.detach(),
            geometry.quats.detach(),
            geometry.log_scales.detach(),
            geometry.logit_opacities.detach(),
            torch.zeros(count, (degree + 1) ** 2),
            torch.zeros(csi_shape),
            torch.as_tensor(tx, dtype=torch.float32),
            window,
            encoding,
            delay_span,
        )


def gain_values(gain_sh: Tensor, directions: Tensor) -> Tensor:
    """Gain `[N, 1]` in window units that Gaussians with `gain_sh` `[N, K]` show along `[N, 3]`."""
    return evaluate(gain_sh[..., None], directions, offset=0.5, clamp=True)


def bounce(means: Tensor, tx: Tensor) -> Tensor:
    """Delay [ns] and departure vector `[N, 4]` of the way from the transmitter to a Gaussian."""
    outward = means - tx
    first = torch.linalg.vector_norm(outward, dim=-1, keepdim=True)
    return torch.cat((first / (SPEED_OF_LIGHT * NANOSECOND), outward / first.clamp_min(1e-6)), -1)


def csi_prior(means: Tensor, tx: Tensor, centre: Tensor) -> Tensor:
    """Delay [ns] and departure vector `[N, 4]` of the single bounce transmitter -> Gaussian -> receiver."""
    prior = bounce(means, tx)
    prior[:, 0] += torch.linalg.vector_norm(means - centre, dim=-1) / (SPEED_OF_LIGHT * NANOSECOND)
    return prior


def csi_values(surface: Surface, centre: Tensor, directions: Tensor) -> Tensor:
    """CSI channels `[N, 4]` (vector) or `[N, 3]` (paper) of each Gaussian for a receiver at `centre`."""
    if surface.encoding == "paper":
        return evaluate(surface.csi_sh, directions, offset=0.5, clamp=True)
    return csi_prior(surface.means, surface.tx, centre) + evaluate(surface.csi_sh, directions)


def picture_of(surface: Surface, view: View, *, csi: bool = True, backend: Backend = "auto") -> Tensor:
    """The channels `[row, col, 2 + CSI]` described above, without gradients; `csi=False` gives the first two alone."""
    with torch.no_grad():
        directions = view_directions(surface.means, view.position)
        values = gain_values(surface.gain_sh, directions)
        if csi:
            values = torch.cat((values, csi_values(surface, view.position, directions)), -1)
        shape = (surface.means, surface.quats, surface.scales, surface.opacities)
        raster = rasterize(*shape, values, view, backend=backend)
    return torch.cat((raster.values[..., :1], raster.weight[..., None], raster.values[..., 1:]), -1)


@dataclass(frozen=True, eq=False)
class Radiance:
    """What a surface sends per direction: power `[*shape]` (linear), and delay `[*shape]` [s] and departure
    `[*shape, 3]` (unit vector, world) where they were asked for; both are zero where nothing is hit.
    """

    power: Tensor
    delay: Tensor | None = None
    aod: Tensor | None = None


def decode(channels: Tensor, surface: Surface, receiver: Tensor) -> Radiance:
    """Physical values of composited channels `[row, col, 2 (+ CSI)]`; interpolate channels, not what this returns.

    The paper's delays count from the first arrival, which is taken to be the straight way to `receiver` `[3]`.
    """
    power = surface_power(channels[..., 0], surface.window)
    if channels.shape[-1] == 2:
        return Radiance(power)
    if surface.encoding == "paper":
        first = torch.linalg.vector_norm(surface.tx - receiver) / SPEED_OF_LIGHT
        shown = torch.cat((channels[..., :1], channels[..., 2:]), -1)
        _, delay, aod = PaperEncoding(surface.window, surface.delay_span).decode(shown, first)
        return Radiance(power, delay, aod)
    weight = channels[..., 1]
    hit = weight > 1e-3
    delay = torch.where(hit, channels[..., 2] / weight.clamp_min(1e-3) * NANOSECOND, torch.zeros_like(weight))
    aod = torch.nn.functional.normalize(channels[..., 3:6], dim=-1, eps=1e-9) * hit[..., None]
    return Radiance(power, delay, aod)


def surface_power(value: Tensor, window: DbWindow) -> Tensor:
    """Linear power `[*shape]` of composited gains in window units: zero at the floor and below, the ceiling at most."""
    return torch.where(value > 0, window.decode(value.clamp(0.0, 1.0)), torch.zeros_like(value))
