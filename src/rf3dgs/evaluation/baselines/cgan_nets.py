"""The two networks of the conditional GAN, and the picture of a pose that both are shown.

Isola, Zhu, Zhou and Efros, "Image-to-Image Translation with Conditional Adversarial Networks" (pix2pix), CVPR 2017:
a U-Net makes the picture, a discriminator judges patches of it beside what it was made from. Where pix2pix has a
source picture, here is a picture of the pose. Pictures are `[picture, channel, row, col]`; those of whole spheres are
continued around the vertical axis, those of pinholes with zeros.
"""

import math
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from rf3dgs.core.frames import Pose
from rf3dgs.core.grids import DirectionGrid
from rf3dgs.evaluation.baselines.cgan_config import CganConfig

LEAK = 0.2  # slope of the leaky rectifiers
FIRST_STD = 0.02  # of the first weights
WIDEST = 8  # times the width
DROPPED = 3  # layers of the way up with dropout


@dataclass(frozen=True, eq=False)
class PoseCode:
    """How a pose becomes a picture: `low` and `high` `[3]` [m] are the box of the training positions."""

    low: Tensor
    high: Tensor
    octaves: int

    @property
    def channels(self) -> int:
        return 6 + 6 * self.octaves

    def picture(self, pose: Pose, grid: DirectionGrid) -> Tensor:
        """`[picture, channel, row, col]` of poses `[picture]`: each pixel's direction in the world, then the position,
        -1 to 1 in the box, with sines and cosines of pi, 2 pi, 4 pi, ... times it."""
        world = torch.einsum("nij,rcj->nirc", pose.world_from_device, grid.directions)
        place = 2 * (pose.position - self.low) / (self.high - self.low).clamp_min(1e-3) - 1
        waves = [math.pi * 2**octave * place for octave in range(self.octaves)]
        numbers = torch.cat([place, *(wave for angle in waves for wave in (angle.sin(), angle.cos()))], -1)
        return torch.cat((world, numbers[..., None, None].expand(*numbers.shape, *grid.shape)), 1)


class Generator(nn.Module):
    """A U-Net from the picture of a pose `[n, channel, row, col]` to the spectrum's `[n, 1, row, col]`, -1 to 1."""

    def __init__(self, channels: int, config: CganConfig, grid: DirectionGrid) -> None:
        super().__init__()
        self.around = grid.kind == "equirect"
        depth = max(1, min(config.depth, int(math.log2(min(grid.shape))) - 1))
        widths = [config.width * min(2**level, WIDEST) for level in range(depth)]
        self.down, self.up = nn.ModuleList(), nn.ModuleList()
        for level, width in enumerate(widths):
            below = channels if level == 0 else widths[level - 1]
            self.down.append(_layer(nn.Conv2d(below, width, 4, 2), normed=0 < level < depth - 1))
            inwards = width if level == depth - 1 else 2 * width
            outwards = 1 if level == 0 else widths[level - 1]
            drop = config.dropout if level >= max(1, depth - DROPPED) else 0.0
            self.up.append(_layer(nn.ConvTranspose2d(inwards, outwards, 4, 2, 1), normed=level > 0, dropout=drop))
        self.apply(_first_weights)

    def forward(self, pose_picture: Tensor) -> Tensor:
        skips, value = [], pose_picture
        for level, down in enumerate(self.down):
            skips.append(value)
            value = down(_padded(value if level == 0 else nn.functional.leaky_relu(value, LEAK), self.around))
        for level in reversed(range(len(self.up))):
            height, width = skips[level].shape[-2:]
            value = self.up[level](_padded(nn.functional.relu(value), self.around))
            value = value[..., 2 : 2 + height, 2 : 2 + width]
            if level > 0:
                value = torch.cat((value, skips[level]), 1)
        return torch.tanh(value)


class Discriminator(nn.Module):
    """Logits `[n, 1, row, col]`, one a patch, that a picture `[n, 1, row, col]` is the true one of its pose."""

    def __init__(self, channels: int, config: CganConfig, grid: DirectionGrid) -> None:
        super().__init__()
        self.around = grid.kind == "equirect"
        depth = max(1, min(config.critic_depth, int(math.log2(min(grid.shape))) - 2))
        widths = [config.critic_width * min(2**level, WIDEST) for level in range(depth + 1)]
        self.layers, below = nn.ModuleList(), channels + 1
        for level, width in enumerate(widths):
            self.layers.append(_layer(nn.Conv2d(below, width, 4, 2 if level < depth else 1), normed=level > 0))
            below = width
        self.layers.append(nn.Conv2d(below, 1, 4))
        self.apply(_first_weights)

    def forward(self, pose_picture: Tensor, picture: Tensor) -> Tensor:
        value = torch.cat((pose_picture, picture), 1)
        for level, layer in enumerate(self.layers):
            value = layer(_padded(value if level == 0 else nn.functional.leaky_relu(value, LEAK), self.around))
        return value


def _layer(convolution: nn.Conv2d | nn.ConvTranspose2d, *, normed: bool, dropout: float = 0.0) -> nn.Sequential:
    parts: list[nn.Module] = [convolution]
    if normed:
        parts.append(nn.BatchNorm2d(convolution.out_channels))
    if dropout > 0:
        parts.append(nn.Dropout(dropout))
    return nn.Sequential(*parts)


def _padded(value: Tensor, around: bool) -> Tensor:
    """One more pixel on every side: beside it what follows around the sphere, or zero; above and below zero."""
    if around:
        value = torch.cat((value[..., -1:], value, value[..., :1]), -1)
    return nn.functional.pad(value, (0, 0, 1, 1) if around else (1, 1, 1, 1))


def _first_weights(module: nn.Module) -> None:
    if isinstance(module, nn.Conv2d | nn.ConvTranspose2d):
        nn.init.normal_(module.weight, 0.0, FIRST_STD)
        if module.bias is not None:
            nn.init.zeros_(module.bias)
    elif isinstance(module, nn.BatchNorm2d):
        nn.init.normal_(module.weight, 1.0, FIRST_STD)
