"""Laws of walls that are held flat while photographs train them."""

import dataclasses

import pytest
import torch
from tests.geometry.test_search import PATTERN, photographs, plain_wall

from rf3dgs.core.grids import Camera
from rf3dgs.data.photo import Photo
from rf3dgs.geometry.flatten import THICKNESS
from rf3dgs.geometry.planes import Planes
from rf3dgs.splats.density import Change
from rf3dgs.splats.gaussians import Gaussians
from rf3dgs.splats.harmonics import C0
from rf3dgs.splats.surface import normals
from rf3dgs.training.checkpoint import CheckpointFolder
from rf3dgs.training.config import VisualConfig
from rf3dgs.training.flat import DIM, Flats, _merged, flatten_walls
from rf3dgs.training.schedule import Schedule
from rf3dgs.training.visual import VisualStage, fit_geometry


def hazy_wall() -> Gaussians:
    """A wall of 6 x 3 m at y = 0.1 whose truth is at y = 0, with a hole of 1 x 1 m, haze before it and junk behind."""
    wall = plain_wall(0.1)
    hole = (wall.means[:, [0, 2]] - torch.tensor([3.0, 1.5])).abs().amax(-1) < 0.5
    wall = wall.subset(~hole)
    generator = torch.Generator().manual_seed(0)
    near = Gaussians.random(60, (0.5, 0.16, 0.5), (5.5, 0.25, 2.5), degree=0, seed=1)
    behind = Gaussians.random(60, (0.5, -2.0, 0.5), (5.5, -1.0, 2.5), degree=0, seed=2)
    away = Gaussians.random(60, (0.5, 1.5, 0.5), (5.5, 2.0, 2.5), degree=0, seed=3)
    loose = [dataclasses.replace(part, log_scales=part.log_scales - 1.5) for part in (near, behind, away)]
    sh = torch.randn(len(wall), 1, 3, generator=generator) * 0.1
    return Gaussians.join([dataclasses.replace(wall, sh=sh), *loose])


@pytest.fixture(scope="module")
def flattened() -> tuple[Gaussians, Change, Flats]:
    gaussians = hazy_wall()
    found = flatten_walls(gaussians, *photographs())
    assert found is not None
    return gaussians, *found


def test_what_lies_on_a_wall_goes_to_where_the_photographs_have_it(flattened) -> None:
    _, change, flats = flattened
    mine = flats.plane_of >= 0
    assert float(mine.float().mean()) > 0.9
    assert float(change.gaussians.means[mine, 1].abs().max()) < 0.03  # a pixel of the photographs is 4 cm
    assert float(change.gaussians.scales[mine].amin(-1).max()) <= THICKNESS * 1.001


def test_a_hole_is_filled_with_the_photographs_colours(flattened) -> None:
    _, change, flats = flattened
    new = change.gaussians.subset(change.fresh)
    inside = (new.means[:, [0, 2]] - torch.tensor([3.0, 1.5])).abs().amax(-1) < 0.5
    assert int(inside.sum()) >= 9  # fillings stand 18 cm apart; 20 cm beside Gaussians of the wall count as wall
    assert float(new.means[:, 1].abs().max()) < 0.03
    assert bool((flats.plane_of[change.fresh] >= 0).all())
    shades = new.sh[inside, 0].mean(-1) * C0 + 0.5
    cell = (new.means[inside][:, [0, 2]] * 100).long()
    painted = PATTERN[cell[:, 0], cell[:, 1]]
    assert float((shades - painted).abs().mean()) < 0.4 * float((painted - painted.mean()).abs().mean())


def test_only_what_floats_at_a_bounding_wall_is_dimmed(flattened) -> None:
    gaussians, change, flats = flattened
    old = ~change.fresh
    off = flats.plane_of[old] < 0
    y = gaussians.means[:, 1]
    now = change.gaussians.opacities[old]
    assert float(now[off & (y < 0.25)].max()) <= DIM * 1.001
    assert torch.equal(now[y > 1.0], gaussians.opacities[y > 1.0])


def test_gaussians_without_planes_stay_as_they_are() -> None:
    cameras, pictures = photographs()
    assert flatten_walls(Gaussians.random(400, (0, 0, 0), (6, 3, 3), seed=1), cameras, pictures) is None
    assert flatten_walls(Gaussians.random(5, (0, 0, 0), (6, 3, 3), seed=1), cameras, pictures) is None


def test_planes_that_photographs_move_to_one_place_become_one() -> None:
    planes = Planes(torch.tensor([[0.0, 1, 0], [0, 1, 0], [0, -1, 0], [0, 1, 0]]), torch.tensor([0.0, 0.05, 0.0, 0.0]))
    cloud = Gaussians.random(400, (0, 0, 0), (6, 0.1, 3), seed=1)
    agreed = torch.tensor([0.6, 0.9, 0.8, float("nan")])
    merged = _merged(cloud, torch.arange(400) % 5 - 1, planes, agreed)
    assert merged[:5].tolist() == [-1, 1, 1, 2, 3]  # the other side and a plane that was not tried stay


