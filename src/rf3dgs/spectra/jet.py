"""Levels as jet colours, as the published RF-3DGS pictures have them, and back by the nearest colour.

Jet is a way through the cube of colours from dark blue over cyan and yellow to dark red. Along it one or two colours
change at a time, three to five times as fast as the level; colours far apart in level are never more than the cube's
width apart. So an error of a level looks larger in jet while it is small, and smaller when it is large.
"""

from functools import cache

import numpy as np
import torch
from scipy.spatial import KDTree
from torch import Tensor

LEVELS = 256


def jet_picture(level: Tensor) -> Tensor:
    """Jet colours `[*shape, 3]` in 0..1 of levels `[*shape]`, both in 8 bits; levels are clipped to 0..1.

    The map is matplotlib's.
    """
    index = (level.clamp(0.0, 1.0) * (LEVELS - 1)).round().long()
    return torch.from_numpy(_palette()).float()[index]


def jet_level(picture: Tensor) -> Tensor:
    """Levels `[*shape]` in 0..1 of colours `[*shape, 3]`: each that of the nearest of the map's colours.

    Near 0.12 the map stands still: five neighbours have one colour, which is read as the middle one.
    """
    tree, levels = _nearest()
    return torch.from_numpy(levels[tree.query(picture.detach().double().numpy())[1]]).float()


def jet_steepness(level: Tensor) -> Tensor:
    """Mean square change `[*shape]` of the three colours per change of the level: how small square errors grow in jet.

    Levels `[*shape]` are clipped to 0..1. The mean over all levels is 6.2: while errors are small the PSNR of jet
    pictures is some 8 dB below that of the levels.
    """
    index = (level.clamp(0.0, 1.0) * (LEVELS - 1)).round().long()
    return torch.from_numpy(_steepness()).float()[index]


@cache
def _palette() -> np.ndarray:
    """The map's colours `[256, 3]` in 0..1, rounded to 8 bits."""
    return np.round(_map() * 255.0) / 255.0


@cache
def _nearest() -> tuple[KDTree, np.ndarray]:
    """The map's distinct colours, to be searched, and the mean level of each."""
    colours, which, count = np.unique(_palette(), axis=0, return_inverse=True, return_counts=True)
    return KDTree(colours), np.bincount(which.ravel(), weights=np.linspace(0.0, 1.0, LEVELS)) / count


@cache
def _steepness() -> np.ndarray:
    return np.mean(np.gradient(_map(), 1.0 / (LEVELS - 1), axis=0) ** 2, axis=-1)


def _map() -> np.ndarray:
    from matplotlib import colormaps

    return colormaps["jet"](np.linspace(0.0, 1.0, LEVELS))[:, :3]
