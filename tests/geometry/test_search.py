import math

import pytest
import torch
from tests.geometry.test_surfaces import EYES, box, room

from rf3dgs.core.errors import InputError
from rf3dgs.core.frames import Pose
from rf3dgs.core.grids import Camera, pinhole_grid, view_of
from rf3dgs.geometry import Planes, check_geometry, find_surfaces, flattened, known_surfaces, refine_planes
from rf3dgs.geometry.flatten import flatten
from rf3dgs.geometry.patches import Patches
from rf3dgs.splats.gaussians import Gaussians
from rf3dgs.splats.surface import normals, sample_mesh


def tube(radius: float = 0.5, sides: int = 24, height: float = 3.0) -> tuple[torch.Tensor, torch.Tensor]:
    angle = torch.arange(sides) * (2 * math.pi / sides)
    ring = radius * torch.stack((angle.cos(), angle.sin()), -1)
    vertices = torch.cat([torch.cat((ring, torch.full((sides, 1), z)), 1) for z in (0.0, height)])
    i = torch.arange(sides)
    j = (i + 1) % sides
    return vertices, torch.cat((torch.stack((i, j, j + sides), -1), torch.stack((i, j + sides, i + sides), -1)))


def ball(radius: float = 1.0) -> tuple[torch.Tensor, torch.Tensor]:
    zenith, azimuth = torch.meshgrid(torch.linspace(0, math.pi, 17), torch.arange(32) * (math.pi / 16), indexing="ij")
    unit = torch.stack((zenith.sin() * azimuth.cos(), zenith.sin() * azimuth.sin(), zenith.cos()), -1)
    i, j = torch.meshgrid(torch.arange(16), torch.arange(32), indexing="ij")
    a, b = i * 32 + j, i * 32 + (j + 1) % 32
    faces = torch.cat((torch.stack((a, a + 32, b), -1), torch.stack((b, a + 32, b + 32), -1)))
    return radius * unit.reshape(-1, 3), faces.reshape(-1, 3)


@pytest.mark.parametrize("mesh", [tube(), ball()], ids=["column", "ball"])
def test_round_things_have_no_planes_whether_searched_or_known(mesh) -> None:
    around = torch.tensor([[3.0, 0, 1], [-3, 0, 1], [0, 3, 1], [0, -3, 1]])
    found = find_surfaces(sample_mesh(*mesh, spacing=0.06), around)
    assert len(found.planes) == 0
    assert len(known_surfaces(*mesh, spacing=0.06)[1].planes) == 0


def test_both_sides_of_a_thin_wall_are_planes_of_their_own() -> None:
    wall = sample_mesh(*box((0.0, 0.0, 0.0), (3.0, 0.12, 2.0)), spacing=0.06)
    found = find_surfaces(wall, torch.tensor([[1.5, 3.0, 1.0], [1.5, -3.0, 1.0]]))
    upright = found.planes.normals[:, 1].abs() > 0.99
    assert sorted(found.planes.offsets[upright].abs().tolist()) == pytest.approx([0.0, 0.12], abs=2e-3)


def hazy_room(seed: int = 0) -> Gaussians:
    """A clean floor and ceiling, and four walls as haze: Gaussians up to 0.3 m off and turned any way."""
    clean = room(9000, seed)
    generator = torch.Generator().manual_seed(seed)
    wall = (clean.means[:, 2] > 0.05) & (clean.means[:, 2] < 2.95)
    wall &= ~((clean.means[:, :2] - torch.tensor([2.5, 2.0])).abs().amax(-1) < 0.6)
    count = int(wall.sum())
    means, quats, log_scales = clean.means.clone(), clean.quats.clone(), clean.log_scales.clone()
    along = normals(clean)[wall]
    means[wall] += along * (0.15 * torch.randn(count, 1, generator=generator)).clamp(-0.3, 0.3)
    quats[wall] = torch.nn.functional.normalize(torch.randn(count, 4, generator=generator), dim=-1)
    log_scales[wall] = clean.log_scales[wall].max(-1, keepdim=True).values - torch.tensor([0.0, 0.3, 1.5])
    return Gaussians(means, quats, log_scales, clean.logit_opacities, clean.sh)


def test_walls_of_haze_are_found_as_layers() -> None:
    found = find_surfaces(hazy_room(), EYES)
    planes = torch.cat((found.planes.normals, found.planes.offsets[:, None]), -1)
    walls = torch.tensor([[1.0, 0, 0, 0], [-1, 0, 0, -5], [0, 1, 0, 0], [0, -1, 0, -4]])
    nearest = (planes[:, None] - walls).abs().amax(-1).amin(0)
    assert float(nearest.max()) < 0.06  # haze of 0.15 m over some hundreds of Gaussians, and tilts of a degree


PATTERN = torch.nn.functional.interpolate(
    torch.rand(1, 1, 31, 16, generator=torch.Generator().manual_seed(3)), size=(620, 320), mode="bilinear"
)[0, 0]


