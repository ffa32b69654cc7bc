"""Rays: what arrives at a receiver from point sources, and what an instrument there sees of it.

Pixels near a ray are sought in NumPy: a hundred blocks of pixels are just so many that torch would wake other threads
for each step, which costs more than the step.
"""

import math
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from rf3dgs.core.frames import Pose
from rf3dgs.core.grids import DirectionGrid
from rf3dgs.spectra.spectrum import Instrument

RAY_FIELDS = ("index", "power", "arrival", "departure", "delay", "order", "points")
FARTHEST_LOBES = 3.2  # where a lobe has fallen by 123 dB


@dataclass(frozen=True, eq=False)
class Rays:
    """What arrives at one receiver from k point sources, in the order of the sources.

    index `[k]`: rows of `PointSources.sequence`. power `[k]`: path gains, linear. arrival, departure `[k, 3]`: unit
    vectors from the receiver and from the transmitter. delay `[k]` [s]. order `[k]`: number of reflections. points
    `[k, 3, 3]`: where they happen [m], the receiver beyond the last.
    """

    index: Tensor
    power: Tensor
    arrival: Tensor
    departure: Tensor
    delay: Tensor
    order: Tensor
    points: Tensor

    def __len__(self) -> int:
        return len(self.index)

    def only(self, chosen: Tensor) -> "Rays":
        """Some of the rays: `chosen` is a mask `[k]` or a list of places."""
        return Rays(*(getattr(self, name)[chosen] for name in RAY_FIELDS))

    def shares(self, pose: Pose, grid: DirectionGrid, instrument: Instrument) -> tuple[Tensor, Tensor, Tensor]:
        """What an instrument at one `pose` sees of each ray: place in the flattened grid `[n]`, ray `[n]`, power `[n]`.

        Pixels farther than `FARTHEST_LOBES` from a ray are left out.
        """
        cut, blocks = min(math.pi, FARTHEST_LOBES * instrument.lobe), grid.blocks
        arrival = pose.to_device(self.arrival)
        block, ray = blocks.near(arrival, cut)
        rows = block.numpy()
        apart = blocks.directions.numpy()[rows] - arrival.numpy()[ray.numpy(), :, None]
        chord2 = np.einsum("bip,bip->bp", apart, apart).ravel()
        near = np.flatnonzero(chord2 <= 4.0 * math.sin(0.5 * cut) ** 2)
        angle = torch.from_numpy(2.0 * np.arcsin(np.minimum(0.5 * np.sqrt(chord2[near]), 1.0)))
        place = torch.from_numpy(blocks.pixels.numpy()[rows].ravel()[near])
        ray = ray[torch.from_numpy(near // blocks.pixels.shape[1])]
        return place, ray, instrument.kernel(angle) * self.power[ray]

    def picture(self, pose: Pose, grid: DirectionGrid, instrument: Instrument) -> Tensor:
        """Power `[row, col]`, linear, that the instrument sees at one `pose`."""
        place, _, share = self.shares(pose, grid, instrument)
        return share.new_zeros(grid.shape).flatten().index_add_(0, place, share).reshape(grid.shape)
