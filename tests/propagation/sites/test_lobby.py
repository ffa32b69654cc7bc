import hashlib

import numpy as np
import pytest
import torch

from rf3dgs.core.errors import InputError
from rf3dgs.propagation.sites.lobby import lobby
from rf3dgs.propagation.sites.lobby_extras import PEOPLE
from rf3dgs.propagation.sites.scene_files import write_radio_scene
from rf3dgs.propagation.sites.scenes import scene_of

PLAIN = "c3aca42a62155c72348fa457dbb659289374c4e71185aac21e8a60b096b8eea3"
PLAIN_RADIO = "cde7912290f25546b7f91987ac05f145c968a5949be8bf65aa9ed2bc672b214b"


@pytest.fixture(scope="module")
def full():
    return lobby("full", people=len(PEOPLE))


def fingerprint(scene):
    found = hashlib.sha256()
    for item in scene.objects:
        what = (item.name, item.material, item.scattering, item.thickness, item.glow, item.solid, item.colour)
        found.update(repr(what).encode())
        for tensor in (item.vertices, item.faces, item.uv):
            found.update(b"" if tensor is None else tensor.contiguous().numpy().tobytes())
    return found.hexdigest()


def test_the_plain_lobby_is_the_one_that_the_shipped_data_were_made_from(site, tmp_path):
    assert fingerprint(site) == PLAIN
    assert hashlib.sha256(write_radio_scene(site, tmp_path).read_bytes()).hexdigest() == PLAIN_RADIO
    # Textures are filtered noise, whose last bits differ between processors: the mean byte is held, not every one.
    assert np.mean([item.texture.mean() for item in site.objects]) == pytest.approx(136.7143, abs=0.01)


def test_the_full_lobby_is_the_same_every_time(full):
    assert fingerprint(full) == fingerprint(lobby("full", people=len(PEOPLE)))


def test_the_full_lobby_adds_what_the_plain_one_lacks(site, full):
    plain, more = {item.name for item in site.objects}, {item.name for item in full.objects}
    assert plain - more == {f"plant-{number}" for number in range(1, 5)}
    for part in ("window-frame", "door-handle", "skirting", "light-frame", "grille", "sofa", "chair-legs", "monitor",
                 "leaves", "bin", "exit-sign", "person"):  # fmt: skip
        assert any(name.startswith(part) for name in more), part
    assert len(more) > 3 * len(plain)
    full.check_radio(60e9)


def test_full_objects_are_closed_face_outwards_and_stay_in_the_room(full):
    for item in full.objects:
        low, high = item.vertices.amin(0), item.vertices.amax(0)
        assert bool((low >= -1e-4).all()), item.name
        assert bool((high <= torch.tensor([14.0, 15.0, 3.5]) + 1e-4).all()), item.name
        if item.solid:
            a, b, c = item.vertices[item.faces].double().unbind(1)
            area = torch.linalg.cross(b - a, c - a)
            assert float(area.sum(0).norm()) < 1e-4 * float(area.norm(dim=-1).sum()), item.name
            assert float((a * torch.linalg.cross(b, c)).sum() / 6) > 0, item.name


def test_receivers_and_transmitter_find_free_space_in_the_full_lobby(full):
    assert full.occupant(full.tx.position) is None
    rx = full.receivers(100, seed=0)
    assert all(full.occupant(position) is None for position in rx.position)
    person = next(item for item in full.objects if item.name == "person-1-coat")
    assert full.occupant(person.vertices.mean(0)) == "person-1-coat"


def test_the_full_lobby_has_a_name(site):
    names = [item.name for item in scene_of("lobby-full").objects]
    assert "sofa-1" in names
    assert not any(name.startswith("person") for name in names)
    assert [item.name for item in scene_of("lobby").objects] == [item.name for item in site.objects]


def test_the_nearest_object_is_named_with_its_distance(site):
    name, distance = site.nearest(torch.tensor([4.5, 4.1, 1.5]))
    assert name == "column-1"
    assert distance == pytest.approx(0.2, abs=1e-5)


def test_people_are_optional_and_counted():
    names = {item.name for item in lobby("plain", people=2).objects}
    assert {"person-1-coat", "person-2-skin"} <= names
    assert not any(name.startswith("person-3") for name in names)
    with pytest.raises(InputError, match="people must be between 0 and 8; got 9"):
        lobby(people=9)
    with pytest.raises(InputError, match='detail must be "plain" or "full"; got \'rich\''):
        lobby("rich")  # pyright: ignore[reportArgumentType]
