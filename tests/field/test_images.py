"""Laws of mirror images, against the shoebox tracer and against themselves."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from rf3dgs.core.angles import angle_between
from rf3dgs.core.errors import InputError
from rf3dgs.core.frames import Pose
from rf3dgs.core.grids import equirect_grid, pinhole_grid
from rf3dgs.core.units import SPEED_OF_LIGHT, friis_gain
from rf3dgs.field.images import image_chain, mirrored, sequences
from rf3dgs.field.rays import RAY_FIELDS
from rf3dgs.field.reflections import RIPPLE, Marks
from rf3dgs.field.sources import PointSources
from rf3dgs.field.ways import Reach
from rf3dgs.geometry import Patches, Planes
from rf3dgs.geometry.patches import plane_axes
from rf3dgs.propagation.room import shoebox
from rf3dgs.spectra.spectrum import Instrument
from rf3dgs.splats.gaussians import Gaussians
from rf3dgs.splats.obstacles import Obstacles
from rf3dgs.splats.surface import sample_mesh

SIZE = torch.tensor([6.0, 5.0, 3.0])
TX = torch.tensor([1.0, 1.2, 2.4])
FREQUENCY = 60e9
FREE = Obstacles(torch.zeros(0, 3), torch.zeros(0, 4), torch.zeros(0, 3), torch.zeros(0))


def box_planes() -> Planes:
    """The walls of the box from the origin to SIZE, in the order of `room.WALLS`, normals inwards."""
    normals = torch.cat([torch.stack((row, -row)) for row in torch.eye(3)])
    offsets = torch.stack([value for size in SIZE for value in (torch.tensor(0.0), -size)])
    return Planes(normals, offsets)


def box_sources(order: int, *, gamma_db: float = -3.0, tx: torch.Tensor = TX) -> PointSources:
    planes = box_planes()
    reflection = torch.tensor([gamma_db, 0.0, 0.0]).expand(6, 3)
    third = torch.arange(6) if order == 3 else None
    return PointSources(tx, FREQUENCY, planes, None, sequences(6, min(order, 2), third=third), reflection)


def receivers(count: int = 12, seed: int = 0) -> torch.Tensor:
    return 0.3 + (SIZE - 0.6) * torch.rand(count, 3, generator=torch.Generator().manual_seed(seed))


@pytest.mark.parametrize("order", [1, 2, 3])
def test_a_box_of_mirrors_is_the_shoebox(order):
    """Each of the tracer's paths is a ray: gain to 0.2 dB, delay to 10 ps, directions to 0.01 degrees."""
    where = receivers()
    gamma_db = -3.0
    truth = shoebox(
        SIZE.tolist(),
        Pose(TX),
        Pose(where),
        FREQUENCY,
        order=order,
        reflection=-(10 ** (gamma_db / 20)),
        dtype=torch.float64,
    )
    for number, rays in enumerate(box_sources(order, gamma_db=gamma_db).rays_each(where, FREE)):
        delay = truth.delay[number]
        assert len(rays) == len(delay)
        rank = rays.delay.argsort()
        torch.testing.assert_close(rays.delay[rank].double(), delay, atol=10e-12, rtol=0)
        late = (rays.delay.double()[:, None] - delay).abs()
        aoa, aod = truth.aoa[number].float(), truth.aod[number].float()
        apart = angle_between(rays.arrival[:, None], aoa[None]) + angle_between(rays.departure[:, None], aod[None])
        match = (apart + (late > 10e-12) * 10).argmin(-1)
        assert len(match.unique()) == len(match), "every path has a ray of its own"
        rows = torch.arange(len(match))
        assert math.degrees(float(apart[rows, match].max())) < 0.02
        gain_db = 10 * torch.log10(truth.path_gain[number][match].float() / rays.power)
        assert float(gain_db.abs().max()) < 0.2
        assert torch.equal(truth.order[number][match].long(), rays.order)


