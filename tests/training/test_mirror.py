"""Laws of the mirror model's fit, in a room whose walls scatter by laws that are known."""

import math
import os
from dataclasses import replace

import pytest
import torch

from rf3dgs.core.errors import InputError
from rf3dgs.core.frames import Pose
from rf3dgs.core.grids import equirect_grid, list_grid, view_of
from rf3dgs.core.units import SPEED_OF_LIGHT, friis_gain
from rf3dgs.field.beam import through_lobe
from rf3dgs.field.lit import LitSurface
from rf3dgs.spectra.spectrum import Instrument, Spectrum
from rf3dgs.splats.gaussians import Gaussians
from rf3dgs.splats.surface import sample_mesh
from rf3dgs.training.config import RadioConfig
from rf3dgs.training.explain import Explained
from rf3dgs.training.lit_views import lit_views
from rf3dgs.training.radio import fit_radio

HIGH = torch.tensor([6.0, 5.0, 3.0])
TX = torch.tensor([1.0, 1.2, 2.4])
LOBE = Instrument.gaussian(math.radians(8))
LEVEL_DB, SLOPE, ALPHA, AMBIENT_DB, FALLOFF = -88.0, 0.8, 6.0, -110.0, -1.0
MIRROR = RadioConfig(model="mirror")


def room(spacing: float = 0.2) -> Gaussians:
    corner = [[float(HIGH[axis]) if i >> axis & 1 else 0.0 for axis in range(3)] for i in range(8)]
    quads = ((0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3))
    faces = [triangle for a, b, c, d in quads for triangle in ((a, b, c), (a, c, d))]
    return sample_mesh(torch.tensor(corner), torch.tensor(faces), spacing=spacing, thickness=0.01)


def measure(pose: Pose, grid=None) -> Spectrum:
    """Lit and ambient power of the walls by one law through the lobe, and the line of sight; ambient waves take 12 ns
    to the wall."""
    grid = equirect_grid(90, 45) if grid is None else grid
    here = pose.position[:, None, None, :]
    directions = pose.to_world(grid.directions.expand(len(pose), *grid.shape, 3))
    ahead = torch.where(directions > 0, HIGH - here, -here) / directions
    ahead = torch.where(directions.abs() > 1e-6, ahead, torch.full_like(ahead, 1e9))
    second, axis = ahead.min(-1)
    normal = -torch.nn.functional.one_hot(axis, 3) * directions.sign()
    hit = here + second[..., None] * directions
    first = torch.linalg.vector_norm(TX - hit, dim=-1)
    w = (TX - hit) / first[..., None]
    cosine = (normal * w).sum(-1)
    r = 2 * cosine[..., None] * normal - w
    lobe = ((1 - (r * directions).sum(-1)) / 2).clamp_min(1e-9) ** ALPHA
    lit = 10 ** (LEVEL_DB / 10) / first**2 * torch.exp(SLOPE * cosine) * lobe
    ambient = 10 ** (AMBIENT_DB / 10) * (first / 5) ** FALLOFF
    straight = TX - here
    distance = torch.linalg.vector_norm(straight, dim=-1)
    cosine = (directions * straight / distance[..., None]).sum(-1).clamp(-1, 1)
    line = LOBE.kernel(torch.acos(cosine)) * friis_gain(distance, 60e9)
    late = lit * (first + second) + ambient * (second + 12e-9 * SPEED_OF_LIGHT)
    left = -lit[..., None] * w + ambient[..., None] * torch.eye(3)[2]
    walls = torch.cat(((lit + ambient)[..., None], late[..., None], left), -1)
    if grid.kind != "list":
        walls = torch.stack([through_lobe(one, view_of(pose[i], grid), LOBE.lobe) for i, one in enumerate(walls)])
    power = walls[..., 0] + line
    delay = walls[..., 1] + line * distance
    aod = torch.nn.functional.normalize(walls[..., 2:] - (line / distance)[..., None] * straight, dim=-1)
    return Spectrum(power, grid, pose, 60e9, LOBE, "ideal", delay / power / SPEED_OF_LIGHT, aod, Pose(TX))


def positions(count: int, seed: int) -> Pose:
    return Pose.scatter(((1.5, 1.5, 0.8), (5.0, 4.0, 1.8)), count, seed)


@pytest.fixture(scope="module")
def training() -> Spectrum:
    return measure(positions(10, 0))


@pytest.fixture(scope="module")
def held_out() -> Spectrum:
    return measure(positions(4, 9))


@pytest.fixture(scope="module")
def field(training):
    return fit_radio(room(), training, MIRROR)


