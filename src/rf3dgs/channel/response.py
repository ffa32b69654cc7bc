"""What arrays respond: manifold vectors, channel frequency response (CFR) and channel impulse response (CIR)."""

import math
from typing import Literal

import torch
from torch import Tensor

from rf3dgs.channel.arrays import PlanarArray
from rf3dgs.channel.paths import Paths
from rf3dgs.channel.patterns import field_pattern
from rf3dgs.core.errors import InputError
from rf3dgs.core.frames import Pose

Phase = Literal["carrier", "zero", "random"]
AT_ONCE = 2**22  # complex numbers of an intermediate result


def manifold(array: PlanarArray, directions: Tensor) -> Tensor:
    """Array manifold a `[*batch, element]` towards device-frame unit vectors `[*batch, 3]`. Paper eq. 8.

    a_m = sqrt(G) exp(+j 2 pi p_m . r), p in wavelengths. complex64 of float32 directions, complex128 of float64.
    """
    phase = directions @ (2.0 * math.pi * array.positions).to(directions.dtype).mT
    return torch.polar(field_pattern(array.pattern, directions)[..., None].expand_as(phase).contiguous(), phase)


def manifold_factors(array: PlanarArray, directions: Tensor) -> tuple[Tensor, Tensor]:
    """The manifold without the element's gain as a product: factors `[col, n]` and `[row, n]`, complex128.

    directions `[n, 3]`, device frame. a[row + col * rows] = sqrt(G) column[col] row[row]: rows + cols phasors for a
    direction instead of rows * cols.
    """
    _, y, z = directions.double().unbind(-1)
    columns = phasors(array.horizontal * y, -(array.cols - 1) / 2, array.cols)
    return columns, phasors(-array.vertical * z, -(array.rows - 1) / 2, array.rows)


def phasors(turn: Tensor, first: float, count: int) -> Tensor:
    """e^{j 2 pi turn (first + i)} `[count, n]`, complex128, for i below `count`; `turn` `[n]`, float64.

    One multiplication leads from each to the next: the error grows by one rounding a step.
    """
    one = torch.ones_like(turn)
    step = torch.polar(one, 2 * math.pi * turn)
    result = torch.empty(count, len(turn), dtype=torch.complex128)
    result[0] = torch.polar(one, 2 * math.pi * first * turn) if first else 1.0
    for index in range(1, count):
        torch.mul(result[index - 1], step, out=result[index])
    return result


def coefficients(paths: Paths, phase: Phase = "carrier", *, seed: int = 0) -> Tensor:
    """Complex path coefficients `[*batch, path]`, complex128, zero where not valid, with the chosen phase.

    "carrier": a e^{-j 2 pi f tau}, what a receiver at the carrier hears. Its phase turns once per wavelength, so it
    means something only for delays exact to picoseconds. "zero": |a|, every path in phase at the carrier. "random":
    |a| with independent uniform phases drawn from `seed`, one draw of the same power delay profile.
    """
    if phase == "carrier":
        turn = torch.remainder(-paths.frequency * paths.delay.double(), 1.0) * (2 * math.pi)
        value = paths.coeff.to(torch.complex128) * torch.polar(torch.ones_like(turn), turn)
    elif phase == "zero":
        value = paths.coeff.abs().to(torch.complex128)
    elif phase == "random":
        generator = torch.Generator().manual_seed(seed)
        turn = 2 * math.pi * torch.rand(paths.delay.shape, generator=generator, dtype=torch.float64)
        value = torch.polar(paths.coeff.abs().double(), turn)
    else:
        raise InputError(f'phase must be "carrier", "zero" or "random"; got {phase!r}')
    return torch.where(paths.valid, value, torch.zeros_like(value))


def cfr(
    paths: Paths,
    array_rx: PlanarArray | None = None,
    array_tx: PlanarArray | None = None,
    subcarriers: Tensor | None = None,
    *,
    phase: Phase = "carrier",
    seed: int = 0,
) -> Tensor:
    """Channel frequency response H `[*batch, rx_ant, tx_ant, subcarrier]`, complex64.

    H_mn(f) = sum_p c_p a_m(aoa) a_n(aod) e^{-j 2 pi f tau_p}, with c_p from `coefficients` (see there for `phase`) and
    f the offsets `subcarriers` `[F]` [Hz] from the carrier, as of `ofdm`; None is the carrier alone. An array that is
    None is one isotropic antenna. The devices' poses are those of `paths`.
    """
    offsets = torch.zeros(1) if subcarriers is None else torch.as_tensor(subcarriers)
    if offsets.dim() != 1:
        raise InputError(f"subcarriers must be [subcarrier] offsets from the carrier in Hz; got {list(offsets.shape)}")
    offsets = offsets.double()
    batch, length = paths.coeff.shape[:-1], paths.coeff.shape[-1]
    coeff = coefficients(paths, phase, seed=seed)
    total = torch.zeros(())
    elements = (1 if array_rx is None else array_rx.count, 1 if array_tx is None else array_tx.count)
    step = max(1, AT_ONCE // (math.prod(batch) * (elements[0] * elements[1] + len(offsets))))
    for start in range(0, max(length, 1), step):
        part = paths._map(lambda value, first=start: value[..., first : first + step])
        pairs = _pairs(part, array_rx, array_tx) * coeff[..., start : start + step, None, None]
        total = total + pairs.flatten(-2).mT @ delay_phase(part.delay, offsets)
    return total.reshape(*batch, *elements, len(offsets)).to(torch.complex64)


def cir(
    paths: Paths,
    array_rx: PlanarArray | None = None,
    array_tx: PlanarArray | None = None,
    *,
    phase: Phase = "carrier",
    seed: int = 0,
) -> tuple[Tensor, Tensor]:
    """Channel impulse response: amplitudes `[*batch, rx_ant, tx_ant, path]` and delays `[*batch, path]` [s].

    The pair (complex64, float32) is what link simulators take; arrays and `phase` as in `cfr`. Invalid paths have
    amplitude zero.
    """
    pairs = _pairs(paths, array_rx, array_tx) * coefficients(paths, phase, seed=seed)[..., None, None]
    return pairs.movedim(-3, -1).to(torch.complex64), paths.delay


def delay_phase(delay: Tensor, offsets: Tensor) -> Tensor:
    """e^{-j 2 pi f tau} `[*batch, path, subcarrier]`, complex128, of delays [s] at frequencies `offsets` [Hz]."""
    turn = torch.remainder(-delay.double()[..., None] * offsets, 1.0)
    return torch.polar(torch.ones_like(turn), 2 * math.pi * turn)


def _pairs(paths: Paths, array_rx: PlanarArray | None, array_tx: PlanarArray | None) -> Tensor:
    """Product of both manifolds `[*batch, path, rx_ant, tx_ant]`, complex128."""
    rx = _seen(array_rx, paths.rx, paths.aoa)
    tx = _seen(array_tx, paths.tx, paths.aod)
    return rx[..., :, None] * tx[..., None, :]


def _seen(array: PlanarArray | None, pose: Pose, directions: Tensor) -> Tensor:
    """Manifold `[*batch, path, element]` towards world-frame directions."""
    if array is None:
        return torch.ones(*directions.shape[:-1], 1, dtype=torch.complex128)
    return manifold(array, (directions.double() @ pose.world_from_device.double()))
