"""Laws of a field whose transmitter moves, in a room whose walls are known exactly; the shoebox tracer is the truth."""

import math
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from rf3dgs.channel.paths import Paths
from rf3dgs.core.angles import angle_between
from rf3dgs.core.errors import InputError
from rf3dgs.core.frames import Pose
from rf3dgs.core.units import SPEED_OF_LIGHT
from rf3dgs.field.bounced import bounced
from rf3dgs.field.images import sequences
from rf3dgs.field.io import load_field
from rf3dgs.field.lit import LitSurface
from rf3dgs.field.moving import with_images
from rf3dgs.field.radiance import bounce
from rf3dgs.field.radio_field import RadioField
from rf3dgs.field.sources import PointSources
from rf3dgs.geometry import Patches, Planes
from rf3dgs.propagation.room import shoebox
from rf3dgs.spectra.codec import DbWindow
from rf3dgs.spectra.spectrum import Instrument
from rf3dgs.splats.gaussians import Gaussians
from rf3dgs.splats.obstacles import Obstacles
from rf3dgs.splats.surface import sample_mesh

SIZE = torch.tensor([6.0, 5.0, 3.0])
HERE, THERE = Pose([1.0, 1.2, 2.4]), Pose([4.8, 1.1, 2.2])
GAMMA_DB = (-6.0, -9.0, -12.0, -7.0, -10.0, -8.0)
SCREEN = 3.0  # the screen's place in x [m]; it reaches from y = 0 to 2.5 and from the floor to the ceiling
LAWS = torch.tensor([-60.0, 0.7, 4.0, -90.0, -1.5])


def box(low: Tensor, high: Tensor) -> Gaussians:
    corner = [[float(high[axis] if i >> axis & 1 else low[axis]) for axis in range(3)] for i in range(8)]
    quads = ((0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3))
    faces = [triangle for a, b, c, d in quads for triangle in ((a, b, c), (a, c, d))]
    return sample_mesh(torch.tensor(corner), torch.tensor(faces), spacing=0.2, thickness=0.01)


def walls() -> tuple[Planes, Patches]:
    """The six walls in the order of the shoebox tracer, with surface everywhere."""
    normals, offsets, points = [], [], []
    for axis in range(3):
        for high in (0, 1):
            spots = [torch.arange(0.05, float(SIZE[other]), 0.1) for other in range(3)]
            spots[axis] = SIZE[axis : axis + 1] * high
            normals.append(torch.eye(3)[axis] * (1.0 - 2.0 * high))
            offsets.append(SIZE[axis] * high * (1.0 - 2.0 * high))
            points.append(torch.cartesian_prod(*spots))
    planes = Planes(torch.stack(normals), torch.stack(offsets))
    return planes, Patches.of(planes, points)


def room(*, screen: bool = False) -> RadioField:
    """A field with the transmitter HERE, whose walls are mirrors of known gain."""
    shell = box(torch.zeros(3), SIZE)
    planes, patches = walls()
    distance = (shell.means @ planes.normals.mT - planes.offsets).abs()
    plane_of, normals = distance.argmin(-1), planes.normals[distance.argmin(-1)]
    if screen:
        added = box(torch.tensor([SCREEN - 0.02, 0.0, 0.0]), torch.tensor([SCREEN + 0.02, 2.5, 3.0]))
        side = (added.means[:, :1] - SCREEN).sign() * torch.eye(3)[:1]
        shell = Gaussians.join([shell, added])
        plane_of = torch.cat((plane_of, torch.full((len(added),), -1)))
        normals = torch.cat((normals, side))
    count, generator = len(shell), torch.Generator().manual_seed(0)
    surface = LitSurface(
        means=shell.means,
        quats=shell.quats,
        log_scales=shell.log_scales,
        logit_opacities=shell.logit_opacities,
        normals=normals,
        visibility=torch.ones(count),
        segment_of=plane_of.clamp_min(0),
        cell_of=plane_of.clamp_min(0),
        laws=LAWS.repeat(6, 1),
        segment_sh=torch.randn(6, 16, generator=generator),
        cell_sh=torch.randn(6, 16, generator=generator),
        level=torch.randn(count, generator=generator),
        ambient=bounce(shell.means, HERE.position),
        segment_csi=torch.randn(6, 9, 4, generator=generator),
        cell_csi=torch.randn(6, 9, 4, generator=generator),
        own_csi=torch.randn(count, 4, generator=generator),
        tx=HERE.position,
        window=DbWindow(-140.0, -60.0),
    )
    sources = PointSources(
        HERE.position,
        60e9,
        planes,
        patches,
        sequences(6, 1),
        torch.tensor([[level, 0.0, 0.0] for level in GAMMA_DB]),
        mirrors=torch.ones(6, dtype=torch.bool),
    )
    return RadioField(
        surface=surface,
        sources=sources,
        solidity=shell.opacities,
        frequency=60e9,
        instrument=Instrument.gaussian(math.radians(3)),
        tx=HERE,
        bounds=torch.tensor([[0.7, 0.7, 0.7], [5.3, 4.3, 2.3]]),
        colour=torch.full((count, 3), 100, dtype=torch.uint8),
        plane_of=plane_of,
    )


