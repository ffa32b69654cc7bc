"""Scenes as files: radio.xml for the ray tracer, visual.xml for the camera, both over the same meshes."""

import re
import xml.etree.ElementTree as ET
from pathlib import Path, PurePosixPath, PureWindowsPath
from typing import Literal

import numpy as np

from rf3dgs.core.errors import DataError
from rf3dgs.core.files import atomic_file, write_whole
from rf3dgs.propagation.sites import meshes
from rf3dgs.propagation.sites.scene import MAX_ALPHA_R, Scene, SceneObject

VERSION = "2.1.0"
LARGEST_XML = 16 * 2**20  # bytes
LEAST_SAMPLING = 0.2  # light paths that seek a faint light, as a share of those that seek the brightest


def write_radio_scene(
    scene: Scene, folder: str | Path, *, frequency: float | None = None, corners: Literal["split", "shared"] = "split"
) -> Path:
    """Write `radio.xml` (Sionna RT) and `meshes/*.ply`; returns the XML's path.

    Materials are written with their permittivity and conductivity at `frequency` [Hz] (the scene's when absent),
    because Sionna loads scenes at 3.5 GHz, where some of them are not defined by name. Its XML has no element for the
    width of a scattering lobe: it is in the material's name, `-a` and alpha_R, and `scene_of` reads it from there.
    corners: "shared" lets neighbouring triangles share their corners, without which Sionna finds no edges that
    diffract; such meshes have no texture coordinates.
    """
    folder = Path(folder)
    frequency = scene.frequency if frequency is None else frequency
    root = ET.Element("scene", version=VERSION)
    known: dict[str, None] = {}
    for item in scene.objects:
        if _radio_name(item) not in known:
            known[_radio_name(item)] = None
            bsdf = ET.SubElement(root, "bsdf", type="radio-material", id=_radio_name(item))
            eta, sigma = item.permittivity(frequency)
            _value(bsdf, "float", "relative_permittivity", eta)
            _value(bsdf, "float", "conductivity", sigma)
            _value(bsdf, "float", "thickness", item.thickness)
            _value(bsdf, "float", "scattering_coefficient", item.scattering)
    for item in scene.objects:
        shape = _shape(root, meshes.welded(item) if corners == "shared" else item, folder)
        ET.SubElement(shape, "ref", id=_radio_name(item), name="bsdf")
    return _write_xml(root, folder / "radio.xml")


def write_visual_scene(scene: Scene, folder: str | Path) -> Path:
    """Write `visual.xml` (Mitsuba 3), `textures/*.png` and `meshes/*.ply`; returns the XML's path.

    A scene without sky and without luminous objects gets a lamp under its ceiling.
    """
    folder = Path(folder)
    root = ET.Element("scene", version=VERSION)
    integrator = ET.SubElement(root, "integrator", type="path")
    _value(integrator, "integer", "max_depth", 6)
    if scene.sky > 0:
        sky = ET.SubElement(root, "emitter", type="constant")
        _value(sky, "rgb", "radiance", ", ".join(str(round(scene.sky * part, 4)) for part in (0.88, 0.94, 1.0)))
    elif all(item.glow == 0 for item in scene.objects):
        lamp = ET.SubElement(root, "emitter", type="point")
        (x0, y0, z0), (x1, y1, z1) = scene.bounds
        position = [f"{value:.4f}" for value in ((x0 + x1) / 2, (y0 + y1) / 2, z0 + 0.9 * (z1 - z0))]
        ET.SubElement(lamp, "point", {"name": "position", **dict(zip("xyz", position, strict=True))})
        _value(lamp, "rgb", "intensity", str(round(0.3 * scene.size**2, 4)))
    brightest = max((item.glow for item in scene.objects), default=0.0)
    for item in scene.objects:
        shape = _shape(root, item, folder)
        whole = shape
        if item.transparency > 0:
            whole = ET.SubElement(shape, "bsdf", type="mask")
            _value(whole, "float", "opacity", round(1 - item.transparency, 4))
        outer = ET.SubElement(whole, "bsdf", type="twosided")
        bsdf = ET.SubElement(outer, "bsdf", type="diffuse")
        if item.glow > 0:
            _value(bsdf, "rgb", "reflectance", "0.05")
            emitter = ET.SubElement(shape, "emitter", type="area")
            _value(emitter, "float", "sampling_weight", round(max(item.glow / brightest, LEAST_SAMPLING), 4))
            _look(emitter, "radiance", item, folder)
        else:
            _look(bsdf, "reflectance", item, folder)
    return _write_xml(root, folder / "visual.xml")


