"""PSNR and SSIM of coloured pictures, in which the paper reports its quality, and how they relate to those of levels.

An error e of a level changes the jet colours by about e times their steepness there, so that while errors are small

    PSNR(jet) = PSNR(level) - 10 log10(mean steepness)

which is some 8 dB lower. No error changes a colour by more than 1, so that large errors cost less in jet than this
says, and the scale's two ends, both dark, are nearer to each other than to its middle.
"""

import math

import torch
from torch import Tensor

from rf3dgs.core.grids import DirectionGrid
from rf3dgs.evaluation import metrics
from rf3dgs.spectra.jet import jet_steepness


def colour_psnr(truth: Tensor, prediction: Tensor, weight: Tensor) -> Tensor:
    """PSNR `[*batch]` [dB] of pictures `[*batch, row, col, channel]` in 0..1, of the channels' mean square error.

    `weight` `[row, col]` sums to 1.
    """
    channels = truth.shape[-1]
    weight = weight.repeat_interleave(channels, -1) / channels
    return metrics.psnr(truth.flatten(-2), prediction.flatten(-2), weight)


def colour_ssim(truth: Tensor, prediction: Tensor, grid: DirectionGrid) -> Tensor:
    """SSIM `[*batch]` of pictures `[*batch, row, col, channel]` in 0..1: the mean of the channels' own."""
    each = [metrics.ssim(a, b, grid) for a, b in zip(truth.unbind(-1), prediction.unbind(-1), strict=True)]
    return torch.stack(each).mean(0)


def jet_gap_db(level: Tensor) -> float:
    """How far [dB] the PSNR of jet pictures is below that of their levels `[*shape]` while errors are small."""
    return 10.0 * math.log10(float(jet_steepness(level).double().mean()))