def test_one_mirror_gives_one_ray_more():
    """A conducting floor: the image below it, Friis' gain over the whole way, the reflection where the angles agree."""
    floor = Planes(torch.tensor([[0.0, 0.0, 1.0]]), torch.zeros(1))
    sources = PointSources(TX, FREQUENCY, floor, None, sequences(1, 2), torch.zeros(1, 3))
    here = torch.tensor([4.0, 3.0, 1.4])
    rays = sources.rays(here, FREE)
    assert rays.order.tolist() == [0, 1]
    image = TX * torch.tensor([1.0, 1.0, -1.0])
    distance = torch.linalg.vector_norm(here - image)
    torch.testing.assert_close(rays.delay[1], distance / SPEED_OF_LIGHT)
    torch.testing.assert_close(rays.power[1], friis_gain(distance, FREQUENCY))
    point = rays.points[1, 0]
    assert abs(float(point[2])) < 1e-5
    torch.testing.assert_close(rays.arrival[1, 2], rays.departure[1, 2], atol=1e-5, rtol=0)
    torch.testing.assert_close(rays.arrival[1, :2], -rays.departure[1, :2], atol=1e-5, rtol=0)
    torch.testing.assert_close(rays.arrival[1], torch.nn.functional.normalize(point - here, dim=-1))


def test_exchanging_transmitter_and_receiver_changes_no_gain():
    """Reciprocity: the same lengths, gains and angles of incidence, arrival and departure exchanged."""
    here = torch.tensor([4.4, 3.1, 1.3])
    planes = box_planes()
    reflection = torch.tensor([[-2.0, -9.0, 4.0]]) * torch.linspace(0.5, 1.5, 6)[:, None]
    there = PointSources(TX, FREQUENCY, planes, None, sequences(6, 2, third=torch.arange(6)), reflection)
    back = replace(there, tx=here)
    out, home = there.rays(here, FREE), back.rays(TX, FREE)
    assert len(out) == len(home)
    reverse = {}
    for row in range(len(home)):
        walk = [plane for plane in back.sequence[home.index[row]].tolist() if plane >= 0]
        reverse[tuple(reversed(walk))] = row
    for row in range(len(out)):
        walk = tuple(plane for plane in there.sequence[out.index[row]].tolist() if plane >= 0)
        other = reverse[walk]
        torch.testing.assert_close(out.power[row], home.power[other], rtol=1e-3, atol=0)
        torch.testing.assert_close(out.delay[row], home.delay[other], rtol=1e-6, atol=0)
        torch.testing.assert_close(out.arrival[row], home.departure[other], atol=1e-5, rtol=0)


def test_an_image_of_an_image_undoes_itself():
    planes = box_planes()
    normals, offsets = planes.normals[:1].expand(5, 3), planes.offsets[1:2].expand(5)
    points = receivers(5)
    torch.testing.assert_close(mirrored(mirrored(points, normals, offsets), normals, offsets), points)


def test_images_over_two_parallel_walls_move_by_twice_their_distance():
    chain = image_chain(
        TX, *(getattr(box_planes(), name) for name in ("normals", "offsets")), torch.tensor([[0, 1, -1]])
    )
    shift = chain[0, 3] - TX
    torch.testing.assert_close(shift, torch.tensor([2 * float(SIZE[0]), 0.0, 0.0]))


def test_images_over_a_corner_do_not_depend_on_the_order():
    planes = box_planes()
    rows = torch.tensor([[0, 2, -1], [2, 0, -1]])
    chain = image_chain(TX, planes.normals, planes.offsets, rows)
    torch.testing.assert_close(chain[0, 3], chain[1, 3])


def test_delay_departure_arrival_and_points_tell_the_same_way():
    where = receivers(6, 4)
    for here, rays in zip(where, box_sources(3).rays_each(where, FREE), strict=True):
        for row in range(len(rays)):
            way = torch.stack((TX, *rays.points[row], here))
            length = torch.linalg.vector_norm(way[1:] - way[:-1], dim=-1).sum()
            torch.testing.assert_close(length / SPEED_OF_LIGHT, rays.delay[row], rtol=1e-5, atol=0)
            first = torch.nn.functional.normalize(way[1] - TX, dim=-1)
            last = torch.nn.functional.normalize(way[int(rays.order[row])] - here, dim=-1)
            torch.testing.assert_close(first, rays.departure[row], atol=1e-4, rtol=0)
            torch.testing.assert_close(last, rays.arrival[row], atol=1e-4, rtol=0)


