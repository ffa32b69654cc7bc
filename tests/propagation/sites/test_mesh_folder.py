import json
import struct
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from PIL import Image

from rf3dgs.core.errors import DataError, MissingDependencyError
from rf3dgs.core.frames import Pose
from rf3dgs.propagation.config import TraceConfig
from rf3dgs.propagation.sites import mesh_files, meshes, shapes
from rf3dgs.propagation.sites.material_table import read_table
from rf3dgs.propagation.sites.materials import SURFACES
from rf3dgs.propagation.sites.mesh_folder import read_mesh_folder
from rf3dgs.propagation.sites.scenes import scene_of

SITE = """
[site]
frequency_ghz = 28
tx = [0.5, 0.5, 2.5]
rx_low = [1, 1, 1]
rx_high = [5, 4, 2]
"""
OBJECTS = """
[objects.cupboard]
material = "wood"
colour = [0.4, 0.3, 0.2]
[objects."*"]
material = "concrete"
thickness = 0.2
"""


def written(path, mesh):
    meshes.write_mesh(path, mesh[0], mesh[1], None)


def room(folder, table=SITE + OBJECTS, scale=1.0):
    """A room of 6 x 5 x 3 m in one file and a cupboard in another."""
    folder.mkdir(exist_ok=True)
    for name, low, high in (("room", (0, 0, 0), (6, 5, 3)), ("cupboard", (4.0, 0.1, 0.0), (5.0, 0.7, 2.0))):
        vertices, faces, uv = shapes.box(low, high)
        written(folder / f"{name}.ply", (scale * vertices, faces.flip(1) if name == "room" else faces, uv))
    (folder / "materials.toml").write_text(table)
    return folder


def test_a_folder_of_meshes_is_a_scene(tmp_path):
    scene = scene_of(str(room(tmp_path / "office")))
    assert scene.name == "office"
    assert scene.frequency == 28e9
    assert [item.name for item in scene.objects] == ["cupboard", "room"]
    cupboard, shell = scene["cupboard"], scene["room"]
    assert (cupboard.material, cupboard.colour, cupboard.solid) == ("wood", (0.4, 0.3, 0.2), True)
    assert (shell.material, shell.thickness, shell.solid) == ("concrete", 0.2, False)
    assert shell.alpha_r == SURFACES["concrete"].alpha_r
    assert torch.equal(scene.tx.position, torch.tensor([0.5, 0.5, 2.5]))
    assert scene.occupant(torch.tensor([4.5, 0.4, 1.0])) == "cupboard"
    assert len(scene.receivers(5, seed=0)) == 5


def test_a_json_table_says_the_same(tmp_path):
    folder = room(tmp_path / "office")
    before = scene_of(folder)
    table = read_table(folder)
    (folder / "materials.toml").unlink()
    (folder / "materials.json").write_text(json.dumps({"site": table.site, "objects": table.objects}))
    after = scene_of(folder)
    for mine, theirs in zip(before.objects, after.objects, strict=True):
        assert (mine.name, mine.material, mine.scattering) == (theirs.name, theirs.material, theirs.scattering)
        assert torch.equal(mine.vertices, theirs.vertices)


def test_the_folder_is_traced_like_the_same_objects_in_python(tmp_path, tracer):
    scene = scene_of(room(tmp_path / "office"))
    config, rx = TraceConfig(rays=5_000, depth=1), Pose([[3.0, 3.0, 1.5]])
    (row,) = tracer.trace_each(scene, None, rx, config)
    mirrors = (row.order == 1) & (row.kind == 1)
    assert int((row.order == 0).sum()) == 1
    assert 5 <= int(mirrors.sum()) <= 8  # floor, ceiling and four walls, some hidden, and the cupboard


def test_units_are_converted_and_millimetres_noticed(tmp_path):
    folder = room(tmp_path / "office", scale=1000.0)
    with pytest.raises(DataError, match=r'span 6000 x 5000 x 3000, which cannot be metres; say unit = "mm"'):
        read_mesh_folder(folder)
    (folder / "materials.toml").write_text(SITE + 'unit = "mm"\n' + OBJECTS)
    assert torch.allclose(read_mesh_folder(folder)["room"].vertices.amax(0), torch.tensor([6.0, 5.0, 3.0]))


