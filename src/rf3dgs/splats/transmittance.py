"""How much passes along a straight segment through the Gaussians, for visibility between points: the specification.

This is not the alpha of a picture: each Gaussian counts once, with its peak along the segment in closed form.
`splats.obstacles` answers the same question in the native core.
"""

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
    start, end = torch.broadcast_tensors(torch.atleast_2d(start), torch.atleast_2d(end))
    if start.shape[-1] != 3 or start.dim() != 2:
        raise InputError(f"start and end must be [segment, 3] in metres; got {list(start.shape)}")
    start, end = start.to(means.dtype), end.to(means.dtype)
    span = end - start
    length = torch.linalg.vector_norm(span, dim=-1)
    finite = torch.isfinite(length) & torch.isfinite(start).all(-1)
    start, span = torch.where(finite[:, None], start, 0.0), torch.where(finite[:, None], span, 0.0)
    length = torch.where(finite, length, 0.0)
    along = span / length.clamp_min(1e-9)[:, None]
    sound = torch.isfinite(torch.cat((means, quats, scales), -1)).all(-1) & (quats.square().sum(-1) > 1e-24)
    reach = torch.where(sound & (opacities >= min_opacity), scales.amax(-1) * CUT, -1.0)
    means = torch.where(sound[:, None], means, 0.0)
    result = torch.ones_like(length)
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
        blocked = opacities[gaussian].clamp_max(1.0) * torch.exp(-0.5 * distance2)
        blocked = torch.where(high > low, blocked, 0.0).nan_to_num(0.0)
        if labels is not None:
            for skip in (skip_start, skip_end):
                if skip is not None:
                    of_segment = skip[index][segment]
                    blocked = torch.where((labels[gaussian] == of_segment) & (of_segment >= 0), 0.0, blocked)
        passed = torch.zeros_like(result[index]).index_add_(0, segment, torch.log1p(-blocked))
        result[index] = torch.exp(passed)
    return torch.where(finite, result, 0.0)


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
