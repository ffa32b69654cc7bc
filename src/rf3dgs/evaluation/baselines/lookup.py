"""Lookup: the nearest training position's spectrum, and the inverse-distance mean of the nearest few.

Both look at where the receiver stands and turn what they copy to the asked orientation; see `copies`.
"""

import torch

from rf3dgs.core.errors import InputError
from rf3dgs.core.frames import Pose
from rf3dgs.core.grids import DirectionGrid
from rf3dgs.evaluation.baselines.copies import Copy, Copying
from rf3dgs.spectra.spectrum import Spectrum


class InverseDistance(Copying):
    """Mean of the `neighbours` nearest training positions, weighted by distance to the power of -`power`.

    Power is averaged linearly; delay and angle of departure are averaged with the power as weight. At a training
    position the answer is that position's spectrum.
    """

    name = "inverse distance"

    def __init__(self, train: Spectrum, *, neighbours: int = 4, power: float = 2.0) -> None:
        super().__init__(train)
        if neighbours < 1:
            raise InputError(f"neighbours must be at least 1; got {neighbours}")
        self.neighbours, self.power = neighbours, power

    def _at(self, pose: Pose, grid: DirectionGrid) -> Copy:
        distance = torch.linalg.vector_norm(self.places.position - pose.position, dim=-1).double()
        nearest = distance.argsort(stable=True)[: self.neighbours]
        if distance[nearest[0]] < 1e-6:
            nearest = nearest[:1]
        weight = distance[nearest].clamp_min(1e-6) ** -self.power
        return self.places.mixed(nearest.tolist(), weight / weight.sum(), pose, grid)


class NearestNeighbour(InverseDistance):
    """A copy of the nearest training position's spectrum, turned to the asked orientation."""

    name = "nearest neighbour"

    def __init__(self, train: Spectrum) -> None:
        super().__init__(train, neighbours=1)
