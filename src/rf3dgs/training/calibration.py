"""Widths of errors from numbers that are known where they were made: the weights of `field.uncertainty`."""

import torch
from torch import Tensor

from rf3dgs.field.uncertainty import ONE_STD, SHARES, SIGNED

STEPS = 40
HALVINGS = 20


def calibrate(numbers: Tensor, error_db: Tensor, counts: Tensor, *, signed: int = SIGNED) -> tuple[Tensor, Tensor]:
    """Weights `[F]` and widths `[7]` for errors `[n]` [dB], which count `[n]`, of pixels with `numbers` `[n, F]`.

    The weights w minimise the sum of counts (w . x + |error| exp(-w . x)), a convex function, with all but the first
    `signed` at least 0; the first is then such that 68.3 % of the errors lie within exp(w . x). Widths are quantiles.
    """
    x, size, counts = numbers.double(), error_db.double().abs(), counts.double() / counts.double().sum()
    free = torch.ones(x.shape[1], dtype=torch.bool)
    while True:
        weights = torch.zeros(x.shape[1], dtype=torch.float64)
        weights[free] = minimum(x[:, free], size, counts)
        negative = weights[signed:] < 0
        if not bool(negative.any()):
            break
        effect = weights[signed:] * x[:, signed:].std(0)
        free[signed + int(torch.where(negative, effect, 0.0).argmin())] = False
    ratio, order = (size / torch.exp(x @ weights)).sort()
    below = counts[order].cumsum(0)
    widths = ratio[torch.searchsorted(below, torch.tensor(SHARES, dtype=torch.float64)).clamp_max(len(ratio) - 1)]
    unit = widths[ONE_STD].clamp_min(1e-6)
    weights[0] += torch.log(unit)
    return weights.float(), (widths / unit).float()


def minimum(x: Tensor, size: Tensor, counts: Tensor) -> Tensor:
    """The weights `[F]` of `calibrate` without bounds, by damped Newton steps."""
    weights = torch.zeros(x.shape[1], dtype=torch.float64)
    weights[0] = torch.log((counts * size).sum().clamp_min(1e-6))
    ridge = 1e-6 * torch.eye(len(weights), dtype=torch.float64)

    def cost(trial: Tensor) -> Tensor:
        log_std = x @ trial
        return (counts * (log_std + size * torch.exp(-log_std))).sum() + 0.5 * trial @ ridge @ trial

    best = cost(weights)
    for _ in range(STEPS):
        ratio = size * torch.exp(-(x @ weights))
        slope = (counts * (1 - ratio)) @ x + ridge @ weights
        step = torch.linalg.solve((x * (counts * ratio)[:, None]).mT @ x + ridge, slope)
        for _ in range(HALVINGS):
            now = cost(weights - step)
            if bool(now <= best):
                break
            step = 0.5 * step
        else:
            break
        weights, gained, best = weights - step, best - now, now
        if float(gained) < 1e-10:
            break
    return weights
