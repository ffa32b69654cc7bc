"""The Gaussians as obstacles: how much of a straight segment's power they let through, for any number of segments.

What passes is defined in `splats.transmittance`. In the native core the Gaussians stand in a tree, built at the first
question and kept; without the core the specification itself answers.
"""

import math
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
import torch
from torch import Tensor

from rf3dgs.core.errors import InputError
from rf3dgs.core.native import native_core
from rf3dgs.core.threads import thread_count
from rf3dgs.splats.transmittance import coverage, segment_transmittance

SOFT_RADIUS = 0.02  # m
CLEAR = 0.05  # most that a Gaussian may stop of a segment that is known to be free
NEGLIGIBLE, OPAQUE = 1e-3, 0.999  # shares that a Gaussian stops
RAYS = 7  # of a soft gate
FEW = 256  # segments that are answered sooner than other threads wake
_SOFT_CHUNK = 200_000  # segments
LARGEST_LABEL = 2**31 - 2
COMPANY, ALONE = 6, 3.0  # the neighbour that is looked for, and how many times the usual distance is too far


@dataclass(frozen=True, eq=False)
class Obstacles:
    """The Gaussians that stop a ray: means `[N, 3]`, quats `[N, 4]`, scales `[N, 3]` [m] and opacities `[N]` in 0..1.

    labels `[N]` name what a Gaussian belongs to, such as its plane; -1 is nothing. Gaussians fainter than
    `min_opacity`, or not finite, stop nothing. The tensors must not be changed afterwards.
    """

    means: Tensor
    quats: Tensor
    scales: Tensor
    opacities: Tensor
    labels: Tensor | None = None
    min_opacity: float = field(default=0.3, kw_only=True)

    def __post_init__(self) -> None:
        count = len(self.means) if self.means.dim() else 0
        shapes = {"means": (count, 3), "quats": (count, 4), "scales": (count, 3), "opacities": (count,)}
        if self.labels is not None:
            shapes["labels"] = (count,)
        for name, shape in shapes.items():
            got = tuple(getattr(self, name).shape)
            if got != shape:
                text = ", ".join(("gaussian", *(str(size) for size in shape[1:])))
                raise InputError(f"{name} must be [{text}] for {count} Gaussians; got {list(got)}. Reshape it")
        if self.labels is not None and len(self.labels) and int(self.labels.max()) > LARGEST_LABEL:
            raise InputError(f"labels must be at most {LARGEST_LABEL}; got {int(self.labels.max())}. Number them anew")

    def __getstate__(self) -> dict[str, object]:
        return {name: value for name, value in self.__dict__.items() if name != "_tree"}

    def transmittance(
        self,
        start: Tensor,
        end: Tensor,
        *,
        skip_start: Tensor | None = None,
        skip_end: Tensor | None = None,
        stop_short: float = 0.10,
    ) -> Tensor:
        """Share `[segment]` in 0..1 that passes from `start` to `end` `[segment, 3]` [m], without gradient.

        Gaussians labelled `skip_start` or `skip_end` `[segment]` do not stop that segment; -1 skips nothing.
        `stop_short` [m] is cut off at both ends. A segment of no length left is free, one that is not finite passes
        nothing.
        """
        start, end, first, last = self._asked(start, end, skip_start, skip_end, stop_short)
        if self._tree is None:
            return segment_transmittance(
                *(self.means, self.quats, self.scales, self.opacities, start, end),
                labels=self.labels,
                skip_start=first,
                skip_end=last,
                stop_short=stop_short,
                min_opacity=self.min_opacity,
            )
        passed = torch.empty(len(start))
        skips = (None if skip is None else skip.clamp(-1, LARGEST_LABEL + 1).int().numpy() for skip in (first, last))
        threads = 1 if len(start) < FEW else thread_count()
        self._tree.transmittance(_floats(start), _floats(end), *skips, stop_short, passed.numpy(), threads)
        return passed

    @torch.no_grad()
    def cleared(
        self,
        start: Tensor,
        end: Tensor,
        free: Tensor,
        *,
        skip_start: Tensor | None = None,
        skip_end: Tensor | None = None,
        stop_short: float = 0.10,
    ) -> "Obstacles":
        """The obstacles without what stands in segments that are known to be `free` `[segment]`; False says that
        something does stand there. Arguments as of `transmittance`.

        What a segment does not let pass speaks against or for the Gaussians on it, in parts as they stop it. Those
        against which more is said become fainter, until none of them stops more than `CLEAR` of a free segment.
        """
        start, end, *skips = self._asked(start, end, skip_start, skip_end, stop_short)
        if free.shape != (len(start),):
            raise InputError(f"free must be [segment] for {len(start)} segments; got {list(free.shape)}")
        solid = self.opacities >= self.min_opacity
        parts = [
            [column[covered > NEGLIGIBLE] for column in (segment, gaussian, covered)]
            for segment, gaussian, covered in coverage(
                *(self.means, self.quats, self.scales, solid, start.to(self.means.dtype), end.to(self.means.dtype)),
                labels=self.labels,
                skips=[skip for skip in skips if skip is not None],
                stop_short=stop_short,
            )
        ]
        if not parts:
            return self
        segment, gaussian, covered = (torch.cat(column) for column in zip(*parts, strict=True))
        depth = -torch.log1p(-(self.opacities[gaussian] * covered).clamp_max(OPAQUE))
        whole = torch.zeros(len(start)).index_add_(0, segment, depth)
        part = depth / whole[segment] * (1 - torch.exp(-whole[segment]))
        against = torch.where(free[segment], part, -part)
        doubted = torch.zeros_like(self.opacities).index_add_(0, gaussian, against) > 0
        widest = torch.zeros_like(self.opacities)
        widest.scatter_reduce_(0, gaussian, torch.where(free[segment], covered, 0.0), "amax")
        limit = torch.where(doubted, CLEAR / widest.clamp_min(1e-12), 1.0)
        return replace(self, opacities=torch.minimum(self.opacities, limit))

    def without_strays(self) -> "Obstacles":
        """The obstacles without those off all planes that stand alone: what photographs leave hanging in the air.

        The sixth neighbour of such a one is more than three times as far as it usually is off the planes.
        """
        from scipy.spatial import KDTree

        solid = (self.opacities >= self.min_opacity) & torch.isfinite(self.means).all(-1)
        off = solid if self.labels is None else solid & (self.labels < 0)
        if int(solid.sum()) <= COMPANY or not bool(off.any()):
            return self
        distance = KDTree(self.means[solid].numpy()).query(self.means[off].numpy(), k=COMPANY + 1)[0][:, -1]
        stray = off.clone()
        stray[off] = torch.from_numpy(distance > ALONE * np.median(distance))
        return replace(self, opacities=torch.where(stray, 0.0, self.opacities))

    def soft(
        self,
        start: Tensor,
        end: Tensor,
        *,
        radius: float = SOFT_RADIUS,
        skip_start: Tensor | None = None,
        skip_end: Tensor | None = None,
        stop_short: float = 0.10,
    ) -> Tensor:
        """Mean transmittance `[segment]` of the segment and six parallel ones at `radius` [m] around it.

        At a silhouette it falls over the width of the radius. Everything else is as with `transmittance`.
        """
        start, end = _segments(start, end)
        if not 0 <= radius < math.inf:
            raise InputError(f"radius must be a length in metres, 0 or more; got {radius}")
        skips = [self._skip(skip, len(start), name) for skip, name in ((skip_start, "start"), (skip_end, "end"))]
        result = torch.empty(len(start))
        for index in torch.arange(len(start)).split(_SOFT_CHUNK):
            first, last = start[index], end[index]
            shift = _shifts(last - first, radius)
            first_skip, last_skip = (None if skip is None else skip[index].repeat(RAYS) for skip in skips)
            passed = self.transmittance(
                (first + shift).reshape(-1, 3),
                (last + shift).reshape(-1, 3),
                skip_start=first_skip,
                skip_end=last_skip,
                stop_short=stop_short,
            )
            result[index] = sum(passed.reshape(RAYS, -1).unbind(0), torch.zeros(len(index))) / RAYS
        return result

    @cached_property
    def _tree(self) -> Any:
        """The Gaussians in the native core's tree, or None without the core."""
        core = native_core()
        if core is None:
            return None
        labels = None if self.labels is None else self.labels.clamp_min(-1).int().contiguous().numpy()
        shape = (_floats(tensor) for tensor in (self.means, self.quats, self.scales, self.opacities))
        return core.Obstacles(*shape, labels, self.min_opacity)

    def _asked(
        self, start: Tensor, end: Tensor, skip_start: Tensor | None, skip_end: Tensor | None, stop_short: float
    ) -> tuple[Tensor, Tensor, Tensor | None, Tensor | None]:
        """The arguments of a question, checked: both ends `[segment, 3]` and what is skipped `[segment]`."""
        start, end = _segments(start, end)
        if not 0 <= stop_short < math.inf:
            raise InputError(f"stop_short must be a length in metres, 0 or more; got {stop_short}")
        first, last = (self._skip(skip, len(start), name) for skip, name in ((skip_start, "start"), (skip_end, "end")))
        return start, end, first, last

    def _skip(self, skip: Tensor | None, count: int, end: str) -> Tensor | None:
        if skip is None:
            return None
        if self.labels is None:
            raise InputError(f"skip_{end} needs obstacles with labels; these have none. Give labels when they are made")
        if skip.shape != (count,):
            raise InputError(f"skip_{end} must be [segment] for {count} segments; got {list(skip.shape)}")
        return skip.to(torch.long)


