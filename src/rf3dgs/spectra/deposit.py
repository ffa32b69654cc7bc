"""Paths put on the nodes of a fine sphere, each on the four around it: power, power x delay, power x departure."""

import math

import numpy as np
import torch
from torch import Tensor

from rf3dgs.core.angles import angles_of
from rf3dgs.core.native import native_core
from rf3dgs.core.threads import thread_count

CHANNELS = 5


def values_of(gain: Tensor, delay: Tensor, departures: Tensor) -> Tensor:
    """Gain, gain x delay and gain x departure vector `[path, 5]`, float64."""
    gain = gain.double()[:, None]
    return torch.cat((gain, gain * delay[:, None], gain * departures), -1)


def deposited(
    directions: Tensor, gain: Tensor, delay: Tensor, departures: Tensor, sphere: tuple[int, int, int]
) -> Tensor:
    """Bilinear deposit of `values_of` onto the nodes of a sphere of (rows, columns, fold): `[5, rows, columns]`.

    In the native core where there is one; `deposit` is its specification.
    """
    rows, columns, fold = sphere
    core = native_core()
    if core is None:
        return deposit(directions, values_of(gain, delay, departures), sphere)
    total = torch.empty(CHANNELS, rows, columns, dtype=torch.float64)
    arrays = (value.float().contiguous().numpy() for value in (directions, gain, delay, departures))
    core.deposit_paths(*arrays, fold, total.numpy(), thread_count())
    return total


def deposit(directions: Tensor, values: Tensor, sphere: tuple[int, int, int]) -> Tensor:
    """Bilinear deposit of `values` `[path, 5]` onto the nodes of a sphere of (rows, columns, fold), in NumPy."""
    rows, columns, fold = sphere
    zenith, azimuth = (angle.double().numpy() for angle in angles_of(directions))
    y = zenith * (rows / math.pi) - 0.5
    x = (math.pi - azimuth) * (columns / (2 * math.pi)) - 0.5 * fold
    row, column = np.floor(y), np.floor(x)
    down, right = y - row, x - column
    channels = np.ascontiguousarray(values.numpy().T)
    total = np.zeros((CHANNELS, rows * columns))
    for i, row_weight in ((0, 1 - down), (1, down)):
        at_row = np.clip(row.astype(np.int64) + i, 0, rows - 1) * columns
        for j, weight in ((0, row_weight * (1 - right)), (1, row_weight * right)):
            node = at_row + (column.astype(np.int64) + j) % columns
            for channel in range(CHANNELS):
                total[channel] += np.bincount(node, channels[channel] * weight, rows * columns)
    return torch.from_numpy(total.reshape(CHANNELS, rows, columns))
