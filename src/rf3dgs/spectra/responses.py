"""Coherent responses of an array to many paths: x_m(f) = sum_p c_p a_m(r_p) e^{-j 2 pi f tau_p} at equal steps of f.

Few paths are summed as written. Many are first spread over a grid of delays, twice as fine as the taps, with a kernel
that is short in delay; one FFT of the grid, divided by the kernel's own transform, gives the responses (Barnett,
Magland and af Klinteberg, 2019: a non-uniform FFT of type 1 with the "exponential of semicircle"). A path then costs
`WIDTH` cells instead of all frequencies. The error is below 1e-9 of the largest response.
`_spread` is the specification of the native core's `spread_responses`.
"""

import math
from functools import lru_cache

import numpy as np
import torch
from torch import Tensor

from rf3dgs.channel.arrays import PlanarArray, ofdm
from rf3dgs.channel.patterns import field_pattern
from rf3dgs.channel.response import delay_phase, manifold, manifold_factors
from rf3dgs.core.native import native_core
from rf3dgs.core.threads import thread_count

FEW = 4_096  # up to so many paths are summed as written
WIDTH = 12  # cells that a path is spread over
AHEAD = WIDTH // 2 - 1  # cells of these before the one that holds the path
SHARPNESS = 2.30 * WIDTH
DEGREE = 15  # of the polynomials that stand for the kernel
AT_ONCE = 2**13  # paths of an intermediate result


def responses(
    coeff: Tensor, delay: Tensor, directions: Tensor, array: PlanarArray, count: int, bandwidth: float
) -> Tensor:
    """Element responses x `[element, count]`, complex128, at the frequencies `ofdm(bandwidth, count)`.

    coeff `[path]` complex, with the carrier's phase; delay `[path]` [s]; directions `[path, 3]` in the device frame.
    Paths with a coefficient of zero are left out.
    """
    arriving = coeff != 0
    coeff, delay, directions = coeff[arriving], delay[arriving].double(), directions[arriving].double()
    if len(coeff) <= FEW:
        return _direct(coeff, delay, directions, array, ofdm(bandwidth, count))
    coeff = coeff.to(torch.complex128) * field_pattern(array.pattern, directions)
    place = torch.remainder(delay * (bandwidth / count), 1.0) * (2 * count)
    core = native_core()
    if core is None:
        cells = _spread(coeff, place, directions, array, 2 * count)
    else:
        total = torch.zeros(2 * array.count, 2 * count, dtype=torch.float64)
        core.spread_responses(
            torch.view_as_real(coeff.contiguous()).numpy(),
            place.numpy(),
            directions.contiguous().numpy(),
            kernel_polynomials().numpy(),
            2 * math.pi * array.horizontal,
            -2 * math.pi * array.vertical,
            array.rows,
            array.cols,
            total.numpy(),
            thread_count(),
        )
        cells = torch.complex(total[: array.count], total[array.count :])
    frequency = torch.arange(count) - count // 2
    return torch.fft.fft(cells)[:, frequency % (2 * count)] / kernel_transform(count)


def _direct(coeff: Tensor, delay: Tensor, directions: Tensor, array: PlanarArray, offsets: Tensor) -> Tensor:
    x = torch.zeros(array.count, len(offsets), dtype=torch.complex128)
    for first in range(0, len(coeff), AT_ONCE):
        part = slice(first, first + AT_ONCE)
        x += (manifold(array, directions[part]) * coeff[part, None]).mT @ delay_phase(delay[part], offsets)
    return x


def _spread(coeff: Tensor, place: Tensor, directions: Tensor, array: PlanarArray, cells: int) -> Tensor:
    """Paths spread over a ring of cells `[element, cell]`; `place` `[path]` counts in cells."""
    total = torch.zeros(cells, array.count, dtype=torch.complex128)
    for first in range(0, len(coeff), AT_ONCE):
        part = slice(first, first + AT_ONCE)
        columns, rows = manifold_factors(array, directions[part])
        steering = ((columns * coeff[part])[:, None] * rows).reshape(array.count, -1).mT
        cell = place[part].floor()
        for tap in range(WIDTH):
            weight = kernel(tap - AHEAD - (place[part] - cell))
            total.index_add_(0, (cell.long() + tap - AHEAD) % cells, steering * weight[:, None])
    return total.mT


def kernel(distance: Tensor) -> Tensor:
    """exp(b (sqrt(1 - (2 d / w)^2) - 1)) of distances d in cells, zero beyond w / 2."""
    inside = 1.0 - (distance * (2.0 / WIDTH)).square()
    return torch.where(inside >= 0, torch.exp(SHARPNESS * (inside.clamp_min(0.0).sqrt() - 1.0)), torch.zeros(()))


@lru_cache(maxsize=8)
def kernel_transform(count: int) -> Tensor:
    """The kernel's Fourier integral `[count]` at the frequencies -count // 2 ... of a ring of 2 count cells."""
    node, weight = (torch.from_numpy(part) for part in np.polynomial.legendre.leggauss(120))
    turn = (torch.arange(count) - count // 2).double() / (2 * count)
    half = 0.5 * WIDTH
    return torch.cos(2 * math.pi * half * turn[:, None] * node) @ (weight * half * kernel(half * node))


@lru_cache(maxsize=1)
def kernel_polynomials() -> Tensor:
    """Coefficients `[DEGREE + 1, 16]`, highest first, that give tap t's weight from the place within its cell.

    In the variable 2 f - 1 of the fraction f; columns beyond `WIDTH` are zero.
    """
    node = np.cos(np.pi * (np.arange(64) + 0.5) / 64)
    result = np.zeros((DEGREE + 1, 16))
    for tap in range(WIDTH):
        value = kernel(torch.from_numpy(tap - AHEAD - 0.5 * (node + 1.0))).numpy()
        fitted = np.polynomial.chebyshev.cheb2poly(np.polynomial.chebyshev.chebfit(node, value, DEGREE))
        result[:, tap] = fitted[::-1]
    return torch.from_numpy(result)
