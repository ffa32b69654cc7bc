"""Laws of a mirror field's uncertainty, in a room with one wall that no model can know."""

import json
import math
from dataclasses import replace

import pytest
import torch

from rf3dgs.core.errors import DataError, InputError
from rf3dgs.core.frames import Pose
from rf3dgs.core.grids import equirect_grid, list_grid, pinhole_grid
from rf3dgs.core.units import friis_gain
from rf3dgs.field.io import _digest, load_field
from rf3dgs.field.uncertainty import NUMBERS, SHARES, Uncertainty, numbers_of
from rf3dgs.spectra.spectrum import Instrument, Spectrum
from rf3dgs.splats.surface import sample_mesh
from rf3dgs.training import RadioConfig, fit_radio, fit_uncertainty
from rf3dgs.training.calibration import calibrate
from rf3dgs.training.uncertainty_fit import folds_of

HIGH = torch.tensor([8.0, 5.0, 3.0])
TX = torch.tensor([4.0, 2.0, 2.6])
LOBE = Instrument.gaussian(math.radians(10))
GRID = equirect_grid(60, 30)
MIRROR = RadioConfig(model="mirror")
TRAINED = ((1.0, 1.0, 0.8), (3.5, 4.0, 1.8))


def geometry(spacing: float = 0.3):
    corner = [[float(HIGH[axis]) if i >> axis & 1 else 0.0 for axis in range(3)] for i in range(8)]
    quads = ((0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3))
    faces = [triangle for a, b, c, d in quads for triangle in ((a, b, c), (a, c, d))]
    return sample_mesh(torch.tensor(corner), torch.tensor(faces), spacing=spacing, thickness=0.01)


def hits(pose: Pose) -> tuple[torch.Tensor, torch.Tensor]:
    """Where the pixels' rays meet the walls, and which pixels meet the wall y = 0."""
    here = pose.position[:, None, None, :]
    directions = pose.to_world(GRID.directions.expand(len(pose), *GRID.shape, 3))
    ahead = torch.where(directions > 0, HIGH - here, -here) / directions
    ahead = torch.where(directions.abs() > 1e-6, ahead, torch.full_like(ahead, 1e9))
    distance, axis = ahead.min(-1)
    return here + distance[..., None] * directions, (axis == 1) & (directions[..., 1] < 0)


def measure(pose: Pose, seed: int) -> Spectrum:
    """Diffuse walls and the line of sight; the wall y = 0 is speckled anew for every position, by 5 dB."""
    hit, speckled = hits(pose)
    power = 1e-9 / (hit - TX).square().sum(-1)
    noise = torch.randn(power.shape, generator=torch.Generator().manual_seed(seed))
    power = power * 10 ** (torch.where(speckled, 5.0, 0.5) * noise / 10)
    straight = TX - pose.position
    distance = torch.linalg.vector_norm(straight, dim=-1)
    directions = pose.to_world(GRID.directions.expand(len(pose), *GRID.shape, 3))
    cosine = (directions * (straight / distance[:, None])[:, None, None]).sum(-1).clamp(-1, 1)
    power = power + LOBE.kernel(torch.acos(cosine)) * friis_gain(distance, 60e9)[:, None, None]
    return Spectrum(power, GRID, pose, 60e9, LOBE, "ideal", None, None, Pose(TX))


@pytest.fixture(scope="module")
def training() -> Spectrum:
    return measure(Pose.scatter(TRAINED, 12, 0), 0)


@pytest.fixture(scope="module")
def field(training):
    return fit_radio(geometry(), training, replace(MIRROR, uncertainty=True))


@pytest.fixture(scope="module")
def held_out() -> Spectrum:
    return measure(Pose.scatter(TRAINED, 6, 7), 7)


def test_what_nobody_can_know_is_least_sure(field, held_out):
    std = field.uncertainty(held_out.pose, held_out.grid)
    assert std.shape == held_out.power.shape
    speckled = hits(held_out.pose)[1]
    # 5 dB against 0.5 dB and what blending misses at edges; pieces of surface are drawn to what is typical.
    assert float(std[speckled].median()) > 2.5 * float(std[~speckled].median())
    assert 3.0 < float(std[speckled].median()) < 8.0