def receivers(count: int) -> Pose:
    return Pose.scatter(((0.7, 0.7, 0.7), (5.3, 4.3, 2.3)), count, 5)


def traced(tx: Pose, pose: Pose) -> Paths:
    return shoebox(SIZE.tolist(), tx, pose, 60e9, 2, [-(10 ** (level / 20)) for level in GAMMA_DB])


@pytest.fixture(scope="module")
def field() -> RadioField:
    return room()


@pytest.fixture(scope="module")
def there(field) -> RadioField:
    return field.moved_to(THERE)


def test_a_moved_field_has_the_mirror_paths_of_the_new_place_exactly(there):
    pose = receivers(12)
    truth, found = traced(THERE, pose), there.paths(pose, strongest=60, parts="sources")
    for number in range(len(pose)):
        real = truth.valid[number]
        assert int(found.valid[number].sum()) == int(real.sum())
        for path in torch.nonzero(real).squeeze(-1).tolist():
            apart = angle_between(found.aoa[number], truth.aoa[number, path].expand_as(found.aoa[number]))
            best = int(torch.where(found.valid[number], apart, torch.inf).argmin())
            # Positions of some metres in float32: 1e-6 rad, a tenth of a picosecond.
            assert float(apart[best]) < 1e-5
            assert abs(float(found.delay[number, best] - truth.delay[number, path])) < 1e-13
            left = angle_between(found.aod[number, best], truth.aod[number, path])
            assert float(left) < 1e-5
            level_db = 10 * torch.log10(found.path_gain[number, best] / truth.path_gain[number, path])
            assert abs(float(level_db)) < 1e-3
    assert there.tx is THERE
    assert torch.equal(there.sources.tx, THERE.position)


def test_the_images_of_a_place_do_not_depend_on_where_the_transmitter_came_from(field, there):
    back, stayed = there.moved_to(HERE), field.moved_to(HERE)
    for name in ("tx", "sequence", "mirrors"):
        assert torch.equal(getattr(back.sources, name), getattr(stayed.sources, name)), name
    assert torch.equal(back.surface.visibility, stayed.surface.visibility)
    trained = {tuple(row) for row in field.sources.sequence.tolist()}
    assert trained <= {tuple(row) for row in back.sources.sequence.tolist()}


def test_shadows_move_with_the_transmitter():
    divided = room(screen=True)
    for tx in (HERE, THERE):
        surface = divided.moved_to(tx).surface
        way = surface.means - tx.position
        share = (SCREEN - tx.position[0]) / way[:, 0]
        crossing = tx.position[1] + share * way[:, 1]
        beyond = (share > 0) & (share < 1) & (divided.plane_of >= 0)
        behind, free = beyond & (crossing < 2.2), beyond & (crossing > 2.8)
        assert min(int(behind.sum()), int(free.sum())) > 200
        # The screen's two sides of opacity 0.98 let through a few per cent between their Gaussians.
        assert float(surface.visibility[behind].mean()) < 0.05
        assert float(surface.visibility[free].mean()) > 0.95


def test_the_lit_laws_stay_and_the_residual_goes(field, there):
    assert torch.equal(there.surface.laws[:, :3], field.surface.laws[:, :3])
    for name in ("segment_sh", "cell_sh", "level"):
        assert float(getattr(there.surface, name).abs().max()) == 0.0
        assert float(getattr(field.surface, name).abs().max()) > 0.0
    assert there.sources.open_above == field.sources.open_above
    assert torch.equal(there.bounds, field.bounds)
    assert there.meta["trained with the transmitter at"] == "1.000 1.200 2.400"
    assert there.moved_to(HERE).meta == there.meta


