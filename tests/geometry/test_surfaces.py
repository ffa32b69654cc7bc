import math

import pytest
import torch

from rf3dgs.core.errors import InputError
from rf3dgs.geometry import Patches, Planes, SurfaceConfig, Surfaces, find_surfaces
from rf3dgs.geometry.patches import plane_axes
from rf3dgs.splats.gaussians import Gaussians
from rf3dgs.splats.surface import sample_mesh


def box(low: tuple[float, ...], high: tuple[float, ...], *, inwards: bool = False) -> tuple[torch.Tensor, torch.Tensor]:
    corners = torch.cartesian_prod(*(torch.tensor(pair) for pair in zip(low, high, strict=True)))
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    faces = torch.tensor([(q[0], *pair) for q in quads for pair in ((q[1], q[2]), (q[2], q[3]))])
    return corners, faces.flip(1) if inwards else faces


def room(count: int = 6000, seed: int = 0) -> Gaussians:
    """A room of 5 x 4 x 3 m with a block of 1 x 1 x 0.8 m in its middle."""
    shell = sample_mesh(*box((0.0, 0.0, 0.0), (5.0, 4.0, 3.0), inwards=True), count=count, seed=seed)
    block = sample_mesh(*box((2.0, 1.5, 0.0), (3.0, 2.5, 0.8)), spacing=0.1, seed=seed)
    return Gaussians.join((shell, block))


EYES = torch.tensor([[1.0, 1.0, 1.5], [4.0, 1.0, 1.6], [1.0, 3.0, 1.4], [4.0, 3.0, 1.5]])


@pytest.fixture(scope="module")
def found() -> Surfaces:
    return find_surfaces(room(), EYES)


def test_every_wall_of_a_room_is_found_where_it_is(found: Surfaces) -> None:
    walls = torch.tensor([[1.0, 0, 0, 0], [-1, 0, 0, -5], [0, 1, 0, 0], [0, -1, 0, -4], [0, 0, 1, 0], [0, 0, -1, -3]])
    planes = torch.cat((found.planes.normals, found.planes.offsets[:, None]), -1)
    nearest = torch.minimum(
        (planes[:, None] - walls).abs().amax(-1).amin(0), (planes[:, None] + walls).abs().amax(-1).amin(0)
    )
    assert float(nearest.max()) < 2e-3  # the lattice lies exactly on the faces; the fit is over thousands of points


def test_each_gaussian_is_in_one_segment_and_on_one_plane_at_most(found: Surfaces) -> None:
    assert len(found.segment_of) == len(found.plane_of) == len(room())
    assert sorted(set(found.segment_of.tolist())) == list(range(found.segments))
    assert int(found.plane_of.max()) == len(found.planes) - 1
    for segment in range(found.segments):
        assert len(set(found.plane_of[found.segment_of == segment].tolist()) - {-1}) <= 1


def test_normals_are_unit_and_face_the_viewpoints(found: Surfaces) -> None:
    means = room().means
    assert torch.allclose(torch.linalg.vector_norm(found.normals, dim=-1), torch.ones(len(means)), atol=1e-5)
    shell = (means[:, 2] > 1e-3) & ((means[:, 0] < 1e-3) | (means[:, 0] > 5 - 1e-3))
    inwards = (torch.tensor([2.5, 2.0, 1.5]) - means) * found.normals
    assert bool((inwards.sum(-1)[shell] > 0).float().mean() > 0.99)


def test_the_same_seed_finds_the_same_surfaces(found: Surfaces) -> None:
    again = find_surfaces(room(), EYES)
    for name, tensor in found.tensors().items():
        assert torch.equal(tensor, again.tensors()[name]), name


def test_surfaces_survive_their_tensors(found: Surfaces) -> None:
    back = Surfaces.from_tensors(found.tensors())
    assert torch.equal(back.patches.cells, found.patches.cells)
    assert torch.equal(back.segment_of, found.segment_of)