def test_errors_where_nobody_measured_lie_within_the_stated_shares(field, held_out):
    error = (field.render(held_out.pose, held_out.grid, csi=False).gain_db - held_out.gain_db).abs()
    area = held_out.grid.solid_angle.expand_as(error)
    # Six positions, whose pixels are not independent: 10 points of 68, less in the tail.
    for share, allowed in ((0.6827, 0.10), (0.9, 0.07), (0.95, 0.05)):
        within = area * (error < field.uncertainty(held_out.pose, held_out.grid, share=share))
        assert abs(float(within.sum() / area.sum()) - share) < allowed


def test_outside_of_the_trained_box_it_is_less_sure(field):
    inside = Pose.scatter(TRAINED, 6, 3)
    outside = Pose.scatter(((5.5, 1.0, 0.8), (7.5, 4.0, 1.8)), 6, 3)
    assert not bool(field.covers(outside).any())
    near, far = (field.uncertainty(pose, GRID).median() for pose in (inside, outside))
    assert float(far) > 1.15 * float(near)


def test_peaks_of_the_surface_are_as_sure_as_their_direction(field, held_out):
    paths = field.paths(held_out.pose, strongest=40)
    std, wide = field.uncertainty_of(paths), field.uncertainty_of(paths, share=0.95)
    assert std.shape == paths.valid.shape
    assert bool((std[~paths.valid] == 0).all())
    assert bool((std[paths.valid] > 0).all())
    surface = paths.valid & (paths.kind == 2)
    assert int(surface.sum()) > 20
    torch.testing.assert_close(wide[surface], std[surface] * field.doubt.width(0.95))
    toward = list_grid(held_out.pose[0].to_device(paths.aoa[0]))
    directions = field.uncertainty(held_out.pose[0], toward)[0]
    torch.testing.assert_close(std[0][surface[0]], directions[surface[0]])


def test_the_straight_way_is_surer_than_the_speckled_wall(field, held_out):
    paths = field.paths(held_out.pose, strongest=1)
    assert bool((paths.kind == 0).all())
    speckled = field.uncertainty(held_out.pose, held_out.grid, share=0.9)[hits(held_out.pose)[1]]
    assert float(field.uncertainty_of(paths, share=0.9).max()) < 0.5 * float(speckled.median())


def test_wider_shares_are_wider(field, held_out):
    widths = [field.doubt.width(share) for share in (0.1, 0.25, 0.5, 0.6, 0.6827, 0.85, 0.95, 0.99)]
    assert widths == sorted(widths)
    assert field.doubt.width(0.6827) == pytest.approx(1.0)
    for share in (0.0, 1.0, 68.0):
        with pytest.raises(InputError, match=r"share must lie in \(0, 0.99\]"):
            field.uncertainty(held_out.pose, held_out.grid, share=share)


def test_pinholes_have_their_own_numbers(field):
    pose = Pose([2.0, 2.0, 1.4])
    std = field.uncertainty(pose, pinhole_grid(30, 20, 90.0))
    assert std.shape == (20, 30)
    assert bool((std > 0).all())


def test_uncertainty_comes_back_from_disk_and_older_fields_refuse(field, training, tmp_path):
    field.save(tmp_path / "sure.field")
    loaded = load_field(tmp_path / "sure.field")
    pose = training.pose[0]
    before, after = field.uncertainty(pose, GRID), loaded.uncertainty(pose, GRID)
    # Rotations and levels are float16 in the file: a depth gate opens here or there.
    assert float((before / after).log().abs().median()) < 0.01
    assert torch.equal(loaded.doubt.seen, field.doubt.seen)
    for name in ("points", "plane", "off", "wrong", "levels"):
        assert torch.equal(getattr(loaded.doubt.paths, name), getattr(field.doubt.paths, name)), name
    replace(field, doubt=None).save(tmp_path / "unsure.field")
    path = tmp_path / "unsure.field" / "field.json"
    body = json.loads(path.read_text())["body"]
    assert body.pop("uncertainty") is None
    path.write_text(json.dumps({"body": body, "sha256": _digest(body)}))
    with pytest.raises(InputError, match="does not know its uncertainty; fit_uncertainty"):
        load_field(tmp_path / "unsure.field").uncertainty(pose, GRID)


