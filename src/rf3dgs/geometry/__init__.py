"""Geometry that radio can use: planes with extents, segments and normals, out of Gaussians, meshes or floor plans."""

from typing import TYPE_CHECKING

from rf3dgs.core.lazy import lazy_names

if TYPE_CHECKING:
    from rf3dgs.geometry.check import GeometryReport as GeometryReport
    from rf3dgs.geometry.check import check_geometry as check_geometry
    from rf3dgs.geometry.config import SurfaceConfig as SurfaceConfig
    from rf3dgs.geometry.flatten import flattened as flattened
    from rf3dgs.geometry.known import known_surfaces as known_surfaces
    from rf3dgs.geometry.patches import Patches as Patches
    from rf3dgs.geometry.photometric import refine_planes as refine_planes
    from rf3dgs.geometry.plan import Opening as Opening
    from rf3dgs.geometry.plan import Room as Room
    from rf3dgs.geometry.plan import plan_mesh as plan_mesh
    from rf3dgs.geometry.plan_file import read_plan as read_plan
    from rf3dgs.geometry.planes import Planes as Planes
    from rf3dgs.geometry.surfaces import Surfaces as Surfaces
    from rf3dgs.geometry.surfaces import find_surfaces as find_surfaces

_HOMES = {
    "Planes": ".planes",
    "Patches": ".patches",
    "Surfaces": ".surfaces",
    "SurfaceConfig": ".config",
    "find_surfaces": ".surfaces",
    "known_surfaces": ".known",
    "refine_planes": ".photometric",
    "flattened": ".flatten",
    "Room": ".plan",
    "Opening": ".plan",
    "read_plan": ".plan_file",
    "plan_mesh": ".plan",
    "check_geometry": ".check",
    "GeometryReport": ".check",
}
__all__ = [  # noqa: RUF022 (reading order)
    "Planes",
    "Patches",
    "Surfaces",
    "SurfaceConfig",
    "find_surfaces",
    "known_surfaces",
    "refine_planes",
    "flattened",
    "Room",
    "Opening",
    "read_plan",
    "plan_mesh",
    "check_geometry",
    "GeometryReport",
]
__getattr__, __dir__ = lazy_names(__name__, _HOMES)
