"""What a rasterizer returns."""

from dataclasses import dataclass

from torch import Tensor


@dataclass(frozen=True, eq=False)
class Raster:
    """One view of a set of Gaussians.

    `values` `[row, col, channel]` are the blended channels, `weight` `[row, col]` the accumulated alpha of each pixel
    (0 empty, 1 opaque) and `radii` `[gaussian]` each Gaussian's extent [pixel], zero for those that were not drawn.
    """

    values: Tensor
    weight: Tensor
    radii: Tensor
