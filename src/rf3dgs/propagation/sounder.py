"""A channel sounder: what it would measure of traced paths, with its noise, its field of view and its clocks."""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from rf3dgs.channel.arrays import PlanarArray, ofdm
from rf3dgs.channel.paths import Paths
from rf3dgs.channel.sounding import Sounding, sounder_response
from rf3dgs.core.errors import InputError
from rf3dgs.core.units import shortest_delay

BOLTZMANN = 1.380649e-23  # [J/K], exact
ROOM_TEMPERATURE = 290.0  # [K], to which noise figures refer


@dataclass(frozen=True)
class Sounder:
    """How a channel is sounded. Noise by `snr_db` or by `tx_power_dbm`; by neither there is none."""

    bandwidth: float = 1e9
    """Bandwidth [Hz]; its inverse is the resolution in delay."""
    points: int = 256
    """Frequencies across the band; points / bandwidth is the longest delay."""
    array_rx: PlanarArray | None = None
    """Receiving array; None is one isotropic element, which tells no direction."""
    array_tx: PlanarArray | None = None
    """Transmitting array."""
    snr_db: float | None = None
    """Mean power of a receiver's responses over the noise power [dB]."""
    tx_power_dbm: float | None = None
    """Transmitted power [dBm], spread evenly over the band; the noise is thermal, at 290 K."""
    noise_figure_db: float = 0.0
    """How far the receiver's noise is above the thermal one [dB]; with `tx_power_dbm`."""
    averages: int = 1
    """Measurements averaged; with `tx_power_dbm`."""
    fov_rx_deg: float = 180.0
    """Vertical field of view of the receiving elements [deg], the full angle about the device's horizon."""
    fov_tx_deg: float = 180.0
    """The same of the transmitting elements."""
    delay_error: float = 0.0
    """Standard deviation [s] of the clocks' difference, drawn once per receiver; above 0 the delays are relative."""
    phase_error: float = 0.0
    """Standard deviation [rad] of a phase common to all elements, drawn once per receiver."""
    seed: int = 0
    """Receiver number i draws with the seed `seed + i`."""

    @property
    def noise_power(self) -> float | None:
        """Mean |noise|^2 of an entry relative to the transmitted power, linear; None where `snr_db` decides."""
        if self.tx_power_dbm is None:
            return None if self.snr_db is not None else 0.0
        thermal = BOLTZMANN * ROOM_TEMPERATURE * self.bandwidth / self.averages
        return thermal * 10 ** (0.1 * (self.noise_figure_db - self.tx_power_dbm + 30.0))


def sound(paths: Paths, sounder: Sounder) -> Sounding:
    """The sounding that `sounder` makes of paths `[*batch, path]`: responses, noise added, as the poses of `paths` are.

    Coherent, with the carrier's phase. Receiver i draws noise and errors from `sounder.seed + i`. A receiver that
    nothing reaches has responses of noise, or of zero where noise is relative (`snr_db`).
    InputError for settings that contradict each other, and where paths within 60 dB of the strongest are later than the
    straight line by more than points / bandwidth, because they would come out too early by that.
    """
    _check(sounder)
    offsets = ofdm(sounder.bandwidth, sounder.points)
    fov_rx, fov_tx = math.radians(sounder.fov_rx_deg), math.radians(sounder.fov_tx_deg)
    _check_delays(paths, sounder)
    batch, rows = paths.coeff.shape[:-1], paths.flat()
    responses, noises = [], []
    for index in range(len(rows.rx)):
        clean = sounder_response(rows[index], sounder.array_rx, sounder.array_tx, offsets, fov_rx=fov_rx, fov_tx=fov_tx)
        response, noise = _disturbed(clean, offsets, sounder, sounder.seed + index)
        responses.append(response)
        noises.append(noise)
    stacked = torch.stack(responses)
    return Sounding(
        response=stacked.reshape(*batch, *stacked.shape[1:]),
        offsets=offsets,
        frequency=paths.frequency,
        tx=paths.tx,
        rx=paths.rx,
        array_rx=sounder.array_rx,
        array_tx=sounder.array_tx,
        noise_power=torch.tensor(noises, dtype=torch.float64).reshape(batch),
        fov_rx=fov_rx,
        fov_tx=fov_tx,
        delay_offset=sounder.delay_error > 0,
    )


def _disturbed(clean: Tensor, offsets: Tensor, sounder: Sounder, seed: int) -> tuple[Tensor, float]:
    """One receiver's response with the clocks' errors and noise, and the noise power."""
    generator = torch.Generator().manual_seed(seed)
    late, turn = torch.randn(2, generator=generator, dtype=torch.float64)
    phase = float(turn) * sounder.phase_error - 2 * math.pi * offsets * float(late) * sounder.delay_error
    noise = sounder.noise_power
    if noise is None:
        assert sounder.snr_db is not None
        noise = float(clean.abs().square().mean()) * 10 ** (-0.1 * sounder.snr_db)
    white = torch.randn(*clean.shape, 2, generator=generator, dtype=torch.float64)
    white = torch.view_as_complex(white) * math.sqrt(0.5 * noise)
    return clean * torch.polar(torch.ones_like(phase), phase) + white, noise


def _check(sounder: Sounder) -> None:
    if sounder.snr_db is not None and sounder.tx_power_dbm is not None:
        raise InputError("noise is given twice, by snr_db and by tx_power_dbm; give one of them")
    if sounder.averages < 1 or sounder.delay_error < 0 or sounder.phase_error < 0:
        raise InputError(
            f"averages must be at least 1, delay_error [s] and phase_error [rad] at least 0; got {sounder.averages}, "
            f"{sounder.delay_error} and {sounder.phase_error}"
        )
    for name in ("fov_rx_deg", "fov_tx_deg"):
        if not 0 < getattr(sounder, name) <= 180:
            raise InputError(f"{name} must be above 0 and up to 180 degrees; got {getattr(sounder, name)}")


def _check_delays(paths: Paths, sounder: Sounder) -> None:
    """Refuse delays that differ from those of light over the straight line by more than the comb tells."""
    if sounder.points == 1 or not paths.coeff.shape[-1]:
        return
    gain = paths.path_gain
    strong = (gain > 0) & (gain >= 1e-6 * gain.amax(-1, keepdim=True))
    if not bool(strong.any()):
        return
    distance = torch.linalg.vector_norm((paths.rx.position - paths.tx.position).double(), dim=-1)
    earliest = torch.as_tensor(shortest_delay(distance.numpy()), dtype=torch.float64).clamp_min(0.0)
    late = float((paths.delay.double() - earliest[..., None])[strong].max())
    longest = sounder.points / sounder.bandwidth
    if late >= longest:
        points = math.ceil(late * sounder.bandwidth) + 1
        raise InputError(
            f"paths arrive up to {late:.3g} s after the straight line, but {sounder.points} points over "
            f"{sounder.bandwidth:g} Hz tell {longest:.3g} s; use at least {points} points"
        )
