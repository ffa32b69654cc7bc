"""The image method in a rectangular room against the laws that it must obey."""

import math
from dataclasses import replace

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from rf3dgs.core.angles import angle_between
from rf3dgs.core.errors import InputError
from rf3dgs.core.frames import Pose
from rf3dgs.core.units import SPEED_OF_LIGHT, friis_gain
from rf3dgs.propagation.room import HIGHEST_ORDER, Slab, shoebox, slab_reflection

SIZE = (6.0, 5.0, 3.0)
TX, RX = Pose((1.0, 1.5, 2.0)), Pose([[4.0, 3.2, 1.2], [2.0, 4.0, 0.7]])
FREQUENCY = 28e9
GLASS = Slab(6.31, 0.3, 0.01)
MIXED = ("concrete", GLASS, 0.5, -1.0, "wood", Slab(3.0))


def exact(order=3, reflection=-1.0, tx=TX, rx=RX, size=SIZE):
    return shoebox(size, tx, rx, FREQUENCY, order, reflection, dtype=torch.float64)


def test_the_line_of_sight_is_friis():
    paths = exact(order=0)
    distance = (RX.position.double() - TX.position.double()).norm(dim=-1)
    assert torch.allclose(paths.path_gain[:, 0], friis_gain(distance, FREQUENCY), rtol=1e-12)
    assert torch.allclose(paths.delay[:, 0] * SPEED_OF_LIGHT, distance, rtol=1e-12)
    towards = TX.position.double() - RX.position.double()
    assert float(angle_between(paths.aoa[:, 0], towards).max()) < 1e-12
    assert float(angle_between(paths.aod[:, 0], -towards).max()) < 1e-12
    assert paths.order.tolist() == paths.kind.tolist() == [[0], [0]]


