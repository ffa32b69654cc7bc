import pytest
import torch

from rf3dgs.core.errors import InputError
from rf3dgs.propagation.config import ReceiverConfig
from rf3dgs.propagation.sites import meshes
from rf3dgs.propagation.sites.receivers import receivers_of


def clear_of(site, rx):
    corners = torch.cat([item.vertices[item.faces] for item in site.objects])
    return float(meshes.distance(rx.position, corners).min())


def test_random_receivers_are_those_of_the_scene(site):
    mine = receivers_of(site, ReceiverConfig(count=40, seed=5))
    theirs = site.receivers(40, 5)
    assert torch.equal(mine.position, theirs.position)
    assert torch.equal(mine.orientation, theirs.orientation)


def test_receivers_keep_their_height_and_clearance(site):
    rx = receivers_of(site, ReceiverConfig(count=60, height=1.2, clearance=0.6))
    assert torch.allclose(rx.position[:, 2], torch.tensor(1.2))
    assert clear_of(site, rx) >= 0.6


def test_a_grid_has_its_spacing_and_leaves_out_what_is_taken(site):
    rx = receivers_of(site, ReceiverConfig(kind="grid", spacing=1.0))
    x, y, z = rx.position.unbind(-1)
    assert torch.allclose(z, torch.tensor(1.5))
    for axis in (x, y):
        steps = torch.unique(axis).diff()
        assert torch.allclose(steps, torch.ones_like(steps), atol=1e-5)
    assert 100 < len(rx) < 14 * 15
    assert clear_of(site, rx) >= 0.35
    assert all(site.occupant(position) is None for position in rx.position)
    low, high = torch.tensor(site.rx_bounds)
    assert torch.allclose(x.min() + x.max(), low[0] + high[0], atol=1e-5)


def test_a_route_is_walked_in_equal_steps_looking_ahead(site):
    route = ((1.5, 3.5), (8.0, 3.5), (8.0, 5.75))
    rx = receivers_of(site, ReceiverConfig(kind="route", route=route, speed=1.5, interval=0.2, height=1.6))
    assert len(rx) == int((6.5 + 2.25) / 0.3) + 1
    assert torch.allclose(rx.position[0], torch.tensor([1.5, 3.5, 1.6]))
    steps = (rx.position[1:] - rx.position[:-1]).norm(dim=-1)
    straight = torch.ones(len(steps), dtype=torch.bool)
    straight[int(6.5 / 0.3)] = False  # round the corner
    assert torch.allclose(steps[straight], torch.tensor(0.3), atol=1e-5)
    forward = rx.world_from_device[:, :, 0]
    assert torch.allclose(forward[0], torch.tensor([1.0, 0.0, 0.0]), atol=1e-6)
    assert torch.allclose(forward[-1], torch.tensor([0.0, 1.0, 0.0]), atol=1e-6)


@pytest.mark.parametrize(
    ("route", "message"),
    [
        (((3.0, 3.5), (3.0, 4.6), (7.0, 4.6)), r"the route is .*'column-1'.* at \(.*walk round it"),
        (((3.0, 3.5), (16.0, 3.5)), "the route is|leaves the scene 'lobby'"),
        (((3.0, 3.5),), "two or more different waypoints"),
        (((3.0, 3.5), (3.0, 3.5)), "two or more different waypoints"),
        ((), "two or more different waypoints"),
    ],
)
def test_impossible_routes_are_refused_with_their_place(site, route, message):
    with pytest.raises(InputError, match=message):
        receivers_of(site, ReceiverConfig(kind="route", route=route))


def test_a_route_outside_the_bounds_says_so(site):
    with pytest.raises(InputError, match=r"leaves the scene 'lobby' at \(15.00, 3.50, 1.50\) m"):
        receivers_of(site, ReceiverConfig(kind="route", route=((15.0, 3.5), (16.0, 3.5))))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"spacing": 0.0}, "positive spacing; got 0.0"),
        ({"kind": "grid", "spacing": 1e-4}, "choose a wider spacing"),
        ({"kind": "grid", "clearance": 5.0}, "no free place on a grid of 0.5 m with 5.0 m clearance"),
        ({"count": 0}, "a count from 1 to 1000000; got 0.35 and 0"),
        ({"clearance": float("nan")}, "a clearance of at least 0 m"),
        ({"kind": "spiral"}, "got 'spiral'"),
        ({"kind": "route", "route": ((1.0, 1.0), (9.0, 9.0)), "speed": 1e-7}, "walk faster"),
    ],
)
def test_impossible_receivers_are_refused(site, change, message):
    with pytest.raises(InputError, match=message):
        receivers_of(site, ReceiverConfig(**change))
