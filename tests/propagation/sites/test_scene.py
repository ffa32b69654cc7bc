import math
import xml.etree.ElementTree as ET
from dataclasses import replace

import numpy as np
import pytest
import torch

from rf3dgs.core.errors import InputError
from rf3dgs.propagation.sites import meshes, shapes
from rf3dgs.propagation.sites.materials import ITU, permittivity
from rf3dgs.propagation.sites.scene import SceneObject
from rf3dgs.propagation.sites.scene_files import write_radio_scene, write_visual_scene


def shape_files(path):
    return {
        shape.get("id"): shape.find("string[@name='filename']").get("value")
        for shape in ET.parse(path).getroot().iter("shape")
    }


def test_radio_and_visual_scenes_reference_the_same_meshes(site, tmp_path):
    radio = write_radio_scene(site, tmp_path)
    before = {path.name: path.read_bytes() for path in (tmp_path / "meshes").iterdir()}
    visual = write_visual_scene(site, tmp_path)
    after = {path.name: path.read_bytes() for path in (tmp_path / "meshes").iterdir()}
    assert shape_files(radio) == shape_files(visual)
    assert len(shape_files(radio)) == len(site.objects) >= 30
    assert before == after
    assert sorted(before) == sorted(f"{item.name}.ply" for item in site.objects)


def test_the_lobby_has_its_size_and_every_material_at_60_ghz(site):
    vertices, faces, colour = site.mesh()
    assert torch.allclose(vertices.amin(0), torch.zeros(3), atol=1e-5)
    assert torch.allclose(vertices.amax(0), torch.tensor([14.0, 15.0, 3.5]), atol=1e-5)
    assert int(faces.max()) < len(vertices)
    assert colour.shape == (len(faces), 3)
    assert 0.0 <= float(colour.min()) <= float(colour.max()) <= 1.0
    site.check_radio(60e9)
    assert {item.material for item in site.objects} >= {"concrete", "plasterboard", "wood", "glass", "metal"}


def test_solids_are_closed_and_face_outwards(site):
    for item in site.objects:
        if item.solid:
            a, b, c = item.vertices[item.faces].double().unbind(1)
            area = torch.linalg.cross(b - a, c - a)
            assert float(area.sum(0).norm()) < 1e-4 * float(area.norm(dim=-1).sum()), item.name
            assert float((a * torch.linalg.cross(b, c)).sum() / 6) > 0, item.name


def test_walls_face_the_room(site):
    middle = torch.tensor([7.0, 7.5, 1.75])
    for name in ("floor", "ceiling", "wall-south", "wall-west", "wall-east", "wall-north", "window-1", "light-3"):
        a, b, c = site[name].vertices[site[name].faces].unbind(1)
        assert bool(((middle - a) * torch.linalg.cross(b - a, c - a)).sum(-1).gt(0).all()), name


def test_receivers_are_free_of_objects(site):
    rx = site.receivers(200, seed=3, clearance=0.35)
    corners = torch.cat([item.vertices[item.faces] for item in site.objects])
    assert float(meshes.distance(rx.position, corners).min()) >= 0.35
    assert all(site.occupant(position) is None for position in rx.position)
    assert bool((rx.position[:, 2] >= 1.0).all() and (rx.position[:, 2] <= 2.0).all())
    assert torch.equal(rx.position, site.receivers(200, seed=3).position)
    assert len(torch.unique(rx.position, dim=0)) == 200


def test_free_and_occupant_know_inside_from_outside(site):
    column = torch.tensor([4.5, 4.6, 1.5])
    points = torch.stack((column, column + torch.tensor([1.0, 0.0, 0.0]), torch.tensor([-1.0, 3.0, 1.0])))
    assert site.free(points, 0.2).tolist() == [False, True, False]
    assert [site.occupant(point) for point in points] == ["column-1", None, "outside"]


def test_too_much_clearance_is_refused(site):
    with pytest.raises(InputError, match=r"no room for 10 positions with 4.0 m clearance"):
        site.receivers(10, seed=0, clearance=4.0)