def test_held_gaussians_lie_flat_on_their_planes_and_keep_the_order_of_their_axes() -> None:
    cloud = Gaussians.random(200, (0, 0, 0), (4, 3, 3), degree=0, seed=4)
    planes = Planes(
        torch.nn.functional.normalize(torch.tensor([[0.0, 1.0, 0.0], [1.0, 2.0, 3.0]]), dim=-1), torch.ones(2)
    )
    flats = Flats(planes, torch.arange(200) % 3 - 1)
    held = flats.held(cloud)
    free, mine = flats.plane_of < 0, flats.plane_of >= 0
    assert all(torch.equal(value[free], cloud.tensors()[name][free]) for name, value in held.tensors().items())
    normal = planes.normals[flats.plane_of[mine]]
    along = (held.means[mine] * normal).sum(-1)
    assert torch.allclose(along, torch.ones_like(along), atol=1e-5)
    assert torch.allclose((normals(held)[mine] * normal).sum(-1).abs(), torch.ones_like(along), atol=1e-5)
    again = flats.held(held)
    assert torch.allclose(again.quats, held.quats, atol=1e-6)
    changed = (held.log_scales != cloud.log_scales)[mine].sum(-1)
    assert int(changed.max()) == 1


def test_copies_and_parts_stay_on_the_plane_of_what_they_come_from() -> None:
    flats = Flats(Planes(torch.eye(3), torch.zeros(3)), torch.tensor([0, -1, 2]))
    source = torch.tensor([2, 2, 0, 1])
    change = Change(Gaussians.random(4, (0, 0, 0), (1, 1, 1)), source, torch.zeros(4, dtype=torch.bool))
    assert flats.followed(change).plane_of.tolist() == [2, 2, 0, -1]


def test_planes_are_found_twice_and_held_to_the_end() -> None:
    schedule = Schedule.of(VisualConfig(steps=1_000))
    assert [step for step in range(1_000) if schedule.flattens_after(step)] == [299, 499]
    assert schedule.holds_after(999)
    free = Schedule.of(VisualConfig(steps=1_000, walls="free"))
    assert not any(free.flattens_after(step) or free.holds_after(step) for step in range(1_000))


CONFIG = VisualConfig(steps=40, max_count=6_000, degree=0, ssim_weight=0.0, background="black")


def photos() -> list[Photo]:
    cameras, pictures = photographs()
    return [
        Photo(str(i), camera, pixels=p.float() / 255)
        for i, (camera, p) in enumerate(zip(cameras, pictures, strict=True))
    ]


def test_a_wall_stays_flat_and_the_photographs_get_better() -> None:
    fitted = {}
    for walls in ("flat", "free"):
        stage = VisualStage(photos(), dataclasses.replace(CONFIG, walls=walls), hazy_wall())
        losses = [stage.step(step) for step in range(CONFIG.steps)]
        fitted[walls] = stage.gaussians(), sum(losses[-10:])
        assert sum(losses[-10:]) < sum(losses[4:14])
    flat, free = (fitted[walls][0] for walls in ("flat", "free"))
    off = [(part.means[:, 1].abs() * part.opacities).sum() / part.opacities.sum() for part in (flat, free)]
    assert float(off[0]) < 0.5 * float(off[1])


def test_a_run_goes_on_from_a_checkpoint_bit_by_bit(tmp_path) -> None:
    config = dataclasses.replace(CONFIG, checkpoint_every=16)
    assert Schedule.of(config).flatten_at == (12, 20)
    whole = fit_geometry(photos(), config, initial=hazy_wall(), checkpoint_dir=tmp_path)
    for file in tmp_path.glob("step-00000040*"):
        file.unlink()
    stage = VisualStage(photos(), config, hazy_wall())
    found = CheckpointFolder(tmp_path, stage.identity).load_newest()
    assert found is not None
    assert found[0] == 32
    stage.restore(found[1])
    assert stage.flats is not None
    again = fit_geometry(photos(), config, initial=hazy_wall(), checkpoint_dir=tmp_path)
    for name, tensor in whole.tensors().items():
        assert torch.equal(tensor, again.tensors()[name]), name


def test_cameras_on_both_sides_make_no_bound() -> None:
    cameras, pictures = photographs()
    behind = dataclasses.replace(
        cameras[0], viewmat=cameras[0].viewmat @ torch.diag(torch.tensor([1.0, -1.0, 1.0, 1.0]))
    )
    assert isinstance(behind, Camera)
    found = flatten_walls(hazy_wall(), [*cameras, behind], [*pictures, pictures[0]])
    assert found is not None
    assert not bool(found[0].fresh.any())
