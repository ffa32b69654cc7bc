"""Level of detail: fewer Gaussians where no receiver can tell them apart.

`prune_unseen` removes what shows in no picture; `level_of_detail` merges neighbours that fall into one pixel at the
nearest receiver, or into a few where a surface goes on in all directions. Whoever had harmonics before or gets some
after can carry them both ways: a `Detail` remembers where each Gaussian went.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from rf3dgs.core.errors import InputError
from rf3dgs.core.frames import matrix_from_quaternion, quaternion_from_matrix
from rf3dgs.core.grids import View
from rf3dgs.splats.backends.native import raise_to_weights_native
from rf3dgs.splats.cells import shared_cells
from rf3dgs.splats.gaussians import Gaussians
from rf3dgs.splats.rasterize import Backend, pick_backend, rasterize
from rf3dgs.splats.surface import normals

DENSEST = 0.99  # largest opacity of a merged Gaussian, as of any in a picture; what does not fit in makes it wider
WIDEST = 2.4  # by at most this factor: members that fill a square deviate by 0.29 of its side, and squares side by side
# hide what is behind them when the Gaussians in them deviate by 0.7
CHANNELS = 64  # of a picture that shows one Gaussian in each
NEAREST = 0.5  # the margin of new positions takes at most this share of a distance


@dataclass(frozen=True, eq=False)
class Detail:
    """Fewer `gaussians`; the new one `cluster` `[old]` into which each old one went, and its `share` `[old]` of it.

    Removed ones have cluster -1 and share 0.
    """

    gaussians: Gaussians
    cluster: Tensor
    share: Tensor

    def gather(self, values: Tensor) -> Tensor:
        """Means `[new, ...]` of the old Gaussians' values `[old, ...]`, weighted by their shares."""
        self._check(values, len(self.cluster), "old")
        return _weighted_sum(values, self.cluster.clamp_min(0), self.share, len(self.gaussians)).to(values.dtype)

    def spread(self, values: Tensor) -> Tensor:
        """Values `[old, ...]`: that of the new one `[new, ...]` into which each old one went, 0 for removed ones."""
        self._check(values, len(self.gaussians), "new")
        result = values[self.cluster]
        result[self.cluster < 0] = 0
        return result

    def then(self, later: "Detail") -> "Detail":
        """This step and a later one, made from its Gaussians, as one."""
        self._check(later.cluster, len(self.gaussians), "new")
        cluster = torch.where(self.cluster < 0, -1, later.cluster[self.cluster])
        return Detail(later.gaussians, cluster, torch.where(cluster < 0, 0.0, self.share * later.share[self.cluster]))

    def _check(self, values: Tensor, count: int, which: str) -> None:
        if values.dim() < 1 or len(values) != count:
            raise InputError(
                f"values must have a row for each of the {count} {which} Gaussians; got {list(values.shape)}"
            )


@torch.no_grad()
def largest_weights(gaussians: Gaussians, views: Sequence[View], *, backend: Backend = "auto") -> Tensor:
    """The largest blending weight `[gaussian]`, 0..1, that each Gaussian has in any pixel of any view.

    The native core finds it in the forward pass. Other backends draw a channel for each Gaussian, which is for small
    scenes and the specification.
    """
    now = gaussians.detach()
    shape = now.means, now.quats, now.scales, now.opacities
    largest = torch.zeros(len(now))
    native = (pick_backend()[0] if backend == "auto" else backend) == "native"
    for view in views:
        if native:
            raise_to_weights_native(largest, shape, view)
            continue
        for some in torch.arange(len(now)).split(CHANNELS):
            one = torch.zeros(len(now), len(some)).index_put_((some, torch.arange(len(some))), torch.ones(len(some)))
            drawn = rasterize(*shape, one, view, backend=backend).values.flatten(0, 1).amax(0)
            largest[some] = torch.maximum(largest[some], drawn)
    return largest


def prune_unseen(
    gaussians: Gaussians, views: Sequence[View], *, keep_weight: float = 0.01, backend: Backend = "auto"
) -> Detail:
    """Remove the Gaussians whose blending weight stays below `keep_weight` in every pixel of every one of `views`.

    They lie behind walls, inside of things, beside all pictures, or are too faint. Raises InputError without views and
    when nothing would remain.
    """
    gaussians.check()
    if not views:
        raise InputError("pruning needs at least one view; got none. Give the training views")
    if not 0 < keep_weight <= 1:
        raise InputError(f"keep_weight must be above 0 and at most 1; got {keep_weight}")
    kept = largest_weights(gaussians, views, backend=backend) >= keep_weight
    if not bool(kept.any()):
        raise InputError(
            f"no view shows any of the {len(gaussians)} Gaussians with a weight of {keep_weight:g}; check that the "
            "geometry and the views share one world, or lower keep_weight"
        )
    cluster = torch.where(kept, kept.cumsum(0) - 1, -1)
    return Detail(gaussians.detach().subset(kept), cluster, kept.float())


