"""Line of sight: the free-space path from a transmitter that is known, and nothing else."""

import torch

from rf3dgs.core.errors import InputError
from rf3dgs.core.frames import Pose
from rf3dgs.core.grids import DirectionGrid
from rf3dgs.core.units import SPEED_OF_LIGHT
from rf3dgs.field.sources import PointSources
from rf3dgs.spectra.spectrum import Instrument, Spectrum, stack_spectra
from rf3dgs.splats.obstacles import Obstacles


class LineOfSight:
    """One path from `tx` with Friis' gain between isotropic antennas (paper eq. 10), as the instrument shows it.

    Nothing is learned. With `obstacles` a receiver that does not see the transmitter gets no power at all; without them
    every one sees it. Delay and angle of departure are those of the straight way in every direction.
    """

    name = "line of sight"

    def __init__(self, tx: Pose, frequency: float, instrument: Instrument, obstacles: Obstacles | None = None) -> None:
        self.tx, self.frequency, self.instrument = tx, frequency, instrument
        self.in_sight = torch.ones(1, dtype=torch.bool) if obstacles is None else None
        self.obstacles = _nothing() if obstacles is None else obstacles
        self.source = PointSources.line_of_sight(tx.position, frequency)

    @classmethod
    def of(cls, spectra: Spectrum, obstacles: Obstacles | None = None) -> "LineOfSight":
        """With the transmitter, frequency and instrument that spectra name; InputError without a transmitter."""
        if spectra.tx is None:
            raise InputError("the line of sight needs spectra that name their transmitter; give tx")
        return cls(spectra.tx, spectra.frequency, spectra.instrument, obstacles)

    def render(self, pose: Pose, grid: DirectionGrid) -> Spectrum:
        """The spectrum on `grid` at one pose, or `[n, row, col]` at n poses."""
        if pose.batch_shape:
            return stack_spectra([self.render(pose[index], grid) for index in range(len(pose))])
        away = pose.position - self.tx.position
        distance = torch.linalg.vector_norm(away)
        rays = self.source.arrivals(pose.position[None], self.obstacles, in_sight=self.in_sight)[1]
        power = rays.picture(pose, grid, self.instrument).float()
        delay = torch.full(grid.shape, float(distance) / SPEED_OF_LIGHT)
        aod = (away / distance.clamp_min(1e-6)).expand(*grid.shape, 3)
        return Spectrum(power, grid, pose, self.frequency, self.instrument, self.name, delay, aod, self.tx)


def _nothing() -> Obstacles:
    return Obstacles(torch.zeros(0, 3), torch.zeros(0, 4), torch.zeros(0, 3), torch.zeros(0))