def test_objects_of_an_obj_file_keep_their_names(tmp_path):
    text = "mtllib ../../secret.mtl\no left wall\nv 0 0 0\nv 0 5 0\nv 0 5 3\nv 0 0 3\nf 1 2 3 4\n"
    text += "o floor\nv 0 0 0\nv 6 0 0\nv 6 5 0\nv 0 5 0\nf 5 6 7 8\n"
    (tmp_path / "site.obj").write_text(text)
    table = SITE + '[objects."left*"]\nmaterial = "glass"\n[objects.floor]\npermittivity = 4.0\nconductivity = 0.1\n'
    (tmp_path / "materials.toml").write_text(table)
    scene = read_mesh_folder(tmp_path)
    assert {item.name: item.material for item in scene.objects} == {"left-wall": "glass", "floor": "own"}
    assert scene["floor"].permittivity(28e9) == (4.0, 0.1)
    assert scene["left-wall"].vertices.shape == (4, 3)


def test_glb_files_are_turned_upright_and_bring_their_textures(tmp_path):
    picture = np.zeros((4, 8, 3), dtype=np.uint8)
    picture[:2] = (255, 0, 0)  # the upper half is red
    wall = trimesh.Trimesh([[0, 0, 0], [6, 0, 0], [6, 3, 0], [0, 3, 0]], [[0, 1, 2], [0, 2, 3]], process=False)
    material = trimesh.visual.material.PBRMaterial(baseColorTexture=Image.fromarray(picture))
    wall.visual = trimesh.visual.TextureVisuals(uv=[[0, 0], [1, 0], [1, 1], [0, 1]], material=material)
    plain = trimesh.creation.box((1, 2, 1))
    plain.apply_translation((3.0, 1.0, -2.0))
    plain.visual = trimesh.visual.TextureVisuals(
        material=trimesh.visual.material.PBRMaterial(baseColorFactor=[0.0, 0.5, 1.0, 1.0])
    )
    both = trimesh.Scene({"wall": wall, "pillar": plain})
    (tmp_path / "site.glb").write_bytes(both.export(file_type="glb"))
    (tmp_path / "materials.toml").write_text(SITE + '[objects."*"]\nmaterial = "concrete"\n')
    scene = read_mesh_folder(tmp_path)
    assert torch.allclose(scene["wall"].vertices.amax(0), torch.tensor([6.0, 0.0, 3.0]), atol=1e-6)
    assert torch.allclose(scene["pillar"].vertices.amin(0), torch.tensor([2.5, 1.5, 0.0]), atol=1e-6)
    assert scene["pillar"].colour == pytest.approx((0.0, 0.5, 1.0), abs=0.01)
    vertices, faces, colour = meshes.coloured(scene["wall"], 0.2)
    height = vertices[faces].mean(1)[:, 2]
    assert float(colour[height > 1.7][:, 0].min()) > 0.9
    assert float(colour[height < 1.3][:, 0].max()) < 0.1


