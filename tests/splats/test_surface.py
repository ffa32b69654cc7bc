import math

import pytest
import torch

from rf3dgs.core.errors import InputError
from rf3dgs.core.frames import Pose, matrix_from_quaternion
from rf3dgs.core.grids import equirect_grid, view_of
from rf3dgs.splats.draw import draw
from rf3dgs.splats.surface import normals, sample_mesh
from rf3dgs.splats.transmittance import segment_transmittance


def box(*size: float) -> tuple[torch.Tensor, torch.Tensor]:
    """A closed box from the origin, each face two triangles with their normals outwards."""
    corners = torch.cartesian_prod(*(torch.tensor([0.0, length]) for length in size))
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    return corners, torch.tensor([(q[0], *pair) for q in quads for pair in ((q[1], q[2]), (q[2], q[3]))])


def square(size: float = 2.0) -> tuple[torch.Tensor, torch.Tensor]:
    corners = torch.tensor([[0.0, 0.0, 0.0], [size, 0.0, 0.0], [size, size, 0.0], [0.0, size, 0.0]])
    return corners, torch.tensor([[0, 1, 2], [0, 2, 3]])


def sphere() -> tuple[torch.Tensor, torch.Tensor]:
    """A sphere of radius 1 m and 3,200 triangles with edges of up to 16 cm."""
    zenith = torch.linspace(0, math.pi, 41)
    azimuth = torch.arange(40) * (2 * math.pi / 40)
    z, a = torch.meshgrid(zenith, azimuth, indexing="ij")
    vertices = torch.stack((torch.sin(z) * torch.cos(a), torch.sin(z) * torch.sin(a), torch.cos(z)), -1).reshape(-1, 3)
    i, j = torch.meshgrid(torch.arange(40), torch.arange(40), indexing="ij")
    p, q = i * 40 + j, i * 40 + (j + 1) % 40
    return vertices, torch.cat((torch.stack((p, p + 40, q), -1), torch.stack((q, p + 40, q + 40), -1))).reshape(-1, 3)


@pytest.mark.parametrize("count", [300, 5000, 40_000])
def test_the_count_asked_for_comes_within_a_few_per_cent(count: int) -> None:
    assert abs(len(sample_mesh(*box(4, 3, 2.5), count=count)) - count) < 0.05 * count


def test_gaussians_lie_on_the_mesh_and_face_outwards() -> None:
    size = torch.tensor([4.0, 3.0, 2.5])
    cloud = sample_mesh(*box(4, 3, 2.5), spacing=0.1)
    cloud.check()
    nearest = torch.minimum(cloud.means.abs(), (cloud.means - size).abs())
    assert float(nearest.amin(-1).max()) < 1e-5
    assert bool(((cloud.means > -1e-5) & (cloud.means < size + 1e-5)).all())
    assert bool(((normals(cloud) * (cloud.means - 0.5 * size)).sum(-1) > 0).all())


def test_the_shortest_axis_is_the_normal() -> None:
    cloud = sample_mesh(*square(), spacing=0.1)
    assert torch.allclose(normals(cloud), torch.tensor([0.0, 0.0, 1.0]).expand(len(cloud), 3), atol=1e-6)
    assert bool((cloud.scales.argmin(-1) == 2).all())
    assert float(cloud.scales[:, 2].max()) <= 0.0101
    assert torch.allclose(matrix_from_quaternion(cloud.quats).det(), torch.ones(len(cloud)))


def test_density_is_the_same_everywhere() -> None:
    vertices, faces = square(4.0)
    means = sample_mesh(vertices, faces, spacing=0.1).means
    inner = means[((means[:, :2] > 0.5) & (means[:, :2] < 3.5)).all(-1), :2] - 0.5
    cells = torch.bincount((inner[:, 1] / 0.5).long() * 6 + (inner[:, 0] / 0.5).long(), minlength=36).double()
    expected = 0.25 / (0.01 * math.sqrt(3) / 2)
    assert bool(((cells - expected).abs() < 0.3 * expected).all())
    assert float(cells.mean()) == pytest.approx(expected, rel=0.03)


