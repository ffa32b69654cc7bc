"""Laws of the baselines that know physics: path loss, the office of TR 38.901, and twins that are a bit wrong."""

import importlib.util
import math
import sys
from dataclasses import replace

import pytest
import torch

from rf3dgs.channel.path_loss import LogDistance, free_space_loss, okumura_hata_loss, tr38901_indoor_loss
from rf3dgs.core.angles import angle_between
from rf3dgs.core.errors import InputError, MissingDependencyError
from rf3dgs.core.frames import Pose
from rf3dgs.core.grids import equirect_grid, list_grid, pinhole_grid
from rf3dgs.core.units import SPEED_OF_LIGHT
from rf3dgs.evaluation.baselines.path_loss import PathLossPredictor, log_distance_of
from rf3dgs.evaluation.baselines.tr38901 import IndoorOffice
from rf3dgs.evaluation.baselines.twin import Twin, misplaced, mistaken
from rf3dgs.propagation.config import TraceConfig
from rf3dgs.propagation.llvm import find_llvm
from rf3dgs.propagation.sites.scene import Scene, SceneObject
from rf3dgs.propagation.sites.shapes import box
from rf3dgs.spectra.peaks import main_peak
from rf3dgs.spectra.spectrum import stack_spectra

FOUR = [index * math.pi / 2 for index in range(4)]


def friis(tx: torch.Tensor, rx: torch.Tensor) -> torch.Tensor:
    return free_space_loss((rx - tx).norm(dim=-1), 60e9)


def four_pinholes(room, places):
    grid = pinhole_grid(24, 16, fov_deg=90)
    return stack_spectra([room.spectrum_at(Pose.from_yaw(place, yaw), grid) for place in places for yaw in FOUR])


def test_a_path_loss_on_a_sphere_has_the_formulas_gain_and_no_direction(room):
    train = room.spectra_at(room.receivers(3))
    place = Pose((6.0, 7.0, 1.5))
    answer = PathLossPredictor(train, friis).render(place, train.grid)
    expected = float(10 ** (-friis(room.tx, place.position) / 10))
    assert float(answer.path_gain) == pytest.approx(expected, rel=1e-4)
    assert float(answer.power.max()) == float(answer.power.min())
    assert answer.delay is None
    assert answer.aod is None


def test_a_path_loss_on_four_pinholes_adds_up_to_the_formulas_gain(room):
    train = four_pinholes(room, room.receivers(2).position)
    predictor = PathLossPredictor(train, friis)
    poses = Pose.from_yaw(torch.tensor([6.0, 7.0, 1.5]).expand(4, 3), torch.tensor(FOUR))
    answer = predictor.render(poses, train.grid)
    expected = float(10 ** (-friis(room.tx, poses.position[0]) / 10))
    assert float(answer.path_gain.sum()) == pytest.approx(expected, rel=1e-4)


@pytest.mark.parametrize("pinholes", [False, True])
def test_a_log_distance_fit_gives_back_the_line_that_spectra_follow(room, pinholes):
    places = room.receivers(6).position
    like = four_pinholes(room, places) if pinholes else room.spectra_at(Pose(places))
    line = LogDistance(71.0, 1.6)
    spectra = PathLossPredictor(like, lambda tx, rx: line.loss((rx - tx).norm(dim=-1))).render(like.pose, like.grid)
    fit = log_distance_of(spectra)
    assert fit.loss_1m_db == pytest.approx(71.0, abs=0.01)
    assert fit.exponent == pytest.approx(1.6, abs=1e-3)
    assert fit.shadowing_db < 0.01


def test_a_formula_outside_its_range_is_refused_when_it_is_made(room):
    def hata(tx, rx):
        return okumura_hata_loss((rx - tx).norm(dim=-1), 60e9, base_height=30.0)

    with pytest.raises(InputError, match=r"Okumura-Hata takes a frequency .MHz. from 150 to 1500; got 60000"):
        PathLossPredictor(room.spectra_at(room.receivers(2)), hata)


def test_baselines_of_physics_need_the_transmitter_and_solid_angles(room):
    train = room.spectra_at(room.receivers(2))
    for make in (lambda spectra: PathLossPredictor(spectra, friis), IndoorOffice):
        with pytest.raises(InputError, match="needs the transmitter's position"):
            make(replace(train, tx=None))
    listed = stack_spectra([room.spectrum_at(Pose((5.0, 5, 1)), list_grid(torch.tensor([[1.0, 0.0, 0.0]])))])
    with pytest.raises(InputError, match="no solid angles to spread power over"):
        PathLossPredictor(listed, friis)
    with pytest.raises(InputError, match="training spectra with a pose axis"):
        PathLossPredictor(train[0], friis)


