"""`Surfaces`: which Gaussians lie on which plane and in which piece of surface."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from rf3dgs.core.errors import DataError, InputError
from rf3dgs.geometry.config import SurfaceConfig
from rf3dgs.geometry.normals import mass, smooth_normals, turned_to
from rf3dgs.geometry.patches import Patches
from rf3dgs.geometry.planes import Planes
from rf3dgs.geometry.search import search_planes
from rf3dgs.geometry.segments import segments_of
from rf3dgs.splats.gaussians import Gaussians

NEIGHBOURS = 12


@dataclass(frozen=True, eq=False)
class Surfaces:
    """Planes, where they have surface, and what each Gaussian belongs to.

    plane_of `[gaussian]` is the plane on which a Gaussian lies or -1, segment_of `[gaussian]` its piece of surface, a
    number from 0 without gaps; normals `[gaussian, 3]` are unit vectors that point to the free side.
    """

    planes: Planes
    patches: Patches
    plane_of: Tensor
    segment_of: Tensor
    normals: Tensor

    def __post_init__(self) -> None:
        count = len(self.normals)
        if self.normals.shape != (count, 3) or len(self.plane_of) != count or len(self.segment_of) != count:
            raise InputError(
                f"plane_of, segment_of and normals must have one row per Gaussian; got {list(self.plane_of.shape)}, "
                f"{list(self.segment_of.shape)} and {list(self.normals.shape)}"
            )

    def __len__(self) -> int:
        return len(self.normals)

    @property
    def segments(self) -> int:
        """How many segments there are."""
        return int(self.segment_of.max()) + 1 if len(self) else 0

    def subset(self, chosen: Tensor) -> "Surfaces":
        """The surfaces of the Gaussians that a mask or index `chosen` keeps; planes and segments keep their numbers."""
        parts = (self.plane_of[chosen], self.segment_of[chosen], self.normals[chosen])
        return Surfaces(self.planes, self.patches, *parts)

    def tensors(self) -> dict[str, Tensor]:
        """All tensors by name, for files."""
        own = {name: getattr(self, name) for name in ("plane_of", "segment_of", "normals")}
        planes = {"plane_normals": self.planes.normals, "plane_offsets": self.planes.offsets}
        return own | planes | {f"patch_{name}": tensor for name, tensor in self.patches.tensors().items()}

    @classmethod
    def from_tensors(cls, tensors: Mapping[str, Tensor]) -> "Surfaces":
        """The surfaces of a mapping as `tensors()` gives it; raises DataError naming a tensor that is missing."""
        try:
            planes = Planes(tensors["plane_normals"], tensors["plane_offsets"])
            patches = Patches.from_tensors(
                {name.removeprefix("patch_"): tensor for name, tensor in tensors.items() if name.startswith("patch_")}
            )
            return cls(planes, patches, tensors["plane_of"], tensors["segment_of"], tensors["normals"])
        except KeyError as error:
            raise DataError(f"stored surfaces lack the tensor {error}; fit them again") from error


def find_surfaces(gaussians: Gaussians, viewpoints: Tensor, config: SurfaceConfig | None = None) -> Surfaces:
    """Planes and segments of Gaussians, seen from `viewpoints` `[view, 3]` [m] such as cameras and receivers.

    Normals are smoothed over neighbours and turned towards the viewpoints. Planes come out largest first; a Gaussian
    lies on one at most. The rest is split into pieces of near neighbours with like normals. The same configuration
    gives the same surfaces. Raises InputError for viewpoints that are not finite `[view, 3]` and for damaged Gaussians.
    """
    from scipy.spatial import KDTree

    config = SurfaceConfig() if config is None else config
    viewpoints = torch.atleast_2d(torch.as_tensor(viewpoints, dtype=torch.float32))
    if viewpoints.dim() != 2 or viewpoints.shape[1] != 3 or not len(viewpoints):
        raise InputError(f"viewpoints must be [view, 3] in metres, at least one; got {list(viewpoints.shape)}")
    if not bool(torch.isfinite(viewpoints).all()):
        raise InputError("viewpoints must be finite; leave out poses that are unknown")
    gaussians = gaussians.detach()
    gaussians.check()
    points = gaussians.means
    tree = KDTree(points.numpy())
    count = min(NEIGHBOURS + 1, len(points))
    neighbours = torch.from_numpy(np.asarray(tree.query(points.numpy(), k=count, workers=-1)[1]).reshape(-1, count))
    normals = turned_to(smooth_normals(gaussians, neighbours[:, 1:]), gaussians, viewpoints)
    planes, plane_of, patches = search_planes(gaussians, normals, mass(gaussians), config)
    lies = plane_of >= 0
    along = planes.normals[plane_of[lies]]
    normals[lies] = torch.where(((along * normals[lies]).sum(-1) < 0)[:, None], -along, along)
    segment_of = segments_of(points, normals, plane_of, patches, neighbours, config)
    return Surfaces(planes, patches, plane_of, segment_of, normals)
