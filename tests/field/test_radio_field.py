import math
from dataclasses import replace

import pytest
import torch

from rf3dgs.core.angles import angle_between
from rf3dgs.core.errors import InputError
from rf3dgs.core.frames import Pose
from rf3dgs.core.grids import equirect_grid, list_grid, pinhole_grid
from rf3dgs.core.units import SPEED_OF_LIGHT, friis_gain
from rf3dgs.field.radiance import Radiance, Surface
from rf3dgs.field.radio_field import add_rays
from rf3dgs.splats.gaussians import Gaussians

HERE = Pose.from_yaw([4.0, 3.0, 1.4], 0.7)


def turned(field, yaw):
    """The field after the whole world turns about the vertical axis; its harmonics must be flat to stay the same."""
    half = torch.tensor(yaw / 2)
    spin = torch.stack((half.cos(), torch.zeros(()), torch.zeros(()), half.sin()))
    w, x, y, z = field.surface.quats.unbind(-1)
    a, d = spin[0], spin[3]
    quats = torch.stack((a * w - d * z, a * x - d * y, a * y + d * x, a * z + d * w), -1)
    matrix = Pose([0.0, 0.0, 0.0], spin).world_from_device
    tx = field.tx.position @ matrix.mT
    surface = replace(field.surface, means=field.surface.means @ matrix.mT, quats=quats, tx=tx)
    sources = replace(field.sources, tx=tx)
    return replace(field, surface=surface, sources=sources, tx=field.tx.turned(yaw))


def flat(field):
    """The same field with harmonics of degree 0 only."""
    gain_sh, csi_sh = field.surface.gain_sh.clone(), torch.zeros_like(field.surface.csi_sh)
    gain_sh[:, 1:] = 0
    return replace(field, surface=replace(field.surface, gain_sh=gain_sh, csi_sh=csi_sh))


def test_paths_survive_the_field(field, room):
    paths = field.paths(room.receivers(5, 1), strongest=6)
    straight = room.tx - room.receivers(5, 1).position
    distance = torch.linalg.vector_norm(straight, dim=-1)
    line = paths.order == 0
    assert bool((line.sum(-1) == 1).all())
    assert torch.allclose(paths.delay[line], distance / SPEED_OF_LIGHT, atol=1e-12, rtol=0)
    assert float(angle_between(paths.aoa[line], straight).max()) < math.radians(0.01)
    assert float(angle_between(paths.aod[line], -straight).max()) < math.radians(0.01)


def test_line_of_sight_gain_equals_friis(field, room):
    receivers = room.receivers(5, 2)
    distance = torch.linalg.vector_norm(room.tx - receivers.position, dim=-1)
    paths = field.paths(receivers)
    torch.testing.assert_close(paths.path_gain[paths.order == 0], friis_gain(distance, 60e9))


def test_the_beam_shows_the_line_of_sight_at_friis_level(field):
    towards = list_grid(HERE.to_device(field.tx.position - HERE.position)[None])
    surface = field.without_sources().render(HERE, towards)
    both = field.render(HERE, towards)
    gain = friis_gain(torch.linalg.vector_norm(field.tx.position - HERE.position), 60e9)
    torch.testing.assert_close(both.power - surface.power, gain.expand(1, 1), rtol=1e-3, atol=0)


def test_power_of_parts_adds_linearly(field, sphere):
    nothing = torch.full_like(field.surface.gain_sh, 0.0)
    nothing[:, 0] = -10.0
    sources_only = replace(field, surface=replace(field.surface, gain_sh=nothing))
    whole = field.render(HERE, sphere).power
    parts = field.without_sources().render(HERE, sphere).power + sources_only.render(HERE, sphere).power
    torch.testing.assert_close(whole, parts)
    louder = replace(field.sources, level_db=10 * math.log10(2))
    twice = replace(field, sources=louder).render(HERE, sphere).power
    torch.testing.assert_close(twice - whole, sources_only.render(HERE, sphere).power, atol=1e-16, rtol=1e-3)