def away_from_the_lamp(truth: Spectrum) -> torch.Tensor:
    straight = torch.nn.functional.normalize(TX - truth.pose.position, dim=-1)
    cosine = (truth.directions * straight[:, None, None]).sum(-1)
    return cosine < math.cos(math.radians(20))


def test_the_law_of_the_walls_is_found(field):
    assert isinstance(field.surface, LitSurface)
    count = torch.bincount(field.surface.segment_of)
    laws = field.surface.laws[count > 100]
    assert len(laws) >= 6
    # A receiver sees each wall from a cone of directions only, through Gaussians of 20 cm and pixels of 4 degrees:
    # level, slope and lobe trade some of their share.
    assert float((laws[:, 2] - ALPHA).abs().median()) < 2.5
    middle = laws[:, 0] + 4.343 * laws[:, 1] * 0.7
    assert float((middle - LEVEL_DB - 4.343 * SLOPE * 0.7).abs().median()) < 1.0


def test_where_nobody_measured_the_model_is_within_a_decibel(field, held_out):
    shown = field.render(held_out.pose, held_out.grid)
    error = (shown.gain_db - held_out.gain_db)[away_from_the_lamp(held_out)]
    assert float(error.square().mean().sqrt()) < 1.0
    # What is bright around the mirror directions is partly taken for mirrors: a quarter of a decibel too much.
    assert float((shown.path_gain / held_out.path_gain).log10().abs().max()) * 10 < 0.4


def test_delay_and_departure_follow_lit_and_ambient_parts(field, held_out):
    shown = field.render(held_out.pose, held_out.grid)
    assert shown.delay is not None
    assert held_out.delay is not None
    assert shown.aod is not None
    assert held_out.aod is not None
    there = away_from_the_lamp(held_out)
    assert float((shown.delay - held_out.delay)[there].abs().mean()) < 0.7e-9
    cosine = (shown.aod * held_out.aod).sum(-1)[there].clamp(-1, 1)
    # A Gaussian of 20 cm has one departure; the transmitter stands a metre from two walls.
    assert math.degrees(float(torch.acos(cosine).mean())) < 8.0


def test_delays_that_depend_on_where_a_wall_is_seen_from_are_learned(training, held_out):
    def bent(spectra: Spectrum) -> Spectrum:
        assert spectra.delay is not None
        return replace(spectra, delay=spectra.delay + 4e-9 * spectra.directions[..., 0])

    def error(field, truth: Spectrum) -> float:
        shown = field.render(truth.pose, truth.grid)
        return float((shown.delay - truth.delay)[away_from_the_lamp(truth)].abs().mean())

    field = fit_radio(room(), bent(training), MIRROR)
    plain = replace(field, surface=field.surface.without_residual())
    # Of the 2 ns by which delays are bent at places that nobody measured, a quarter is left at most.
    assert error(field, bent(held_out)) < 0.5e-9
    assert error(plain, bent(held_out)) > 2 * error(field, bent(held_out))


def test_the_log_says_what_each_part_explains(training, field):
    parts = Explained.of_meta(field.meta)
    assert parts is not None
    # Of a room that is made of these parts nothing is left but errors: levels are right within a quarter of a decibel.
    assert parts.sources + parts.lit + parts.ambient == pytest.approx(1.0, abs=0.06)
    assert parts.lit > parts.ambient > 0
    assert parts.sources_db > parts.laws_db > parts.whole_db
    assert f"{parts.lit:.0%} by lit surfaces" in parts.text()
    assert Explained.of_meta({"seed": 0}) is None
    power = torch.stack([field.only(part).render(training.pose, training.grid).power for part in ("lit", "ambient")])
    area = training.grid.solid_angle
    shares = (power * area).sum((1, 2, 3)) / (training.power * area).sum()
    assert shares.tolist() == pytest.approx([parts.lit, parts.ambient], abs=1e-3)


@pytest.mark.parametrize("threads", ["1", "3"])
def test_the_same_spectra_give_the_same_bits_on_any_number_of_threads(training, field, monkeypatch, threads):
    monkeypatch.setenv("RF3DGS_THREADS", threads)
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: set(range(8)), raising=False)
    again = fit_radio(room(), training, MIRROR)
    assert torch.equal(again.sources.reflection, field.sources.reflection)
    for name in ("laws", "ambient", "level", "segment_sh", "cell_sh", "cell_csi", "own_csi"):
        assert torch.equal(getattr(again.surface, name), getattr(field.surface, name)), name


def test_torch_works_on_one_thread_so_that_threads_do_not_change_the_bits(training, torch_threads):
    fit_radio(room(), training, MIRROR, progress=torch_threads)
    assert torch_threads.seen == {1}


