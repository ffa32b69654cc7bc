"""Geometry that radio can use: planes with extents, segments and normals, out of Gaussians, meshes or floor plans."""

from typing import TYPE_CHECKING

from rf3dgs.core.lazy import lazy_names

if TYPE_CHECKING:
    from rf3dgs.geometry.config import SurfaceConfig as SurfaceConfig
    from rf3dgs.geometry.patches import Patches as Patches
    from rf3dgs.geometry.planes import Planes as Planes
    from rf3dgs.geometry.surfaces import Surfaces as Surfaces
    from rf3dgs.geometry.surfaces import find_surfaces as find_surfaces

_HOMES = {
    "Planes": ".planes",
    "Patches": ".patches",
    "Surfaces": ".surfaces",
    "SurfaceConfig": ".config",
    "find_surfaces": ".surfaces",
}
__all__ = [  # noqa: RUF022 (reading order)
    "Planes",
    "Patches",
    "Surfaces",
    "SurfaceConfig",
    "find_surfaces",
]
__getattr__, __dir__ = lazy_names(__name__, _HOMES)
