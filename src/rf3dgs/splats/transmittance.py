"""How much passes along a straight segment through the Gaussians, for visibility between points: the specification.

This is not the alpha of a picture: each Gaussian counts once, with its peak along the segment in closed form.
`splats.obstacles` answers the same question in the native core.
"""

from collections.abc import Iterator, Sequence

import torch
from torch import Tensor

from rf3dgs.core.errors import InputError
from rf3dgs.core.frames import matrix_from_quaternion

CUT = 5.0  # Gaussians further than this many standard deviations from the segment block under 4e-6 and are left out
_PAIRS_PER_CHUNK = 4_000_000


@torch.no_grad()
def segment_transmittance(
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    opacities: Tensor,
    start: Tensor,
    end: Tensor,
    *,
    labels: Tensor | None = None,
    skip_start: Tensor | None = None,
    skip_end: Tensor | None = None,
    stop_short: float = 0.10,
    min_opacity: float = 0.3,
) -> Tensor:
    """Transmittance `[segment]` in 0..1 from `start` to `end` `[segment, 3]` [m]: the product of 1 - o exp(-d^2 / 2).

    o is a Gaussian's opacity and d the least Mahalanobis distance to the segment, from which `stop_short` [m] is cut
    off at both ends so that the surfaces it joins do not hide each other; a segment of no length left is free, one
    that is not finite passes nothing. Gaussians fainter than `min_opacity`, or not finite, are ignored, and so are
    those of `labels` `[gaussian]` that equal the segment's `skip_start` or `skip_end` `[segment]`, where these are
    not negative. The result carries no gradient.
    """
    start, end = _segments(start, end, means.dtype)
    passed = torch.zeros_like(start[:, 0])
    skips = () if labels is None else tuple(skip for skip in (skip_start, skip_end) if skip is not None)
    for segment, gaussian, covered in coverage(
        *(means, quats, scales, opacities >= min_opacity, start, end), labels=labels, skips=skips, stop_short=stop_short
    ):
        passed.index_add_(0, segment, torch.log1p(-opacities[gaussian].clamp_max(1.0) * covered))
    return torch.where(_finite(start, end), torch.exp(passed), 0.0)


def coverage(
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    chosen: Tensor,
    start: Tensor,
    end: Tensor,
    *,
    labels: Tensor | None,
    skips: Sequence[Tensor],
    stop_short: float,
) -> Iterator[tuple[Tensor, Tensor, Tensor]]:
    """Triples (segment, Gaussian, exp(-d^2 / 2)), in parts, of all segments that come near a `chosen` `[gaussian]` one.

    The arguments are those of `segment_transmittance`, of which this is the sum over pairs. It is 0 for a Gaussian
    whose label is one of the segment's `skips` `[segment]`, and for what is not finite or has no length left.
    """
    finite = _finite(start, end)
    start, end = torch.where(finite[:, None], start, 0.0), torch.where(finite[:, None], end, 0.0)
    reach = torch.where(chosen, scales.amax(-1) * CUT, -1.0)
    span = end - start
    length = torch.linalg.vector_norm(span, dim=-1)
    along = span / length.clamp_min(1e-9)[:, None]
    for index in torch.arange(len(start)).split(max(1, _PAIRS_PER_CHUNK // max(1, len(means)))):
        first, direction = start[index], along[index]
        segment, gaussian = _near_pairs(means, reach, first, direction, length[index])
        inverse = matrix_from_quaternion(quats[gaussian]).mT / scales[gaussian].clamp_min(1e-6)[:, :, None]
        offset = (inverse @ (first[segment] - means[gaussian])[..., None]).squeeze(-1)
        step = (inverse @ direction[segment][..., None]).squeeze(-1)
        low = torch.full_like(step[:, 0], stop_short)
        high = length[index][segment] - stop_short
        nearest = -(offset * step).sum(-1) / step.square().sum(-1)
        nearest = torch.minimum(torch.maximum(nearest, low), high)
        distance2 = (offset + nearest[:, None] * step).square().sum(-1)
        sound = torch.isfinite(scales[gaussian]).all(-1) & (quats[gaussian].square().sum(-1) > 1e-24)
        sound &= (high > low) & finite[index][segment]
        covered = torch.where(sound, torch.exp(-0.5 * distance2), 0.0).nan_to_num(0.0)
        for skip in skips:
            assert labels is not None
            of_segment = skip[index][segment]
            covered = torch.where((labels[gaussian] == of_segment) & (of_segment >= 0), 0.0, covered)
        yield index[segment], gaussian, covered


def _segments(start: Tensor, end: Tensor, dtype: torch.dtype) -> tuple[Tensor, Tensor]:
    """Both ends `[segment, 3]`, as many."""
    start, end = torch.broadcast_tensors(torch.atleast_2d(start), torch.atleast_2d(end))
    if start.shape[-1] != 3 or start.dim() != 2:
        raise InputError(f"start and end must be [segment, 3] in metres; got {list(start.shape)}")
    return start.to(dtype), end.to(dtype)


def _finite(start: Tensor, end: Tensor) -> Tensor:
    """Which segments `[segment]` have both ends, and a length, that are finite."""
    return torch.isfinite(torch.linalg.vector_norm(end - start, dim=-1)) & torch.isfinite(start).all(-1)


def _near_pairs(means: Tensor, reach: Tensor, start: Tensor, along: Tensor, length: Tensor) -> tuple[Tensor, Tensor]:
    """Pairs (segment, Gaussian) whose Euclidean distance is below the Gaussian's `reach` `[gaussian]` [m].

    A rounding margin of a millimetre per ten metres is added; negative reaches match nothing.
    """
    centre = start.mean(0)
    means, start = means - centre, start - centre
    projected = along @ means.mT - (along * start).sum(-1, keepdim=True)
    position = torch.minimum(projected.clamp_min(0), length[:, None])
    squared = means.square().sum(-1) - 2 * (start @ means.mT) + start.square().sum(-1, keepdim=True)
    squared += position * (position - 2 * projected)
    limit = torch.where(reach >= 0, (reach + 1e-3) ** 2 + 1e-5 * means.square().sum(-1), -1.0)
    segment, gaussian = torch.nonzero(squared <= limit, as_tuple=True)
    return segment, gaussian
