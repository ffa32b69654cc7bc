import math
from dataclasses import replace
from pathlib import Path

import pytest
import torch

import rf3dgs
from rf3dgs.core.angles import angle_between
from rf3dgs.core.errors import InputError
from rf3dgs.core.frames import Pose
from rf3dgs.core.grids import equirect_grid, list_grid
from rf3dgs.core.units import friis_gain
from rf3dgs.field.radio_field import RadioField
from rf3dgs.field.sources import PointSources
from rf3dgs.field.transmitter import estimate_transmitter
from rf3dgs.spectra.spectrum import Instrument, Spectrum
from rf3dgs.splats.obstacles import Obstacles
from rf3dgs.splats.transmittance import segment_transmittance
from rf3dgs.training.line_of_sight import fit_line_of_sight, fit_opening


def cluttered(count: int, *, blocked: int, seed: int, degrees: float = 2.0, lobe: float = 3.0) -> tuple[Spectrum, Pose]:
    """Line-of-sight spectra with twelve weaker lobes each; `blocked` positions have the clutter only."""
    generator = torch.Generator().manual_seed(seed)
    tx = torch.tensor([7.3, 3.1, 2.6])
    pose = Pose.scatter(((0.5, 0.5, 1.0), (13.0, 13.0, 1.8)), count, seed)
    grid = equirect_grid(round(360 / degrees), round(180 / degrees))
    instrument = Instrument.gaussian(math.radians(lobe))
    straight = tx - pose.position
    distance = torch.linalg.vector_norm(straight, dim=-1)
    level = friis_gain(distance, 60e9)
    power = 1e-3 * level[:, None, None] * (0.5 + torch.rand(count, *grid.shape, generator=generator))
    for index in range(count):
        lobes = torch.nn.functional.normalize(torch.randn(12, 3, generator=generator), dim=-1)
        strength = level[index] * torch.rand(12, generator=generator) * 0.3
        if index >= blocked:
            lobes = torch.cat((lobes, straight[index : index + 1]))
            strength = torch.cat((strength, level[index : index + 1]))
        angle = angle_between(grid.directions[..., None, :], lobes.expand(*grid.shape, len(lobes), 3))
        power[index] += (instrument.kernel(angle) * strength).sum(-1)
    return Spectrum(power, grid, pose, 60e9, instrument), Pose(tx)


def test_the_transmitter_is_found_to_centimetres_amid_clutter():
    for seed in range(3):
        spectra, tx = cluttered(24, blocked=7, seed=seed)
        found = estimate_transmitter(spectra)
        assert float(torch.linalg.vector_norm(found.position - tx.position)) < 0.03


def test_a_found_transmitter_keeps_the_line_of_sight():
    spectra, tx = cluttered(24, blocked=5, seed=4)
    found = estimate_transmitter(spectra).position
    here = torch.tensor([10.0, 8.0, 1.5])
    free = Obstacles(torch.zeros(0, 3), torch.zeros(0, 4), torch.zeros(0, 3), torch.zeros(0))
    exact, estimated = (PointSources.line_of_sight(place, 60e9).rays(here, free) for place in (tx.position, found))
    assert abs(float(exact.delay - estimated.delay)) < 1e-10
    assert float(angle_between(exact.arrival, estimated.arrival)) < math.radians(0.5)


def test_bearings_that_do_not_meet_are_refused():
    spectra, _ = cluttered(12, blocked=12, seed=1)
    with pytest.raises(InputError, match="give tx"):
        estimate_transmitter(spectra)
    with pytest.raises(InputError, match="three or more positions"):
        estimate_transmitter(spectra[:2])


def test_the_level_of_the_line_of_sight_is_fitted_where_it_is_seen():
    spectra, tx = cluttered(20, blocked=6, seed=2)
    louder = replace(spectra, power=spectra.power * 10 ** (0.7))
    sources, seen = fit_line_of_sight(PointSources.line_of_sight(tx.position, 60e9), louder)
    assert seen.tolist() == [False] * 6 + [True] * 14
    assert abs(sources.level_db - 7.0) < 0.3


def test_a_source_that_nobody_sees_keeps_its_level():
    spectra, _ = cluttered(8, blocked=0, seed=2)
    sources = PointSources.line_of_sight(torch.tensor([-20.0, 4.0, 9.0]), 60e9, level_db=1.5)
    sources, seen = fit_line_of_sight(sources, replace(spectra, power=torch.ones_like(spectra.power)))
    assert sources.level_db == 1.5
    assert not bool(seen.any())


def test_a_wall_hides_a_source_and_the_threshold_follows_what_was_seen(wall):
    obstacles = Obstacles(wall.means, wall.quats, wall.scales, wall.opacities)
    sources = PointSources.line_of_sight(torch.tensor([1.0, 1.0, 2.0]), 60e9)
    receivers = torch.tensor([[2.0, 3.0, 1.0], [5.0, 3.0, 1.0], [4.0, 1.0, 1.5]])
    assert sources.sees(receivers, obstacles).tolist() == [True, False, False]
    haze = replace(obstacles, opacities=torch.full_like(obstacles.opacities, 0.35))
    passed = haze.transmittance(sources.tx.expand(3, 3), receivers)
    assert 0.01 < float(passed[1]) < 0.9
    fitted = fit_opening(sources, torch.tensor([True, True, True]), receivers, haze)
    assert bool(fitted.sees(receivers, haze).all())


def test_the_shipped_field_sees_its_transmitter_where_the_specification_does():
    assert rf3dgs.__file__ is not None
    field = RadioField.load(Path(rf3dgs.__file__).parent / "assets" / "lobby.field")
    low, high = field.bounds.tolist()
    receivers = Pose.scatter((tuple(low), tuple(high)), 60, 3).position
    source, obstacles = field.sources, field.obstacles
    shape = (obstacles.means, obstacles.quats, obstacles.scales, obstacles.opacities)
    passed = segment_transmittance(*shape, source.tx[None], receivers)
    clear = (passed - source.open_above).abs() > 3e-3  # float32 cannot tell the others
    seen = field.sees_transmitter(Pose(receivers))
    assert seen[clear].tolist() == (passed > source.open_above)[clear].tolist()
    assert int(clear.sum()) > 50
    assert 5 < int(seen.sum()) < 60


def test_a_beam_is_one_at_its_centre_and_half_at_half_a_lobe():
    free = Obstacles(torch.zeros(0, 3), torch.zeros(0, 4), torch.zeros(0, 3), torch.zeros(0))
    rays = PointSources.line_of_sight(torch.tensor([5.0, 0.0, 0.0]), 60e9).rays(torch.zeros(3), free)
    half = math.radians(1.5)
    directions = torch.tensor([[1.0, 0.0, 0.0], [math.cos(half), math.sin(half), 0.0], [-1.0, 0.0, 0.0]])
    beam = rays.picture(Pose(torch.zeros(3)), list_grid(directions), Instrument.gaussian(math.radians(3))) / rays.power
    torch.testing.assert_close(beam, torch.tensor([[1.0, 0.5, 0.0]]), atol=1e-4, rtol=0)
