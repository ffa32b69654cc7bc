"""What makes coherent sources look independent: averaging a covariance forward and backward, and over subarrays.

Two copies of one wave, as from a mirror, respond alike in every snapshot: their covariance has rank one, and Capon and
MUSIC see neither. Both averages restore the rank (Shan, Wax and Kailath, 1985; Pillai and Kwon, 1989).
"""

from dataclasses import replace

import torch
from torch import Tensor

from rf3dgs.channel.arrays import PlanarArray
from rf3dgs.core.errors import InputError


def forward_backward(R: Tensor) -> Tensor:
    """(R + J R^* J) / 2 of R `[*batch, element, element]`, J the exchange of each element with its point reflection.

    The result is Hermitian and persymmetric (J R^* J = R). It doubles the snapshots and separates two coherent sources
    whose phases differ at the middle of the array; uncorrelated waves are left as they are. For arrays that are their
    own point reflection, as every `PlanarArray`.
    """
    return 0.5 * (R + R.conj().flip(-1, -2))


def smoothed(R: Tensor, array: PlanarArray, rows: int, cols: int) -> tuple[Tensor, PlanarArray]:
    """The mean covariance `[*batch, rows * cols, rows * cols]` of all `rows` x `cols` subarrays, and such an array.

    With L subarrays up to L coherent sources are separated, in directions where their phases differ from subarray to
    subarray; the smaller aperture resolves less. InputError where the subarray does not fit into `array`.
    """
    if not (1 <= rows <= array.rows and 1 <= cols <= array.cols):
        raise InputError(
            f"a subarray must have 1 to {array.rows} rows and 1 to {array.cols} columns of the {array.label} array; "
            f"got {rows}x{cols}"
        )
    if R.shape[-2:] != (array.count, array.count):
        raise InputError(f"R must be [*batch, {array.count}, {array.count}] for {array.label}; got {list(R.shape)}")
    row, col = torch.arange(rows).repeat(cols), torch.arange(cols).repeat_interleave(rows)
    places = [
        (row + down) + (col + right) * array.rows
        for right in range(array.cols - cols + 1)
        for down in range(array.rows - rows + 1)
    ]
    total = sum(R[..., place[:, None], place] for place in places)
    assert isinstance(total, Tensor)
    return total / len(places), replace(array, rows=rows, cols=cols)
