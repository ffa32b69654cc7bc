"""Point sources: what reaches a receiver straight from one point, the transmitter first of all.

A point source is a delta that moves with the receiver, which no harmonics on surfaces can follow; its power, delay,
arrival and departure are known in closed form. The transmitter's mirror images are point sources of the same kind.
"""

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from rf3dgs.core.angles import angle_between
from rf3dgs.core.errors import InputError
from rf3dgs.core.frames import Pose
from rf3dgs.core.units import SPEED_OF_LIGHT, friis_gain
from rf3dgs.spectra.peaks import main_peak
from rf3dgs.spectra.spectrum import Instrument, Spectrum
from rf3dgs.splats.obstacles import Obstacles


@dataclass(frozen=True, eq=False)
class PointSource:
    """A source at `position` `[3]` [m]; its waves leave the transmitter at `tx` `[3]`, the same for the line of sight.

    gain_db: level over Friis' free-space gain between isotropic antennas. open_above: the transmittance of the
    segment to the receiver above which the source is seen.
    """

    position: Tensor
    tx: Tensor
    gain_db: float = 0.0
    open_above: float = 0.1

    def distance(self, receiver: Tensor) -> Tensor:
        """Length of the path `[*batch]` [m] to receivers `[*batch, 3]`."""
        return torch.linalg.vector_norm(receiver - self.position, dim=-1).clamp_min(1e-3)

    def delay(self, receiver: Tensor) -> Tensor:
        """Delay D / c `[*batch]` [s]."""
        return self.distance(receiver) / SPEED_OF_LIGHT

    def arrival(self, receiver: Tensor) -> Tensor:
        """Unit vectors `[*batch, 3]` from the receivers towards the source."""
        return torch.nn.functional.normalize(self.position - receiver, dim=-1)

    def departure(self, receiver: Tensor) -> Tensor:
        """Unit vectors `[*batch, 3]` along which the waves leave the transmitter."""
        return -self.arrival(receiver)

    def gain(self, receiver: Tensor, frequency: float) -> Tensor:
        """Path gain `[*batch]`, linear, where nothing is in the way: Friis times `gain_db`."""
        return friis_gain(self.distance(receiver), frequency) * 10.0 ** (self.gain_db / 10.0)

    def visible(self, receiver: Tensor, obstacles: Obstacles) -> Tensor:
        """True `[*batch]` where the segment from the source to the receiver is open."""
        return self.transmittance(receiver, obstacles) > self.open_above

    def transmittance(self, receiver: Tensor, obstacles: Obstacles) -> Tensor:
        """Share `[*batch]` that the Gaussians let through between source and receivers, without end pieces of 10 cm."""
        flat = receiver.reshape(-1, 3)
        start = self.position.expand_as(flat)
        return obstacles.transmittance(start, flat).reshape(receiver.shape[:-1])

    def beam(self, directions: Tensor, receiver: Tensor, instrument: Instrument) -> Tensor:
        """Relative power `[*shape]` seen by an instrument at `receiver` `[3]` along world directions `[*shape, 3]`."""
        return instrument.kernel(angle_between(directions, self.arrival(receiver).expand_as(directions)))


def fit_line_of_sight(source: PointSource, spectra: Spectrum) -> tuple[PointSource, Tensor]:
    """The source with its level fitted to `spectra` `[position, row, col]`, and where the spectra see it `[position]`.

    At each position the beam's power is what stands within half a lobe of the source's direction over the median of
    the ring around it (2 to 4 lobes), solved for by least squares. A position sees the source when that power lies 3 dB
    over the ring and within 6 dB of the median level over Friis of such positions; that median is the fitted level.
    When no position sees the source it keeps its level.
    """
    excess, over_ring = [], []
    centre = spectra.pose.position
    for index in range(len(spectra)):
        one = spectra[index]
        angle = angle_between(one.directions, source.arrival(centre[index]).expand_as(one.directions))
        lobe = spectra.instrument.lobe
        near = angle < max(0.5 * lobe, 0.75 * _pixel(spectra))
        ring = (angle > 2 * lobe) & (angle < 4 * lobe)
        if not bool(near.any()) or not bool(ring.any()):
            excess.append(float("nan"))
            over_ring.append(0.0)
            continue
        level = one.power[ring].double().median()
        kernel = spectra.instrument.kernel(angle[near]).double()
        power = (kernel * (one.power[near].double() - level)).sum() / (kernel * kernel).sum()
        free = friis_gain(source.distance(centre[index]), spectra.frequency).double()
        excess.append(float(10 * torch.log10((power / free).clamp_min(1e-30))))
        over_ring.append(float(power / level.clamp_min(1e-30)))
    level_db, contrast = torch.tensor(excess), torch.tensor(over_ring)
    seen = torch.isfinite(level_db) & (contrast > 2.0)
    if not bool(seen.any()):
        return source, seen
    median = level_db[seen].median()
    seen &= (level_db - median).abs() < 6.0
    return replace(source, gain_db=float(level_db[seen].median())), seen


