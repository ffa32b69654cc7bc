"""Laws of the table's scenes: receivers are free and nested, nobody stands under a roof, geometry is what was seen."""

from dataclasses import replace

import pytest
import torch
from benchmarks.quality.protocol import data, scenes
from benchmarks.quality.protocol.data import geometry_of
from benchmarks.quality.protocol.scenes import MOVED, SITES, Setting, under_a_roof
from benchmarks.quality.protocol.study import Study, StudyConfig

from rf3dgs.core.errors import InputError
from rf3dgs.propagation.sites.lobby import lobby
from rf3dgs.propagation.sites.scene import SceneObject
from rf3dgs.propagation.sites.shapes import box
from rf3dgs.splats.gaussians import Gaussians


def test_only_points_below_a_face_are_under_a_roof():
    vertices, faces, _ = box((0.0, 0.0, 3.0), (2.0, 2.0, 4.0))
    points = torch.tensor([[1.0, 0.5, 1.5], [1.0, 0.5, 3.5], [1.0, 0.5, 4.5], [2.5, 0.5, 1.5], [-0.1, 1.0, 1.5]])
    assert under_a_roof(points, vertices, faces).tolist() == [True, True, False, False, False]


def test_the_round_room_keeps_receivers_off_the_cylinder_and_the_sphere():
    setting = Setting("round-room", "realistic")
    place, scene = setting.receivers(60).position, setting.scene()
    assert bool(scene.free(place, 0.35).all())
    assert scene.occupant(scene.tx.position) is None
    assert scene.occupant(torch.tensor([3.0, 4.6, 1.5])) == "cylinder"
    assert scene.occupant(torch.tensor([5.4, 2.6, 1.1])) == "sphere"
    assert torch.equal(setting.receivers(20).position, place[:20])


def test_receivers_of_the_moved_lobby_are_free_before_and_after():
    moved, before = Setting("lobby-moved", "realistic"), Setting("lobby-before", "realistic")
    place = moved.receivers(40).position
    assert torch.equal(place, before.receivers(40).position)
    assert bool(moved.scene().free(place, 0.35).all())
    assert bool(before.scene().free(place, 0.35).all())


def test_only_the_furniture_named_has_moved():
    was, now = lobby(), Setting("lobby-moved", "realistic").scene()
    for old, new in zip(was.objects, now.objects, strict=True):
        shift = (new.vertices - old.vertices).mean(0)
        expected = torch.tensor([*MOVED.get(old.name, (0.0, 0.0)), 0.0])
        torch.testing.assert_close(shift, expected, atol=1e-5, rtol=0.0)  # float32 sums over a few hundred vertices
    assert set(MOVED) <= {item.name for item in was.objects}


def test_geometry_ends_where_the_site_says(monkeypatch, tmp_path):
    whole = SITES["round-room"].make()
    small = replace(whole, rx_bounds=((2.0, 2.0, 1.0), (6.0, 5.0, 2.0)))
    monkeypatch.setitem(scenes.SITES, "round-room", replace(SITES["round-room"], make=lambda: small, around=1.0))
    means = geometry_of("mesh", Setting("round-room", "realistic"), tmp_path, count=500).means[:, :2]
    edge = 0.25  # of the longest triangle, which is in where its middle is
    assert bool((means > 1.0 - edge).all())
    assert bool((means < torch.tensor([7.0, 6.0]) + edge).all())
    assert float(means[:, 0].max() - means[:, 0].min()) > 5.0


def test_what_nobody_sees_takes_no_gaussians(monkeypatch, tmp_path):
    whole = SITES["round-room"].make()
    low, high = whole.bounds
    hidden = SceneObject("cellar", *box((2.0, 2.0, -2.0), (4.0, 4.0, -1.0))[:2], "concrete", 0.6)
    cellar = replace(whole, objects=(*whole.objects, hidden), bounds=((low[0], low[1], -3.0), high))
    monkeypatch.setattr(data, "EYES", 8)
    for around in (None, 9.0):
        site = replace(SITES["round-room"], make=lambda: cellar, around=around)
        monkeypatch.setitem(scenes.SITES, "round-room", site)
        means = geometry_of("mesh", Setting("round-room", "realistic"), tmp_path / str(around), count=3000).means
        assert bool((means[:, 2] < -0.5).any()) == (around is None)
        assert bool((means[:, 2] > 2.9).any())


def test_a_mesh_is_sampled_once(tmp_path, monkeypatch):
    setting = Setting("round-room", "realistic")
    first = geometry_of("mesh", setting, tmp_path, count=500)
    monkeypatch.setattr("benchmarks.quality.protocol.data.sample_mesh", lambda *args, **named: pytest.fail("again"))
    assert torch.equal(first.means, geometry_of("mesh", setting, tmp_path, count=500).means)


def test_every_seed_has_geometry_of_its_own(tmp_path, monkeypatch):
    def grown(photos, config, *, progress=None):
        return Gaussians.random(40, [0.0, 0.0, 0.0], [1.0, 1.0, 1.0], degree=0, seed=config.seed)

    monkeypatch.setattr("rf3dgs.training.visual.fit_geometry", grown)
    study = Study(StudyConfig("lobby", "diffuse", tmp_path))
    first, second = study.geometry(0), study.geometry(1)
    assert not torch.equal(first.means, second.means)
    monkeypatch.setattr("rf3dgs.training.visual.fit_geometry", lambda *args, **named: pytest.fail("again"))
    assert torch.equal(Study(StudyConfig("lobby", "diffuse", tmp_path)).geometry(1).means, second.means)


def test_photographs_of_a_scene_that_has_none_are_refused(tmp_path):
    with pytest.raises(InputError, match="nobody photographed"):
        geometry_of("photos", Setting("round-room", "realistic"), tmp_path, count=500)


def test_an_unknown_scene_or_preset_is_refused():
    with pytest.raises(InputError, match="the scenes of the table are"):
        Setting("castle", "realistic")
    with pytest.raises(InputError, match="no preset is named"):
        Setting("lobby", "sunny")
