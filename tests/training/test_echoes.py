"""Laws of echoes: places of single bounces, and geometry out of them, in rooms whose walls are known."""

import math
from dataclasses import replace
from itertools import pairwise

import pytest
import torch
from torch import Tensor

from rf3dgs.core.errors import InputError
from rf3dgs.core.frames import Pose
from rf3dgs.core.grids import equirect_grid
from rf3dgs.core.units import SPEED_OF_LIGHT, friis_gain
from rf3dgs.geometry import Patches, Planes
from rf3dgs.geometry.patches import surface_points
from rf3dgs.propagation.room import shoebox
from rf3dgs.spectra.scan import spectrum_of
from rf3dgs.spectra.spectrum import Instrument, Spectrum
from rf3dgs.splats.gaussians import Gaussians
from rf3dgs.splats.surface import normals, sample_mesh
from rf3dgs.training import corrected, geometry_from_spectra, radio_geometry
from rf3dgs.training.echo_planes import REACH, behind, bounding, filled, in_free_space, refined_by_echoes
from rf3dgs.training.echoes import Echoes, echoes_of, merged

HIGH = torch.tensor([6.0, 5.0, 3.0])
TX = torch.tensor([1.0, 1.2, 2.4])
GRID = equirect_grid(90, 45)


def receivers(count: int = 10) -> Pose:
    share = torch.rand(count, 3, generator=torch.Generator().manual_seed(0))
    return Pose(torch.tensor([0.8, 0.8, 1.0]) + share * torch.tensor([4.4, 3.4, 1.0]))


def wall_towards(start: Tensor, direction: Tensor) -> Tensor:
    """Where rays from `start` along `direction` meet the walls of the room, `[*batch, 3]`."""
    ahead = torch.where(direction > 0, HIGH - start, -start) / torch.where(direction.abs() > 1e-6, direction, 1e-9)
    return start + ahead.amin(-1, keepdim=True) * direction


def spectra_by(places: tuple[Tensor, ...], pose: Pose, directions: Tensor, *, late: float = 0.0) -> Spectrum:
    """Spectra whose pixels are ways over `places`, the one next to the receiver last, `late` [m] too long."""
    here = pose.position[:, None, None, :]
    stops = (TX.expand_as(directions), *places, here.expand_as(directions))
    way = sum(torch.linalg.vector_norm(b - a, dim=-1) for a, b in pairwise(stops))
    departure = torch.nn.functional.normalize(stops[1] - TX, dim=-1)
    power = friis_gain(way, 60e9)
    delay = (way + late) / SPEED_OF_LIGHT
    return Spectrum(power, GRID, pose, 60e9, Instrument.gaussian(math.radians(3)), "ideal", delay, departure, Pose(TX))


def looking(pose: Pose) -> tuple[Tensor, Tensor]:
    directions = pose.to_world(GRID.directions.expand(len(pose), *GRID.shape, 3))
    return directions, wall_towards(pose.position[:, None, None, :], directions)


def single(count: int = 10, *, late: float = 0.0, astray_deg: float = 0.0) -> Spectrum:
    """Every pixel one bounce off the walls, the departures turned at random."""
    pose = receivers(count)
    directions, hit = looking(pose)
    spectra = spectra_by((hit,), pose, directions, late=late)
    assert spectra.aod is not None
    noise = torch.randn(spectra.aod.shape, generator=torch.Generator().manual_seed(1)) * math.radians(astray_deg)
    return replace(spectra, aod=torch.nn.functional.normalize(spectra.aod + noise, dim=-1))


def off_the_walls(points: Tensor) -> Tensor:
    """Distance `[point]` [m] to the nearest wall's plane."""
    return torch.minimum(points.abs(), (points - HIGH).abs()).amin(-1)


def room(spacing: float, *, without: int | None = None) -> Gaussians:
    corner = [[float(HIGH[axis]) if i >> axis & 1 else 0.0 for axis in range(3)] for i in range(8)]
    quads = ((0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3))
    kept = [quad for number, quad in enumerate(quads) if number != without]
    faces = [triangle for a, b, c, d in kept for triangle in ((a, b, c), (a, c, d))]
    return sample_mesh(torch.tensor(corner), torch.tensor(faces), spacing=spacing, degree=1)