def test_the_ambient_level_is_that_of_what_was_dark():
    divided = room(screen=True)
    divided = replace(divided, surface=divided.surface.without_residual())
    moved = divided.moved_to(THERE)
    level = float(moved.surface.laws[0, 3])
    assert moved.surface.laws[:, 3].tolist() == [level] * 6
    assert float(moved.surface.laws[:, 4].abs().max()) == 0.0
    # However the place was reached; a place's own cell decides by how much the level shifts.
    assert float(moved.moved_to(HERE).surface.laws[0, 3]) == pytest.approx(level, abs=0.1)
    home = divided.moved_to(HERE).surface
    trained = replace(divided.surface, visibility=home.visibility)
    home = replace(divided, surface=trained).moved_to(HERE).surface
    dark = home.visibility < 0.1
    before, after = (10 * torch.log10(one.parts(torch.zeros_like(one.means))[1][dark]) for one in (trained, home))
    assert float((before - after).median()) == pytest.approx(0.0, abs=0.05)


def test_one_bounce_falls_off_with_distance_and_with_both_cosines():
    plate = sample_mesh(torch.tensor([[0.0, 0, 0], [0.2, 0, 0], [0, 0.2, 0]]), torch.tensor([[0, 1, 2]]), spacing=0.1)
    low, far = plate.means, torch.tensor([[0.0, 0.0, 2.0], [0.0, 0.0, 4.0], [3.0, 0.0, 3.0]])
    count = len(low) + 3
    tiny = torch.full((3, 3), -6.0)
    normals = torch.cat((torch.tensor([[0.0, 0.0, 1.0]]).expand(len(low), 3), torch.tensor([[0.0, 0.0, -1.0]] * 3)))
    cell = torch.cat((torch.zeros(len(low), dtype=torch.long), torch.arange(1, 4)))
    tx = torch.tensor([0.0, 1.0, 1.0])
    surface = LitSurface(
        means=torch.cat((low, far)),
        quats=torch.cat((plate.quats, torch.tensor([[1.0, 0.0, 0.0, 0.0]] * 3))),
        log_scales=torch.cat((plate.log_scales, tiny)),
        logit_opacities=torch.cat((plate.logit_opacities, torch.full((3,), -10.0))),
        normals=normals,
        visibility=torch.cat((torch.ones(len(low)), torch.zeros(3))),
        segment_of=torch.zeros(count, dtype=torch.long),
        cell_of=cell,
        laws=torch.tensor([[-60.0, 0.0, 0.0, -90.0, 0.0]]),
        segment_sh=torch.zeros(1, 16),
        cell_sh=torch.zeros(4, 16),
        level=torch.zeros(count),
        ambient=bounce(torch.cat((low, far)), tx),
        segment_csi=torch.zeros(1, 9, 4),
        cell_csi=torch.zeros(4, 9, 4),
        own_csi=torch.zeros(count, 4),
        tx=tx,
        window=DbWindow(-140.0, -60.0),
    )
    got = bounced(surface, Obstacles(surface.means, surface.quats, surface.scales, surface.opacities))
    # The plate is 0.2 m wide, at 2 m; what comes twice as far is a quarter, what comes at 45 degrees twice cos 45 less.
    one = got[1:, 0] / got[1, 0]
    assert one.tolist() == pytest.approx([1.0, 0.25, 0.5 * 4.0 / 18.0], rel=0.08)
    assert float(got[0, 0]) == 0.0
    legs = torch.linalg.vector_norm(low.mean(0) - tx) + torch.linalg.vector_norm(far - low.mean(0), dim=-1)
    torch.testing.assert_close(got[1:, 1] / got[1:, 0], legs / SPEED_OF_LIGHT * 1e9, atol=0.2, rtol=0)
    departure = torch.nn.functional.normalize(low.mean(0) - tx, dim=-1)
    torch.testing.assert_close(got[1:, 2:] / got[1:, :1], departure.expand(3, 3), atol=0.05, rtol=0)
    obstacles = Obstacles(surface.means, surface.quats, surface.scales, surface.opacities)
    dark = bounced(replace(surface, visibility=torch.zeros(count)), obstacles)
    assert float(dark.abs().max()) == 0.0


def test_what_a_screen_hides_gets_less_ambient_light():
    divided = room(screen=True)
    surface = divided.surface
    places = (surface.means / 0.5).floor().long()
    cell_of = torch.unique(torch.cat((surface.segment_of[:, None], places), -1), dim=0, return_inverse=True)[1]
    cells = int(cell_of.max()) + 1
    finer = replace(surface, cell_of=cell_of, cell_sh=torch.zeros(cells, 16), cell_csi=torch.zeros(cells, 9, 4))
    moved = replace(divided, surface=finer).moved_to(HERE).surface
    level = 10 * torch.log10(moved.parts(torch.zeros_like(moved.means))[1])
    means = moved.means
    behind = (means[:, 0] > 5.9) & (means[:, 1] < 2.0)
    before = (means[:, 0] < 0.1) & (means[:, 1] < 2.0)
    assert float(level[behind].mean()) < float(level[before].mean()) - 2.0


