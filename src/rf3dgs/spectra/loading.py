"""Diagonal loading: what is added to a covariance so that it can be inverted, by the name of its rule."""

import math
from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor

from rf3dgs.core.errors import InputError

Rule = Literal["relative", "absolute", "snr"]
RULES = ("relative", "absolute", "snr")


@dataclass(frozen=True)
class Loading:
    """How much is added to the diagonal of a covariance.

    rule "relative": `amount` times the mean element power. "absolute": `amount` itself, a power [linear] in the unit of
    the covariance. "snr": the noise power of a receiver whose signal-to-noise ratio is `amount` [dB], taken as not yet
    in the covariance: mean power times 10^(-amount / 10).
    """

    amount: float
    rule: Rule = "relative"

    def __post_init__(self) -> None:
        if self.rule not in RULES:
            raise InputError(f"a loading's rule must be one of {', '.join(RULES)}; got {self.rule!r}")
        if not math.isfinite(self.amount) or (self.rule != "snr" and self.amount < 0):
            raise InputError(f"a {self.rule} loading must be finite and, as a power, not negative; got {self.amount}")

    def power(self, R: Tensor) -> Tensor:
        """What is added to the diagonal of each R `[*batch, element, element]`: `[*batch]`, linear."""
        mean = R.diagonal(dim1=-2, dim2=-1).real.mean(-1)
        if self.rule == "absolute":
            return torch.full_like(mean, self.amount)
        return mean * (self.amount if self.rule == "relative" else 10.0 ** (-self.amount / 10.0))


def loaded(R: Tensor, loading: float | Loading) -> Tensor:
    """R `[*batch, element, element]` with `loading` on its diagonal; a number is a share of the mean element power."""
    rule = loading if isinstance(loading, Loading) else Loading(float(loading))
    return R + rule.power(R)[..., None, None] * torch.eye(R.shape[-1], dtype=R.dtype)