def test_the_indoor_office_has_its_path_loss_and_the_true_line_of_sight(room):
    train = room.spectra_at(room.receivers(2))
    grid, place = equirect_grid(90, 45), Pose((9.0, 8.0, 1.3))
    answer = IndoorOffice(train).render(place, grid)
    away = room.tx - place.position
    expected = -float(tr38901_indoor_loss(away.norm(), 60e9))
    assert 10 * math.log10(float(answer.path_gain)) == pytest.approx(expected, abs=0.02)
    assert math.degrees(float(angle_between(main_peak(answer), away))) < 4.0  # the grid's pixel
    peak = int(answer.power.argmax())
    # Other clusters within the lobe of 12 degrees are later, weaker by 7 dB together, of 20 ns of spread.
    assert float(answer.delay.flatten()[peak]) == pytest.approx(float(away.norm()) / SPEED_OF_LIGHT, abs=5e-9)
    assert float(angle_between(answer.aod.reshape(-1, 3)[peak], -away)) < math.radians(10)
    dark = answer.power == 0
    assert bool(dark.any())
    torch.testing.assert_close(answer.delay[dark], (away.norm() / SPEED_OF_LIGHT).expand(int(dark.sum())))
    assert float(angle_between(answer.aod[dark], -away.expand(int(dark.sum()), 3)).max()) < 1e-5


def test_the_indoor_office_is_in_sight_nearby_and_out_of_sight_far_away(room):
    office = IndoorOffice(room.spectra_at(room.receivers(2)))
    assert office.sees(Pose((9.0, 8.0, 1.3)))
    far = Pose((82.0, 3.0, 2.8))
    assert not office.sees(far)
    power = office.render(far, equirect_grid(60, 30)).path_gain
    expected = -float(tr38901_indoor_loss(torch.tensor(80.0), 60e9, line_of_sight=False))
    assert 10 * math.log10(float(power)) == pytest.approx(expected, abs=0.02)


@pytest.fixture(scope="module")
def hall() -> Scene:
    shell = box((0.0, 0.0, 0.0), (8.0, 7.0, 3.0))
    things = {
        "shell": ((shell[0], shell[1].flip(1)), "concrete", 0.6, False),
        "crate": (box((3.0, 3.0, 0.0), (4.0, 4.0, 1.0))[:2], "wood", 0.4, True),
        "plate": (box((5.0, 5.0, 0.5), (6.0, 5.1, 2.0))[:2], "metal", 0.2, True),
        "crate-2": (box((6.0, 1.0, 0.0), (6.5, 1.5, 1.0))[:2], "wood", 0.9, True),
    }
    objects = tuple(
        SceneObject(name, *mesh, material, scattering, solid=solid)
        for name, (mesh, material, scattering, solid) in things.items()
    )
    bounds = ((0.0, 0.0, 0.0), (8.0, 7.0, 3.0))
    return Scene("hall", objects, Pose((0.7, 0.8, 2.4)), bounds, bounds, bounds, 60e9)


@pytest.fixture(scope="module")
def traced(hall, room):
    if importlib.util.find_spec("sionna") is None:
        pytest.skip("sionna-rt is not installed")
    if find_llvm().path is None:
        pytest.skip(f"no LLVM for the ray tracer: {find_llvm().reason}")
    return Twin(hall, room.spectra_at(room.receivers(2)), TraceConfig(rays=5_000, depth=2, seed=3))


def test_a_twin_of_the_true_scene_sees_the_transmitter_where_it_is(traced, hall):
    place = Pose((7.0, 4.0, 1.5))
    answer = traced.render(place, equirect_grid(90, 45))
    away = hall.tx.position - place.position
    assert math.degrees(float(angle_between(main_peak(answer), away))) < 4.0  # the grid's pixel
    free = float(10 ** (-free_space_loss(away.norm(), 60e9) / 10))
    assert free < float(answer.path_gain) < 10 * free
    assert float(answer.delay[answer.power > 0].min()) >= float(away.norm()) / SPEED_OF_LIGHT * (1 - 1e-5)
    assert torch.equal(traced.render(place, equirect_grid(90, 45)).power, answer.power)


