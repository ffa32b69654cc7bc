import json
from pathlib import Path

import pytest
import torch

from rf3dgs.cli.main import main
from rf3dgs.core.errors import DataError, InputError
from rf3dgs.geometry import Opening, Room, known_surfaces, plan_mesh, read_plan
from rf3dgs.splats.ply import read_ply

OFFICE = Path(__file__).parents[2] / "examples" / "office.toml"
SQUARE = ((0.0, 0.0), (4.0, 0.0), (4.0, 3.0), (0.0, 3.0))


def areas(mesh) -> dict[str, float]:
    corners = mesh.vertices[mesh.faces]
    cross = torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0], dim=-1)
    area = torch.zeros(len(mesh.names)).index_add_(0, mesh.surface, 0.5 * cross.norm(dim=-1))
    return dict(zip(mesh.names, area.tolist(), strict=True))


@pytest.mark.parametrize("corners", [SQUARE, SQUARE[::-1]])
def test_a_room_is_closed_and_its_faces_look_inwards(corners) -> None:
    mesh = plan_mesh((Room("a", corners, 2.5),))
    corner = mesh.vertices[mesh.faces].double()
    normal = torch.linalg.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0], dim=-1)
    assert bool((((torch.tensor([2.0, 1.5, 1.25]) - corner.mean(1)) * normal).sum(-1) > 0).all())
    volume = float((corner[:, 0] * torch.linalg.cross(corner[:, 1], corner[:, 2], dim=-1)).sum()) / 6
    assert volume == pytest.approx(-30.0, rel=1e-5)  # inward faces enclose minus the volume of 4 x 3 x 2.5 m


def test_openings_are_cut_out_and_filled_with_their_material() -> None:
    openings = (Opening(0, 1.0, 3.0, 0.9, 2.0, "glass"), Opening(1, 0.5, 1.5, 0.0, 2.0))
    mesh = plan_mesh((Room("a", SQUARE, 2.5, openings=openings),))
    area = areas(mesh)
    assert area["a/wall-0"] == pytest.approx(10.0 - 2.2, rel=1e-5)
    assert area["a/wall-0-opening-0"] == pytest.approx(2.2, rel=1e-5)
    assert area["a/wall-1"] == pytest.approx(7.5 - 2.0, rel=1e-5)
    assert "a/wall-1-opening-1" not in area
    assert dict(zip(mesh.names, mesh.materials, strict=True))["a/wall-0-opening-0"] == "glass"


def test_a_room_with_a_bay_has_the_floor_of_its_polygon() -> None:
    corners = ((0.0, 0.0), (6.0, 0.0), (6.0, 5.0), (4.0, 5.0), (4.0, 2.0), (2.0, 2.0), (2.0, 5.0), (0.0, 5.0))
    area = areas(plan_mesh((Room("u", corners, 3.0),)))
    assert area["u/floor"] == pytest.approx(24.0, rel=1e-5)
    assert area["u/ceiling"] == pytest.approx(24.0, rel=1e-5)


def test_surfaces_of_a_plan_are_exactly_those_of_the_plan() -> None:
    mesh = plan_mesh((Room("a", SQUARE, 2.5, openings=(Opening(0, 1.0, 3.0, 0.9, 2.0, "glass"),)),))
    gaussians, surfaces = known_surfaces(mesh.vertices, mesh.faces, labels=mesh.surface, spacing=0.1)
    assert len(surfaces.planes) == 6  # the window is in the plane of its wall
    assert surfaces.segments == 7  # but a segment of its own
    away = (gaussians.means * surfaces.planes.normals[surfaces.plane_of]).sum(-1)
    assert torch.allclose(away, surfaces.planes.offsets[surfaces.plane_of], atol=1e-5)
    assert sorted(surfaces.patches.areas.tolist())[-2:] == pytest.approx([12.0, 12.0], rel=0.1)


@pytest.mark.parametrize(
    ("room", "text"),
    [
        (Room("a", SQUARE[:2], 2.5), "needs three or more corners"),
        (Room("a", (SQUARE[0], SQUARE[2], SQUARE[1], SQUARE[3]), 2.5), "needs three or more corners|walls that cross"),
        (Room("a", (*SQUARE, SQUARE[3]), 2.5), "the same corner twice"),
        (Room("a", tuple((1000 * x, 1000 * y) for x, y in SQUARE), 2500.0), "are these metres"),
        (Room("a", SQUARE, 2.5, openings=(Opening(4, 0, 1, 0, 1),)), "wall must be 0 to 3; got 4"),
        (Room("a", SQUARE, 2.5, openings=(Opening(0, 3, 5, 0, 1),)), "must lie in its wall, 4.00 m long"),
        (Room("a", SQUARE, 2.5, openings=(Opening(0, 0, 2, 0, 2), Opening(0, 1, 3, 1, 2))), "over one another"),
    ],
)
def test_rooms_that_nobody_could_build_are_refused(room: Room, text: str) -> None:
    with pytest.raises(InputError, match=text):
        plan_mesh((room,))


@pytest.mark.parametrize(
    ("content", "text"),
    [
        ("rooms = 3", "needs a list of 1 to 1000 rooms"),
        ("hight = 2.5\n[[rooms]]\ncorners = [[0,0],[1,0],[1,1]]", "unknown key 'hight'"),
        ("[[rooms]]\ncorners = [[0,0],[1,0],[1,1]]", "height must be a number in metres; got None"),
        ("[[rooms]]\nheight = 2.5\ncorners = [[0,0],[1,0],['a',1]]", "corners must be a number"),
        (
            "[[rooms]]\nheight = 2.5\ncorners = [[0,0],[1,0],[1,1]]\nopenings = [{wall = 'x'}]",
            "wall must be a whole number",
        ),
        ("[[rooms]", "cannot be read as a floor plan"),
    ],
)
def test_a_faulty_plan_is_one_error_that_names_the_file(tmp_path: Path, content: str, text: str) -> None:
    path = tmp_path / "plan.toml"
    path.write_text(content)
    with pytest.raises(DataError, match=text) as caught:
        read_plan(path)
    assert str(path) in str(caught.value)


def test_toml_and_json_say_the_same(tmp_path: Path) -> None:
    import tomllib

    path = tmp_path / "office.json"
    path.write_text(json.dumps(tomllib.loads(OFFICE.read_text())))
    assert read_plan(path) == read_plan(OFFICE)
    with pytest.raises(DataError, match="there is no such file"):
        read_plan(tmp_path / "none.toml")


def test_the_command_turns_a_plan_into_geometry_and_checks_it(tmp_path: Path, capsys) -> None:
    path = tmp_path / "office.ply"
    assert main(["fit-geometry", "--plan", str(OFFICE), "--mesh-count", "6000", "--out", str(path)]) == 0
    assert len(read_ply(path)) == pytest.approx(6000, rel=0.05)
    capsys.readouterr()
    assert main(["check-geometry", str(path), "--format", "json"]) == 0
    report = json.loads(capsys.readouterr().out)
    assert report["planes"] >= 10  # 12, but the two sides of the thin wall between the rooms may share one
    assert report["on_planes"] > 0.9
    assert main(["check-geometry", str(path)]) == 0
    assert max(len(line) for line in capsys.readouterr().out.splitlines() if not line.startswith("- ")) <= 80
    assert main(["fit-geometry", "--out", str(path)]) == 2
    assert "none of them" in capsys.readouterr().err
