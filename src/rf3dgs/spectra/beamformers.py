"""Beamformers: power per scanning direction from a covariance. Functions of arrays; everything in complex128.

All scan with unit-modulus steering vectors v = sqrt(M) a / |a|, so that the element's gain stays in the picture as a
receiver sees it and noise is equally strong in all directions. The level is the same for all three: one path of gain g
through isotropic elements gives g at its direction, white noise of power s per element gives s / M with the
untapered ones. With elements of gain G the path gives g G; a direction with no gain has power 0. Elements in one
plane cannot tell front from back: behind the array the picture repeats as a mirror image unless the element has no
gain there.
"""

import math

import torch
from torch import Tensor

from rf3dgs.channel.arrays import PlanarArray
from rf3dgs.core.errors import InputError


def bartlett(R: Tensor, A: Tensor) -> Tensor:
    """Bartlett (CBF) spectrum `[*batch, *direction]`, power [linear]: v^H R v / M^2. Paper eq. 11.

    R `[*batch, element, element]` covariance; A `[*direction, element]` manifold.
    """
    return tapered(R, A, torch.ones(A.shape[-1]))


def tapered(R: Tensor, A: Tensor, taper: Tensor) -> Tensor:
    """Tapered Bartlett (TCBF) spectrum `[*batch, *direction]`, power [linear]: w^H R w with w = t v / sum(t).

    `taper` t `[element]`, real weights such as `hann_taper`: lower side lobes for a wider main lobe.
    """
    _check(R, A)
    if taper.shape != A.shape[-1:] or not bool(taper.sum() > 0):
        raise InputError(f"taper must be [{A.shape[-1]}] weights with a positive sum; got {list(taper.shape)}")
    weights = _steering(A) * (taper.double() / taper.double().sum())
    return _per_batch(R, A, lambda one: ((weights.conj() @ one) * weights).sum(-1).real.clamp_min(0.0))


def capon(R: Tensor, A: Tensor, loading: float = 1e-3) -> Tensor:
    """Capon (MVDR) spectrum `[*batch, *direction]`, power [linear]: 1 / (v^H R^-1 v). Paper eq. 14.

    `loading` times the mean element power is added to the diagonal of R first; it must suffice to make R positive
    definite. For isotropic elements this is eq. 14 to the letter; for others eq. 14 times the element's gain, which
    keeps noise flat where the element is deaf.
    """
    _check(R, A)
    steering = _steering(A)
    identity = torch.eye(A.shape[-1], dtype=torch.complex128)

    def scan(one: Tensor) -> Tensor:
        mean = one.diagonal().real.mean()
        if float(mean) == 0.0:
            return torch.zeros(len(steering), dtype=torch.float64)
        factor, failed = torch.linalg.cholesky_ex(one / mean + loading * identity)
        if int(failed):
            raise InputError(f"R is not positive definite with loading {loading}; use a larger one, such as 1e-3")
        whitener = torch.linalg.solve_triangular(factor, identity, upper=False)
        white = torch.view_as_real(steering @ whitener.mT).square().sum((-2, -1))
        return torch.where(white > 0, mean / white, torch.zeros_like(white))

    return _per_batch(R, A, scan)


def hann_taper(array: PlanarArray) -> Tensor:
    """Separable Hann weights `[element]`, sin^2(pi (n + 1) / (N + 1)) along rows and columns: no element is lost."""

    def window(count: int) -> Tensor:
        return torch.sin(math.pi * (torch.arange(count, dtype=torch.float64) + 1) / (count + 1)) ** 2

    return (window(array.cols)[:, None] * window(array.rows)).reshape(-1)


def _steering(A: Tensor) -> Tensor:
    """Unit-modulus steering vectors `[direction, element]`, complex128; zero where the manifold is."""
    flat = A.reshape(-1, A.shape[-1]).to(torch.complex128)
    norm = torch.linalg.vector_norm(flat, dim=-1, keepdim=True)
    return torch.where(norm > 0, flat * (math.sqrt(A.shape[-1]) / norm.clamp_min(1e-300)), torch.zeros_like(flat))


def _per_batch(R: Tensor, A: Tensor, scan) -> Tensor:
    rows = [scan(one) for one in R.to(torch.complex128).reshape(-1, *R.shape[-2:])]
    return torch.stack(rows).reshape(*R.shape[:-2], *A.shape[:-1])


def _check(R: Tensor, A: Tensor) -> None:
    if R.dim() < 2 or R.shape[-1] != R.shape[-2] or R.shape[-1] != A.shape[-1]:
        raise InputError(
            f"R must be [*batch, element, element] and A [*direction, element] with as many elements; "
            f"got {list(R.shape)} and {list(A.shape)}"
        )
    if not bool(torch.isfinite(torch.view_as_real(R.to(torch.complex128))).all()):
        raise InputError("R has NaN or infinite values; check the paths it was made from")