def test_spectra_without_delays_leave_the_ambient_part_its_straight_way(training):
    bare = replace(training, delay=None, aod=None)
    surface = fit_radio(room(), bare[:4], MIRROR).surface
    straight = torch.linalg.vector_norm(surface.means - TX, dim=-1) / SPEED_OF_LIGHT * 1e9
    torch.testing.assert_close(surface.ambient[:, 0], straight, rtol=1e-5, atol=1e-4)


def test_pixels_that_a_point_source_rules_do_not_count(training, field):
    found = lit_views(training[:1], [field.sources.rays(training.pose.position[0], field.obstacles)])[0]
    lamp = ~away_from_the_lamp(training[:1])[0]
    near = lamp & (training.power[0] == training.power[0].max())
    assert float(found.keep[near]) == 0.0
    assert float((found.keep[~lamp] > 0).float().mean()) > 0.95


def test_pixels_without_power_say_that_no_surface_shines_there(training, field):
    """However weak it is, the skirt of a point source is all of the power of a pixel that has none."""
    dark = torch.zeros(training.grid.shape, dtype=torch.bool)
    dark[:, 40:50] = True
    some = replace(training[:1], power=training.power[:1] * ~dark)
    rays = [field.sources.rays(training.pose.position[0], field.obstacles)]
    found = lit_views(some, rays)[0]
    assert float(found.keep[dark].min()) > 0.0
    assert not bool((found.certain > 0)[dark].any())


def test_what_is_dark_for_every_receiver_is_shown_dark(training, field):
    """Half of the room's pictures without power: the field follows by what its residual may do, 12 dB."""
    half = torch.arange(training.grid.height)[:, None] < training.grid.height // 2
    dark = replace(training, power=torch.where(half, 0.0, training.power))
    shown = fit_radio(room(), dark, replace(MIRROR, mirror_order=0)).render(training.pose[0], training.grid).power
    usual = field.render(training.pose[0], training.grid).power
    above = half & away_from_the_lamp(training[:1])[0] & (usual > 0)
    fallen_db = 10 * torch.log10(usual[above] / shown[above].clamp_min(1e-30))
    assert float(fallen_db.median()) > 8.0


def test_lists_of_directions_are_refused(training):
    grid = list_grid(
        torch.nn.functional.normalize(torch.randn(8, 3, generator=torch.Generator().manual_seed(0)), dim=-1)
    )
    listed = measure(training.pose[:3], grid)
    with pytest.raises(InputError, match="needs pinhole or equirectangular spectra"):
        lit_views(listed, None)


def test_the_configuration_says_how_many_reflections_are_followed(training):
    alone = fit_radio(room(), training, replace(MIRROR, mirror_order=0))
    assert alone.sources is not None
    assert len(alone.sources) == 1
    with pytest.raises(InputError, match="order must be from 0 to 3; got 4"):
        fit_radio(room(), training, replace(MIRROR, mirror_order=4))


@pytest.mark.parametrize("part", ["lit", "ambient", "residual"])
def test_a_part_that_is_left_out_sends_nothing(training, part):
    surface = fit_radio(room(), training[:4], replace(MIRROR, without=(part,))).surface
    lit, ambient = surface.parts(torch.nn.functional.normalize(surface.means - training.pose.position[0], dim=-1))
    there = {"lit": float(lit.max()), "ambient": float(ambient.max()), "residual": float(surface.level.abs().max())}
    assert all(value > 1e-15 for name, value in there.items() if name != part)  # walls send 1e-10 or so
    assert there[part] < 1e-25


def test_point_sources_may_be_left_alone(training):
    field = fit_radio(room(), training[:4], replace(MIRROR, without=("lit", "ambient", "residual")))
    assert float(field.without_sources().render(training.pose[0], training.grid, csi=False).power.max()) < 1e-25


def test_without_visibility_nothing_casts_a_shadow(training):
    blind = fit_radio(room(), training[:4], replace(MIRROR, without=("visibility",)))
    assert float(blind.surface.visibility.min()) == 1.0
    outside = Pose(torch.tensor([9.0, 2.0, 1.5]))
    assert bool(blind.sees_transmitter(outside))


def test_parts_that_do_not_exist_cannot_be_left_out(training):
    with pytest.raises(InputError, match="without names parts of the mirror model"):
        fit_radio(room(), training, replace(MIRROR, without=("walls",)))
    with pytest.raises(InputError, match="with the model 'paper'"):
        fit_radio(room(), training, RadioConfig(model="paper", without=("lit",)))