def column() -> Gaussians:
    """A square column of 0.6 m between transmitter, floor and receiver."""
    low, high = (2.5, 2.0, 0.0), (3.1, 2.6, 3.0)
    corner = [[(low, high)[i >> axis & 1][axis] for axis in range(3)] for i in range(8)]
    quads = ((0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3))
    faces = [triangle for a, b, c, d in quads for triangle in ((a, b, c), (a, c, d))]
    return sample_mesh(torch.tensor(corner), torch.tensor(faces), spacing=0.1, thickness=0.01)


def test_the_gate_closes_behind_a_column():
    solid = column()
    obstacles = Obstacles(solid.means, solid.quats, solid.scales, solid.opacities)
    floor = Planes(torch.tensor([[0.0, 0.0, 1.0]]), torch.zeros(1))
    sources = PointSources(TX, FREQUENCY, floor, None, sequences(1, 1), torch.zeros(1, 3))
    behind = TX + 2.2 * (torch.tensor([2.8, 2.3, 2.0]) - TX)
    assert len(sources.rays(behind, FREE)) == 2
    assert len(sources.rays(behind, obstacles)) == 0
    beside = behind + torch.tensor([0.0, -2.0, 0.0])
    assert sources.rays(beside, obstacles).order.tolist() == [0, 1]


def test_a_plane_that_a_leg_ends_on_does_not_stand_in_its_way():
    """Gaussians of the mirror itself that reach over the 10 cm at a leg's end are passed by their label."""
    corners = torch.tensor([[-1.0, -1.0, 0.0], [9.0, -1.0, 0.0], [9.0, 9.0, 0.0], [-1.0, 9.0, 0.0]])
    thick = sample_mesh(corners, torch.tensor([[0, 1, 2], [0, 2, 3]]), spacing=0.3, thickness=0.15)
    floor = Planes(torch.tensor([[0.0, 0.0, 1.0]]), torch.zeros(1))
    sources = PointSources(TX, FREQUENCY, floor, None, sequences(1, 1), torch.zeros(1, 3), open_above=0.2)
    here = torch.tensor([4.0, 3.0, 1.4])
    shape = (thick.means, thick.quats, thick.scales, thick.opacities)
    assert sources.rays(here, Obstacles(*shape)).order.tolist() == [0]
    assert sources.rays(here, Obstacles(*shape, torch.zeros(len(thick), dtype=torch.long))).order.tolist() == [0, 1]


def test_a_mirror_reflects_only_where_it_has_surface():
    floor = Planes(torch.tensor([[0.0, 0.0, 1.0]]), torch.zeros(1))
    steps = torch.arange(0.05, 3.0, 0.1)
    spots = torch.cartesian_prod(steps, steps, torch.zeros(1))
    patches = Patches.of(floor, [spots])
    sources = PointSources(TX, FREQUENCY, floor, patches, sequences(1, 1), torch.zeros(1, 3))
    where = receivers(40, 7)
    for rays, here in zip(sources.rays_each(where, FREE), where, strict=True):
        share = TX[2] / (TX[2] + here[2])
        point = TX + share * (here * torch.tensor([1.0, 1.0, -1.0]) - TX) * torch.tensor([1.0, 1.0, 0.0])
        if float((point[:2] - 3.0).abs().min()) > 0.15:
            assert (1 in rays.order.tolist()) == bool((point[:2] < 3.0).all())


def test_reach_closes_gaps_and_keeps_outlines():
    """A plate of 10 by 6 cells: its slit, two cells wide, closes; its notch, three cells wide, stays."""
    floor = Planes(torch.tensor([[0.0, 0.0, 1.0]]), torch.zeros(1))
    cells = torch.cartesian_prod(torch.arange(6.0), torch.arange(10.0))
    slit = ((cells[:, 1] == 3) | (cells[:, 1] == 4)) & (cells[:, 0] > 0)
    notch = (cells[:, 1] >= 6) & (cells[:, 1] <= 8) & (cells[:, 0] > 2)
    axes = plane_axes(floor.normals)[0]
    reach = Reach.of(Patches.of(floor, [(0.1 * cells[~slit & ~notch] + 0.05) @ axes]))
    asked = torch.cartesian_prod(torch.arange(-3.0, 9.0), torch.arange(-3.0, 13.0))
    held = reach.holds(((0.1 * asked + 0.05) @ axes).double().numpy(), np.zeros(len(asked), dtype=np.int64))
    row, column = asked.T
    plate = (row >= 0) & (row < 6) & (column >= 0) & (column < 10)
    open_notch = (column >= 6) & (column <= 8) & (row > 2)
    assert held.tolist() == (plate & ~open_notch).tolist()