def test_an_echo_lies_where_its_wave_bounced():
    spectra = single()
    echoes = echoes_of(spectra, TX)
    assert len(echoes) > 0.5 * spectra.power.numel()
    assert float(off_the_walls(echoes.points).max()) < 2e-3  # float32 delays of 20 m
    assert set(echoes.view.tolist()) == set(range(10))


def test_two_bounces_are_no_echo():
    pose = receivers()
    directions, last = looking(pose)
    turned = torch.nn.functional.normalize(0.5 * HIGH + torch.tensor([0.3, -0.2, 0.1]) - last, dim=-1)
    first = wall_towards(last + 1e-3 * turned, turned)
    echoes = echoes_of(spectra_by((first, last), pose, directions), TX)
    assert len(echoes) < 0.002 * last[..., 0].numel()  # those whose ways cross by chance


def test_what_comes_straight_is_no_echo():
    pose = receivers()
    directions, _ = looking(pose)
    assert len(echoes_of(spectra_by((), pose, directions), TX)) == 0


def test_power_of_later_waves_makes_the_delay_longer_and_moves_no_echo():
    exact, late = echoes_of(single(), TX), echoes_of(single(late=0.15), TX)
    assert len(late) > 0.9 * len(exact)
    assert float(off_the_walls(late.points).max()) < 2e-3


def test_echoes_need_delay_and_departure():
    with pytest.raises(InputError, match="echoes need spectra with delay and departure"):
        echoes_of(replace(single(2), delay=None), TX)


def test_merged_echoes_keep_the_wall_and_look_into_the_room():
    spots = merged(echoes_of(single(), TX), 0.12)
    inside = (spots.points > 0.4) & (spots.points < HIGH - 0.4)
    middle = inside.sum(-1) == 2  # away from edges, where a cube holds two walls
    assert float(off_the_walls(spots.points[middle]).max()) < 2e-3
    inwards = torch.where(spots.points < 0.5 * HIGH, 1.0, -1.0) * ~inside
    assert float((spots.normals * inwards)[middle].sum(-1).min()) > 0.99
    assert int(spots.views.max()) <= 10


def test_planes_that_are_a_little_off_come_back_to_their_echoes():
    echoes = echoes_of(single(astray_deg=0.3), TX)
    lean = math.radians(1.5)
    normal = torch.tensor([math.cos(lean), math.sin(lean), 0.0])
    spots = torch.rand(4000, 3, generator=torch.Generator().manual_seed(0)) * HIGH * torch.tensor([0.0, 1.0, 1.0])
    off = Planes(normal[None], (normal @ spots.mean(0) + 0.08)[None])
    planes, witnesses = refined_by_echoes(off, Patches.of(off, [spots]), echoes)
    assert int(witnesses[0]) > 50
    assert float(planes.normals[0, 0]) > math.cos(math.radians(0.2))
    assert abs(float(planes.normals[0] @ torch.tensor([0.0, 2.5, 1.5]) - planes.offsets[0])) < 0.01


def test_a_plane_without_echoes_stays():
    plane = Planes(torch.tensor([[1.0, 0.0, 0.0]]), torch.tensor([3.0]))
    patch = Patches.of(plane, [torch.tensor([[3.0, 1.0, 1.0], [3.0, 2.0, 2.0]])])
    planes, witnesses = refined_by_echoes(plane, patch, echoes_of(single(), TX))
    assert torch.equal(planes.offsets, plane.offsets)
    assert int(witnesses[0]) < 8


def wall_with_a_hole(behind: bool) -> Patches:
    """A wall at x = 3 whose surface lacks a square of 1 m, seen through which is a floor, or nothing."""
    y, z = torch.meshgrid(torch.arange(0.05, 5, 0.1), torch.arange(0.05, 3, 0.1), indexing="ij")
    cells = torch.stack((torch.full_like(y, 3.0), y, z), -1).reshape(-1, 3)
    hole = (cells[:, 1:] - torch.tensor([2.5, 1.5])).abs().amax(-1) < 0.5
    plane = Planes(torch.tensor([[-1.0, 0.0, 0.0]]), torch.tensor([-3.0]))
    seen = Patches.of(plane, [cells[~hole]])
    here = torch.tensor([[1.0, 2.5, 1.5]])
    through = here + 2.0 * (cells[hole] - here)
    points = torch.cat((cells[~hole], through)) if behind else cells[~hole]
    nobody = torch.zeros(len(points), dtype=torch.long)
    return filled(plane, seen, Echoes(points, nobody, torch.full((len(points),), 0.05), here, here[0]))


