"""Quadratic forms v^H Q v of steering vectors: what every array spectrum comes down to.

All scan with unit-modulus steering vectors v = sqrt(M) a / |a|, zero where the manifold a is. For any manifold the form
is a matrix product of M^2 multiplications a direction. On a planar array v_m^* v_n depends only on how many rows and
columns m and n are apart, so the entries of Q that share such a lag are summed first:

    v^H Q v = Re sum_{dc >= 0} e_dc y^dc sum_dr S[dr, dc] z^dr,   S[dr, dc] = sum over (m, n) of that lag of Q_mn

with y, z the phasors of one column and one row, e_0 = 1 and e_dc = 2: (2 rows - 1) cols multiplications a direction.
"""

from dataclasses import dataclass

import torch
from torch import Tensor

from rf3dgs.channel.arrays import PlanarArray
from rf3dgs.channel.patterns import power_pattern
from rf3dgs.channel.response import phasors

AT_ONCE = 2048  # directions: what is made of them stays in the cache


@dataclass(frozen=True, eq=False)
class PlanarSteering:
    """The steering vectors of `array` towards device-frame unit vectors `directions` `[*direction, 3]`.

    Stands wherever a beamformer takes a manifold, gives the same numbers and is many times as fast.
    """

    array: PlanarArray
    directions: Tensor

    @property
    def shape(self) -> tuple[int, ...]:
        """That of the manifold: `[*direction, element]`."""
        return (*self.directions.shape[:-1], self.array.count)

    def forms(self, Q: Tensor) -> Tensor:
        """v^H Q v `[n]`, float64, of a Hermitian Q `[element, element]` over the flattened directions."""
        return self.of_sums(lag_sums(Q, self.array))

    def of_sums(self, sums: Tensor) -> Tensor:
        """The same `[n]` of a Hermitian matrix whose `lag_sums` are `sums`."""
        array = self.array
        directions = self.directions.reshape(-1, 3)
        result = torch.empty(len(directions), dtype=torch.float64)
        for first in range(0, len(directions), AT_ONCE):
            _, y, z = directions[first : first + AT_ONCE].double().unbind(-1)
            half = phasors(-array.vertical * z, 0.0, array.rows)
            rows = torch.cat((half[1:].flip(0).conj(), half))
            lines = (sums.mT @ rows) * phasors(array.horizontal * y, 0.0, array.cols)
            lines = lines.real
            result[first : first + AT_ONCE] = lines[0] + 2.0 * lines[1:].sum(0)
        return torch.where(power_pattern(array.pattern, directions) > 0, result, torch.zeros_like(result))


@dataclass(frozen=True, eq=False)
class ManifoldSteering:
    """The steering vectors of any manifold A `[*direction, element]`."""

    A: Tensor

    @property
    def shape(self) -> tuple[int, ...]:
        return tuple(self.A.shape)

    def forms(self, Q: Tensor) -> Tensor:
        """v^H Q v `[n]`, float64, of a Hermitian Q `[element, element]` over the flattened directions."""
        flat = self.A.reshape(-1, self.A.shape[-1])
        result = torch.empty(len(flat), dtype=torch.float64)
        opposite = Q.conj().resolve_conj()
        for first in range(0, len(flat), AT_ONCE):
            part = flat[first : first + AT_ONCE].to(torch.complex128)
            turned, plain = torch.view_as_real(part @ opposite), torch.view_as_real(part)
            square = plain.square().sum((-2, -1))
            form = (turned * plain).sum((-2, -1)) * (flat.shape[-1] / square.clamp_min(1e-300))
            result[first : first + AT_ONCE] = torch.where(square > 0, form, torch.zeros_like(form))
        return result


Steering = PlanarSteering | ManifoldSteering


def steering_of(A: Tensor | Steering) -> Steering:
    """Steering vectors of a manifold `[*direction, element]`, or those given."""
    return ManifoldSteering(A) if isinstance(A, Tensor) else A


def lag_sums(Q: Tensor, array: PlanarArray) -> Tensor:
    """S `[2 rows - 1, cols]`: sums of the entries of Q whose columns lie dc >= 0 and rows dr columns and rows apart.

    Entry (m, n) has dc = col_n - col_m and dr = row_n - row_m; dr runs from -(rows - 1).
    """
    rows, cols = array.rows, array.cols
    row, col = torch.arange(array.count) % rows, torch.arange(array.count) // rows
    apart, across = row - row[:, None] + rows - 1, col - col[:, None]
    chosen = across >= 0
    sums = torch.zeros((2 * rows - 1) * cols, dtype=torch.complex128)
    sums.index_add_(0, (apart * cols + across)[chosen], Q[chosen])
    return sums.reshape(2 * rows - 1, cols)


def from_lags(lags: Tensor, array: PlanarArray) -> Tensor:
    """The Hermitian matrix `[element, element]` whose entry (m, n) is `lags[dr + rows - 1, dc]` of its lag.

    Here dc = col_m - col_n and dr = row_m - row_n, as in a covariance of plane waves; a negative dc is the conjugate of
    the opposite lag.
    """
    rows = array.rows
    row, col = torch.arange(array.count) % rows, torch.arange(array.count) // rows
    apart, across = row[:, None] - row, col[:, None] - col
    flip = across < 0
    apart = torch.where(flip, -apart, apart) + rows - 1
    values = lags[apart, across.abs()]
    return torch.where(flip, values.conj(), values)
