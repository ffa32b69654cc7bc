"""Diagonal loading: what is added to a covariance so that it can be inverted, by the name of its rule."""

import torch
from torch import Tensor

from rf3dgs.spectra.config import Loading


def loaded(R: Tensor, loading: Loading) -> Tensor:
    """R `[*batch, element, element]` with `loading` on its diagonal.

    "relative" adds its amount times the mean element power, "absolute" the amount itself, "snr" the mean power times
    10^(-amount / 10).
    """
    return R + loading_power(R, loading)[..., None, None] * torch.eye(R.shape[-1], dtype=R.dtype)


def loading_power(R: Tensor, loading: Loading) -> Tensor:
    """What `loaded` adds to the diagonal of R `[*batch, element, element]`, `[*batch]`, in the unit of R."""
    mean = R.diagonal(dim1=-2, dim2=-1).real.mean(-1)
    if loading.rule == "absolute":
        return torch.full_like(mean, loading.amount)
    return mean * (loading.amount if loading.rule == "relative" else 10.0 ** (-loading.amount / 10.0))
