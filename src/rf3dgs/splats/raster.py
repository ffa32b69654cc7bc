"""What a rasterizer returns."""

from dataclasses import dataclass

from rf3dgs.core.types import Float, Tensor


@dataclass(frozen=True, eq=False)
class Raster:
    """One view of a set of Gaussians.

    `values` are the blended channels, `weight` the accumulated alpha of each pixel (0 empty, 1 opaque) and `radii` each
    Gaussian's extent [pixel], zero for those that were not drawn.
    """

    values: Float[Tensor, "row col channel"]
    weight: Float[Tensor, "row col"]
    radii: Float[Tensor, "gaussian"]
