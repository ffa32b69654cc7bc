"""Learning rates of a training step."""

from dataclasses import dataclass

import torch
from torch import Tensor

from rf3dgs.core.errors import InputError


@dataclass(frozen=True)
class Rates:
    """Adam's learning rate of each group: `means` [m], `quats`, `log_scales`, `logit_opacities`, and of the harmonics
    the constant one (`level`) and the others (`bands`), one number or one for each channel. What is not trained needs
    none.
    """

    means: float = 0.0
    quats: float = 0.0
    log_scales: float = 0.0
    logit_opacities: float = 0.0
    level: float | tuple[float, ...] = 0.0
    bands: float | tuple[float, ...] = 0.0

    def of_sh(self, channels: int, lanes: int) -> Tensor:
        """The rate of each coefficient `[channel, lane]`."""
        result = torch.empty(channels, lanes)
        result[:, :1] = self._channels("level", channels)
        result[:, 1:] = self._channels("bands", channels)
        return result

    def _channels(self, name: str, channels: int) -> Tensor:
        rates = torch.tensor(getattr(self, name), dtype=torch.float32).reshape(-1, 1)
        if len(rates) not in (1, channels):
            raise InputError(f"{name} must be one rate or one for each of {channels} channels; got {len(rates)}")
        return rates
