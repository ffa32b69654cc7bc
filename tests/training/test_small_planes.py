"""Small planes of photographs: two faces, flat pieces, outlines and feet."""

from dataclasses import replace

import pytest
import torch

from rf3dgs.geometry import Patches, Planes, Surfaces, find_surfaces
from rf3dgs.geometry.patches import surface_points
from rf3dgs.splats.obstacles import Obstacles
from rf3dgs.splats.surface import sample_mesh
from rf3dgs.training.small_planes import flat_pieces, outlined, standing, with_both_faces


@pytest.mark.parametrize("spacing", [0.06, 0.095])
def test_an_outline_is_that_of_the_thing(spacing):
    """A partition of 2 x 1.9 m whose Gaussians reach over its edges, and a mirror in its plane that nobody saw."""
    corners = torch.tensor([[0.0, 0.0, 0.0], [2.0, 0.0, 0.0], [2.0, 0.0, 1.9], [0.0, 0.0, 1.9]])
    gaussians = sample_mesh(corners, torch.tensor([[0, 1, 2], [0, 2, 3]]), spacing=spacing)
    surfaces = find_surfaces(gaussians, torch.tensor([[1.0, 3.0, 1.0]]))
    unseen = torch.cartesian_prod(torch.arange(5.05, 5.3, 0.1), torch.zeros(1), torch.arange(0.05, 1.0, 0.1))
    points = torch.cat((surface_points(surfaces.planes, surfaces.patches)[0], unseen))
    patches = Patches.of(surfaces.planes, [points])
    obstacles = Obstacles(gaussians.means, gaussians.quats, gaussians.scales, gaussians.opacities)
    assert float(surface_points(surfaces.planes, patches)[0][:, 2].max()) > 1.93
    found = surface_points(surfaces.planes, outlined(surfaces.planes, patches, obstacles))[0]
    own = found[found[:, 0] < 4]
    assert float(own[:, 0].min()) > -0.03
    assert float(own[:, 0].max()) < 2.03
    assert float(own[:, 2].max()) < 1.93
    assert 0.01 * len(own) == pytest.approx(3.8, abs=0.25)
    assert 0.01 * (len(found) - len(own)) == pytest.approx(0.3, abs=0.11)


def things(*parts: tuple[torch.Tensor, int]) -> tuple[Surfaces, Obstacles]:
    """Surfaces and obstacles of small opaque Gaussians at points `[n, 3]` that belong to planes x = 4 (number 0, facing
    -x), or to none (-1)."""
    means, label = torch.cat([points for points, _ in parts]), []
    for points, number in parts:
        label.append(torch.full((len(points),), number))
    plane_of = torch.cat(label)
    planes = Planes(torch.tensor([[-1.0, 0.0, 0.0]]), torch.tensor([-4.0]))
    on_it = means[plane_of == 0] * torch.tensor([0.0, 1.0, 1.0]) + torch.tensor([4.0, 0.0, 0.0])
    count = len(means)
    normals = torch.tensor([-1.0, 0.0, 0.0]).expand(count, 3)
    surfaces = Surfaces(planes, Patches.of(planes, [on_it]), plane_of, torch.zeros(count, dtype=torch.long), normals)
    quats, scales = torch.tensor([1.0, 0, 0, 0]).expand(count, 4), torch.full((count, 3), 0.03)
    return surfaces, Obstacles(means, quats, scales, torch.full((count,), 0.9), plane_of)


def sheet(x: float, low: float, high: float, *, bulge: float = 0.0, seed: int = 0) -> torch.Tensor:
    """Points of an upright sheet at `x` from y = `low` to `high`, a centimetre rough; its middle stands `bulge` out."""
    generator = torch.Generator().manual_seed(seed)
    y, z = (torch.rand(400, generator=generator) for _ in range(2))
    out = bulge * (1 - (2 * y - 1).square())
    rough = 0.01 * (torch.rand(400, generator=generator) - 0.5)
    return torch.stack((x + rough - out, low + (high - low) * y, 1.8 * z), -1)


def test_a_board_of_a_decimetre_has_two_faces_that_look_outwards():
    front, back = sheet(3.94, 0.0, 2.0), sheet(4.05, 0.0, 2.0, seed=1)
    surfaces, obstacles = things((front[:200], 0), (front[200:], -1), (back[:200], 0), (back[200:], -1))
    both = with_both_faces(surfaces, obstacles)
    assert both.planes.normals.tolist() == [[-1.0, 0.0, 0.0], [1.0, 0.0, 0.0]]
    assert both.planes.offsets.tolist() == pytest.approx([-3.94, 4.05], abs=0.005)
    assert both.plane_of.tolist() == [0] * 400 + [1] * 400
    assert both.patches.areas.tolist() == pytest.approx(surfaces.patches.areas.tolist() * 2, rel=0.02)


