"""A first solution of the harmonics in closed form: spectra thrown back onto the Gaussians, then ridge regression.

For each view the rasterizer's own gradient gives every Gaussian the mean target over the pixels it decides and how
much it decides them. Those observations, one per view and Gaussian, make small normal equations that are solved coarse
to fine: all Gaussians, cells of the room, single Gaussians, each level drawn to the one above.
"""

from collections.abc import Sequence

import torch
from torch import Tensor

from rf3dgs.core.frames import matrix_from_quaternion
from rf3dgs.field.radiance import CSI_DEGREE, Surface, csi_prior, in_view, reach_of
from rf3dgs.splats.harmonics import basis, view_directions
from rf3dgs.splats.rasterize import rasterize
from rf3dgs.training.radio_views import RadioView

CELLS = (2.0, 0.7)
HALF_WEIGHT = 0.3


def back_project(surface: Surface, view: RadioView, picture: Tensor, backend: str) -> tuple[Tensor, Tensor, Tensor]:
    """Indices `[n]` of the Gaussians in view, the sum of `picture` `[row, col, C]` over what each decides `[n, C]`,
    and their directions `[n, 3]`.

    Exactly the gradient of `(rendering * picture).sum()` in the Gaussians' values.
    """
    index = in_view(surface.means, reach_of(surface.scales), view.camera)
    seen = surface.select(index)
    values = torch.zeros(len(index), picture.shape[-1], requires_grad=True)
    raster = rasterize(seen.means, seen.quats, seen.scales, seen.opacities, values, view.camera, backend=backend)
    (sums,) = torch.autograd.grad(raster.values, values, picture)
    return index, sums, view_directions(seen.means, view.camera.position)


def ridge_start(
    surface: Surface, views: Sequence[RadioView], *, degree: int, ridge: float, backend: str = "auto"
) -> tuple[Tensor, Tensor]:
    """Gain harmonics `[N, K]` and, for encoding "vector", CSI harmonics `[N, 4, 4]` that explain the views best.

    `ridge` counts in observations: how many of them the neighbourhood's solution is worth.
    """
    count, size = len(surface), (degree + 1) ** 2
    csi = surface.encoding == "vector" and all(view.csi is not None for view in views)
    gain = _Normal(count, size, 1)
    rest = _Normal(count, (CSI_DEGREE["vector"] + 1) ** 2, 4) if csi else None
    for view in views:
        parts = [view.keep[..., None], (view.keep * view.gain)[..., None]]
        if csi:
            assert view.csi is not None
            parts += [(view.keep * view.gain)[..., None] * view.csi]
        index, sums, directions = back_project(surface, view, torch.cat(parts, -1), backend)
        total = sums[:, 0]
        weight = total / (total + HALF_WEIGHT)
        usable = weight > 0.02
        index, sums, total, weight = index[usable], sums[usable], total[usable], weight[usable]
        harmonics = basis(directions[usable], degree)
        gain.add(index, harmonics, sums[:, 1:2] / total[:, None] - 0.5, weight)
        if rest is not None:
            power = sums[:, 1]
            observed = sums[:, 2:6] / power.clamp_min(1e-6)[:, None]
            error = observed - csi_prior(surface.means[index], surface.tx, view.camera.position)
            rest.add(index, harmonics[:, :4], error, weight * (power / total) * (power > 1e-6))
    cells = [_cells(surface, cell) for cell in CELLS]
    solution = gain.solve(cells, ridge)[..., 0]
    return solution, surface.csi_sh if rest is None else rest.solve(cells, ridge)


class _Normal:
    """Normal equations of every Gaussian: `left` `[N, K, K]` and `right` `[N, K, C]`."""

    def __init__(self, count: int, size: int, channels: int) -> None:
        self.left = torch.zeros(count, size, size)
        self.right = torch.zeros(count, size, channels)

    def add(self, index: Tensor, harmonics: Tensor, target: Tensor, weight: Tensor) -> None:
        """One observation of each Gaussian `index` `[n]`: basis `[n, K]`, target `[n, C]`, weight `[n]`."""
        weighted = harmonics * weight[:, None]
        self.left[index] += weighted[:, :, None] * harmonics[:, None, :]
        self.right[index] += weighted[:, :, None] * target[:, None, :]

    def solve(self, cells: Sequence[Tensor], ridge: float) -> Tensor:
        """Coefficients `[N, K, C]`, coarse to fine; each level adds a correction that the ridge keeps small."""
        size = self.left.shape[1]
        band = torch.tensor([degree for degree in range(4) for _ in range(2 * degree + 1)][:size], dtype=torch.float32)
        penalty = torch.diag(ridge * 0.25 * (1.0 + band) ** 2)
        everyone = torch.zeros(len(self.left), dtype=torch.long)
        solution = torch.zeros_like(self.right)
        for group in (everyone, *cells, None):
            left, right = self.left, self.right - self.left @ solution
            if group is not None:
                groups = int(group.max()) + 1
                left = left.new_zeros(groups, *left.shape[1:]).index_add_(0, group, left)
                right = right.new_zeros(groups, *right.shape[1:]).index_add_(0, group, right)
            correction = torch.linalg.solve(left + penalty, right)
            solution = solution + (correction if group is None else correction[group])
        return solution


def _cells(surface: Surface, size: float) -> Tensor:
    """A number `[N]` for each cell of `size` [m] and main axis of the normal, so that a floor and a wall stay apart."""
    place = torch.floor(surface.means / size).long()
    axes = matrix_from_quaternion(surface.quats)
    shortest = surface.log_scales.argmin(-1)[:, None, None].expand(-1, 3, 1)
    normal = axes.gather(-1, shortest).squeeze(-1)
    key = torch.cat((place, normal.abs().argmax(-1, keepdim=True)), -1)
    return torch.unique(key, dim=0, return_inverse=True)[1]
