"""What reflections leave by the native core against its specification, over the planes of the shipped field."""

import pickle
from dataclasses import replace

import numpy as np
import pytest
import torch

from rf3dgs.cli.facts import open_field
from rf3dgs.core.errors import InputError
from rf3dgs.core.native import native_core
from rf3dgs.field import reflections
from rf3dgs.field.images import sequences
from rf3dgs.field.reflections import RIPPLE, Marks, Reflections, reflected_db, reflected_reference
from rf3dgs.field.sources import PointSources
from rf3dgs.field.ways import ways_over

Met = tuple[np.ndarray, np.ndarray, np.ndarray]


@pytest.fixture(scope="module")
def sources() -> PointSources:
    """The shipped planes, each with a ripple and the first six with marks, and their images."""
    found = open_field("lobby").sources
    assert found is not None
    rng = np.random.default_rng(1)
    plane = torch.from_numpy(rng.integers(0, 6, 3000))
    points = rng.uniform([0.0, 0.0, 0.0], [14.0, 15.0, 3.0], (3000, 3))
    normals, offsets = found.planes.normals[plane].double().numpy(), found.planes.offsets[plane].double().numpy()
    points -= ((points * normals).sum(-1) - offsets)[:, None] * normals
    level_db = torch.from_numpy(rng.normal(0.0, 8.0, 3000)).float()
    ripple = torch.from_numpy(rng.normal(0.0, 3.0, (len(found.planes), RIPPLE))).float()
    rows = torch.cat((sequences(len(found.planes), 2), sequences(0, 0, third=torch.arange(6))[1:]))
    return replace(
        found, sequence=rows, ripple=ripple, marks=Marks(torch.from_numpy(points).float(), plane, level_db, 0.3)
    )


@pytest.fixture(scope="module")
def met(sources) -> Met:
    """Planes, cosines and points of ways all over the lobby."""
    receivers = np.random.default_rng(0).uniform([0.0, 0.0, 0.0], [14.0, 15.0, 3.0], (700, 3))
    ways = ways_over(sources.plan, receivers)
    return sources.plan.sequence[ways.source], ways.cosine, ways.points


def reflections_of(sources: PointSources) -> Reflections:
    return Reflections.of(sources.reflection, sources.ripple, sources.marks)


@pytest.mark.parametrize("without", [(), ("ripple",), ("marks",), ("ripple", "marks")])
def test_the_core_says_what_the_specification_says(sources, met, without):
    of = reflections_of(replace(sources, **dict.fromkeys(without)))
    assert of.held is not None
    found, wanted = reflected_db(of, *met), reflected_reference(of, *met)
    assert len(wanted) > 3000
    assert set((met[0] >= 0).sum(-1)) == {0, 1, 2, 3}
    assert wanted.max() == 0.0
    assert (wanted < 0.0).sum() > 3000
    np.testing.assert_allclose(found, wanted, rtol=1e-12, atol=1e-11)


def test_a_place_has_the_mean_of_all_marks_that_reach_it():
    """Formula (6), however many marks there are, and only of the plane's own."""
    rng = np.random.default_rng(0)
    points = torch.from_numpy(rng.uniform(0.0, 1.0, (400, 3))).float()
    plane, level_db = torch.arange(400) % 3, torch.from_numpy(rng.uniform(-8.0, 0.0, 400)).float()
    of = Reflections.of(torch.zeros(3, 3), None, Marks(points, plane, level_db, 0.3))
    here = np.array([[[0.4, 0.5, 0.6]] * 3])
    apart2 = ((points.double().numpy() - here[0, 0]) ** 2).sum(-1)
    weight = np.exp(-0.5 * apart2 / 0.3**2) * (plane.numpy() == 1)
    wanted = (weight @ level_db.double().numpy()) / (weight.sum() + 0.05)
    for answer in (reflected_db, reflected_reference):
        assert answer(of, np.array([[1, -1, -1]]), np.ones((1, 3)), here) == pytest.approx(wanted, abs=1e-4)


def test_threads_change_no_bit(sources, met, monkeypatch):
    found = []
    for threads in (1, 3):
        monkeypatch.setattr(reflections, "thread_count", lambda threads=threads: threads)
        found.append(reflected_db(reflections_of(sources), *met))
    assert np.array_equal(*found)


def test_without_the_core_the_specification_answers(sources, met, monkeypatch):
    monkeypatch.setattr(reflections, "native_core", lambda: None)
    of = reflections_of(sources)
    assert of.held is None
    assert np.array_equal(reflected_db(of, *met), reflected_reference(of, *met))


def test_reflections_can_be_sent_to_another_process(sources, met):
    of = reflections_of(sources)
    assert of.held is not None
    again = pickle.loads(pickle.dumps(of))
    assert np.array_equal(reflected_db(again, *met), reflected_db(of, *met))


def test_no_way_leaves_nothing(sources):
    none = np.zeros((0, 3), dtype=np.int64), np.zeros((0, 3)), np.zeros((0, 3, 3))
    assert reflected_db(reflections_of(sources), *none).shape == (0,)


def test_tables_that_do_not_fit_together_are_refused(sources, met):
    of = reflections_of(sources)
    assert native_core() is not None
    for damaged in (
        replace(of, ripple=of.ripple[:-1]),
        replace(of, start=of.start[:-1]),
        replace(of, start=of.start + 1),
        replace(of, start=of.start[::-1].copy()),
        replace(of, level_db=of.level_db[:-1]),
        replace(of, along=of.along[:-1]),
        replace(of, width=0.0),
        replace(of, width=float("nan")),
    ):
        with pytest.raises(ValueError, match=r"row per|sorted by plane|is a length"):
            reflected_db(damaged, *met)
    with pytest.raises(TypeError):
        reflected_db(replace(of, ripple=of.ripple[:, :-1].copy()), *met)


def test_ways_that_do_not_fit_together_are_refused(sources, met):
    planes, cosine, points = met
    of = reflections_of(sources)
    for damaged in (
        (planes + len(of.laws), cosine, points),
        (planes - 1, cosine, points),
        (planes, cosine[:-1], points),
        (planes, cosine, points[:-1]),
    ):
        with pytest.raises(ValueError, match=r"row per way|planes that there are"):
            reflected_db(of, *damaged)


def test_marks_of_a_plane_that_is_not_there_are_refused(sources):
    assert sources.marks is not None
    with pytest.raises(InputError, match=r"marks must be on planes below \d+; got"):
        replace(sources, marks=replace(sources.marks, plane=sources.marks.plane + len(sources.planes)))