@pytest.mark.parametrize("yaw", [0.0, 0.7, 1.6, 2.6, -2.2, -1.2])
@pytest.mark.parametrize("csi", [False, True])
def test_a_picture_asks_only_for_sources_that_it_may_show(field, yaw, csi):
    """It is the same as with all rays, at all sides of the picture and with none in it."""
    pose, grid = Pose.from_yaw(HERE.position, yaw), pinhole_grid(30, 20, 70.0)
    every = field.sources.rays(pose.position, field.obstacles)
    surface = field.without_sources().render(pose, grid, csi=csi)
    expected, shown = Radiance(surface.power, surface.delay, surface.aod), field.render(pose, grid, csi=csi)
    add_rays(expected, every, pose, grid, field.instrument)
    for name in ("power", "delay", "aod"):
        torch.testing.assert_close(getattr(shown, name), getattr(expected, name), rtol=1e-6, atol=0)


def test_delay_and_departure_are_weighted_by_power(field, sphere):
    whole, surface = field.render(HERE, sphere), field.without_sources().render(HERE, sphere)
    assert whole.delay is not None
    assert surface.delay is not None
    line = whole.power - surface.power
    delay = torch.linalg.vector_norm(field.tx.position - HERE.position) / SPEED_OF_LIGHT
    expected = (surface.power * surface.delay + line * delay) / whole.power
    torch.testing.assert_close(whole.delay, expected, atol=1e-13, rtol=1e-4)


def test_turning_the_world_turns_the_spectrum(field, sphere):
    before = flat(field)
    after = turned(before, 0.9)
    tilted = Pose(HERE.position, [0.9, 0.1, -0.3, 0.2])  # no wall is seen square on, so that no depths are equal
    first, second = before.render(tilted, sphere), after.render(tilted.turned(0.9), sphere)
    torch.testing.assert_close(first.gain_db, second.gain_db, atol=0.05, rtol=0)
    assert first.delay is not None
    assert second.delay is not None
    torch.testing.assert_close(first.delay, second.delay, atol=2e-11, rtol=0)


def test_turning_the_receiver_turns_only_the_picture(field):
    directions = torch.nn.functional.normalize(torch.randn(40, 3, generator=torch.Generator().manual_seed(0)), dim=-1)
    other = Pose.from_yaw(HERE.position, -1.1)
    first = field.render(HERE, list_grid(HERE.to_device(directions)))
    second = field.render(other, list_grid(other.to_device(directions)))
    error = (first.gain_db - second.gain_db).abs()
    assert float(error.median()) < 1.0


def test_faces_agree_with_a_pinhole_picture(field):
    pinhole = pinhole_grid(24, 24, 60)
    direct = field.render(HERE, pinhole)
    sampled = field.render(HERE, list_grid(pinhole.directions.reshape(-1, 3)))
    error = (direct.gain_db.reshape(-1) - sampled.gain_db.reshape(-1)).abs()
    assert float(error.median()) < 1.0


def test_a_batch_renders_what_its_poses_render(field, room, sphere):
    poses = room.receivers(4, 5)
    batch = field.render(Pose(poses.position.reshape(2, 2, 3)), sphere)
    assert tuple(batch.power.shape) == (2, 2, 24, 48)
    torch.testing.assert_close(batch.power[1, 0], field.render(poses[2], sphere).power)
    assert field.paths(Pose(poses.position.reshape(2, 2, 3)), strongest=3).coeff.shape == (2, 2, 3)


def test_a_blocked_transmitter_gives_no_line_of_sight(field, wall):
    def joined(name):
        return torch.cat((getattr(field.surface, name), getattr(wall, name)))

    surface = Surface.bare(
        Gaussians(
            joined("means"),
            joined("quats"),
            joined("log_scales"),
            joined("logit_opacities"),
            torch.zeros(len(field.surface) + len(wall), 1, 1),
        ),
        tx=field.surface.tx,
        window=field.surface.window,
    )
    blocked = replace(field, surface=surface, solidity=surface.opacities)
    behind, before = Pose([4.5, 3.0, 1.4]), Pose([2.0, 3.0, 1.4])
    assert not bool(blocked.sees_transmitter(behind))
    assert bool(blocked.sees_transmitter(before))
    assert bool(field.sees_transmitter(behind))
    assert not bool((blocked.paths(behind).order[blocked.paths(behind).valid] == 0).any())
    loss = (
        field.render(behind, equirect_grid(48, 24)).power.max()
        / blocked.render(behind, equirect_grid(48, 24)).power.max()
    )
    assert float(loss) > 10


