"""Reading PLY, OBJ and GLB files of unknown origin with trimesh (the extra `mesh`), each bounded before it is read.

No other file is opened: material libraries and pictures beside a mesh are not followed, pictures inside a GLB are used.
"""

import io
import json
import math
import re
import struct
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from rf3dgs.core.errors import DataError, MissingDependencyError

SUFFIXES = (".ply", ".obj", ".glb")
LARGEST_FILE = 512 * 2**20  # bytes
MOST_FACES = 5_000_000
MOST_OBJECTS = 10_000
LARGEST_PICTURE = 64_000_000  # pixels
GLB_HEADER = 20  # bytes before a GLB's JSON


class RawMesh(NamedTuple):
    """vertices `[V, 3]`, faces `[F, 3]` in the file's own unit and axes; uv `[V, 2]` with v downwards and `texture`
    `[row, col, 3]` bytes, or the plain sRGB `colour`, where the file has them."""

    name: str
    vertices: NDArray[np.float64]
    faces: NDArray[np.int64]
    uv: NDArray[np.float64] | None = None
    texture: NDArray[np.uint8] | None = None
    colour: tuple[float, float, float] | None = None


def read_meshes(path: Path) -> list[RawMesh]:
    """The meshes of one file, at least one; several in an OBJ with objects or a GLB with nodes.

    Raises DataError naming the file when it is too large, damaged, empty, or holds NaN or infinite values;
    MissingDependencyError without trimesh.
    """
    try:
        import trimesh
    except ImportError as error:
        raise MissingDependencyError('mesh folders need trimesh: pip install "rf3dgs[mesh]"') from error
    data = _bounded(path)
    kind = path.suffix.lower().removeprefix(".")
    options: dict[str, Any] = {"process": False, "skip_materials": kind != "glb"}
    if kind == "obj":  # the name of the first option changed with trimesh 5
        options |= {"split_objects": True, "split_object": True, "group_material": False}
    try:
        scene = trimesh.load_scene(io.BytesIO(data), file_type=kind, **options)
        nodes = sorted(scene.graph.nodes_geometry)
        if len(nodes) > MOST_OBJECTS:
            raise DataError(f"{path}: has {len(nodes)} objects; at most {MOST_OBJECTS} are read")
        placed = [(node, *scene.graph[node]) for node in nodes]
        parts = [(node, matrix, scene.geometry[key]) for node, matrix, key in placed]
        parts = [part for part in parts if len(getattr(part[2], "faces", ()))]
        count = sum(len(mesh.faces) for _, _, mesh in parts)
        if count > MOST_FACES:
            raise DataError(f"{path}: has {count} triangles; at most {MOST_FACES} are read, simplify it")
        found = [_raw(str(node) if len(parts) > 1 else path.stem, matrix, mesh) for node, matrix, mesh in parts]
    except (DataError, MemoryError):
        raise
    except Exception as error:  # trimesh raises many kinds for a damaged file
        raise DataError(f"{path}: cannot be read as {kind.upper()} ({error}); export it again") from error
    if not found:
        raise DataError(f"{path}: has no triangles; export it as a mesh")
    for mesh in found:
        if not np.isfinite(mesh.vertices).all() or (mesh.uv is not None and not np.isfinite(mesh.uv).all()):
            raise DataError(f"{path}: {mesh.name!r} has NaN or infinite values; mend the mesh and export it again")
    return found