@torch.no_grad()
def level_of_detail(
    gaussians: Gaussians,
    positions: Tensor,
    *,
    pixel: float,
    flat: int = 3,
    widest: float = 0.1,
    colour: float = 0.05,
    margin: float | None = None,
) -> Detail:
    """Merge Gaussians that pictures with pixels of `pixel` [rad] at `positions` `[position, 3]` [m] do not tell apart.

    A Gaussian may merge with those of like normals (about 20 degrees) in a cell as wide as a pixel at the nearest
    position, and in cells wider by up to `flat` factors of two and up to `widest` [m] where the surface goes on to all
    sides and the standard deviation of the constant colour is at most `colour`. Widths are rounded down to powers of
    two of a millimetre. `margin` [m] is how much nearer new positions may come (at most to half the distance); None
    takes half the mean distance of neighbouring positions. Gaussians larger than their cell, and those alone in it,
    stay as they are.

    A merged Gaussian has its members' mean and covariance, weighted by opacity times area, and the weighted mean of
    their harmonics. Its opacity keeps their optical thickness, the sum of opacity times area; where that would exceed
    0.99 it becomes wider instead. The order of the Gaussians does not matter, and the same ones give the same
    result. Raises InputError for Gaussians that are not finite and positions that are none.
    """
    gaussians.check()
    finest = pixel * _distance(gaussians.means, positions, margin)
    if not (0 < pixel < math.inf and 0 < widest < math.inf):
        raise InputError(f"pixel [rad] and widest [m] must be positive and finite; got {pixel} and {widest}")
    if flat < 0 or not colour >= 0:
        raise InputError(f"flat and colour must be at least 0; got {flat} and {colour}")
    cluster = shared_cells(gaussians, finest, widest, flat, colour)
    return _merge(gaussians.detach(), cluster)


def _distance(means: Tensor, positions: Tensor, margin: float | None) -> Tensor:
    """How near `[gaussian]` [m] a receiver at one of `positions` `[position, 3]`, or `margin` from it, may come."""
    from scipy.spatial import KDTree

    positions = torch.as_tensor(positions, dtype=torch.float32)
    if positions.dim() != 2 or positions.shape[1] != 3 or len(positions) == 0:
        raise InputError(f"positions must be [position, 3] in metres, at least one; got {list(positions.shape)}")
    if not bool(torch.isfinite(positions).all()):
        raise InputError("positions must be finite; remove those with NaN or infinity")
    tree = KDTree(positions.numpy())
    if margin is None:
        margin = 0.5 * float(tree.query(positions.numpy(), k=2)[0][:, 1].mean()) if len(positions) > 1 else 0.0
    if not margin >= 0:
        raise InputError(f"margin must be at least 0 m; got {margin}")
    nearest = torch.from_numpy(tree.query(means.numpy())[0])
    return torch.maximum(nearest - margin, NEAREST * nearest)


def _merge(gaussians: Gaussians, cluster: Tensor) -> Detail:
    """One Gaussian for each cluster; those alone in theirs stay as they are."""
    count = int(cluster.max()) + 1
    scales = gaussians.scales.double()
    thickness = (gaussians.opacities.double() * _area(scales)).clamp_min(1e-30)
    total = torch.zeros(count, dtype=torch.float64).index_add_(0, cluster, thickness)
    share = thickness / total[cluster]
    index = torch.arange(len(cluster))
    first = torch.full((count,), len(cluster)).scatter_reduce_(0, cluster, index, "amin")
    merged = gaussians.subset(first)
    new = (torch.bincount(cluster, minlength=count) > 1).nonzero().squeeze(-1)
    if len(new) == 0:
        return Detail(merged, cluster, share.float())

    number = torch.full((count,), -1).index_copy_(0, new, torch.arange(len(new)))[cluster]
    member = (number >= 0).nonzero().squeeze(-1)
    number, weight, old = number[member], share[member], gaussians.subset(member)

    def mean(values: Tensor) -> Tensor:
        return _weighted_sum(values, number, weight, len(new))

    centre = mean(old.means)
    offset = old.means.double() - centre[number]
    shape = matrix_from_quaternion(old.quats.double()) * scales[member][:, None]
    spread, axes = torch.linalg.eigh(mean(shape @ shape.mT + offset[:, :, None] * offset[:, None]))
    wide, axes = spread.clamp_min(1e-12).sqrt().flip(-1), axes.flip(-1)
    wide[:, :2] *= (total[new] / (DENSEST * _area(wide))).sqrt().clamp(1.0, WIDEST)[:, None]
    opacity = (total[new] / _area(wide)).clamp(1e-6, DENSEST)
    merged.means[new] = centre.float()
    merged.quats[new] = quaternion_from_matrix(_right_handed(axes, mean(normals(old)))).float()
    merged.log_scales[new] = wide.log().float()
    merged.logit_opacities[new] = torch.logit(opacity).float()
    merged.sh[new] = mean(old.sh).float()
    return Detail(merged, cluster, share.float())


def _area(scales: Tensor) -> Tensor:
    """What a Gaussian of `scales` `[gaussian, 3]` covers face on `[gaussian]` [m^2]."""
    return 2 * math.pi * scales.sort(-1).values[:, 1:].prod(-1)


def _right_handed(axes: Tensor, side: Tensor) -> Tensor:
    """Rotations `[gaussian, 3, 3]` with the given columns up to sign; the last one points to `side` `[gaussian, 3]`."""
    last = axes[..., 2] * torch.where((axes[..., 2] * side).sum(-1) < 0, -1.0, 1.0)[:, None]
    return torch.stack((axes[..., 0], torch.linalg.cross(last, axes[..., 0], dim=-1), last), -1)


def _weighted_sum(values: Tensor, group: Tensor, weight: Tensor, count: int) -> Tensor:
    """Sums `[group, ...]` of `values` `[row, ...]` times `weight` `[row]`, in float64."""
    rows = values.double().flatten(1) if values.dim() > 1 else values.double()[:, None]
    total = torch.zeros(count, rows.shape[1], dtype=torch.float64)
    return total.index_add_(0, group, rows * weight.double()[:, None]).reshape(count, *values.shape[1:])