@pytest.mark.parametrize(
    ("table", "message"),
    [
        (OBJECTS, r"materials.toml: expected a table \[site\]"),
        (SITE, r"expected a table \[objects\]"),
        ("[site]\ntx = [1, 2, 2]\n" + OBJECTS, r"\[site\] lacks frequency_ghz, rx_low, rx_high"),
        (SITE + '[objects."*"]\nmaterial = "velvet"\n', "material 'velvet', which is unknown or not defined at 28 GHz"),
        (SITE + '[objects."*"]\nmaterial = "floorboard"\n', "'floorboard', which is unknown or not defined at 28 GHz"),
        (SITE + '[objects.room]\nmaterial = "wood"\n', r"'cupboard' has no entry; add \[objects.\"cupboard\"\]"),
        (SITE + OBJECTS + '[objects.sofa]\nmaterial = "wood"\n', "'sofa' fits no object .*there are: cupboard, room"),
        (SITE + '[objects."*"]\nmaterial = "wood"\nscatering = 0.2\n', "unknown key 'scatering'; known are material"),
        (SITE + '[objects."*"]\nmaterial = "wood"\nscattering = 1.2\n', "scattering is an amplitude S between 0 and 1"),
        (SITE + '[objects."*"]\nmaterial = "wood"\nthickness = nan\n', "thickness must be a finite number; got 'nan'"),
        (SITE + '[objects."*"]\nthickness = 0.1\n', "needs either a material or a permittivity"),
        (SITE + '[objects."*"]\npermittivity = 0.5\n', "relative permittivity of at least 1"),
        (SITE.replace("28", "28e9") + OBJECTS, "frequency_ghz must be from 0.1 to 1000 gigahertz; got 2.8e"),
        (SITE.replace("[1, 1, 1]", "[1, 1]") + OBJECTS, "site.rx_low must be three numbers"),
        (SITE.replace("[1, 1, 1]", "[9, 1, 1]") + OBJECTS, "rx_low must not exceed rx_high"),
        (SITE.replace("0.5, 0.5, 2.5", "500, 500, 2500") + OBJECTS, "lie far from the meshes"),
        (SITE.replace("0.5, 0.5, 2.5", "4.5, 0.4, 1.0") + OBJECTS, "is inside 'cupboard'; move it"),
        (SITE + 'unit = "mile"\n' + OBJECTS, "unit must be one of m, cm"),
        ("[site", "cannot be read"),
        ("x = " + "[" * 100_000, "cannot be read"),
        (SITE + OBJECTS + "[extra]\na = 1\n", "got also 'extra'"),
        ("#" * 2_000_000, "larger than 1 MiB"),
    ],
)
def test_faulty_tables_are_refused_with_their_name(tmp_path, table, message):
    folder = room(tmp_path / "office", table)
    with pytest.raises(DataError, match=message) as caught:
        read_mesh_folder(folder)
    assert "materials.toml" in str(caught.value)


def test_the_table_of_the_page_is_one(tmp_path):
    page = (Path(__file__).parents[3] / "docs" / "how-to" / "scenes.md").read_text()
    folder = room(tmp_path / "office", page.split("```toml\n")[1].split("```")[0])
    vertices, faces, _ = shapes.prism((3.0, 2.5), 0.2, 0.0, 3.0, 8)
    meshes.write_mesh(folder / "pillar-1.ply", vertices, faces, None)
    scene = read_mesh_folder(folder)
    assert scene["pillar-1"].electric == (5.2, 0.6)
    assert (scene["cupboard"].material, scene["room"].material) == ("metal", "plasterboard")


def test_a_folder_without_table_or_meshes_is_refused(tmp_path):
    with pytest.raises(DataError, match=r"expected materials.toml or materials.json"):
        read_mesh_folder(tmp_path)
    (tmp_path / "materials.toml").write_text(SITE + OBJECTS)
    with pytest.raises(DataError, match=r"has no meshes; expected files ending in .ply, .obj, .glb"):
        read_mesh_folder(tmp_path)


def test_a_folder_named_like_a_scene_does_not_hide_it(tmp_path, tracer, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "box").mkdir()
    assert scene_of("box").source is not None
    room(tmp_path / "box")
    assert scene_of("box").source is None
    (tmp_path / "empty").mkdir()
    with pytest.raises(DataError, match=r"expected materials.toml"):
        scene_of(tmp_path / "empty")


def test_links_out_of_the_folder_are_refused(tmp_path):
    folder = room(tmp_path / "office")
    vertices, faces, _ = shapes.box((0, 0, 0), (1, 1, 1))
    meshes.write_mesh(tmp_path / "secret.ply", vertices, faces, None)
    (folder / "link.ply").symlink_to(tmp_path / "secret.ply")
    with pytest.raises(DataError, match=r"link.ply leads out of"):
        read_mesh_folder(folder)


