"""Beamformers: power per scanning direction from a covariance. Functions of arrays; everything in complex128.

All scan with unit-modulus steering vectors v (see `steering`), so that the element's gain stays in the picture as a
receiver sees it and noise is equally strong in all directions. The level is the same for the first three: one path of
gain g through isotropic elements gives g at its direction, white noise of power s per element gives s / M with the
untapered ones. With elements of gain G the path gives g G; a direction with no gain has power 0. MUSIC has no level.
Elements in one plane cannot tell front from back: behind the array the picture repeats as a mirror image unless the
element has no gain there.

Wherever A stands, a manifold `[*direction, element]` or a `PlanarSteering` may be given.
"""

import math

import torch
from torch import Tensor

from rf3dgs.channel.arrays import PlanarArray
from rf3dgs.core.errors import InputError
from rf3dgs.spectra.config import Loading
from rf3dgs.spectra.loading import loaded
from rf3dgs.spectra.steering import Steering, steering_of

SHARPEST = 1e-12  # share of a steering vector outside the signal subspace that rounding leaves of none


def bartlett(R: Tensor, A: Tensor | Steering) -> Tensor:
    """Bartlett (CBF) spectrum `[*batch, *direction]`, power [linear]: v^H R v / M^2. Paper eq. 11.

    R `[*batch, element, element]` covariance; A `[*direction, element]` manifold.
    """
    return tapered(R, A, torch.ones(A.shape[-1]))


def tapered(R: Tensor, A: Tensor | Steering, taper: Tensor) -> Tensor:
    """Tapered Bartlett (TCBF) spectrum `[*batch, *direction]`, power [linear]: w^H R w with w = t v / sum(t).

    `taper` t `[element]`, real weights such as `hann_taper`: lower side lobes for a wider main lobe.
    """
    _check(R, A)
    if taper.shape != A.shape[-1:] or not bool(taper.sum() > 0):
        raise InputError(f"taper must be [{A.shape[-1]}] weights with a positive sum; got {list(taper.shape)}")
    steering, weight = steering_of(A), taper.double() / taper.double().sum()
    return _per_batch(R, A, lambda one: steering.forms(weight[:, None] * one * weight).clamp_min(0.0))


def capon(R: Tensor, A: Tensor | Steering, loading: Loading | None = None) -> Tensor:
    """Capon (MVDR) spectrum `[*batch, *direction]`, power [linear]: 1 / (v^H R^-1 v). Paper eq. 14.

    `loading` is added to the diagonal of R first, a thousandth of the mean element power unless given. It must suffice
    to make R positive definite. For isotropic elements this is eq. 14 to the letter; for others eq. 14 times the
    element's gain, which keeps noise flat where the element is deaf.
    """
    _check(R, A)
    loading = Loading() if loading is None else loading
    steering, full = steering_of(A), loaded(R.to(torch.complex128), loading)

    def scan(one: Tensor) -> Tensor:
        mean = one.diagonal().real.mean()
        if float(mean) == 0.0:
            return torch.zeros(math.prod(A.shape[:-1]), dtype=torch.float64)
        factor, failed = torch.linalg.cholesky_ex(one / mean)
        if int(failed):
            raise InputError(f"R is not positive definite with {loading}; use a larger one, such as Loading(1e-3)")
        white = steering.forms(torch.cholesky_inverse(factor))
        return torch.where(white > 0, mean / white, torch.zeros_like(white))

    return _per_batch(full, A, scan)


def music(R: Tensor, A: Tensor | Steering, sources: int) -> Tensor:
    """MUSIC pseudo-spectrum `[*batch, *direction]`: M / (v^H E E^H v), E the eigenvectors beside the `sources` largest.

    1 for a direction outside the signal subspace, without bound (here 1e12) for one inside: it says how well a
    direction fits, not how strong it is. Schmidt, 1986. `sources` from 0 to M - 1; see `source_count`.
    """
    _check(R, A)
    count = A.shape[-1]
    if not 0 <= sources < count:
        raise InputError(
            f"sources must lie between 0 and {count - 1}, fewer than the {count} elements; got {sources}. "
            "Use more elements or a larger subarray"
        )
    steering = steering_of(A)

    def scan(one: Tensor) -> Tensor:
        noise = torch.linalg.eigh(one)[1][:, : count - sources]
        outside = steering.forms(noise @ noise.mH) / count
        deaf = steering.forms(torch.eye(count, dtype=torch.complex128)) == 0
        return torch.where(deaf, torch.zeros_like(outside), 1.0 / outside.clamp_min(SHARPEST))

    return _per_batch(R, A, scan)


def hann_taper(array: PlanarArray) -> Tensor:
    """Separable Hann weights `[element]`, sin^2(pi (n + 1) / (N + 1)) along rows and columns: no element is lost."""

    def window(count: int) -> Tensor:
        return torch.sin(math.pi * (torch.arange(count, dtype=torch.float64) + 1) / (count + 1)) ** 2

    return (window(array.cols)[:, None] * window(array.rows)).reshape(-1)


def _per_batch(R: Tensor, A: Tensor | Steering, scan) -> Tensor:
    rows = [scan(one) for one in R.to(torch.complex128).reshape(-1, *R.shape[-2:])]
    return torch.stack(rows).reshape(*R.shape[:-2], *A.shape[:-1])


def _check(R: Tensor, A: Tensor | Steering) -> None:
    if R.dim() < 2 or R.shape[-1] != R.shape[-2] or R.shape[-1] != A.shape[-1]:
        raise InputError(
            f"R must be [*batch, element, element] and A [*direction, element] with as many elements; "
            f"got {list(R.shape)} and {list(A.shape)}"
        )
    if not bool(torch.isfinite(torch.view_as_real(R.to(torch.complex128))).all()):
        raise InputError("R has NaN or infinite values; check the paths it was made from")