@pytest.mark.parametrize("order", [0, 1, 2, 3, 7])
def test_there_are_four_k_squared_plus_two_images_of_k_reflections(order):
    paths = exact(order)
    assert paths.coeff.shape == (2, (2 * order + 1) * (2 * order**2 + 2 * order + 3) // 3)
    for k in range(1, order + 1):
        assert (paths.order == k).sum(-1).tolist() == [4 * k * k + 2] * 2
    assert bool(paths.valid.all())
    assert bool((paths.delay.diff() >= 0).all())


def test_a_floor_reflection_comes_from_the_mirror_image():
    paths = exact(1, [0.0, 0.0, 0.0, 0.0, 0.5, 0.0])
    assert paths.count.tolist() == [2, 2], "black walls send nothing"
    image = TX.position.double() * torch.tensor([1.0, 1.0, -1.0])
    towards = image - RX.position.double()
    bounce = paths.valid & (paths.order == 1)
    assert torch.allclose(paths.delay[bounce] * SPEED_OF_LIGHT, towards.norm(dim=-1), rtol=1e-12)
    assert torch.allclose(paths.path_gain[bounce], 0.25 * friis_gain(towards.norm(dim=-1), FREQUENCY), rtol=1e-12)
    assert float(angle_between(paths.aoa[bounce], towards).max()) < 1e-12
    departs = RX.position.double() * torch.tensor([1.0, 1.0, -1.0]) - TX.position.double()
    assert float(angle_between(paths.aod[bounce], departs).max()) < 1e-12


def test_perfect_conductors_keep_the_power_of_every_path():
    """Power over distance alone, and a vertical antenna's image in the floor (a wall) is upright (upside down)."""
    paths = exact(4)
    assert torch.allclose(paths.path_gain, friis_gain(paths.delay * SPEED_OF_LIGHT, FREQUENCY), rtol=1e-12)
    single = exact(1, [0, 0, 0, 0, -1.0, 0])
    assert float(single.coeff[0][single.valid[0] & (single.order[0] == 1)].angle().abs().max()) < 1e-9
    single = exact(1, [0, -1.0, 0, 0, 0, 0])
    turned = single.coeff[0][single.valid[0] & (single.order[0] == 1)].angle().abs()
    assert float((turned - math.pi).abs().max()) < 1e-9


def test_a_good_conductor_is_nearly_a_perfect_one():
    """Metal of 1e7 S/m at 28 GHz reflects all but sqrt(16 pi f eps0 / sigma) = 0.11 % of the power, head-on."""
    metal = exact(2, "metal")
    perfect = exact(2)
    assert torch.allclose(metal.path_gain, perfect.path_gain, rtol=0.05)
    assert bool((metal.path_gain <= perfect.path_gain * (1 + 1e-12)).all())


@pytest.mark.parametrize("reflection", [-1.0, 0.3 + 0.4j, "concrete", MIXED], ids=["mirror", "number", "slab", "mixed"])
def test_the_channel_is_reciprocal(reflection):
    here, there = Pose(RX.position[0]), Pose(TX.position[None])
    forth = exact(3, reflection)[0]
    back = exact(3, reflection, tx=here, rx=there)[0]
    assert torch.allclose(forth.delay, back.delay, rtol=1e-12)
    assert torch.allclose(forth.path_gain, back.path_gain, rtol=1e-9)
    assert float(angle_between(forth.aoa, back.aod).max()) < 1e-9
    assert float(angle_between(forth.aod, back.aoa).max()) < 1e-9
    # The entry from vertical to vertical is reciprocal as well, so the phases agree where there is power.
    assert torch.allclose(forth.coeff, back.coeff, rtol=1e-6, atol=1e-12)


positions = st.tuples(*(st.floats(0.05, 0.95) for _ in range(3)))
sizes = st.tuples(*(st.floats(2.0, 12.0) for _ in range(3)))


@settings(max_examples=60, deadline=None)
@given(size=sizes, tx=positions, rx=positions, order=st.integers(0, 4))
def test_no_path_gains_power_and_every_path_folds_back_into_the_room(size, tx, rx, order):
    room = torch.tensor(size, dtype=torch.float64)
    source, sink = torch.tensor(tx) * room, torch.tensor(rx) * room
    if float((source - sink).norm()) < 0.01:
        return
    paths = exact(order, MIXED, Pose(source), Pose(sink), size)
    length = paths.delay * SPEED_OF_LIGHT
    assert bool((paths.path_gain <= friis_gain(length, FREQUENCY) * (1 + 1e-9)).all())
    ends = _walk(Pose(source).position.double(), paths.aod, length, room)
    assert float((ends - Pose(sink).position.double()).norm(dim=-1).max()) < 1e-8


def _walk(start, direction, length, room):
    """Where straight lines end that are folded back at the walls like a triangle wave."""
    unfolded = torch.remainder(start + direction * length[..., None], 2 * room)
    return torch.where(unfolded > room, 2 * room - unfolded, unfolded)


def test_turning_the_room_turns_the_paths():
    """A quarter turn about the vertical exchanges x and y walls; gains, delays and zeniths stay."""
    walls = ["concrete", "wood", 0.5, GLASS, "plasterboard", -0.8]
    turned_walls = [walls[3], walls[2], walls[0], walls[1], walls[4], walls[5]]

    def turn(pose):
        x, y, z = pose.position.unbind(-1)
        return Pose(torch.stack((SIZE[1] - y, x, z), -1))

    before = exact(3, walls)
    after = exact(3, turned_walls, turn(TX), turn(RX), (SIZE[1], SIZE[0], SIZE[2]))
    assert torch.allclose(before.delay, after.delay, rtol=1e-7)
    assert torch.allclose(before.path_gain, after.path_gain, rtol=1e-5)
    assert torch.allclose(before.aoa_zenith, after.aoa_zenith, atol=1e-6)


def test_fresnel_coefficients_are_the_textbook_ones():
    cosine = torch.linspace(0.01, 1.0, 50, dtype=torch.float64)
    half = Slab(4.0)
    te, tm = slab_reflection(half, cosine, FREQUENCY)
    assert float(te[-1].real) == pytest.approx(-1 / 3)
    assert float(tm[-1].real) == pytest.approx(1 / 3)
    brewster = torch.tensor(math.cos(math.atan(2.0)), dtype=torch.float64)
    assert abs(complex(slab_reflection(half, brewster, FREQUENCY)[1])) < 1e-12
    # A lossless slab half a wavelength thick inside is invisible head-on, a quarter of one is brightest.
    inside = 299_792_458.0 / FREQUENCY / 2
    head_on = torch.ones((), dtype=torch.float64)
    assert abs(complex(slab_reflection(Slab(4.0, 0, inside / 2), head_on, FREQUENCY)[0])) < 1e-12
    expected = 2 * (1 / 3) / (1 + 1 / 9)
    assert abs(complex(slab_reflection(Slab(4.0, 0, inside / 4), head_on, FREQUENCY)[0])) == pytest.approx(expected)
    # An absorbing slab that is thick enough is a half-space.
    lossy = slab_reflection(Slab(5.24, 1.1, 1.0), cosine, FREQUENCY)
    assert torch.allclose(lossy[0], slab_reflection(Slab(5.24, 1.1), cosine, FREQUENCY)[0], atol=1e-12)


def test_head_on_reflections_have_no_preferred_polarisation():
    """Transmitter and receiver on one normal: the plane of incidence is undefined and must not matter."""
    paths = shoebox((4, 4, 4), Pose((2.0, 2.0, 1.0)), Pose((2.0, 2.0, 3.0)), FREQUENCY, 2, Slab(4.0))
    ceiling = paths.path_gain[(paths.order == 1) & (paths.aoa_zenith < 1e-3)]
    assert float(ceiling) == pytest.approx(float(friis_gain(torch.tensor(4.0), FREQUENCY)) / 9, rel=1e-5)


def test_one_receiver_or_a_grid_of_them():
    one = shoebox(SIZE, TX, RX[0], FREQUENCY, 2)
    grid = shoebox(SIZE, TX, Pose(RX.position.reshape(2, 1, 3)), FREQUENCY, 2)
    assert one.coeff.shape == (25,)
    assert grid.coeff.shape == (2, 1, 25)
    assert torch.equal(grid.delay[0, 0], one.delay)
    assert one.delay.dtype == torch.float32
    assert replace(one, rx=RX[0]).coeff.dtype == torch.complex64


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"rx": Pose([[4.0, 3.0, 1.0], [7.0, 3.0, 1.0]])}, r"receiver 1 at \(7, 3, 1\) is outside the room, .* 3.0\]"),
        ({"tx": Pose((1.0, 0.0, 1.0))}, "the transmitter at .* is outside the room"),
        ({"rx": TX}, "receiver 0 at .* is at the transmitter; move it away"),
        ({"tx": RX}, r"tx must be one pose; got \[2\]"),
        ({"size": (6.0, -5.0, 3.0)}, "size must be the three edges of the room, positive"),
        ({"order": -1}, "order must be between 0 and 60"),
        ({"order": HIGHEST_ORDER + 1}, "as the number of paths grows with its cube; got 61"),
        ({"reflection": [0.5] * 5}, "one for all walls or six .*; got 5"),
        ({"reflection": 1.2}, "wall 'x low' must have a reflection coefficient of at most 1; got 1.2"),
        ({"reflection": "velvet"}, "wall 'x low' has the material 'velvet', which ITU-R P.2040 does not define"),
        ({"reflection": ["metal"] * 5 + ["floorboard"]}, "wall 'z high' has the material 'floorboard', .* at 28 GHz"),
        ({"frequency": 28.0}, "frequency must be in hertz"),
    ],
)
def test_impossible_rooms_are_refused(change, message):
    arguments = {"size": SIZE, "tx": TX, "rx": RX, "frequency": FREQUENCY, "order": 2} | change
    with pytest.raises(InputError, match=message):
        shoebox(**arguments)


def test_a_wall_has_physical_values():
    with pytest.raises(InputError, match="permittivity of at least 1"):
        Slab(0.5)