def test_a_patch_holds_its_wall_and_nothing_beside_it(found: Surfaces) -> None:
    floor = int((found.planes.normals[:, 2].abs() - found.planes.offsets.abs()).argmax())
    points = torch.tensor([[1.0, 1.0, 0.0], [4.9, 3.9, 0.5], [5.4, 1.0, 0.0], [1.0, -0.4, 0.0]])
    assert found.patches.holds(points, torch.tensor([floor] * 4)).tolist() == [True, True, False, False]
    assert not bool(found.patches.holds(points, torch.tensor([-1] * 4)).any())
    assert math.isclose(float(found.patches.areas[floor]), 19.0, rel_tol=0.15)  # 20 m^2 less the block's foot


def test_a_street_of_large_gaussians_has_planes_too() -> None:
    walls = sample_mesh(*box((0.0, 0.0, 0.0), (60.0, 40.0, 20.0), inwards=True), spacing=1.5)
    eyes = torch.tensor([[10.0, 10.0, 1.5], [50.0, 30.0, 1.5], [30.0, 20.0, 10.0]])
    found = find_surfaces(walls, eyes)
    assert found.patches.cell > 0.4
    assert len(found.planes) == found.segments == 6
    areas = found.patches.areas.sort().values[[0, 4]]  # whole cells of half a metre reach over the walls' edges
    torch.testing.assert_close(areas, torch.tensor([800.0, 2400.0]), rtol=0.12, atol=0)
    back = Surfaces.from_tensors(found.tensors())
    assert back.patches.cell == found.patches.cell


def test_small_gaussians_keep_cells_of_ten_centimetres(found: Surfaces) -> None:
    assert found.patches.cell == 0.1
    old = {name: tensor for name, tensor in found.tensors().items() if name != "patch_cell"}
    assert Surfaces.from_tensors(old).patches.cell == 0.1


def test_a_cloud_without_planes_has_segments_only() -> None:
    cloud = Gaussians.random(300, (0, 0, 0), (5, 5, 5), seed=1)
    found = find_surfaces(cloud, EYES)
    assert len(found.planes) == 0
    assert bool((found.plane_of == -1).all())
    assert not bool(found.patches.holds(torch.zeros(2, 3), torch.tensor([0, -1])).any())


def test_viewpoints_that_are_no_points_are_refused() -> None:
    with pytest.raises(InputError, match=r"viewpoints must be \[view, 3\]"):
        find_surfaces(room(600), torch.zeros(4, 2))
    with pytest.raises(InputError, match="viewpoints must be finite"):
        find_surfaces(room(600), torch.tensor([[math.nan, 0.0, 0.0]]), SurfaceConfig())


def test_a_plane_is_large_by_what_hangs_together():
    """Three tops of 2 m^2 each in one plane are none; nor is what gaps of a few cells cut told apart."""
    planes = Planes(torch.tensor([[0.0, 0.0, 1.0]]), torch.full((1,), 0.45))

    def of(*starts: float) -> bool:
        top = torch.cartesian_prod(torch.arange(0.05, 1.0, 0.1), torch.arange(0.05, 2.0, 0.1), torch.tensor([0.45]))
        cells = torch.cat([top + torch.tensor([start, 0.0, 0.0]) for start in starts])
        return bool(Patches.of(planes, [cells]).large[0])

    assert not of(0.0, 1.0)
    assert of(0.0, 1.0, 2.0)
    assert of(0.0, 1.3, 2.6)
    assert not of(0.0, 3.0, 6.0)


def test_cells_are_those_under_points_however_far_off_the_plane_they_stand():
    normal = torch.tensor([[0.6, 0.0, 0.8]])
    planes = Planes(normal, torch.tensor([1.5]))
    steps = torch.arange(0.05, 2.0, 0.1)
    flat = torch.cartesian_prod(steps, steps) @ plane_axes(normal)[0] + 1.5 * normal
    height = torch.linspace(-0.3, 0.3, len(flat))[:, None]
    on, off = (Patches.of(planes, [points]) for points in (flat, flat + height * normal))
    assert on.shape.tolist() == off.shape.tolist() == [[20, 20]]
    assert torch.equal(on.cells, off.cells)
    torch.testing.assert_close(on.low, off.low)
