"""Real spherical harmonics up to degree 3, in the order and with the signs and constants of 3DGS.

A Gaussian's value towards a viewer is `sum_k sh_k Y_k(d)`, where d is the unit vector from the viewer to the
Gaussian. 3DGS stores colour so that 0.5 is added and negative results are cut at 0. Kerbl et al. (2023); Ramamoorthi
and Hanrahan (2001).
"""

import torch
from torch import Tensor

from rf3dgs.core.errors import InputError
from rf3dgs.splats.backends.native import evaluate_harmonics, takes

C0 = 0.28209479177387814
C1 = 0.4886025119029199
C2 = (1.0925484305920792, -1.0925484305920792, 0.31539156525252005, -1.0925484305920792, 0.5462742152960396)
C3 = (
    -0.5900435899266435,
    2.890611442640554,
    -0.4570457994644658,
    0.3731763325901154,
    -0.4570457994644658,
    1.445305721320277,
    -0.5900435899266435,
)
MAX_DEGREE = 3


def coefficient_count(degree: int) -> int:
    """How many coefficients a degree has: (degree + 1)^2."""
    if not 0 <= degree <= MAX_DEGREE:
        raise InputError(f"the degree of the harmonics must be 0 to {MAX_DEGREE}; got {degree}")
    return (degree + 1) ** 2


def degree_of(count: int) -> int:
    """The degree that has `count` coefficients."""
    for degree in range(MAX_DEGREE + 1):
        if coefficient_count(degree) == count:
            return degree
    raise InputError(f"harmonics have 1, 4, 9 or 16 coefficients; got {count}. Cut or pad the coefficient dimension")


def basis(directions: Tensor, degree: int) -> Tensor:
    """Values `[*batch, (degree + 1)^2]` of the harmonics at unit vectors `[*batch, 3]`."""
    coefficient_count(degree)
    x, y, z = directions.unbind(-1)
    terms = [torch.full_like(x, C0)]
    if degree >= 1:
        terms += [-C1 * y, C1 * z, -C1 * x]
    xx, yy, zz = x * x, y * y, z * z
    if degree >= 2:
        terms += [C2[0] * x * y, C2[1] * y * z, C2[2] * (2 * zz - xx - yy), C2[3] * x * z, C2[4] * (xx - yy)]
    if degree >= 3:
        terms += [
            C3[0] * y * (3 * xx - yy),
            C3[1] * x * y * z,
            C3[2] * y * (4 * zz - xx - yy),
            C3[3] * z * (2 * zz - 3 * xx - 3 * yy),
            C3[4] * x * (4 * zz - xx - yy),
            C3[5] * z * (xx - yy),
            C3[6] * x * (xx - 3 * yy),
        ]
    return torch.stack(terms, -1)


def evaluate(sh: Tensor, directions: Tensor, *, offset: float = 0.0, clamp: bool = False) -> Tensor:
    """Values `[gaussian, channel]` of coefficients `[gaussian, k, channel]` towards unit vectors `[gaussian, 3]`.

    `offset` is added and, with `clamp`, what is negative then becomes 0: an offset of 0.5 with clamping is 3DGS colour.
    """
    if sh.dim() != 3 or directions.shape != (len(sh), 3):
        raise InputError(
            f"sh must be [gaussian, k, channel] and directions [gaussian, 3]; got {list(sh.shape)} and "
            f"{list(directions.shape)}"
        )
    degree = degree_of(sh.shape[1])
    if takes(sh, directions) and not directions.requires_grad:
        values = evaluate_harmonics(sh, directions)
    else:
        values = torch.einsum("gk,gkc->gc", basis(directions, degree), sh)
    values = values + offset if offset else values
    return values.clamp_min(0.0) if clamp else values


def view_directions(means: Tensor, centre: Tensor) -> Tensor:
    """Unit vectors `[gaussian, 3]` from a viewer at `centre` `[3]` to `means` `[gaussian, 3]`; 0 where both are one."""
    along = means - centre.to(means.dtype)
    return along * torch.rsqrt(along.square().sum(-1, keepdim=True) + 1e-24)


def view_values(sh: Tensor, means: Tensor, centre: Tensor, *, offset: float = 0.0, clamp: bool = False) -> Tensor:
    """Values `[gaussian, channel]` that a viewer at `centre` `[3]` [m] sees; see `evaluate`."""
    return evaluate(sh, view_directions(means, centre), offset=offset, clamp=clamp)