def test_paths_are_sorted_and_peaks_of_the_surface_have_their_own_delay(field, room):
    paths = field.paths(HERE, strongest=5)
    gain = paths.path_gain[paths.valid]
    assert bool((gain[:-1] >= gain[1:]).all())
    assert bool((paths.coeff.imag == 0).all())
    straight = torch.linalg.vector_norm(room.tx - HERE.position) / SPEED_OF_LIGHT
    rest = paths.valid & (paths.order == 1)
    assert bool((paths.delay[rest] > straight - 2e-9).all())


def test_sources_alone_are_asked_without_a_search_for_peaks(field):
    paths = field.paths(HERE, strongest=5, parts="sources")
    assert paths.valid.tolist() == [True, False, False, False, False]
    assert paths.kind.tolist()[0] == 0
    everything = field.paths(HERE, strongest=5)
    assert everything.valid.all()
    assert sorted(everything.kind.tolist()) == [0, 2, 2, 2, 2]
    first = int((everything.kind == 0).nonzero()[0])
    assert torch.equal(paths.coeff[0], everything.coeff[first])


@pytest.mark.parametrize("parts", ["all", "sources"])
def test_a_batch_has_the_paths_of_its_poses(field, room, parts):
    poses = room.receivers(6, 5)
    batch = Pose(poses.position.reshape(2, 3, 3), poses.orientation.reshape(2, 3, 4))
    whole = field.paths(batch, parts=parts, strongest=5)
    assert whole.delay.shape == (2, 3, 5)
    for index in range(6):
        one = field.paths(poses[index], parts=parts, strongest=5)
        for name in ("coeff", "delay", "aoa_zenith", "aod_azimuth", "valid", "order", "kind"):
            assert torch.equal(getattr(whole.flat(), name)[index], getattr(one, name))


def test_a_channel_comes_out_of_the_paths(field):
    from rf3dgs.channel.arrays import ofdm, planar_array

    array = planar_array(rows=2, cols=2, pattern="isotropic")
    response = field.paths(HERE, strongest=4).cfr(array, subcarriers=ofdm(100e6, 16))
    assert response.shape[0] == 4
    assert response.shape[-1] == 16
    assert bool(torch.isfinite(response.abs()).all())


def test_the_field_marks_receivers_outside_its_training(field):
    inside = field.covers(Pose([[3.0, 2.0, 1.0], [9.0, 2.0, 1.0]]))
    assert inside.tolist() == [True, False]


def test_errors_say_what_to_do(field):
    with pytest.raises(InputError, match="strongest must be at least 1; got 0"):
        field.paths(HERE, strongest=0)
    with pytest.raises(InputError, match='parts must be "all" or "sources"; got "mirrors"'):
        field.paths(HERE, parts="mirrors")
    with pytest.raises(InputError, match="paths needs at least one pose; got an empty batch"):
        field.paths(Pose(torch.zeros(0, 3)))
    with pytest.raises(InputError, match="at least one pose"):
        field.render(Pose(torch.zeros(0, 3)), equirect_grid(8, 4))
    with pytest.raises(InputError, match='"vector" or "paper"'):
        replace(field.surface, encoding="polar")
    with pytest.raises(InputError, match="gain_sh must be"):
        replace(field.surface, gain_sh=torch.zeros(3, 16))


def test_a_field_of_the_paper_model_does_not_move(field):
    with pytest.raises(InputError, match="needs a field of the mirror model; this one is of the paper's"):
        field.moved_to(HERE)