def test_a_shadow_on_a_wall_is_filled():
    assert float(wall_with_a_hole(behind=False).areas[0]) == pytest.approx(15.0, abs=0.6)


def test_a_hole_that_waves_came_through_stays_open():
    patch = wall_with_a_hole(behind=True)
    assert not bool(patch.holds(torch.tensor([3.0, 2.5, 1.5]), torch.tensor(0)))
    assert float(patch.areas[0]) < 14.6


def test_free_space_is_where_waves_went_and_nothing_answered():
    echoes = echoes_of(single(), TX)
    free = in_free_space(torch.tensor([[3.0, 2.5, 1.6], [3.0, 2.5, 0.0], [6.0, 2.5, 1.5], [9.0, 2.5, 1.5]]), echoes)
    assert free.tolist() == [True, False, False, False]


def test_behind_is_what_a_wall_hides_from_all_receivers():
    echoes = echoes_of(single(), TX)
    points = torch.rand(4000, 3, generator=torch.Generator().manual_seed(0)) * HIGH
    points[:, 0] = 6.0
    outwards, across = torch.tensor([[1.0, 0.0, 0.0]]), torch.tensor([[0.0, 1.0, 0.0]])
    places = torch.tensor([[6.5, 2.5, 1.5], [5.5, 2.5, 1.5], [6.5, 9.0, 1.5]])
    wall = Planes(outwards, torch.tensor([6.0]))
    assert behind(places, wall, Patches.of(wall, [points]), echoes).tolist() == [True, False, False]
    screen = Planes(across, torch.tensor([2.5]))  # with receivers on both sides
    assert not bool(behind(places, screen, Patches.of(screen, [points.roll(1, 1)]), echoes).any())


@pytest.mark.parametrize(("on_it", "bounds"), [(150, []), (1500, [0])])
def test_a_plane_with_more_echoes_behind_it_than_on_it_bounds_nothing(on_it, bounds):
    echoes = echoes_of(single(), TX)
    normal = torch.tensor([-math.sqrt(0.5), -math.sqrt(0.5), 0.0])  # cuts off a corner of the room
    offset = (echoes.points @ normal).quantile(0.015) + REACH
    middle = offset * normal + torch.tensor([0.5, -0.5, 0.0])
    along, up = torch.tensor([math.sqrt(0.5), -math.sqrt(0.5), 0.0]), torch.tensor([0.0, 0.0, 1.0])
    share = torch.rand(on_it, 2, generator=torch.Generator().manual_seed(0)) - 0.5
    places = middle + 1.2 * share[:, :1] * along + (1.5 + 2.4 * share[:, 1:]) * up
    plane = Planes(normal[None], offset[None])
    y, z = torch.meshgrid(torch.arange(-0.6, 0.6, 0.1), torch.arange(0.3, 2.7, 0.1), indexing="ij")
    patch = Patches.of(plane, [(middle + y[..., None] * along + z[..., None] * up).reshape(-1, 3)])
    more = Echoes(
        torch.cat((echoes.points, places)),
        torch.cat((echoes.view, torch.zeros(on_it, dtype=torch.long))),
        torch.cat((echoes.error, torch.full((on_it,), 0.05))),
        echoes.receivers,
        echoes.tx,
    )
    beyond = int((more.points @ normal - offset < -REACH).sum())
    assert 150 < beyond < 1500
    assert float(patch.areas[0]) > 2.0
    assert bounding(plane, patch, more) == bounds


@pytest.fixture(scope="module")
def from_radio() -> Gaussians:
    return geometry_from_spectra(single(astray_deg=0.3))


def test_geometry_from_spectra_covers_every_wall(from_radio):
    assert float((off_the_walls(from_radio.means) < 0.02).double().mean()) > 0.97
    truth = room(0.3).means
    apart = torch.cdist(truth, from_radio.means).amin(-1)
    assert float((apart < 0.12).double().mean()) > 0.97
    assert float((normals(from_radio).abs().amax(-1) > 0.99).double().mean()) > 0.97