def test_pictures_of_one_position_share_one_trace(traced, monkeypatch):
    calls = []
    paths = traced._tracer.paths
    monkeypatch.setattr(traced._tracer, "paths", lambda *values: calls.append(values) or paths(*values))
    grid = pinhole_grid(24, 16, fov_deg=90)
    pictures = [traced.render(Pose.from_yaw((2.0, 5.0, 1.4), yaw), grid) for yaw in FOUR]
    assert len(calls) == 1
    assert len({float(picture.path_gain) for picture in pictures}) == 4
    assert [picture.method for picture in pictures] == ["twin"] * 4


def test_a_twin_with_something_solid_at_the_receiver_still_answers(traced, room):
    answer = traced.render(Pose((3.5, 3.5, 0.5)), room.grid)
    clear = traced.render(Pose((3.5, 2.5, 0.5)), room.grid)
    assert bool(torch.isfinite(answer.power).all())
    assert float(answer.path_gain) < 0.01 * float(clear.path_gain)
    outside = traced.render(Pose((20.0, 3.5, 1.5)), room.grid)
    assert float(outside.power.abs().max()) == 0.0


def test_misplaced_objects_move_as_a_whole_and_the_transmitter_stays(hall):
    moved = misplaced(hall, 0.05, seed=4)
    offsets = []
    for before, after in zip(hall.objects, moved.objects, strict=True):
        shift = after.vertices - before.vertices
        torch.testing.assert_close(shift, shift[:1].expand_as(shift), rtol=0, atol=1e-6)
        offsets.append(shift[0])
        assert torch.equal(after.faces, before.faces)
    assert len({tuple(offset.tolist()) for offset in offsets}) == len(hall.objects)
    assert torch.equal(moved.tx.position, hall.tx.position)
    assert moved.bounds == hall.bounds
    again, other = misplaced(hall, 0.05, seed=4), misplaced(hall, 0.05, seed=5)
    assert torch.equal(moved.objects[1].vertices, again.objects[1].vertices)
    assert not torch.equal(moved.objects[1].vertices, other.objects[1].vertices)
    twice = misplaced(hall, 0.10, seed=4).objects[1].vertices - hall.objects[1].vertices
    torch.testing.assert_close(twice, 2 * (moved.objects[1].vertices - hall.objects[1].vertices), rtol=0, atol=1e-6)


def test_offsets_have_the_asked_deviation(hall):
    many = replace(hall, objects=tuple(replace(hall.objects[1], name=f"crate-{i}") for i in range(400)))
    moved = misplaced(many, 0.1, seed=0)
    offset = torch.stack([item.vertices[0] for item in moved.objects]) - hall.objects[1].vertices[0]
    assert float(offset.std()) == pytest.approx(0.1, rel=5 / math.sqrt(2 * 1200))
    assert float(offset.mean().abs()) < 5 * 0.1 / math.sqrt(1200)


def test_mistaken_materials_are_those_of_the_next_less_reflecting_object_and_shapes_stay(hall):
    wrong = mistaken(hall)  # metal for concrete, concrete for wood, and wood, which reflects least, for concrete
    assert [item.material for item in wrong.objects] == ["wood", "concrete", "concrete", "concrete"]
    assert [item.scattering for item in wrong.objects] == [0.4, 0.6, 0.6, 0.6]
    for before, after in zip(hall.objects, wrong.objects, strict=True):
        assert torch.equal(before.vertices, after.vertices)
        assert (before.name, before.solid) == (after.name, after.solid)


def test_what_cannot_be_made_wrong_is_refused(hall, tmp_path):
    read = replace(hall, source=tmp_path / "street.xml")
    for change in (mistaken, lambda scene: misplaced(scene, 0.02)):
        with pytest.raises(InputError, match=r"'hall' is traced from street.xml, whose objects cannot be changed here"):
            change(read)
    with pytest.raises(InputError, match="deviation must be a length of at least 0 m; got -1"):
        misplaced(hall, -1.0)
    with pytest.raises(InputError, match="'hall' has only metal"):
        mistaken(replace(hall, objects=hall.objects[2:3]))


def test_a_twin_without_the_tracer_names_the_extra(hall, room, monkeypatch):
    monkeypatch.setitem(sys.modules, "mitsuba", None)
    with pytest.raises(MissingDependencyError, match=r"rf3dgs\[trace\]"):
        Twin(hall, room.spectra_at(room.receivers(2)), TraceConfig())
