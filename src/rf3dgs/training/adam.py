"""Adam over named tensors whose rows come and go: the moments follow the Gaussians through growth and pruning."""

from collections.abc import Mapping

import torch
from torch import Tensor
from torch.optim.adam import adam


class Adam:
    """Adam (Kingma and Ba 2015) for a dictionary of leaf tensors, with a learning rate by name in every step.

    `parameters` is shared with its owner, who may replace a tensor when `first` and `second`, its moments, are replaced
    with it. Bias correction counts the steps of the whole run, as 3D Gaussian Splatting does for Gaussians born late.
    """

    def __init__(self, parameters: dict[str, Tensor], *, betas: tuple[float, float] = (0.9, 0.999), eps: float = 1e-15):
        self.parameters, self.betas, self.eps, self.count = parameters, betas, eps, 0
        self.first = {name: torch.zeros_like(value, requires_grad=False) for name, value in parameters.items()}
        self.second = {name: torch.zeros_like(value, requires_grad=False) for name, value in parameters.items()}

    def step(self, rates: Mapping[str, float]) -> None:
        """Move every parameter that has a gradient by its rate, then drop the gradients."""
        with torch.no_grad():
            for name, parameter in self.parameters.items():
                if parameter.grad is None:
                    continue
                adam(
                    [parameter],
                    [parameter.grad],
                    [self.first[name]],
                    [self.second[name]],
                    [],
                    [torch.tensor(float(self.count))],
                    fused=True,
                    amsgrad=False,
                    beta1=self.betas[0],
                    beta2=self.betas[1],
                    lr=rates[name],
                    weight_decay=0.0,
                    eps=self.eps,
                    maximize=False,
                )
                parameter.grad = None
        self.count += 1

    def gather(self, source: Tensor) -> None:
        """Rows after a change of population: row i continues row `source[i]`, or starts afresh where that is -1."""
        fresh = source < 0
        for moments in (self.first, self.second):
            for name, value in moments.items():
                rows = value[source.clamp_min(0)]
                rows[fresh] = 0.0
                moments[name] = rows

    def forget(self, name: str) -> None:
        """Zero the moments of one parameter, after its values were set from outside."""
        self.first[name].zero_()
        self.second[name].zero_()