def plain_wall(offset: float) -> Gaussians:
    """A wall of 6 x 3 m at y = offset [m] that looks towards +y."""
    corners = torch.tensor([[0.0, offset, 0.0], [6.0, offset, 0.0], [6.0, offset, 3.0], [0.0, offset, 3.0]])
    return sample_mesh(corners, torch.tensor([[0, 2, 1], [0, 3, 2]]), spacing=0.07)


def photographs(finer: int = 1, grain: float = 0.0) -> tuple[list[Camera], list[torch.Tensor]]:
    """Pictures of a wall at y = 0 that is painted with a random pattern of 20 cm, from five places; exact but for
    `grain`, the standard deviation of noise in each pixel.
    """
    cameras, pictures = [], []
    generator = torch.Generator().manual_seed(5)
    for x in (1.0, 2.0, 3.0, 4.0, 5.0):
        grid = pinhole_grid(160 * finer, 110 * finer, fov_deg=80.0)
        camera = view_of(Pose.look_at((x, 4.0, 1.5), (3.0, 0.0, 1.5)), grid)
        assert isinstance(camera, Camera)
        row, col = torch.meshgrid(torch.arange(grid.height) + 0.5, torch.arange(grid.width) + 0.5, indexing="ij")
        rays = torch.stack((col, row, torch.ones_like(row)), -1) @ torch.linalg.inv(camera.K).mT
        rays = rays @ camera.viewmat[:3, :3]
        hit = camera.position - rays * (camera.position[1] / rays[..., 1])[..., None]
        cell = (hit[..., [0, 2]] * 100).long()
        on = ((cell >= 0) & (cell < torch.tensor([600, 300]))).all(-1)
        cell = torch.where(on[..., None], cell, 0)
        grey = torch.where(on, PATTERN[cell[..., 0], cell[..., 1]], 0.0)
        grey = (grey + grain * torch.randn(grey.shape, generator=generator)).clamp(0, 1)
        cameras.append(camera)
        pictures.append((255 * grey)[..., None].expand(-1, -1, 3).to(torch.uint8))
    return cameras, pictures


def test_a_plane_moves_to_where_photographs_agree_and_gaussians_follow() -> None:
    cameras, pictures = photographs()
    wrong = plain_wall(0.25)
    plane_of = torch.zeros(len(wrong), dtype=torch.long)
    planes = Planes(torch.tensor([[0.0, 1.0, 0.0]]), torch.tensor([0.25]))
    patches = Patches.of(planes, [wrong.means])
    moved, agreement = refine_planes(wrong, planes, patches, cameras, pictures)
    assert float(moved.offsets.abs()) < 0.02  # the last step of the sweep is 8 mm; a pixel is 4 cm
    assert float(moved.normals[0, 1]) > math.cos(math.radians(0.6))
    assert float(agreement) > 0.8
    surfaces = find_surfaces(wrong, torch.stack([camera.position for camera in cameras]))
    assert torch.equal(surfaces.plane_of, plane_of)
    flat = flattened(wrong, surfaces, moved, agreement > 0.5)
    assert torch.allclose(flat.means @ moved.normals[0], moved.offsets.expand(len(flat)), atol=1e-5)
    assert torch.allclose((normals(flat) @ moved.normals[0]).abs(), torch.ones(len(flat)), atol=1e-5)
    eyes = torch.stack([camera.position for camera in cameras])
    assert torch.allclose(flatten(wrong, eyes, cameras, pictures).means, flat.means, atol=0.02)
    assert flattened(wrong, surfaces, moved, agreement > 2) is wrong
    with pytest.raises(InputError, match="a picture for each camera; got 5 and 0"):
        flatten(wrong, EYES, cameras, [])


def test_the_grain_of_fine_photographs_says_nothing_about_a_plane() -> None:
    cameras, pictures = photographs(finer=6, grain=0.3)
    wrong = plain_wall(0.25)
    planes = Planes(torch.tensor([[0.0, 1.0, 0.0]]), torch.tensor([0.25]))
    moved, agreement = refine_planes(wrong, planes, Patches.of(planes, [wrong.means]), cameras, pictures)
    assert float(moved.offsets.abs()) < 0.02
    assert float(agreement) > 0.7


def test_the_check_tells_a_clean_room_from_a_hazy_one() -> None:
    clean, hazy = check_geometry(room(9000), EYES), check_geometry(hazy_room(), EYES)
    assert clean.remarks == ()
    assert clean.on_planes > 0.95
    assert clean.open_share < 0.01
    assert max(item.roughness_cm for item in clean.segments if item.plane >= 0) < 0.5
    assert any("stray more than 5 cm" in text for text in hazy.remarks)
    assert hazy.on_planes < clean.on_planes


def test_the_check_sees_a_missing_ceiling() -> None:
    whole = room(9000)
    report = check_geometry(whole.subset(whole.means[:, 2] < 2.9), EYES)
    assert report.open_share > 0.1
    assert any("directions meet nothing" in text for text in report.remarks)