@pytest.mark.parametrize(
    "other",
    [sheet(4.0, 0.0, 2.0, seed=1), sheet(4.03, 0.0, 2.0, seed=1), sheet(4.05, 2.5, 3.5, seed=1)],
    ids=["the same", "closer than 5 cm", "beside it"],
)
def test_what_is_no_board_keeps_its_plane(other):
    surfaces, obstacles = things((sheet(4.0, 0.0, 2.0), 0), (other, 0))
    assert with_both_faces(surfaces, obstacles).planes.offsets.tolist() == [-4.0]


def test_the_face_behind_another_that_looks_the_same_way_is_turned():
    surfaces, obstacles = things((sheet(4.0, 0.0, 2.0), 0))
    planes = Planes(torch.tensor([[-1.0, 0.0, 0.0]] * 2), torch.tensor([-4.0, -4.2]))
    spots = surface_points(surfaces.planes, surfaces.patches)[0]
    doubled = replace(surfaces, planes=planes, patches=Patches.of(planes, [spots, spots + torch.tensor([0.2, 0, 0])]))
    both = with_both_faces(doubled, obstacles).planes
    assert both.normals.tolist() == [[-1.0, 0.0, 0.0], [1.0, 0.0, 0.0]]
    assert both.offsets.tolist() == pytest.approx([-4.0, 4.2])


def test_round_pieces_and_pieces_of_other_things_are_no_part_of_a_mirror():
    board, column = sheet(4.0, 0.0, 1.0), sheet(4.0, 2.0, 2.6, bulge=0.05, seed=1)
    shelf, more = sheet(4.06, 3.5, 4.0, seed=2), sheet(4.01, 5.0, 5.5, seed=3)
    surfaces, obstacles = things((board, 0), (column, 0), (shelf, 0), (more, 0))
    flat = flat_pieces(surfaces, obstacles)
    assert bool((flat.plane_of.reshape(4, 400) == torch.tensor([[0], [-1], [-1], [0]])).all())
    y = surface_points(flat.planes, flat.patches)[0][:, 1]
    assert bool((((y > -0.1) & (y < 1.1)) | ((y > 4.9) & (y < 5.6))).all())


def test_a_strip_narrower_than_a_column_is_no_mirror():
    """Of a round column that was drawn flat a strip of 30 cm is left; a board of 50 cm beside it stays."""
    strip, board = sheet(4.0, 0.0, 0.3), sheet(4.0, 1.0, 1.5, seed=1)
    surfaces, obstacles = things((strip, 0), (board, 0))
    flat = flat_pieces(surfaces, obstacles)
    assert bool((flat.plane_of.reshape(2, 400) == torch.tensor([[-1], [0]])).all())
    assert float(surface_points(flat.planes, flat.patches)[0][:, 1].min()) > 0.9


@pytest.mark.parametrize(("gap", "stands"), [(0.0, True), (0.2, True), (0.6, False)])
def test_a_board_that_ends_close_to_the_floor_stands_on_it(gap, stands):
    planes = Planes(torch.tensor([[0.0, 0.0, 1.0], [0.0, -1.0, 0.0]]), torch.tensor([0.0, -2.0]))
    floor = torch.cartesian_prod(torch.arange(0.05, 4.0, 0.1), torch.arange(0.05, 4.0, 0.1), torch.zeros(1))
    board = torch.cartesian_prod(
        torch.arange(1.05, 2.0, 0.1), torch.full((1,), 2.0), torch.arange(gap + 0.05, 1.8, 0.1)
    )
    found = standing(planes, Patches.of(planes, [floor, board]))
    foot, top = torch.tensor([[1.5, 2.0, 0.02], [1.5, 2.0, 1.6]]).unbind()
    assert bool(found.holds(foot, torch.tensor(1))) == stands
    assert bool(found.holds(top, torch.tensor(1)))
    assert float(surface_points(planes, found)[1][:, 2].min()) > -0.06
    assert float(found.areas[1]) == pytest.approx(1.8 - (0 if stands else gap), abs=0.11)
    assert float(found.areas[0]) == pytest.approx(16.0, rel=0.01)


def test_wide_cells_of_a_board_stay_as_they_are():
    """Streets have cells of metres, which reach the ground by themselves."""
    planes = Planes(torch.tensor([[0.0, 0.0, 1.0], [0.0, -1.0, 0.0]]), torch.tensor([0.0, -2.0]))
    spots = [torch.tensor([[1.0, 1.0, 0.0], [3.0, 1.0, 0.0], [1.0, 3.0, 0.0]]), torch.tensor([[1.0, 2.0, 0.2]])]
    patches = Patches.of(planes, spots, 2.0)
    assert standing(planes, patches).areas.tolist() == pytest.approx(patches.areas.tolist())