def test_nothing_stands_where_waves_went_through():
    """A dozen echoes that lie about one place in mid-room, seen from three receivers, make nothing there."""
    echoes = echoes_of(single(), TX)
    stray = torch.tensor([3.0, 2.5, 1.6]) + 0.02 * torch.randn(12, 3, generator=torch.Generator().manual_seed(3))
    told = replace(
        echoes,
        points=torch.cat((echoes.points, stray)),
        view=torch.cat((echoes.view, torch.arange(12) % 3)),
        error=torch.cat((echoes.error, torch.full((12,), 0.02))),
    )
    spots = merged(told, 0.12)
    beside = torch.cdist(spots.points, stray.mean(0, keepdim=True)).squeeze(-1) < 0.1
    assert int(spots.views[beside].max()) == 3
    made = radio_geometry.geometry_of_echoes(told)
    assert float(torch.cdist(made.means, stray).min()) > 0.3
    assert float(off_the_walls(made.means).max()) < 0.1


def test_geometry_from_spectra_finds_the_transmitter_when_it_is_not_told(from_radio):
    spectra = single(astray_deg=0.3)
    straight = TX - spectra.pose.position
    distance = torch.linalg.vector_norm(straight, dim=-1)
    cosine = (spectra.directions * (straight / distance[:, None])[:, None, None]).sum(-1).clamp(-1, 1)
    line = spectra.instrument.kernel(torch.acos(cosine)) * 30 * friis_gain(distance, 60e9)[:, None, None]
    found = geometry_from_spectra(replace(spectra, power=spectra.power + line, tx=None))
    assert float((off_the_walls(found.means) < 0.05).double().mean()) > 0.95


def test_geometry_from_spectra_is_the_same_every_time(from_radio):
    again = geometry_from_spectra(single(astray_deg=0.3))
    assert all(torch.equal(part, again.tensors()[name]) for name, part in from_radio.tensors().items())


def test_too_few_echoes_are_refused():
    pose = receivers(3)
    directions, _ = looking(pose)
    with pytest.raises(InputError, match="geometry needs 100 echoes or more of one bounce; 3 spectra have 0"):
        geometry_from_spectra(spectra_by((), pose, directions))


def test_mirror_images_alone_give_the_walls():
    levels = [-(10 ** (level / 20)) for level in (-6.0, -9.0, -12.0, -7.0, -10.0, -8.0)]
    pose = receivers(16)
    paths = shoebox(HIGH.tolist(), Pose(TX), pose, 60e9, 1, levels)
    spectra = spectrum_of(paths, None, equirect_grid(180, 90), lobe=math.radians(4.0))
    haze = 3e-5 * spectra.power.amax((-2, -1), keepdim=True)
    found = geometry_from_spectra(replace(spectra, power=spectra.power + haze, delay=None, aod=None))
    assert float((off_the_walls(found.means) < 0.05).double().mean()) > 0.95
    apart = torch.cdist(room(0.3).means, found.means).amin(-1)
    assert float((apart < 0.2).double().mean()) > 0.9


def test_spectra_that_show_no_mirror_are_refused():
    pose = receivers(6)
    directions, _ = looking(pose)
    straight = TX - pose.position
    distance = torch.linalg.vector_norm(straight, dim=-1)
    cosine = (directions * (straight / distance[:, None])[:, None, None]).sum(-1).clamp(-1, 1)
    spectra = spectra_by((), pose, directions)
    line = spectra.instrument.kernel(torch.acos(cosine)) * friis_gain(distance, 60e9)[:, None, None]
    with pytest.raises(InputError, match="6 spectra without delay and departure show no mirror image"):
        geometry_from_spectra(replace(spectra, power=line + 1e-14, delay=None, aod=None))