def _raw(name: str, matrix: NDArray, mesh: Any) -> RawMesh:
    """One placed mesh with the vertices that its faces use."""
    faces = np.asarray(mesh.faces, dtype=np.int64)
    vertices = np.asarray(mesh.vertices, dtype=np.float64)
    if faces.min() < 0 or faces.max() >= len(vertices):
        raise ValueError(f"a triangle names a vertex that does not exist ({len(vertices)} vertices)")
    used, faces = np.unique(faces, return_inverse=True)
    placed = vertices[used] @ np.asarray(matrix)[:3, :3].T + np.asarray(matrix)[:3, 3]
    faces = faces.reshape(-1, 3)
    if np.linalg.det(np.asarray(matrix)[:3, :3]) < 0:  # a mirrored copy is inside out
        faces = faces[:, ::-1].copy()
    material = getattr(mesh.visual, "material", None)
    factor = getattr(material, "baseColorFactor", None)
    colour = None
    if factor is not None:
        share = np.asarray(factor, dtype=np.float64).reshape(-1)[:3] / (
            255.0 if np.asarray(factor).dtype == np.uint8 else 1
        )
        colour = (float(share[0]), float(share[1]), float(share[2]))
    picture, uv = getattr(material, "baseColorTexture", None), getattr(mesh.visual, "uv", None)
    if picture is None or uv is None:
        return RawMesh(name, placed, faces, colour=colour)
    if picture.width * picture.height > LARGEST_PICTURE:
        raise ValueError(f"its picture has {picture.width}x{picture.height} pixels")
    v_down = np.asarray(uv, dtype=np.float64)[used] * (1, -1) + (0, 1)
    return RawMesh(name, placed, faces, v_down, np.array(picture.convert("RGB")), colour)


def _bounded(path: Path) -> bytes:
    """A mesh file's bytes; what it declares must fit into it."""
    try:
        size = path.stat().st_size
        if size > LARGEST_FILE:
            raise DataError(f"{path}: has {size} bytes; expected at most {LARGEST_FILE}, simplify the mesh")
        data = path.read_bytes()
    except OSError as error:
        raise DataError(f"{path}: cannot be read ({error.strerror})") from error
    if path.suffix.lower() == ".ply":
        _check_ply(path, data)
    elif path.suffix.lower() == ".glb":
        _check_glb(path, data)
    return data


def _check_ply(path: Path, data: bytes) -> None:
    """Each declared element takes at least one byte of the file."""
    header = data[:65536].split(b"end_header", 1)
    if not data.startswith(b"ply") or len(header) < 2:
        raise DataError(f"{path}: expected a PLY file; its header is missing or damaged")
    for line in header[0].decode("ascii", "replace").splitlines():
        if line.startswith("element"):
            count = line.split()[-1]
            if not re.fullmatch(r"\d{1,12}", count) or int(count) > len(data):
                raise DataError(f"{path}: declares {count[:20]} elements, more than its {len(data)} bytes can hold")


def _check_glb(path: Path, data: bytes) -> None:
    """Every accessor is stored in the file and not larger than it; nothing is read from elsewhere."""
    try:
        magic, version, _, length, kind = struct.unpack("<4sIII4s", data[:GLB_HEADER])
        if magic != b"glTF" or version != 2 or kind != b"JSON":
            raise ValueError("not GLB, version 2")
        tree = json.loads(data[GLB_HEADER : GLB_HEADER + length])
        accessors = tree.get("accessors", [])
        stored = all("bufferView" in item and "sparse" not in item for item in accessors)
        fits = all(0 <= item["count"] <= len(data) for item in accessors)
        outside = [item["uri"] for key in ("buffers", "images") for item in tree.get(key, []) if "uri" in item]
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError, struct.error) as error:
        raise DataError(f"{path}: expected a GLB file; it is damaged or another format ({error})") from error
    if outside:
        raise DataError(f"{path}: reads {str(outside[0])[:80]!r}; export a GLB that holds everything itself")
    if not (stored and fits):
        raise DataError(f"{path}: declares more values than its {len(data)} bytes can hold; export it again")


def span(meshes: list[RawMesh]) -> tuple[NDArray[np.float64], float]:
    """Size of the box around all meshes `[3]`, and its diagonal, in their own unit."""
    low = np.min([mesh.vertices.min(0) for mesh in meshes], axis=0)
    high = np.max([mesh.vertices.max(0) for mesh in meshes], axis=0)
    return high - low, math.dist(low, high)
