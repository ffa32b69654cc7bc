"""Where the transmitter stands, from the bearings of what it sends straight to many positions."""

import torch
from torch import Tensor

from rf3dgs.core.angles import angle_between
from rf3dgs.core.errors import InputError
from rf3dgs.core.frames import Pose
from rf3dgs.spectra.peaks import main_peak
from rf3dgs.spectra.spectrum import Spectrum


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
    limit = max(0.5 * spectra.instrument.lobe, pixel_of(spectra)) if tolerance is None else tolerance
    candidates = pairwise_meetings(origin, bearing)
    best, most = candidates[0], -1
    for chunk in candidates.split(4096):
        inliers = (bearing_error(chunk[:, None], origin, bearing) < limit).sum(-1)
        if int(inliers.max()) > most:
            best, most = chunk[int(inliers.argmax())], int(inliers.max())
    if most < 3:
        raise InputError(
            f"the strongest bearings of {len(spectra)} positions do not meet in one point (at most {most} agree within "
            f"{torch.rad2deg(torch.tensor(limit)):.1f} deg); give tx, or spectra that see the transmitter"
        )
    for _ in range(20):
        error = bearing_error(best[None], origin, bearing)
        spread = error[error < limit].median().clamp_min(1e-4)
        inlier = error < torch.clamp(4 * spread, max=limit)
        best = closest_point(origin[inlier], bearing[inlier], best)
    return Pose(best.float())


def pixel_of(spectra: Spectrum) -> float:
    """The angle [rad] between the pixels of spectra; 0 for lists of directions."""
    return 0.0 if spectra.grid.kind == "list" else spectra.grid.spacing


def bearing_error(point: Tensor, origin: Tensor, bearing: Tensor) -> Tensor:
    """Angles [rad] by which bearings `[n, 3]` from origins `[n, 3]` miss points `[*batch, 1, 3]`, `[*batch, n]`."""
    towards = point - origin
    return angle_between(towards, bearing.expand_as(towards))


def pairwise_meetings(origin: Tensor, bearing: Tensor) -> Tensor:
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


def closest_point(origin: Tensor, bearing: Tensor, start: Tensor) -> Tensor:
    """The point with the least sum of squared angles: distances from the bearings' lines, weighted by 1 / range^2."""
    across = torch.eye(3, dtype=origin.dtype) - bearing[:, :, None] * bearing[:, None, :]
    weight = 1.0 / (start - origin).square().sum(-1).clamp_min(1e-6)
    normal = (weight[:, None, None] * across).sum(0)
    right = (weight[:, None] * torch.einsum("nij,nj->ni", across, origin)).sum(0)
    return torch.linalg.lstsq(normal, right).solution
