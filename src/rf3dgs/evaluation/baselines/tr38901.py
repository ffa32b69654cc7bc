"""3GPP TR 38.901, indoor office, as a predictor: what standards expect of a room that nobody has seen."""

import math
from dataclasses import replace

import torch

from rf3dgs.channel.cdl import cdl_paths, indoor_office_spreads, scaled_rays
from rf3dgs.channel.path_loss import open_office_sight, tr38901_indoor_loss
from rf3dgs.core.frames import Pose
from rf3dgs.core.grids import DirectionGrid
from rf3dgs.core.units import SPEED_OF_LIGHT, power_from_db
from rf3dgs.evaluation.baselines.path_loss import transmitter_of
from rf3dgs.spectra.scan import spectrum_of
from rf3dgs.spectra.spectrum import Spectrum


class IndoorOffice:
    """Spectra of CDL-D, or CDL-A where no line of sight is likelier, with the indoor office's path loss and medians.

    A line of sight is taken where its probability in the open office is at least a half. The line of sight is the true
    one; where the other clusters come from has nothing to do with the site. No shadowing is drawn: medians are the best
    guess. Of the training spectra only frequency, transmitter and lobe are used. InputError at frequencies and
    distances that the standard has no values for, and where the transmitter is not known.
    """

    name = "TR 38.901 InH"

    def __init__(self, train: Spectrum, *, seed: int = 0) -> None:
        self.tx, self.frequency, self.lobe, self.seed = (
            transmitter_of(train),
            train.frequency,
            train.instrument.lobe,
            seed,
        )
        seen, hidden = (indoor_office_spreads(train.frequency, line_of_sight=sight) for sight in (True, False))
        self.rays = {True: scaled_rays("CDL-D", seen, seed=seed), False: scaled_rays("CDL-A", hidden, seed=seed)}
        distance = torch.linalg.vector_norm(train.pose.position.reshape(-1, 3) - self.tx.position, dim=-1)
        tr38901_indoor_loss(distance, train.frequency)

    def sees(self, pose: Pose) -> bool:
        """Whether the transmitter is taken to be in sight at one pose."""
        flat = math.dist(pose.position[:2].tolist(), self.tx.position[:2].tolist())
        return float(open_office_sight(torch.tensor(flat))) >= 0.5

    def render(self, pose: Pose, grid: DirectionGrid) -> Spectrum:
        """The spectrum `[row, col]` at one pose; delay and departure are the straight way's where nothing arrives."""
        sight = self.sees(pose)
        distance = torch.linalg.vector_norm(pose.position - self.tx.position)
        gain = power_from_db(-tr38901_indoor_loss(distance, self.frequency, line_of_sight=sight))
        paths = cdl_paths(self.rays[sight], self.tx, pose, self.frequency, gain, seed=self.seed)
        seen = spectrum_of(paths, None, grid, lobe=self.lobe)
        assert seen.delay is not None
        assert seen.aod is not None
        dark, straight = seen.power == 0, (pose.position - self.tx.position) / distance
        delay = torch.where(dark, distance / SPEED_OF_LIGHT, seen.delay)
        aod = torch.where(dark[..., None], straight, seen.aod)
        return replace(seen, method=self.name, delay=delay, aod=aod)
