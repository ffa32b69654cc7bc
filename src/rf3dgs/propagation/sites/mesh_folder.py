"""A folder of PLY, OBJ and GLB meshes with a table of materials as a `Scene`; docs/how-to/scenes.md shows one."""

import re
from collections.abc import Sequence
from dataclasses import replace
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any

import numpy as np
import torch

from rf3dgs.core.errors import DataError, InputError
from rf3dgs.core.frames import Pose
from rf3dgs.propagation.sites import meshes
from rf3dgs.propagation.sites.material_table import UNITS, read_table
from rf3dgs.propagation.sites.materials import SURFACES, names_at, scattering_amplitude
from rf3dgs.propagation.sites.mesh_files import MOST_OBJECTS, SUFFIXES, RawMesh, read_meshes, span
from rf3dgs.propagation.sites.scene import Scene, SceneObject

LEAST_SPAN, MOST_SPAN = 0.5, 2000.0
"""Diagonals [m] between which a site is believed to be in metres without being told so."""
DEFAULT_SCATTERING, DEFAULT_THICKNESS = 0.3, 0.1


def read_mesh_folder(folder: str | Path) -> Scene:
    """The scene of a folder: every mesh in it and below, and one table, `materials.toml` or `materials.json`.

    The table's `site` says where transmitter and receivers are, `objects` what each object, or each glob of names, is
    made of; the first entry that fits counts. Raises DataError, naming the file, for a table that is missing, unknown,
    incomplete or of wrong types, for objects without an entry and entries without an object, for materials that are
    unknown or not defined at the frequency, for damaged, empty or non-finite meshes, for sizes that cannot be metres,
    and for links that lead out of the folder.
    """
    folder = Path(folder)
    table, site, entries = read_table(folder)
    raw = _named([mesh for path in _files_in(folder) for mesh in _upright(path, site)])
    raw = _in_metres(raw, site, folder)
    frequency = 1e9 * site["frequency_ghz"]
    used: set[str] = set()
    objects, told = [], []
    for mesh in raw:
        key = next((key for key in entries if fnmatchcase(mesh.name, key)), None)
        if key is None:
            raise DataError(
                f'{table}: the object {mesh.name!r} has no entry; add [objects."{mesh.name}"] or [objects."*"]'
            )
        used.add(key)
        told.append(entries[key].get("solid"))
        try:
            objects.append(_object(mesh, entries[key], frequency))
        except InputError as error:
            raise DataError(f"{table}: {error}") from error
    unused = [key for key in entries if key not in used and key != "*"]
    if unused:
        names = ", ".join(mesh.name for mesh in raw[:20])
        raise DataError(
            f"{table}: the entry {unused[0]!r} fits no object that an earlier one does not; there are: {names}"
        )
    return _scene(folder.resolve().name, table, site, _with_solids(objects, told, table))


def _files_in(folder: Path) -> list[Path]:
    """The mesh files of a folder and those below, by name; links out of it are refused."""
    found = sorted(path for path in folder.rglob("*") if path.suffix.lower() in SUFFIXES and path.is_file())
    for path in found:
        if not path.resolve().is_relative_to(folder.resolve()):
            raise DataError(f"{path} leads out of {folder}; copy the mesh into the folder")
    if not found:
        raise DataError(f"{folder}: has no meshes; expected files ending in {', '.join(SUFFIXES)}")
    return found


def _upright(path: Path, site: dict[str, Any]) -> list[RawMesh]:
    """The meshes of a file with z up; those of GLB files have y up unless the table says otherwise."""
    found = read_meshes(path)
    if site.get("up", "y" if path.suffix.lower() == ".glb" else "z") == "z":
        return found
    return [mesh._replace(vertices=mesh.vertices[:, [0, 2, 1]] * (1, -1, 1)) for mesh in found]


def _named(raw: list[RawMesh]) -> list[RawMesh]:
    """The meshes with names that are allowed and used once."""
    if len(raw) > MOST_OBJECTS:
        raise DataError(f"the folder has {len(raw)} objects; at most {MOST_OBJECTS} are read")
    taken: set[str] = set()
    result = []
    for mesh in raw:
        plain = re.sub(r"[^A-Za-z0-9_.-]+", "-", mesh.name).lstrip("_.-")[:90] or "object"
        name, number = plain, 2
        while name in taken:
            name, number = f"{plain}-{number}", number + 1
        taken.add(name)
        result.append(mesh._replace(name=name))
    return result


def _in_metres(raw: list[RawMesh], site: dict[str, Any], folder: Path) -> list[RawMesh]:
    size, diagonal = span(raw)
    if "unit" not in site and not LEAST_SPAN <= diagonal <= MOST_SPAN:
        extent = " x ".join(f"{value:g}" for value in size)
        raise DataError(
            f"{folder}: its meshes span {extent}, which cannot be metres; say unit = "
            f'"{"mm" if diagonal > MOST_SPAN else "m"}" (or another) in [site]'
        )
    scale = UNITS[site.get("unit", "m")]
    return [mesh._replace(vertices=scale * mesh.vertices) for mesh in raw]


