"""Scenes by name: the built-in lobby, the ones that ship with Sionna RT, and any Sionna/Mitsuba XML file."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch

from rf3dgs.core.errors import DataError, InputError
from rf3dgs.core.frames import Pose
from rf3dgs.propagation.sites import meshes
from rf3dgs.propagation.sites.lobby import lobby
from rf3dgs.propagation.sites.material_table import has_table
from rf3dgs.propagation.sites.scene import Bounds, Scene, SceneObject
from rf3dgs.propagation.sites.scene_files import check_foreign_xml, lobe_of_name


@dataclass(frozen=True)
class Site:
    """Where the transmitter of a scene stands and looks, and where receivers and cameras may stand [m]."""

    tx: tuple[float, float, float]
    target: tuple[float, float, float]
    rx_bounds: Bounds
    camera_bounds: Bounds
    frequency: float = 28e9


SITES: Mapping[str, Site] = {
    "box": Site(
        tx=(-3.5, -3.5, 4.0),
        target=(0.0, 0.0, 1.5),
        rx_bounds=((-4.5, -4.5, 1.0), (4.5, 4.5, 2.0)),
        camera_bounds=((-4.2, -4.2, 0.8), (4.2, 4.2, 3.5)),
    ),
    "simple_street_canyon": Site(
        tx=(-32.0, 0.5, 12.0),
        target=(0.0, 0.0, 1.5),
        rx_bounds=((-25.0, -8.0, 1.5), (30.0, 9.0, 1.5)),
        camera_bounds=((-40.0, -7.5, 1.5), (40.0, 8.5, 9.0)),
    ),
}
"""Sites inside scenes that ship with Sionna RT; other scenes get a transmitter above the middle of their bounds."""

FOREIGN_SCATTERING = 0.6
"""Scattering amplitude S of the scenes that ship with Sionna RT, which have none of their own."""


def scene_of(name_or_xml: str | Path | Scene, *, scattering: float | None = None) -> Scene:
    """The scene of that name, or the one that a folder of meshes or a Sionna/Mitsuba XML file describes.

    Names: "lobby", "lobby-full" (at full detail), and those that ship with Sionna RT ("box", "simple_street_canyon",
    "munich", ...). A folder holds PLY, OBJ or GLB meshes and a `materials.toml` (`mesh_folder.read_mesh_folder`).
    scattering: the amplitude S given to every material that has none; 0.6 for Sionna's scenes, and 0 (as written) for
    XML files when absent. Raises InputError for an unknown name, DataError for an unsafe or broken file,
    MissingDependencyError without sionna-rt.
    """
    if isinstance(name_or_xml, Scene):
        return name_or_xml
    name = str(name_or_xml)
    if name in ("lobby", "lobby-full"):
        return lobby("plain" if name == "lobby" else "full")
    if Path(name).is_dir() and (has_table(Path(name)) or Path(name).name != name):  # else a scene's name may be meant
        from rf3dgs.propagation.sites.mesh_folder import read_mesh_folder

        return read_mesh_folder(Path(name))
    if Path(name).suffix.lower() == ".xml":
        check_foreign_xml(name)
        return _read(Path(name).stem, Path(name), scattering or 0.0, None)
    from rf3dgs.propagation.sionna import import_sionna

    folder = Path(import_sionna().__file__).parent / "scenes"
    known = sorted(path.parent.name for path in folder.glob("*/*.xml"))
    if name not in known:
        raise InputError(
            f"no scene is named {name!r}; use lobby, lobby-full, a folder of meshes, an .xml file, or one of Sionna's: "
            f"{', '.join(known)}"
        )
    amplitude = FOREIGN_SCATTERING if scattering is None else scattering
    return _read(name, folder / name / f"{name}.xml", amplitude, SITES.get(name))


def _read(name: str, path: Path, scattering: float, site: Site | None) -> Scene:
    """A scene whose meshes and materials are read from a Sionna XML file; without a `site` its middle is taken."""
    from rf3dgs.propagation.llvm import mitsuba_variant
    from rf3dgs.propagation.sionna import VARIANT, import_sionna

    rt = import_sionna()
    with mitsuba_variant(VARIANT):
        try:
            loaded = rt.load_scene(str(path), merge_shapes=False)
        except Exception as error:  # Sionna and Mitsuba raise many kinds for a broken file
            raise DataError(f"{path} cannot be read as a Sionna scene: {error}") from error
        objects = [_object(key, item, scattering) for key, item in loaded.objects.items()]
    if not objects:
        raise DataError(f"{path} has no objects; a scene needs at least one shape with a radio material")
    corners = torch.cat([item.vertices for item in objects])
    low, high = corners.amin(0), corners.amax(0)
    shells = [item.name for item in objects if meshes.is_shell(item, low, high)]
    objects = [replace(item, solid=item.name not in shells and meshes.is_closed(item)) for item in objects]
    open_sky = not any(item.name in shells and meshes.is_closed(item) for item in objects)
    site = _middle(low, high) if site is None else site
    headroom = 50.0 if open_sky else 0.0
    bounds = (low - 0.01).tolist(), (high + torch.tensor([0.01, 0.01, 0.01 + headroom])).tolist()
    return Scene(
        name=name,
        objects=tuple(objects),
        tx=Pose.look_at(site.tx, site.target),
        bounds=(tuple(bounds[0]), tuple(bounds[1])),
        rx_bounds=site.rx_bounds,
        camera_bounds=site.camera_bounds,
        frequency=site.frequency,
        sky=1.0 if open_sky else 0.0,
        source=path.resolve(),
    )


def _object(name: str, item, scattering: float) -> SceneObject:
    """One object of a loaded Sionna scene."""
    mesh = item.mi_mesh
    material = item.radio_material
    own = float(np.array(material.scattering_coefficient).reshape(-1)[0])
    colour = tuple(float(value) for value in np.array(material.color).reshape(-1)[:3])
    return SceneObject(
        name=name,
        vertices=torch.from_numpy(np.array(mesh.vertex_positions_buffer(), dtype=np.float32).reshape(-1, 3)),
        faces=torch.from_numpy(np.array(mesh.faces_buffer(), dtype=np.int64).reshape(-1, 3)),
        material=getattr(material, "itu_type", material.name),
        scattering=own if own > 0 else scattering,
        thickness=float(np.array(material.thickness).reshape(-1)[0]),
        colour=colour if len(colour) == 3 else (0.6, 0.6, 0.6),
        alpha_r=lobe_of_name(material.name),
    )


def _middle(low: torch.Tensor, high: torch.Tensor) -> Site:
    """A transmitter above the middle of the bounds and receivers at 1.5 m height around it."""
    x, y = ((low + high) / 2)[:2].tolist()
    width, length = (0.25 * (high - low))[:2].tolist()
    ground = float(low[2])
    top = max(float(high[2]) * 0.8, ground + 2.0)
    rx = ((x - width, y - length, ground + 1.5), (x + width, y + length, ground + 1.5))
    camera = ((x - width, y - length, ground + 1.5), (x + width, y + length, ground + 3.0))
    return Site(tx=(x, y, top), target=(x + 0.3 * width, y, ground + 1.5), rx_bounds=rx, camera_bounds=camera)
