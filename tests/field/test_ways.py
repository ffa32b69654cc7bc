"""Ways by the native core against their specification, over the planes of the shipped field."""

import pickle
from dataclasses import fields, replace

import numpy as np
import pytest
import torch

from rf3dgs.cli.facts import open_field
from rf3dgs.core.native import native_core
from rf3dgs.field import ways
from rf3dgs.field.images import sequences
from rf3dgs.field.sources import PointSources
from rf3dgs.field.ways import Plan, ways_over, ways_reference


@pytest.fixture(scope="module")
def sources() -> PointSources:
    """All images of two reflections, and of three in a few planes."""
    found = open_field("lobby").sources
    assert found is not None
    assert found.patches is not None
    few = torch.arange(6)
    rows = torch.cat((sequences(len(found.planes), 2), sequences(0, 0, third=few)[1:]))
    return replace(found, sequence=rows)


@pytest.fixture(scope="module")
def receivers() -> np.ndarray:
    """All over the lobby and beyond it."""
    return np.random.default_rng(0).uniform([-3.0, -3.0, -1.0], [17.0, 18.0, 5.0], (700, 3))


def plan_of(sources: PointSources, surface: bool) -> Plan:
    return sources.plan if surface else replace(sources, patches=None).plan


@pytest.mark.parametrize("surface", [True, False])
def test_the_core_finds_the_ways_of_the_specification(sources, receivers, surface):
    plan = plan_of(sources, surface)
    found, wanted = ways_over(plan, receivers), ways_reference(plan, receivers)
    assert plan.held is not None
    assert len(wanted) > 1000
    assert set(plan.order[wanted.source]) == {0, 1, 2, 3}
    for field in fields(wanted):
        mine, other = getattr(found, field.name), getattr(wanted, field.name)
        assert (mine.dtype, mine.shape) == (other.dtype, other.shape)
        np.testing.assert_allclose(mine, other, rtol=1e-9, atol=1e-12, err_msg=field.name)


def test_sources_that_are_not_asked_have_no_way(sources, receivers):
    asked = np.arange(len(sources)) % 3 == 0
    found = ways_over(sources.plan, receivers, asked)
    every = ways_reference(sources.plan, receivers)
    chosen = every.only(asked[every.source])
    assert 0 < len(chosen) < len(every)
    assert np.array_equal(found.source, chosen.source)
    assert np.array_equal(found.place, chosen.place)


def test_threads_change_no_bit(sources, receivers, monkeypatch):
    found = []
    for threads in (1, 3):
        monkeypatch.setattr(ways, "thread_count", lambda threads=threads: threads)
        found.append(ways_over(sources.plan, receivers))
    for field in fields(found[0]):
        assert np.array_equal(getattr(found[0], field.name), getattr(found[1], field.name)), field.name


def test_a_receiver_that_is_nowhere_has_no_way(sources):
    places = np.array([[np.nan, 1.0, 1.0], [np.inf, 1.0, 1.0], [3.0, 3.0, 1.5]])
    with np.errstate(invalid="ignore"):
        found = ways_over(sources.plan, places)
    reflected = sources.plan.order[found.source] > 0
    assert set(found.place[reflected]) == {2}
    assert len(ways_over(sources.plan, np.zeros((0, 3)))) == 0


def test_without_the_core_the_specification_answers(sources, receivers, monkeypatch):
    monkeypatch.setattr(ways, "native_core", lambda: None)
    plan = replace(sources, level_db=0.0).plan
    assert plan.held is None
    found, wanted = ways_over(plan, receivers), ways_over(sources.plan, receivers)
    assert np.array_equal(found.source, wanted.source)


def test_a_plan_can_be_sent_to_another_process(sources, receivers):
    assert sources.plan.held is not None
    again = pickle.loads(pickle.dumps(sources.plan))
    assert np.array_equal(ways_over(again, receivers).points, ways_over(sources.plan, receivers).points)


def test_plans_whose_numbers_point_elsewhere_are_refused(sources):
    plan, reach = sources.plan, sources.plan.reach
    assert reach is not None
    assert native_core() is not None
    for damaged in (
        replace(plan, sequence=plan.sequence + 1000),
        replace(plan, order=plan.order[:-1]),
        replace(plan, order=plan.order + 3),
        replace(plan, last=plan.last + 1000),
        replace(plan, reach=replace(reach, cells=reach.cells[:-200])),
        replace(plan, reach=replace(reach, start=reach.start - 10)),
        replace(plan, reach=replace(reach, last=reach.last * np.nan)),
    ):
        with pytest.raises(ValueError, match=r"row per|in planes that|beyond the last"):
            ways_over(damaged, np.zeros((1, 3)))