def fit_opening(source: PointSource, seen: Tensor, positions: Tensor, obstacles: Obstacles) -> PointSource:
    """The source with the transmittance threshold that agrees best with where training spectra see it `[position]`."""
    passed = source.transmittance(positions, obstacles)
    thresholds = torch.tensor([0.1, 0.05, 0.2, 0.02, 0.3, 0.01, 0.5])
    agreement = ((passed[None] > thresholds[:, None]) == seen[None]).sum(-1)
    return replace(source, open_above=float(thresholds[agreement.argmax()]))


def estimate_transmitter(spectra: Spectrum, *, tolerance: float | None = None) -> Pose:
    """Where the transmitter stands, from each position's strongest bearing: RANSAC over all pairs, then least squares.

    `tolerance` [rad] is how far a bearing may point past the transmitter and still count; None is half a lobe or one
    pixel. The pose's orientation is the world's, since bearings do not tell it. Raises InputError for fewer than three
    positions or when fewer than three bearings meet in one point.
    """
    if not spectra.pose.batch_shape or len(spectra) < 3:
        raise InputError("estimating the transmitter needs spectra at three or more positions; give tx instead")
    origin = spectra.pose.position.double()
    bearing = torch.nn.functional.normalize(main_peak(spectra).double(), dim=-1)
    limit = max(0.5 * spectra.instrument.lobe, _pixel(spectra)) if tolerance is None else tolerance
    candidates = _pairwise_meetings(origin, bearing)
    best, most = candidates[0], -1
    for chunk in candidates.split(4096):
        inliers = (_bearing_error(chunk[:, None], origin, bearing) < limit).sum(-1)
        if int(inliers.max()) > most:
            best, most = chunk[int(inliers.argmax())], int(inliers.max())
    if most < 3:
        raise InputError(
            f"the strongest bearings of {len(spectra)} positions do not meet in one point (at most {most} agree within "
            f"{torch.rad2deg(torch.tensor(limit)):.1f} deg); give tx, or spectra that see the transmitter"
        )
    for _ in range(20):
        error = _bearing_error(best[None], origin, bearing)
        spread = error[error < limit].median().clamp_min(1e-4)
        inlier = error < torch.clamp(4 * spread, max=limit)
        best = _closest_point(origin[inlier], bearing[inlier], best)
    return Pose(best.float())


def _pixel(spectra: Spectrum) -> float:
    return 0.0 if spectra.grid.kind == "list" else spectra.grid.spacing


def _bearing_error(point: Tensor, origin: Tensor, bearing: Tensor) -> Tensor:
    towards = point - origin
    return angle_between(towards, bearing.expand_as(towards))


def _pairwise_meetings(origin: Tensor, bearing: Tensor) -> Tensor:
    """Midpoints `[pair, 3]` of the shortest links between all pairs of bearings that converge ahead of both."""
    first, second = torch.triu_indices(len(origin), len(origin), 1)
    if len(first) > 200_000:
        chosen = torch.randperm(len(first), generator=torch.Generator().manual_seed(0))[:200_000]
        first, second = first[chosen], second[chosen]
    link, u, v = origin[second] - origin[first], bearing[first], bearing[second]
    cosine = (u * v).sum(-1)
    sine2 = (1 - cosine * cosine).clamp_min(1e-12)
    along_u = ((link * u).sum(-1) - cosine * (link * v).sum(-1)) / sine2
    along_v = (cosine * (link * u).sum(-1) - (link * v).sum(-1)) / sine2
    usable = (sine2 > 1e-3) & (along_u > 0) & (along_v > 0)
    if not bool(usable.any()):
        raise InputError("the strongest bearings are parallel or diverge; give tx, or spectra from more positions")
    middle = 0.5 * (origin[first] + along_u[:, None] * u + origin[second] + along_v[:, None] * v)
    return middle[usable]


def _closest_point(origin: Tensor, bearing: Tensor, start: Tensor) -> Tensor:
    """The point with the least sum of squared angles: distances from the bearings' lines, weighted by 1 / range^2."""
    across = torch.eye(3, dtype=origin.dtype) - bearing[:, :, None] * bearing[:, None, :]
    weight = 1.0 / (start - origin).square().sum(-1).clamp_min(1e-6)
    normal = (weight[:, None, None] * across).sum(0)
    right = (weight[:, None] * torch.einsum("nij,nj->ni", across, origin)).sum(0)
    return torch.linalg.lstsq(normal, right).solution