def test_no_point_of_a_surface_is_far_from_a_gaussian() -> None:
    """Tested on the mesh's whole surface, its edges and corners included."""
    spacing = 0.1
    vertices, faces = box(2, 1.5, 1)
    means = sample_mesh(vertices, faces, spacing=spacing).means
    generator = torch.Generator().manual_seed(0)
    weights = torch.distributions.Dirichlet(torch.ones(3)).sample((4000,))
    chosen = torch.randint(len(faces), (4000,), generator=generator)
    probe = (weights[:, :, None] * vertices[faces[chosen]]).sum(1)
    assert float(torch.cdist(probe, means).amin(-1).max()) < spacing


def test_triangles_of_one_plane_share_a_lattice_without_a_seam() -> None:
    corners, faces = square(3.0)
    one = sample_mesh(corners, faces, spacing=0.1).means
    other = sample_mesh(corners, torch.tensor([[0, 1, 3], [1, 2, 3]]), spacing=0.1).means
    inner, same = (points[((points[:, :2] > 0.3) & (points[:, :2] < 2.7)).all(-1)] for points in (one, other))
    assert abs(len(inner) - len(same)) < 0.02 * len(inner)
    assert float(torch.cdist(inner, other).amin(-1).max()) < 0.03
    closest = torch.cdist(inner, inner).fill_diagonal_(1).amin(-1)
    assert float(closest.min()) > 0.07


def test_the_seed_decides_the_points() -> None:
    first, again, other = (sample_mesh(*box(2, 2, 2), spacing=0.2, seed=seed).means for seed in (1, 1, 2))
    assert torch.equal(first, again)
    assert first.shape != other.shape or not torch.equal(first, other)


def test_each_face_gives_its_colour() -> None:
    vertices, faces = box(1, 1, 1)
    colours = torch.zeros(12, 4)
    colours[4:6] = torch.tensor([1.0, 0.2, 0.6, 0.4])
    cloud = sample_mesh(vertices, faces, spacing=0.1, colours=colours, degree=1)
    shade = cloud.sh[:, 0] * 0.28209479177387814 + 0.5
    front = cloud.means[:, 1].abs() < 1e-6
    front &= normals(cloud)[:, 1] < -0.9
    assert torch.allclose(shade[front], colours[4].expand(int(front.sum()), 4), atol=1e-6)
    assert torch.allclose(shade[~front], torch.zeros(int((~front).sum()), 4), atol=1e-6)
    assert cloud.sh.shape[1:] == (4, 4)


def test_tiny_triangles_are_sampled_by_their_area() -> None:
    cloud = sample_mesh(*sphere(), spacing=0.25)
    expected = 4 * math.pi / (0.25**2 * math.sqrt(3) / 2)
    assert abs(len(cloud) - expected) < 5 * math.sqrt(expected)
    assert float((normals(cloud) * cloud.means).sum(-1).min()) > 0.97


def test_curved_surfaces_have_hardly_a_hole() -> None:
    cloud = sample_mesh(*sphere(), count=4000)
    away = torch.nn.functional.normalize(torch.randn(500, 3, generator=torch.Generator().manual_seed(1)), dim=-1)
    passed = segment_transmittance(cloud.means, cloud.quats, cloud.scales, cloud.opacities, torch.zeros(1, 3), 2 * away)
    assert float((passed > 0.1).float().mean()) < 0.01