def test_reach_is_empty_far_beyond_its_cells():
    floor = Planes(torch.tensor([[0.0, 0.0, 1.0]]), torch.zeros(1))
    reach = Reach.of(Patches.of(floor, [torch.tensor([[0.05, 0.05, 0.0], [0.15, 0.05, 0.0]])]))
    local = np.array([[0.05, 0.05], [0.05, 0.15], [0.05, 0.25], [1e15, 0.05], [-1e15, -1e15]])
    points = local @ plane_axes(floor.normals)[0].double().numpy()
    assert reach.holds(points, np.zeros(5, dtype=np.int64)).tolist() == [True, False, False, False, False]


def test_many_receivers_get_what_each_gets_alone(monkeypatch):
    """Answers do not depend on who else is asked, nor on the parts in which many are answered."""
    solid = column()
    obstacles = Obstacles(solid.means, solid.quats, solid.scales, solid.opacities)
    where, sources = receivers(50, 9), box_sources(3)
    alone = [sources.rays(here, obstacles) for here in where]
    assert len({len(rays) for rays in alone}) > 3
    for at_once in (256, 8):
        monkeypatch.setattr("rf3dgs.field.sources.AT_ONCE", at_once)
        place, joined = sources.arrivals(where, obstacles)
        assert bool((place.diff() >= 0).all())
        for number, one in enumerate(alone):
            for name in RAY_FIELDS:
                assert torch.equal(getattr(joined, name)[place == number], getattr(one, name))
        for one, rays in zip(alone, sources.rays_each(where, obstacles), strict=True):
            assert torch.equal(rays.power, one.power)


def test_rays_within_a_cone_are_those_of_all_that_arrive_there():
    sources, here = box_sources(3), torch.tensor([4.0, 3.1, 1.4])
    every, middle = sources.rays(here, FREE), torch.nn.functional.normalize(torch.tensor([1.0, -0.4, 0.3]), dim=0)
    for angle in (0.4, 0.9, 1.5, 2.0):
        found = sources.rays(here, FREE, within=(middle, angle))
        inside = every.only(angle_between(every.arrival, middle.expand_as(every.arrival)) <= angle)
        assert 0 < len(inside) < len(every)
        for name in RAY_FIELDS:
            assert torch.equal(getattr(found, name), getattr(inside, name))


def test_nobody_to_ask_gives_no_rays():
    place, rays = box_sources(2).arrivals(torch.zeros(0, 3), FREE)
    assert len(place) == len(rays) == 0
    assert box_sources(2).rays_each(torch.zeros(0, 3), FREE) == []


def test_a_decided_line_of_sight_is_taken_for_each_receiver(monkeypatch):
    monkeypatch.setattr("rf3dgs.field.sources.AT_ONCE", 4)
    seen = torch.arange(10) % 3 == 0
    found = box_sources(1).rays_each(receivers(10), FREE, in_sight=seen)
    assert [0 in rays.order.tolist() for rays in found] == seen.tolist()


@pytest.mark.parametrize("grid", [equirect_grid(90, 45), pinhole_grid(70, 50, 100.0)])
def test_a_picture_is_the_sum_of_all_lobes(grid):
    """Against every pixel and every ray; what is beyond 3.2 lobes is 123 dB down, and float32 has 7 digits."""
    pose = Pose.look_at([4.0, 3.1, 1.4], TX + 0.3)
    instrument = Instrument.gaussian(math.radians(7))
    rays = box_sources(2).rays(pose.position, FREE)
    pixels = pose.to_world(grid.directions)[..., None, :]
    angle = angle_between(*torch.broadcast_tensors(pixels, rays.arrival))
    expected = (instrument.kernel(angle) * rays.power).sum(-1)
    assert float(expected.max()) > 0.5 * float(rays.power.max())
    picture = rays.picture(pose, grid, instrument)
    torch.testing.assert_close(picture, expected, rtol=1e-4, atol=1e-12 * float(rays.power.sum()))