def test_a_solid_must_be_closed(tmp_path):
    folder = room(tmp_path / "office", SITE + '[objects."*"]\nmaterial = "wood"\nsolid = true\n')
    written(folder / "sheet.ply", shapes.quad((1, 1, 1), (1, 0, 0), (0, 0, -1)))
    with pytest.raises(DataError, match="'sheet' is said to be solid, but its mesh is not closed"):
        read_mesh_folder(folder)


def glb(tree):
    body = json.dumps(tree).encode()
    body += b" " * (-len(body) % 4)
    return struct.pack("<4sIII4s", b"glTF", 2, 20 + len(body), len(body), b"JSON") + body


@pytest.mark.parametrize(
    ("name", "data", "message"),
    [
        (
            "a.ply",
            b"ply\nformat ascii 1.0\nelement vertex 1000000000000\nend_header\n",
            "more than its .* bytes can hold",
        ),
        ("a.ply", b"ply\nformat ascii 1.0\nelement vertex -3\nend_header\n", "more than its .* bytes can hold"),
        ("a.ply", b"solid\n", "expected a PLY file"),
        ("a.ply", b"ply\nformat ascii 1.0\nelement vertex 0\nend_header\n", "cannot be read|has no triangles"),
        ("a.obj", b"\xff\xfe\x00garbage", "cannot be read|has no triangles"),
        ("a.obj", b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 9\n", "cannot be read"),
        ("a.obj", b"v 0 0 nan\nv 1 0 0\nv 0 1 0\nf 1 2 3\n", "NaN or infinite values"),
        ("a.glb", b"glTF", "expected a GLB file"),
        ("a.glb", glb({"buffers": [{"uri": "/etc/passwd", "byteLength": 9}]}), "reads '/etc/passwd'"),
        ("a.glb", glb({"images": [{"uri": "../secret.png"}]}), r"reads '\.\./secret.png'"),
        ("a.glb", glb({"accessors": [{"count": 10**12, "componentType": 5126, "type": "VEC3"}]}), "more values than"),
        ("a.glb", glb({"accessors": "x"}), "expected a GLB file"),
        ("a.glb", glb({"asset": {"version": "2.0"}}), "cannot be read|has no triangles"),
    ],
)
def test_damaged_and_hostile_meshes_are_refused_with_their_name(tmp_path, name, data, message):
    folder = room(tmp_path / "office")
    (folder / name).write_bytes(data)
    with pytest.raises(DataError, match=message) as caught:
        read_mesh_folder(folder)
    assert name in str(caught.value)


def test_every_truncation_of_a_glb_is_refused_or_read(tmp_path):
    whole = trimesh.Scene({"a": trimesh.creation.box((1, 1, 1))}).export(file_type="glb")
    path = tmp_path / "a.glb"
    for length in range(0, len(whole), 37):
        path.write_bytes(whole[:length])
        with pytest.raises(DataError, match=r"a\.glb"):
            mesh_files.read_meshes(path)


@pytest.mark.parametrize("kind", ["ply", "obj", "glb"])
def test_flipped_bytes_are_one_error_or_finite_meshes(tmp_path, kind):
    whole = trimesh.creation.icosphere(subdivisions=1).export(file_type=kind)
    whole = whole.encode() if isinstance(whole, str) else whole
    generator = np.random.default_rng(0)
    path = tmp_path / f"a.{kind}"
    refused = []
    for _ in range(150):
        data = bytearray(whole)
        data[int(generator.integers(len(data)))] ^= 1 << int(generator.integers(8))
        path.write_bytes(data)
        try:
            found = mesh_files.read_meshes(path)
        except DataError as error:
            refused.append(str(error))
        else:
            assert all(np.isfinite(mesh.vertices).all() and len(mesh.faces) for mesh in found)
            assert all(0 <= mesh.faces.min() <= mesh.faces.max() < len(mesh.vertices) for mesh in found)
    assert 0 < len(refused) < 150
    assert all(f"a.{kind}" in message for message in refused)


def test_without_trimesh_the_error_says_what_to_install(tmp_path, monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "trimesh", None)
    with pytest.raises(MissingDependencyError, match=r'pip install "rf3dgs\[mesh\]"'):
        read_mesh_folder(room(tmp_path / "office"))