def test_silent_planes_mirror_nothing_at_the_new_place_either(field):
    mirrors = torch.tensor([True, True, True, True, False, True])
    silent = replace(field, sources=replace(field.sources, mirrors=mirrors)).moved_to(THERE)
    assert not bool((silent.sources.sequence == 4).any())
    forgotten = replace(field, sources=replace(field.sources, sequence=sequences(6, 1)[:5], mirrors=None))
    moved = forgotten.moved_to(THERE).sources
    assert moved.mirrors.tolist() == [True] * 4 + [False] * 2
    assert set(moved.sequence.unique().tolist()) == {-1, 0, 1, 2, 3}


def test_the_order_says_how_many_reflections_are_sought(field):
    for order in (0, 1, 2, 3):
        assert int(field.moved_to(THERE, order=order).sources.order.max()) == order


def test_a_field_without_planes_or_sources_moves_too(field):
    line = PointSources.line_of_sight(HERE.position, field.frequency, open_above=0.3)
    moved = replace(field, sources=line, plane_of=None).moved_to(THERE)
    assert torch.equal(moved.sources.tx, THERE.position)
    assert moved.sources.open_above == 0.3
    assert field.without_sources().moved_to(THERE).sources is None


def test_a_moved_field_comes_back_from_disk_and_moves_on(there, tmp_path):
    there.save(tmp_path / "there.field")
    loaded = load_field(tmp_path / "there.field")
    pose = receivers(3)
    before, after = there.paths(pose, parts="sources"), loaded.paths(pose, parts="sources")
    torch.testing.assert_close(after.delay, before.delay)
    torch.testing.assert_close(after.path_gain, before.path_gain)
    assert torch.equal(loaded.tx.position, THERE.position)
    assert torch.equal(loaded.surface.tx, THERE.position)
    assert torch.equal(loaded.surface.ambient_shift, there.surface.ambient_shift)
    torch.testing.assert_close(loaded.surface.visibility, there.surface.visibility, atol=1 / 510 + 1e-6, rtol=0)
    assert loaded.meta == there.meta
    assert torch.equal(loaded.sources.mirrors, there.sources.mirrors)
    assert torch.equal(loaded.moved_to(HERE).sources.sequence, there.moved_to(HERE).sources.sequence)


@pytest.mark.parametrize(
    ("where", "message"),
    [
        (
            dict(tx=Pose([20.0, 2.5, 1.5])),
            r"free space of this field; from \(20.00, 2.50, 1.50\) m \d\.\d% of the surface is lit",
        ),
        (dict(tx=Pose(torch.ones(2, 3))), r"tx must be one pose; got a batch \[2\]"),
        (dict(tx=THERE, order=4), "order must be from 0 to 3; got 4"),
    ],
)
def test_places_that_cannot_be_are_refused(field, where, message):
    with pytest.raises(InputError, match=message):
        field.moved_to(**where)


def test_mirrors_must_fit_the_planes(field):
    with pytest.raises(InputError, match=r"mirrors must be \[6\], one for each plane; got \[5\]"):
        replace(field.sources, mirrors=torch.ones(5, dtype=torch.bool))


def test_planes_that_mirror_to_a_receiver_go_before_larger_ones():
    planes = Planes(torch.tensor([[0.0, 0.0, 1.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]]), torch.tensor([-9.0, -8.0, 0.0]))
    steps, wide = torch.arange(0.05, 3.0, 0.1), torch.arange(60.0, 70.0, 0.1)
    far = torch.cartesian_prod(wide, wide, torch.zeros(1))  # surface under nobody
    points = [far - torch.tensor([0, 0, 9.0]), far - torch.tensor([0, 0, 8.0])]
    patches = Patches.of(planes, [*points, torch.cartesian_prod(torch.zeros(1), steps, steps)])
    row = torch.full((1, 3), -1)
    sources = PointSources(HERE.position, 60e9, planes, patches, row, torch.zeros(3, 3))
    probes = torch.tensor([[2.0, 2.0, 1.5], [3.0, 1.5, 1.2]])
    found = with_images(sources, probes, order=1, planes=1, largest=1)
    assert found.sequence[:, 0].tolist() == [-1, 2]