def test_damaged_uncertainty_is_refused(field, tmp_path):
    broken = replace(field.doubt, spread_db=field.doubt.spread_db * torch.nan)
    with pytest.raises(InputError, match="doubt_spread_db has NaN"):
        replace(field, doubt=broken).save(tmp_path / "broken.field")
    short = replace(field.doubt, spread_db=field.doubt.spread_db[:3], seen=field.doubt.seen[:3])
    replace(field, doubt=short).save(tmp_path / "short.field")
    with pytest.raises(DataError, match="doubt_spread_db must be"):
        load_field(tmp_path / "short.field")
    unknown = replace(field.doubt, paths=replace(field.doubt.paths, levels=torch.full((7,), torch.nan)))
    with pytest.raises(InputError, match="doubt_paths_levels has NaN"):
        replace(field, doubt=unknown).save(tmp_path / "unknown.field")


def test_the_same_spectra_give_the_same_uncertainty(field, training):
    again = fit_uncertainty(replace(field, doubt=None), training)
    assert torch.equal(again.doubt.weights, field.doubt.weights)
    assert torch.equal(again.doubt.spread_db, field.doubt.spread_db)


def test_too_few_positions_and_other_models_are_refused(field, training):
    with pytest.raises(InputError, match="needs 8 training positions or more, to leave some out; got 5"):
        fit_uncertainty(field, training[:5])
    with pytest.raises(InputError, match="uncertainty belongs to the mirror model"):
        fit_radio(geometry(), training, RadioConfig(model="paper", uncertainty=True))
    with pytest.raises(InputError, match="is empty: no power"):
        fit_uncertainty(field, replace(training, power=training.power * 0))


def test_every_position_is_left_out_with_few_and_with_many_neighbours():
    positions = Pose.scatter(TRAINED, 21, 1).position
    folds = folds_of(positions, seed=3)
    assert len(folds) == 7
    assert sorted(place for fold in folds[:4] for place in fold) == list(range(21))
    assert sorted(place for fold in folds[4:] for place in fold) == list(range(21))
    along = positions[:, 1]  # the longer side
    assert float(along[folds[4]].max()) <= float(along[folds[5]].min())


def test_calibration_finds_the_widths_of_laplace_errors():
    generator = torch.Generator().manual_seed(0)
    x = torch.cat((torch.ones(40_000, 1), torch.rand(40_000, 2, generator=generator)), -1)
    sign = torch.rand(40_000, generator=generator) - 0.5
    scale = torch.exp(0.5 + 1.5 * x[:, 1] - 1.0 * x[:, 2])
    error = -scale * sign.sign() * torch.log1p(-2 * sign.abs())
    weights, widths = calibrate(x, error, torch.ones(40_000), signed=1)
    # Standard errors of the slopes are 0.02; one that would narrow is left out.
    assert float(weights[1]) == pytest.approx(1.5, abs=0.1)
    assert float(weights[2]) == 0.0
    std = torch.exp(x @ weights)
    for share, width in zip(SHARES, widths.tolist(), strict=True):
        assert float((error.abs() < width * std).float().mean()) == pytest.approx(share, abs=1e-3)


def test_a_piece_of_surface_knows_from_where_it_was_seen():
    seen = torch.tensor([[True, False], [False, True], [False, False]])
    receivers = torch.tensor([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    doubt = Uncertainty(
        torch.ones(3), torch.ones(1), receivers, seen, 1.0, torch.zeros(len(NUMBERS)), torch.ones(len(SHARES))
    )
    turns = doubt.turns(torch.zeros(3, 3), torch.tensor([3.0, 3.0, 0.0]))
    torch.testing.assert_close(turns, torch.tensor([math.pi / 4, math.pi / 4, math.pi]), rtol=0, atol=1e-3)
    assert doubt.away(torch.tensor([1.0, 0.0, 2.0])) == pytest.approx(2.0)


def test_a_gate_in_doubt_makes_its_directions_unsure(field):
    pose = Pose([2.0, 2.0, 1.4])
    passed = field.obstacles.transmittance(TX[None], pose.position[None])
    assert float(passed) > 0.999999  # the way is free; a threshold just under that leaves it in doubt
    gate = NUMBERS.index("gate")
    for threshold, least, most in ((0.999999, 4.0, 20.0), (1e-3, 0.0, 0.5)):
        unsure = replace(field, sources=replace(field.sources, open_above=threshold))
        straight = pose.to_device(torch.nn.functional.normalize(TX - pose.position, dim=-1))
        col, row = GRID.pixel_of(straight)[0].long().tolist()
        found = numbers_of(unsure, field.doubt, pose, GRID)[row, col, gate].expm1()
        assert least <= float(found) <= most
