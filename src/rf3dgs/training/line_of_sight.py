"""The straight way from the transmitter, and what stands out of a spectrum in any direction."""

import math
from dataclasses import replace

import torch
from torch import Tensor

from rf3dgs.core.angles import angle_between
from rf3dgs.core.units import friis_gain
from rf3dgs.field.sources import PointSources
from rf3dgs.field.transmitter import pixel_of
from rf3dgs.spectra.spectrum import Spectrum
from rf3dgs.splats.obstacles import Obstacles

THRESHOLDS = (0.1, 0.05, 0.2, 0.02, 0.3, 0.01, 0.5)
SEEN_OVER_RING = 2.0
SAME_LEVEL_DB = 6.0
ROUNDING = 1e-5


def standing_out(one: Spectrum, direction: Tensor) -> tuple[float, float]:
    """Power of a beam along `direction` `[3]` (world) in a spectrum `[row, col]`, and the level around it, linear.

    The level is the median of the ring of 2 to 4 lobes; the beam's power is what stands over it within half a lobe, by
    least squares, and may be negative. Both are NaN where the instrument does not look there.
    """
    lobe = one.instrument.lobe
    along = one.grid.directions.reshape(-1, 3)
    reach = min(max(4 * lobe, pixel_of(one)) + ROUNDING, math.pi)
    around = torch.nonzero(along @ one.pose.to_device(direction) >= math.cos(reach) - ROUNDING).squeeze(-1)
    world = one.pose.to_world(along[around])
    angle = angle_between(world, direction.expand_as(world))
    angle, heard = torch.where(one.looked.reshape(-1)[around], angle, torch.inf), one.heard.reshape(-1)[around]
    near = angle < max(0.5 * lobe, 0.75 * pixel_of(one))
    ring = (angle > 2 * lobe) & (angle < 4 * lobe)
    if not bool(near.any()) or not bool(ring.any()):
        return float("nan"), float("nan")
    level = heard[ring].double().median()
    kernel = one.instrument.kernel(angle[near]).double()
    power = (kernel * (heard[near].double() - level)).sum() / (kernel * kernel).sum()
    return float(power), float(level)


def fit_line_of_sight(sources: PointSources, spectra: Spectrum) -> tuple[PointSources, Tensor]:
    """The sources with their level fitted to `spectra` `[position, row, col]`, and who sees the transmitter.

    A position sees it when what stands out in its direction lies 3 dB over the ring and within 6 dB of the median
    level over Friis of such positions; that median is the fitted level. When nobody sees it the level stays.
    """
    straight = sources.tx - spectra.pose.position
    distance = torch.linalg.vector_norm(straight, dim=-1).clamp_min(1e-3)
    found = [standing_out(spectra[index], straight[index] / distance[index]) for index in range(len(spectra))]
    power, ring = torch.tensor(found, dtype=torch.float64).reshape(-1, 2).unbind(-1)
    level_db = 10 * torch.log10((power / friis_gain(distance, spectra.frequency).double()).clamp_min(1e-30)).float()
    seen = torch.isfinite(level_db) & (power / ring.clamp_min(1e-30) > SEEN_OVER_RING)
    if not bool(seen.any()):
        return sources, seen
    median = level_db[seen].median()
    seen &= (level_db - median).abs() < SAME_LEVEL_DB
    return replace(sources, level_db=float(level_db[seen].median())), seen


def fit_opening(sources: PointSources, seen: Tensor, positions: Tensor, obstacles: Obstacles) -> PointSources:
    """The sources with the threshold of transmittance that agrees best with who sees the transmitter `[position]`."""
    passed = obstacles.transmittance(sources.tx.expand_as(positions), positions)
    thresholds = torch.tensor(THRESHOLDS)
    agreement = ((passed[None] > thresholds[:, None]) == seen[None]).sum(-1)
    return replace(sources, open_above=float(thresholds[agreement.argmax()]))
