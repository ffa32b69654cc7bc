"""Path loss as a predictor: a formula says how much arrives, and nobody says from where.

The power is the same in all directions, so of all scores only path gain (and what follows from the level alone) means
something. It is spread over the solid angle that the training pictures of one position see together: over the whole
sphere of spherical pictures, or over the four pinholes of a position. The path gains of a position's pictures then add
up to the formula's.
"""

from collections.abc import Callable

import torch
from torch import Tensor

from rf3dgs.channel.path_loss import LogDistance, fit_log_distance
from rf3dgs.core.errors import InputError
from rf3dgs.core.frames import Pose
from rf3dgs.core.grids import DirectionGrid
from rf3dgs.core.units import power_from_db
from rf3dgs.data.split import places_of
from rf3dgs.spectra.spectrum import Spectrum

Loss = Callable[[Tensor, Tensor], Tensor]
"""Loss [dB] `[n]` between the transmitter's position `[3]` and receivers' `[n, 3]` [m]."""


class PathLossPredictor:
    """Spectra that are the same in every direction, at the level that `loss` says of the receiver's position.

    Of the training spectra only transmitter, instrument and grid are used. What `loss` refuses at a training position
    it refuses here; InputError also where the transmitter is not known.
    """

    def __init__(self, train: Spectrum, loss: Loss, *, name: str = "path loss") -> None:
        self.name, self.loss = name, loss
        self.frequency, self.instrument, self.tx = train.frequency, train.instrument, transmitter_of(train)
        self.covered = solid_angle_of_a_place(train)
        loss(self.tx.position, train.pose.position.reshape(-1, 3))

    def render(self, pose: Pose, grid: DirectionGrid) -> Spectrum:
        """The spectrum `[row, col]` at one pose, or `[n, row, col]` at n poses; without delay and departure."""
        gain = power_from_db(-self.loss(self.tx.position, pose.position.reshape(-1, 3))).reshape(pose.batch_shape)
        level = gain * (self.instrument.beam_solid_angle / self.covered)
        power = level[..., None, None].expand(*pose.batch_shape, *grid.shape).float().contiguous()
        return Spectrum(power, grid, pose, self.frequency, self.instrument, self.name, tx=self.tx)


def log_distance_of(train: Spectrum) -> LogDistance:
    """The log-distance line through the path gains of the training positions, pictures of one position summed."""
    tx = transmitter_of(train)
    place, first = (torch.from_numpy(values) for values in places_of(train.pose.position))
    gain = torch.zeros(len(first), dtype=torch.float64).index_add_(0, place, train.path_gain.double())
    distance = torch.linalg.vector_norm(train.pose.position[first] - tx.position, dim=-1)
    return fit_log_distance(distance, gain)


def transmitter_of(train: Spectrum) -> Pose:
    """The transmitter's pose; InputError where the spectra do not know it."""
    if train.tx is None:
        raise InputError("this baseline needs the transmitter's position, which the training spectra do not have")
    return train.tx


def solid_angle_of_a_place(train: Spectrum) -> float:
    """Solid angle [sr] that the pictures of a training position see together, on average over the positions."""
    if not train.pose.batch_shape or len(train) == 0:
        raise InputError("a baseline needs training spectra with a pose axis and at least one position")
    pictures = len(train) / len(places_of(train.pose.position)[1])
    covered = pictures * float(train.grid.solid_angle.sum())
    if not covered > 0:
        raise InputError("the training grid has no solid angles to spread power over; use a pinhole or a sphere")
    return covered