def test_distance_and_winding_of_a_box():
    vertices, faces, _ = shapes.box((0, 0, 0), (1, 2, 3))
    corners = vertices[faces]
    points = torch.tensor([[0.5, 1.0, 1.5], [2.0, 1.0, 1.0], [2.0, 3.0, 4.0], [0.9, 0.1, 2.9]])
    assert torch.allclose(meshes.distance(points, corners), torch.tensor([0.5, 1.0, math.sqrt(3), 0.1]), atol=1e-6)
    assert meshes.inside(points, corners).tolist() == [True, False, False, True]


def test_cutting_triangles_keeps_the_area_and_shortens_the_edges(site):
    item = site["wall-east"]
    for edge in (None, 0.4):
        vertices, faces, colour = meshes.coloured(item, edge)
        a, b, c = vertices[faces].unbind(1)
        area = float(torch.linalg.cross(b - a, c - a).norm(dim=-1).sum() / 2)
        assert area == pytest.approx(15 * 3.5 - 2 * 2.1, rel=1e-4)
    assert float((vertices[faces] - vertices[faces].roll(-1, 1)).norm(dim=-1).max()) <= 0.4
    assert len(torch.unique(colour, dim=0)) > 50


def test_the_large_surfaces_are_textured(site):
    for name in ("floor", "ceiling", "wall-south", "wall-west", "wall-east", "wall-north"):
        picture = site[name].texture.astype(float)
        blocks = picture[: picture.shape[0] // 24 * 24, : picture.shape[1] // 24 * 24]
        blocks = blocks.reshape(blocks.shape[0] // 24, 24, -1, 24, 3).std((1, 3)).max(-1)
        assert (blocks > 4).mean() > 0.95, name


def test_an_unknown_material_is_named(site, tmp_path):
    bad = replace(site["floor"], material="velvet")
    scene = replace(site, objects=(bad,))
    with pytest.raises(InputError, match=r"object 'floor' has the material 'velvet'.*60 GHz; use one of concrete"):
        write_radio_scene(scene, tmp_path)
    with pytest.raises(InputError, match=r"'brick', which ITU-R P.2040 does not define at 60 GHz"):
        permittivity("brick", 60e9)
    assert not list(tmp_path.iterdir())


def test_materials_equal_sionnas_own_table(tracer):
    tracer.import_sionna()
    from sionna.rt.radio_materials.itu import itu_material

    for name, material in ITU.items():
        frequency = 28e9 if material.high_ghz >= 28 and material.low_ghz <= 28 else 60e9
        assert permittivity(name, frequency) == pytest.approx(
            [float(np.array(v).item()) for v in itu_material(name, frequency)], rel=1e-4
        )


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"scattering": 1.5}, "scattering is an amplitude S between 0 and 1; got 1.5"),
        ({"name": "../floor"}, "name must be letters"),
        ({"uv": None}, "a texture needs uv coordinates"),
        ({"faces": torch.tensor([[0, 1, 9]])}, "faces name vertices that do not exist"),
        ({"vertices": torch.full((4, 3), float("nan"))}, "NaN or infinite"),
    ],
)
def test_bad_objects_are_refused(site, change, message):
    with pytest.raises(InputError, match=message):
        replace(site["floor"], **change)


def test_names_are_used_once(site):
    with pytest.raises(InputError, match="used twice: floor"):
        replace(site, objects=(site["floor"], site["floor"]))


def test_ply_files_hold_vertices_faces_and_uv(tmp_path):
    vertices, faces, uv = shapes.box((0, 0, 0), (1, 1, 1))
    meshes.write_mesh(tmp_path / "a.ply", vertices, faces, uv)
    data = (tmp_path / "a.ply").read_bytes()
    header, body = data.split(b"end_header\n", 1)
    assert b"element vertex 24" in header
    assert b"element face 12" in header
    assert len(body) == 24 * 20 + 12 * 13
    assert isinstance(SceneObject("a", vertices, faces, "wood", 0.5), SceneObject)