def _object(mesh: RawMesh, entry: dict[str, Any], frequency: float) -> SceneObject:
    """One object; what its entry leaves out comes from the material's usual surface."""
    material = entry.get("material", "own")
    surface = SURFACES.get(material)
    if "material" in entry and material not in names_at(frequency):
        raise InputError(
            f"object {mesh.name!r} has the material {material!r}, which is unknown or not defined at "
            f"{frequency / 1e9:g} GHz; give its permittivity and conductivity, or use one of "
            f"{', '.join(names_at(frequency))}"
        )
    usual = DEFAULT_SCATTERING if surface is None else round(scattering_amplitude(surface, frequency), 4)
    electric = (entry["permittivity"], entry.get("conductivity", 0.0)) if "permittivity" in entry else None
    colour = entry.get("colour") or mesh.colour or (0.6, 0.6, 0.6)
    textured = mesh.texture is not None and "colour" not in entry
    return SceneObject(
        name=mesh.name,
        vertices=torch.from_numpy(mesh.vertices.astype(np.float32)),
        faces=torch.from_numpy(mesh.faces),
        material=material,
        scattering=entry.get("scattering", usual),
        thickness=entry.get("thickness", DEFAULT_THICKNESS),
        colour=(float(colour[0]), float(colour[1]), float(colour[2])),
        texture=mesh.texture if textured else None,
        uv=torch.from_numpy(mesh.uv.astype(np.float32)) if textured and mesh.uv is not None else None,
        glow=entry.get("glow", 0.0),
        alpha_r=entry.get("alpha_r", surface.alpha_r if surface is not None and "scattering" not in entry else None),
        electric=electric,
        transparency=entry.get("transparency", 0.0),
    )


def _with_solids(objects: list[SceneObject], told: Sequence[bool | None], table: Path) -> list[SceneObject]:
    """Closed objects that do not reach over the whole site are solid, unless the table says otherwise."""
    corners = torch.cat([item.vertices for item in objects])
    low, high = corners.amin(0), corners.amax(0)
    result = []
    for item, solid in zip(objects, told, strict=True):
        closed = meshes.is_closed(item)
        if solid and not closed:
            raise DataError(f"{table}: {item.name!r} is said to be solid, but its mesh is not closed; close it")
        solid = closed and not meshes.is_shell(item, low, high) if solid is None else solid
        result.append(replace(meshes.facing_outwards(item), solid=True) if solid else item)
    return result


def _scene(name: str, table: Path, site: dict[str, Any], objects: list[SceneObject]) -> Scene:
    """The scene, whose bounds hold all meshes and every place that the table names."""
    rx_bounds = site["rx_low"], site["rx_high"]
    camera_bounds = site.get("camera_low", site["rx_low"]), site.get("camera_high", site["rx_high"])
    for what, (low, high) in (("rx", rx_bounds), ("camera", camera_bounds)):
        if any(a > b for a, b in zip(low, high, strict=True)):
            raise DataError(f"{table}: {what}_low must not exceed {what}_high; got {low} and {high}")
    tx = site["tx"]
    middle = [(a + b) / 2 for a, b in zip(*rx_bounds, strict=True)]
    target = site.get("look_at", middle if middle != tx else [tx[0] + 1.0, tx[1], tx[2]])
    if target == tx:
        raise DataError(f"{table}: look_at is the transmitter's own place {tx}; give another point")
    corners = torch.cat([item.vertices for item in objects])
    low, high = corners.amin(0), corners.amax(0)
    extent = float((high - low).norm())
    places = torch.tensor([tx, *rx_bounds, *camera_bounds], dtype=torch.float32)
    if bool(((places < low - extent) | (places > high + extent)).any()):
        raise DataError(
            f"{table}: the places in [site] lie far from the meshes, which span {low.tolist()} to {high.tolist()} m; "
            "are all in metres and the same axes?"
        )
    low, high = torch.minimum(low, places.amin(0)) - 0.01, torch.maximum(high, places.amax(0)) + 0.01
    scene = Scene(
        name=name,
        objects=tuple(objects),
        tx=Pose.look_at(tx, target),
        bounds=(tuple(low.tolist()), tuple(high.tolist())),
        rx_bounds=rx_bounds,
        camera_bounds=camera_bounds,
        frequency=1e9 * site["frequency_ghz"],
        exposure=site.get("exposure", 1.0),
        sky=site.get("sky", 0.0),
    )
    occupant = scene.occupant(scene.tx.position)
    if occupant is not None:
        raise DataError(
            f"{table}: the transmitter at {tx} is inside {occupant!r}; move it, or say solid = false for that"
        )
    return scene
