"""Adam over named tensors whose rows come and go: the moments follow the Gaussians through growth and pruning."""

from collections.abc import Mapping

import torch
from torch import Tensor
from torch.optim.adam import adam

from rf3dgs.splats.density import Change


class Adam:
    """Adam (Kingma and Ba 2015) for a dictionary of leaf tensors, with a learning rate by name in every step.

    `first` and `second` are the moments. Bias correction counts the steps of the whole run, as 3D Gaussian Splatting
    does for Gaussians born late.
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

    def follow(self, change: Change, parameters: dict[str, Tensor]) -> None:
        """Take over the parameters of a changed population; the moments follow, and are zero for fresh rows."""
        self.parameters = parameters
        self.first = {name: change.follow(moment) for name, moment in self.first.items()}
        self.second = {name: change.follow(moment) for name, moment in self.second.items()}

    def forget(self, name: str) -> None:
        """Zero the moments of one parameter, after its values were set from outside."""
        self.first[name].zero_()
        self.second[name].zero_()
