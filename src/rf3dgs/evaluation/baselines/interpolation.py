"""Linear interpolation: the training positions joined to triangles or tetrahedra, and the mean of one's corners."""

import numpy as np
import torch
from scipy.spatial import Delaunay, QhullError

from rf3dgs.core.frames import Pose
from rf3dgs.core.grids import DirectionGrid
from rf3dgs.evaluation.baselines.copies import Copy, Copying
from rf3dgs.spectra.spectrum import Spectrum

FLAT = 0.5  # [m], positions whose heights span less are joined on the ground plan


class LinearInterpolation(Copying):
    """The barycentric mean of the training positions round the receiver, the nearest one outside their hull.

    Positions are joined by Delaunay's rule in space, or on the ground plan where their heights span less than `flat`
    [m]; the receiver's height then does not matter. Too few positions, or positions on one line or plane, have no hull.
    At a training position the answer is that position's spectrum; power between them is linear in position, delay and
    angle of departure are averaged with the power as weight.
    """

    name = "linear interpolation"

    def __init__(self, train: Spectrum, *, flat: float = FLAT) -> None:
        super().__init__(train)
        points = self.places.position.double().numpy()
        self._points = points[:, :2] if np.ptp(points[:, 2]) < flat else points
        try:
            self._cells: Delaunay | None = Delaunay(self._points)
        except (QhullError, ValueError):
            self._cells = None

    def _at(self, pose: Pose, grid: DirectionGrid) -> Copy:
        point = pose.position.double().numpy()[: self._points.shape[1]]
        corners, weight = self._corners(point)
        return self.places.mixed(corners, torch.from_numpy(weight), pose, grid)

    def _corners(self, point: np.ndarray) -> tuple[list[int], np.ndarray]:
        """The places that count at `point` `[2 or 3]` [m], and their weights, which sum to 1."""
        cell = -1 if self._cells is None else int(self._cells.find_simplex(point))
        if self._cells is None or cell < 0:
            return [int(np.linalg.norm(self._points - point, axis=1).argmin())], np.ones(1)
        transform = self._cells.transform[cell]
        part = transform[:-1] @ (point - transform[-1])
        weight = np.append(part, 1.0 - part.sum()).clip(0.0, 1.0)
        counts = weight > 1e-9
        weight = weight[counts] / weight[counts].sum()
        return self._cells.simplices[cell][counts].tolist(), weight