def visibility_of(
    obstacles: Obstacles,
    means: Tensor,
    normals: Tensor,
    tx: Tensor,
    labels: Tensor | None = None,
    *,
    lift: float = 0.05,
) -> Tensor:
    """Share `[point]` of the power that reaches surface points `means` `[point, 3]` [m] from `tx` `[3]`.

    A segment starts `lift` [m] off the surface along its normal (`normals` `[point, 3]`, unit, on the side that is
    lit); obstacles with the point's own one of `labels` `[point]` do not hide it.
    """
    if means.shape != normals.shape:
        raise InputError(f"normals must be {list(means.shape)} as the means; got {list(normals.shape)}")
    return obstacles.transmittance(means + lift * normals, tx.reshape(1, 3).expand_as(means), skip_start=labels)


def _floats(tensor: Tensor) -> Any:
    return tensor.detach().to("cpu", torch.float32).contiguous().numpy()


def _segments(start: Tensor, end: Tensor) -> tuple[Tensor, Tensor]:
    start, end = torch.atleast_2d(start), torch.atleast_2d(end)
    if start.dim() != 2 or end.dim() != 2 or start.shape[1] != 3 or end.shape[1] != 3:
        raise InputError(f"start and end must be [segment, 3] in metres; got {list(start.shape)}, {list(end.shape)}")
    if len(start) != len(end) and 1 not in (len(start), len(end)):
        raise InputError(f"start and end must be as many, or one of them one; got {len(start)} and {len(end)}")
    start, end = torch.broadcast_tensors(start, end)
    return start, end


def _shifts(span: Tensor, radius: float) -> Tensor:
    """Shifts `[RAYS, segment, 3]` [m] across each span: none, and the corners of a hexagon of this radius."""
    along = torch.nn.functional.normalize(span, dim=-1)
    least = torch.nn.functional.one_hot(along.abs().argmin(-1), 3).to(along.dtype)
    across = torch.nn.functional.normalize(torch.linalg.cross(along, least, dim=-1), dim=-1)
    up = torch.linalg.cross(along, across, dim=-1)
    turns = torch.arange(RAYS - 1) * (2 * math.pi / (RAYS - 1))
    corners = radius * (turns.cos()[:, None, None] * across + turns.sin()[:, None, None] * up)
    return torch.cat((torch.zeros_like(corners[:1]), corners))
