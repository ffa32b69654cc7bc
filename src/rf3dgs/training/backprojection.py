"""A first solution of the harmonics in closed form: spectra thrown back onto the Gaussians, then ridge regression.

For each view the rasterizer's own gradient gives every Gaussian what the picture lacks, as a mean over the pixels that
it decides, and how much it decides them. Those observations, one per view and Gaussian, make small normal equations
that are solved coarse to fine: all Gaussians, cells of the room, single Gaussians, each level drawn to the one above.
"""

from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from rf3dgs.core.frames import matrix_from_quaternion
from rf3dgs.field.radiance import Surface, csi_values, gain_values
from rf3dgs.splats.harmonics import basis, view_directions
from rf3dgs.splats.rasterize import Backend, rasterize
from rf3dgs.training.radio_views import RadioView

CELLS = (2.0, 1.0, 0.4)
HALF_WEIGHT = 1.0
LEAST_WEIGHT = 0.02


def ridge_start(
    surface: Surface,
    views: Sequence[RadioView],
    *,
    degree: int,
    ridge: float,
    passes: int = 2,
    backend: Backend = "auto",
) -> tuple[Tensor, Tensor]:
    """Gain harmonics `[N, K]` and, for encoding "vector", CSI harmonics `[N, 4, 4]` that explain the views best.

    Each pass solves for what the one before left over. `ridge` counts in observations: how many of them the
    neighbourhood's solution is worth.
    """
    cells = [_cells(surface, cell) for cell in CELLS]
    with_csi = surface.encoding == "vector" and all(view.csi is not None for view in views)
    size = (degree + 1) ** 2
    gain = _Normal(len(surface), size, 1)
    csi = _Normal(len(surface), *surface.csi_sh.shape[1:])
    for number in range(passes):
        current = replace(surface, gain_sh=gain.solution[..., 0], csi_sh=csi.solution)
        gain.right.zero_()
        csi.right.zero_()
        for view in views:
            sums, directions = _leftover(current, view, with_csi, backend)
            total = sums[:, 0]
            weight = total / (total + HALF_WEIGHT)
            chosen = (weight > LEAST_WEIGHT).nonzero().squeeze(-1)
            sums, total, weight = sums[chosen], total[chosen], weight[chosen]
            harmonics = basis(directions[chosen], max(degree, 1))
            gain.add(chosen, harmonics[:, :size], sums[:, 2:3] / total[:, None], weight, both=number == 0)
            if with_csi:
                power = sums[:, 1]
                left = sums[:, 3:] / power.clamp_min(1e-6)[:, None] * (power > 1e-6)[:, None]
                csi.add(chosen, harmonics[:, :4], left, weight * power / total, both=number == 0)
        gain.solve(cells, ridge)
        if with_csi:
            csi.solve(cells, ridge)
    return gain.solution[..., 0], csi.solution


def _leftover(surface: Surface, view: RadioView, with_csi: bool, backend: Backend) -> tuple[Tensor, Tensor]:
    """Sums `[N, 3 (+ 4)]` over the pixels that each Gaussian of the surface decides, and directions `[N, 3]`.

    The sums are of 1, of the target gain, of what the gain lacks, and of what delay and departure lack times the target
    gain: the gradient of `(rendering * those pictures).sum()` in the Gaussians' values.
    """
    here = view.view.position
    directions = view_directions(surface.means, here)
    values = torch.cat((torch.zeros(len(surface), 2), gain_values(surface.gain_sh, directions)), -1)
    if with_csi:
        values = torch.cat((values, csi_values(surface, here, directions)), -1)
    values.requires_grad_()
    shape = (surface.means, surface.quats, surface.scales, surface.opacities)
    raster = rasterize(*shape, values, view.view, backend=backend)
    picture = raster.values.detach()
    reached = view.keep * view.gain
    parts = [view.keep, reached, view.keep * (view.gain - picture[..., 2])]
    lacking = torch.stack(parts, -1)
    if with_csi:
        assert view.csi is not None
        shown = picture[..., 3:] / raster.weight.detach().clamp_min(1e-3)[..., None]
        lacking = torch.cat((lacking, reached[..., None] * (view.csi - shown)), -1)
    (sums,) = torch.autograd.grad(raster.values, values, lacking)
    return sums, directions


class _Normal:
    """Normal equations of every Gaussian, `left` `[N, K, K]` and `right` `[N, K, C]`, with `solution` `[N, K, C]`."""

    def __init__(self, count: int, size: int, channels: int) -> None:
        self.left = torch.zeros(count, size, size)
        self.right = torch.zeros(count, size, channels)
        self.solution = torch.zeros(count, size, channels)

    def add(self, index: Tensor, harmonics: Tensor, lacking: Tensor, weight: Tensor, *, both: bool) -> None:
        """One observation of each Gaussian `index` `[n]`: basis `[n, K]`, what is lacking `[n, C]`, weight `[n]`.

        The left side depends on basis and weight alone; without `both` it is taken as added already.
        """
        weighted = harmonics * weight[:, None]
        if both:
            self.left.index_add_(0, index, weighted[:, :, None] * harmonics[:, None, :])
        self.right.index_add_(0, index, weighted[:, :, None] * lacking[:, None, :])

    def solve(self, cells: Sequence[Tensor], ridge: float) -> None:
        """Add to the solution what is lacking, coarse to fine; the ridge keeps each level's correction small."""
        size = self.left.shape[1]
        band = torch.tensor([degree for degree in range(4) for _ in range(2 * degree + 1)][:size], dtype=torch.float32)
        penalty = torch.diag(ridge * 0.25 * (1.0 + band) ** 2)
        everyone = torch.zeros(len(self.left), dtype=torch.long)
        found = torch.zeros_like(self.solution)
        for group in (everyone, *cells, None):
            left, right = self.left, self.right - self.left @ found
            if group is not None:
                groups = int(group.max()) + 1
                left = left.new_zeros(groups, *left.shape[1:]).index_add_(0, group, left)
                right = right.new_zeros(groups, *right.shape[1:]).index_add_(0, group, right)
            correction = torch.linalg.solve(left + penalty, right)
            found = found + (correction if group is None else correction[group])
        self.solution = self.solution + found


def _cells(surface: Surface, size: float) -> Tensor:
    """A number `[N]` for each cell of `size` [m] and main axis of the normal, so that a floor and a wall stay apart."""
    place = torch.floor(surface.means / size).long()
    axes = matrix_from_quaternion(surface.quats)
    shortest = surface.log_scales.argmin(-1)[:, None, None].expand(-1, 3, 1)
    normal = axes.gather(-1, shortest).squeeze(-1)
    key = torch.cat((place, normal.abs().argmax(-1, keepdim=True)), -1)
    return torch.unique(key, dim=0, return_inverse=True)[1]
