"""How many sources a covariance holds: the information criteria of Wax and Kailath, 1985."""

import math

import torch
from torch import Tensor

from rf3dgs.core.errors import InputError
from rf3dgs.spectra.config import CRITERIA, Criterion

SMALLEST = 1e-15  # of the largest eigenvalue: below it eigenvalues are rounding


def source_count(R: Tensor, snapshots: int, criterion: Criterion = "mdl") -> Tensor:
    """Number of sources `[*batch]`, 0 to M - 1, in covariances R `[*batch, M, M]` of `snapshots` N responses each.

    The k that is smallest in N (M - k) log(arithmetic / geometric mean of the M - k smallest eigenvalues) plus
    k (2M - k) log(N) / 2 ("mdl", consistent) or k (2M - k) ("aic", takes some too many). Both suppose white noise: a
    channel without noise, or with thousands of weak paths, has as many sources as the array can hold.
    InputError unless there are more snapshots than elements.
    """
    count = R.shape[-1]
    if criterion not in CRITERIA:
        raise InputError(f'a criterion must be "mdl" or "aic"; got {criterion!r}')
    if snapshots <= count:
        raise InputError(
            f"to count sources takes more snapshots than the {count} elements; got {snapshots}. "
            "Give sources as a number, use more snapshots or a smaller subarray"
        )
    values = torch.linalg.eigvalsh(R.to(torch.complex128)).flip(-1)
    values = values.clamp_min(1e-300).maximum(SMALLEST * values[..., :1])
    costs = []
    for k in range(count):
        rest = values[..., k:]
        likelihood = snapshots * (count - k) * (rest.mean(-1).log() - rest.log().mean(-1))
        free = k * (2 * count - k)
        costs.append(likelihood + (0.5 * free * math.log(snapshots) if criterion == "mdl" else free))
    return torch.stack(costs, -1).argmin(-1)