def check_foreign_xml(path: str | Path) -> None:
    """Raise DataError, naming `path`, when a scene file is not plain: it may only read files beside or below it.

    Refused are includes, document types and entities, `path` and `alias` elements, and file names that are absolute,
    lead upwards, or leave the scene's folder through a link.
    """
    path = Path(path)
    try:
        if path.stat().st_size > LARGEST_XML:
            raise DataError(f"{path} is larger than {LARGEST_XML >> 20} MiB, too large for a scene description")
        text = path.read_bytes()
        if re.search(rb"<!\s*(DOCTYPE|ENTITY)", text, re.IGNORECASE) or b"\0" in text:
            raise DataError(f"{path} declares a document type or entities, or is not UTF-8; save it as a plain scene")
        root = ET.fromstring(text.decode("utf-8"))
    except (OSError, UnicodeDecodeError, ET.ParseError) as error:
        raise DataError(f"cannot read the scene {path}: {error}") from error
    if root.tag != "scene":
        raise DataError(f"{path} is not a Mitsuba scene: its outermost element is <{root.tag}>, expected <scene>")
    folder = path.parent.resolve()
    for element in root.iter():
        if element.tag in {"include", "path", "alias", "default"}:
            raise DataError(f"{path} has a <{element.tag}> element, which is refused; write the scene in one file")
        if element.tag != "string" or not element.get("name", "").lower().endswith(("filename", "path", "file")):
            continue
        name = element.get("value", "")
        upward = name.startswith(("~", "$")) or "$" in name or ".." in re.split(r"[\\/]", name)
        absolute = PurePosixPath(name).is_absolute() or bool(PureWindowsPath(name).anchor)
        if upward or absolute or not (folder / name).resolve().is_relative_to(folder):
            raise DataError(f"{path} names the file {name!r}; only files in the scene's own folder may be read")
        if not (folder / name).is_file():
            raise DataError(f"{path} names the file {name!r}, which does not exist beside it")


def lobe_of_name(material: str) -> int | None:
    """The alpha_R that `write_radio_scene` put into a material's name, or None."""
    found = re.fullmatch(r"radio-.*-a(\d{1,3})", material)
    return int(found[1]) if found and 1 <= int(found[1]) <= MAX_ALPHA_R else None


def _radio_name(item: SceneObject) -> str:
    electric = "" if item.electric is None else f"-e{item.electric[0]:g}-c{item.electric[1]:g}"
    lobe = "" if item.alpha_r is None else f"-a{item.alpha_r}"
    return f"radio-{item.material}{electric}-s{item.scattering:g}-d{item.thickness:g}{lobe}"


def _shape(root: ET.Element, item: SceneObject, folder: Path) -> ET.Element:
    """A shape element, with its mesh written beside the scene."""
    name = f"meshes/{item.name}.ply"
    with atomic_file(folder / name) as temporary:
        meshes.write_mesh(temporary, item.vertices, item.faces, item.uv)
    shape = ET.SubElement(root, "shape", type="ply", id=f"mesh-{item.name}")
    _value(shape, "string", "filename", name)
    _value(shape, "boolean", "face_normals", "true")
    return shape


def _look(parent: ET.Element, role: str, item: SceneObject, folder: Path) -> None:
    """The colour or texture of an object; light brighter than white is one mean colour."""
    scale = item.glow if item.glow > 0 else 1.0
    if item.texture is None or scale > 1.0:
        shade = np.array(item.colour) if item.texture is None else item.texture.reshape(-1, 3).mean(0) / 255.0
        _value(parent, "rgb", role, ", ".join(f"{value:.5f}" for value in scale * linear_from_srgb(shade)))
        return
    from PIL import Image

    pixels = item.texture
    if scale != 1.0:
        pixels = np.round(255.0 * srgb_from_linear(scale * linear_from_srgb(pixels / 255.0))).astype(np.uint8)
    name = f"textures/{item.name}.png"
    with atomic_file(folder / name) as temporary:
        Image.fromarray(pixels).save(temporary, format="PNG")
    texture = ET.SubElement(parent, "texture", type="bitmap", name=role)
    _value(texture, "string", "filename", name)
    _value(texture, "string", "filter_type", "bilinear")
    _value(texture, "string", "wrap_mode", "repeat")


def linear_from_srgb(value: np.ndarray) -> np.ndarray:
    """Linear light of sRGB values in [0, 1] (IEC 61966-2-1)."""
    return np.where(value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4)


def srgb_from_linear(value: np.ndarray) -> np.ndarray:
    """sRGB values in [0, 1] of linear light, which is clipped to that range first."""
    value = np.clip(value, 0.0, 1.0)
    return np.where(value <= 0.0031308, 12.92 * value, 1.055 * value ** (1 / 2.4) - 0.055)


def _value(parent: ET.Element, kind: str, name: str, value: object) -> None:
    ET.SubElement(parent, kind, name=name, value=str(value))


def _write_xml(root: ET.Element, path: Path) -> Path:
    ET.indent(root)
    write_whole(path, ET.tostring(root, encoding="utf-8", xml_declaration=True))
    return path
