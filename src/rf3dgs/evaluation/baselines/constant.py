"""Constant: the mean training spectrum, by direction in the world, wherever the receiver stands."""

from collections.abc import Sequence

import torch
from torch import Tensor

from rf3dgs.core.errors import InputError
from rf3dgs.core.frames import Pose
from rf3dgs.core.grids import DirectionGrid
from rf3dgs.evaluation.baselines.copies import Copy, Copying, channels_of, turned
from rf3dgs.spectra.spectrum import Spectrum

SAME_TURN = 1e-5  # of the entries of two rotations that are one


class Constant(Copying):
    """The mean of all training spectra that have seen a direction of the world.

    Power is averaged linearly, delay and angle of departure with the power as weight. Pictures of one orientation are
    averaged once and for all.
    """

    name = "constant"

    def __init__(self, train: Spectrum) -> None:
        if not train.pose.batch_shape or len(train) == 0:
            raise InputError("the constant needs training spectra with a pose axis and at least one position")
        groups = _by_orientation(train.pose)
        super().__init__(_means(train, groups))
        self.counts = torch.tensor([float(len(group)) for group in groups], dtype=torch.float64)

    def _at(self, pose: Pose, grid: DirectionGrid) -> Copy:
        if len(self.counts) == 1:
            return self.places.copy(0, pose, grid)
        return turned(self.train, range(len(self.counts)), pose, grid, self.counts)


def _by_orientation(pose: Pose) -> list[Tensor]:
    """The views `[n]` of each orientation."""
    left, groups = torch.arange(len(pose)), []
    turns = pose.world_from_device
    while len(left):
        same = (turns[left] - turns[left[0]]).abs().amax((-2, -1)) < SAME_TURN
        groups.append(left[same])
        left = left[~same]
    return groups


def _means(train: Spectrum, groups: Sequence[Tensor]) -> Spectrum:
    """One picture `[group, row, col]` for each orientation: the mean of its views."""
    first = torch.tensor([int(group[0]) for group in groups])
    total = torch.stack([channels_of(train[group]).mean(0) for group in groups])
    power = total[..., 0]
    part = total[..., 1:] / power.clamp_min(1e-300)[..., None]
    middle = train.pose.position.mean(0).expand(len(groups), 3)
    delay = None if train.delay is None else part[..., 0].float()
    aod = None if train.aod is None else torch.nn.functional.normalize(part[..., 1:], dim=-1).float()
    pose = Pose(middle, train.pose.orientation[first])
    tail = (train.frequency, train.instrument, train.method, delay, aod, train.tx)
    return Spectrum(power.float(), train.grid, pose, *tail)