def test_a_mark_changes_the_reflection_where_it_is():
    floor = Planes(torch.tensor([[0.0, 0.0, 1.0]]), torch.zeros(1))
    plain = PointSources(TX, FREQUENCY, floor, None, sequences(1, 1), torch.tensor([[-20.0, 0.0, 0.0]]))
    here = torch.tensor([4.0, 3.0, 1.4])
    point = plain.rays(here, FREE).points[1, :1]
    marked = replace(plain, marks=Marks(point, torch.zeros(1, dtype=torch.long), torch.tensor([10.0]), 0.3))
    gained = 10 * torch.log10(marked.rays(here, FREE).power / plain.rays(here, FREE).power)
    assert float(gained[0]) == 0.0
    assert 9.0 < float(gained[1]) <= 10.0
    far = torch.tensor([1.5, 1.5, 0.6])
    torch.testing.assert_close(marked.rays(far, FREE).power, plain.rays(far, FREE).power, rtol=1e-3, atol=0)


def test_a_ripple_changes_the_reflection_by_the_angle():
    floor = Planes(torch.tensor([[0.0, 0.0, 1.0]]), torch.zeros(1))
    plain = PointSources(TX, FREQUENCY, floor, None, sequences(1, 1), torch.tensor([[-20.0, 0.0, 0.0]]))
    ripple = 8.0 * torch.linspace(0, 1, RIPPLE)[None]
    rippled = replace(plain, ripple=ripple)
    for here in (torch.tensor([4.0, 3.0, 1.4]), torch.tensor([1.2, 1.3, 0.6]), torch.tensor([30.0, 3.0, 0.1])):
        before, after = plain.rays(here, FREE), rippled.rays(here, FREE)
        gained = 10 * torch.log10(after.power / before.power)
        assert float(gained[0]) == 0.0
        assert float(gained[1]) == pytest.approx(8.0 * abs(float(before.departure[1, 2])), abs=1e-3)
    with pytest.raises(InputError, match=r"ripple must be \[1, 81\], a row a plane; got \[1, 5\]"):
        replace(plain, ripple=torch.zeros(1, 5))


def test_no_reflection_gains_power():
    floor = Planes(torch.tensor([[0.0, 0.0, 1.0]]), torch.zeros(1))
    sources = PointSources(TX, FREQUENCY, floor, None, sequences(1, 1), torch.tensor([[12.0, 0.0, 0.0]]))
    rays = sources.rays(torch.tensor([4.0, 3.0, 1.4]), FREE)
    torch.testing.assert_close(rays.power, friis_gain(rays.delay * SPEED_OF_LIGHT, FREQUENCY))


def test_a_receiver_on_the_mirror_and_a_grazing_way_stay_finite():
    where = torch.tensor([[4.0, 3.0, 0.0], [4.0, 3.0, 1e-7], [1.0, 1.2, 2.4], [0.0, 0.0, 0.0]])
    for rays in box_sources(3).rays_each(where, FREE):
        assert bool(torch.isfinite(rays.power).all())
        assert bool(torch.isfinite(rays.arrival).all())


def test_wrong_sources_are_refused():
    good = box_sources(1)
    for change, message in (
        ({"tx": torch.zeros(2)}, "tx must be three coordinates"),
        ({"reflection": torch.zeros(5, 3)}, r"reflection must be \[6, 3\]"),
        ({"sequence": torch.zeros(2, 3, dtype=torch.long)}, "line of sight, all -1, first"),
        ({"sequence": torch.tensor([[-1, -1, -1], [7, -1, -1]])}, "planes below 6 without gaps"),
        ({"sequence": torch.tensor([[-1, -1, -1], [-1, 2, -1]])}, "planes below 6 without gaps"),
    ):
        with pytest.raises(InputError, match=message):
            replace(good, **change)
