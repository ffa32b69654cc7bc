"""What is seen at each position: one sphere, or several pinhole pictures, ideal or by an array."""

import math
from dataclasses import dataclass

from rf3dgs.channel.arrays import PlanarArray, planar_array
from rf3dgs.channel.paths import Paths
from rf3dgs.core.grids import DirectionGrid, equirect_grid, pinhole_grid
from rf3dgs.spectra.config import ArrayProcessing, Method
from rf3dgs.spectra.scan import spectrum_of
from rf3dgs.spectra.spectrum import Spectrum
from rf3dgs.spectra.yaws import at_yaws

YAWS_DEG = (0.0, 90.0, 180.0, 270.0)
FOV_DEG = 90.0


@dataclass(frozen=True)
class Pictures:
    """The pictures of one position."""

    size: tuple[int, int]
    """Columns and rows."""
    yaws_deg: tuple[float, ...] = ()
    """Pinholes, 90 degrees wide, turned by these angles; none is one sphere."""
    method: Method = "ideal"
    """How they are made; all but "ideal" by an array of patches."""
    elements: int = 8
    """Rows and columns of that array."""
    snapshots: int | None = None
    """Frequencies of the array's covariance; None is its expectation over the paths' phases."""

    @property
    def views(self) -> int:
        return max(len(self.yaws_deg), 1)

    @property
    def grid(self) -> DirectionGrid:
        return pinhole_grid(*self.size, fov_deg=FOV_DEG) if self.yaws_deg else equirect_grid(*self.size)

    @property
    def array(self) -> PlanarArray | None:
        """What receives; None where spectra are ideal."""
        return None if self.method == "ideal" else planar_array(self.elements, self.elements, pattern="patch")

    def of(self, number: int, paths: Paths) -> Spectrum:
        """The pictures `[view, row, col]`, or the sphere `[row, col]`, that receiver `number` sees of its paths."""
        seen = at_yaws(paths, [math.radians(yaw) for yaw in self.yaws_deg]) if self.yaws_deg else paths
        how = None if self.method == "ideal" else ArrayProcessing(snapshots=self.snapshots)
        seed = number * self.views
        return spectrum_of(seen, self.array, self.grid, method=self.method, processing=how, seed=seed)


SPHERE = Pictures((180, 90))
"""The sphere of the radiance table."""


def pinholes(width: int, height: int, method: Method = "ideal") -> Pictures:
    """The paper's four pictures of a position."""
    return Pictures((width, height), YAWS_DEG, method)