def test_a_silhouette_stands_within_a_quarter_of_the_spacing_from_the_edge() -> None:
    """What passes a plate beside and inside its edge."""
    spacing, edge = 0.02, float(square()[0][:, 0].max())
    cloud = sample_mesh(*square(), spacing=spacing)
    along = torch.linspace(0.2, 0.8, 200) * edge
    passed = []
    for beside in (-1.0, -0.5, 0.0, 0.25, 1.0):
        start = torch.stack((torch.full_like(along, edge + beside * spacing), along, torch.full_like(along, -1.0)), -1)
        end = start * torch.tensor([1.0, 1.0, -1.0])
        shape = cloud.means, cloud.quats, cloud.scales, cloud.opacities
        passed.append(float(segment_transmittance(*shape, start, end).median()))
    inside, near, at, over, beyond = passed
    assert inside < 0.02
    assert near < 0.05
    assert 0.2 < at < 0.5 < over
    assert beyond > 0.9


def test_the_crease_between_two_walls_is_closed() -> None:
    vertices, faces = box(2, 2, 2)
    cloud = sample_mesh(vertices, faces, spacing=0.1)
    height = torch.linspace(0.3, 1.7, 400)
    start = torch.stack((torch.full_like(height, 1.0), torch.full_like(height, 1.0), height), -1)
    end = torch.stack((torch.full_like(height, 2.5), torch.full_like(height, 2.5), height), -1)
    shape = cloud.means, cloud.quats, cloud.scales, cloud.opacities
    assert float(segment_transmittance(*shape, start, end).max()) < 0.1


def test_faces_without_area_are_left_out() -> None:
    vertices, faces = square()
    more = torch.cat((faces, torch.tensor([[0, 0, 1], [1, 1, 1]])))
    assert torch.equal(sample_mesh(vertices, more, spacing=0.2).means, sample_mesh(vertices, faces, spacing=0.2).means)
    with pytest.raises(InputError, match="no face with an area; check the units"):
        sample_mesh(vertices, torch.tensor([[0, 0, 1]]), count=10)


def test_wrong_input_is_explained() -> None:
    vertices, faces = square()
    with pytest.raises(InputError, match="either count or spacing"):
        sample_mesh(vertices, faces)
    with pytest.raises(InputError, match="indices of the 4 vertices"):
        sample_mesh(vertices, faces + 3, count=10)
    with pytest.raises(InputError, match="vertices must be finite"):
        sample_mesh(vertices * math.nan, faces, count=10)
    with pytest.raises(InputError, match="space wider"):
        sample_mesh(vertices * 1000, faces, spacing=0.01)
    with pytest.raises(InputError, match="must be positive"):
        sample_mesh(vertices, faces, count=0)
    with pytest.raises(InputError, match=r"colours must be \[face, channel\] for 2 faces"):
        sample_mesh(vertices, faces, count=10, colours=torch.zeros(3, 3))


def test_normals_are_composited_beside_depth_in_one_pass() -> None:
    """Seen from inside a box, the normal in each direction is that of the wall there, and the depth its distance."""
    size = torch.tensor([4.0, 3.0, 2.5])
    gaussians = sample_mesh(*box(*size.tolist()), spacing=0.05)
    grid = equirect_grid(120, 60)
    pose = Pose(size / 2)
    raster = draw(gaussians, view_of(pose, grid), extra=normals(gaussians), depth=True)
    found = raster.values / raster.weight[..., None]
    directions = grid.directions
    reach = (size / 2) / directions.abs()
    axis = reach.argmin(-1)
    clear = reach.sort(-1).values.diff(dim=-1)[..., 0] > 0.4  # away from the edges between walls
    expected = torch.nn.functional.one_hot(axis, 3) * directions.sign()  # outwards
    normal = torch.nn.functional.normalize(found[..., -4:-1], dim=-1)
    assert float((normal * expected).sum(-1)[clear].min()) > 0.999
    # On a slanted wall the nearer Gaussians of a pixel come first, so only what is faced is seen at its distance.
    faced = (directions * expected).sum(-1) > 0.95
    assert float((found[..., -1] - reach.amin(-1))[faced].abs().mean()) < 0.02