def test_corrected_geometry_has_its_walls_where_the_echoes_are():
    true = room(0.12, without=5)
    swollen = replace(true, means=0.5 * HIGH + (true.means - 0.5 * HIGH) * (1 + 0.16 / HIGH))  # each wall 8 cm out
    floaters = Gaussians.random(40, [2.0, 1.5, 1.2], [4.0, 3.5, 2.0], degree=1, seed=3)
    beyond = Gaussians.random(40, [6.5, 1.0, 1.0], [7.5, 4.0, 2.0], degree=1, seed=4)
    haze = replace(Gaussians.join((floaters, beyond)), logit_opacities=torch.full((80,), 2.0))
    found = corrected(Gaussians.join((swollen, haze)), single(astray_deg=0.3))
    away = off_the_walls(found.means)
    assert float((away < 0.02).double().mean()) > 0.95
    assert int((away > 0.5).sum()) == 0
    assert bool(((found.means > -0.1) & (found.means < HIGH + 0.1)).all())
    apart = torch.cdist(room(0.3).means, found.means).amin(-1)
    assert float((apart < 0.15).double().mean()) > 0.97


def test_where_no_plane_is_found_geometry_stays_and_none_is_made_of_echoes(monkeypatch):
    monkeypatch.setattr(radio_geometry, "SEARCH", replace(radio_geometry.SEARCH, min_area=1e6))
    before = room(0.1)
    assert torch.equal(corrected(before, single()).means, before.means)
    with pytest.raises(InputError, match="echoes lie on no common plane"):
        radio_geometry.geometry_of_echoes(echoes_of(single(), TX))


def test_wide_gaussians_leave_no_gaps_to_fill():
    fine, coarse = room(0.1), room(1.0)
    assert float(coarse.scales.amax(-1).median()) > 0.4
    assert len(radio_geometry.completed_by(coarse, fine)) < 1.02 * len(coarse)
    holed = room(1.0, without=0)
    added = radio_geometry.completed_by(holed, fine).means[len(holed) :]
    assert len(added) > 100
    assert float((off_the_walls(added) < 0.05).float().mean()) == 1.0


def test_a_wall_that_echoes_tell_badly_lies_on_that_of_the_geometry():
    """A bit of the wall x = 6, by its echoes turned by 2 degrees, and a wall behind it that geometry does not have."""
    known = Planes(torch.tensor([[-1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]), torch.tensor([-6.0, 0.0]))
    turn = math.radians(2.0)
    turned = torch.tensor([-math.cos(turn), math.sin(turn), 0.0])
    walls = Planes(torch.stack((turned, known.normals[0])), torch.tensor([-5.95, -6.6]))
    y, z = torch.meshgrid(torch.arange(0.05, 2.0, 0.1), torch.arange(0.05, 3.0, 0.1), indexing="ij")
    spots = torch.stack((torch.full_like(y, 6.0), y, z), -1).reshape(-1, 3)
    points = [spots - ((spots @ walls.normals[k]) - walls.offsets[k])[:, None] * walls.normals[k] for k in (0, 1)]
    extents = Patches.of(walls, points)
    found, moved = radio_geometry._onto_known(walls, extents, known, torch.tensor([15.0, 18.0]))
    assert torch.equal(found.normals[0], known.normals[0])
    assert float(found.offsets[0]) == -6.0
    assert torch.equal(found.normals[1], walls.normals[1])
    assert float(found.offsets[1]) == pytest.approx(-6.6)
    cells = surface_points(found, moved)[0]
    assert float((cells[:, 0] - 6.0).abs().max()) < 1e-5
    assert float(cells[:, 1].min()) < 0.2
    assert float(cells[:, 1].max()) > 1.8


def test_a_wall_that_echoes_tell_badly_lays_nothing_before_the_true_one(monkeypatch):
    turn = math.radians(6.0)
    normal = torch.tensor([[-math.cos(turn), -math.sin(turn), 0.0]])
    wall = Planes(normal, normal @ torch.tensor([6.0, 0.5, 0.0]))
    y, z = torch.meshgrid(torch.arange(0.05, 5.0, 0.1), torch.arange(0.05, 3.0, 0.1), indexing="ij")
    cells = torch.stack((6.0 - (y - 0.5) * math.tan(turn), y, z), -1).reshape(-1, 3)
    monkeypatch.setattr(radio_geometry, "_planes_of", lambda *_: (wall, Patches.of(wall, [cells])))
    found = corrected(room(0.12), single(astray_deg=0.3))
    assert float(off_the_walls(found.means).max()) < 0.05
