"""What ways keep of polarisation, against the shoebox tracer and by the core against its specification."""

import pickle
from dataclasses import replace

import numpy as np
import pytest
import torch

from rf3dgs.core.errors import InputError
from rf3dgs.core.frames import Pose
from rf3dgs.field import polarisation
from rf3dgs.field.images import sequences
from rf3dgs.field.polarisation import METAL, Slabs, kept_db, kept_reference
from rf3dgs.field.reflections import RIPPLE
from rf3dgs.field.sources import PointSources
from rf3dgs.field.ways import ways_over
from rf3dgs.geometry import Planes
from rf3dgs.propagation.room import Slab, shoebox
from rf3dgs.splats.obstacles import Obstacles
from rf3dgs.training.levels import slab_levels

SIZE = torch.tensor([6.0, 5.0, 3.0])
TX = torch.tensor([1.0, 1.2, 2.4])
FREQUENCY = 60e9
OF_X = (Slab(6.3, 0.9, 0.012), Slab(2.5, 1.2, 0.1))
OF_Y = (Slab(1.5, 0.1, 0.02), Slab(3.7, 1.1, 0.03))
WALLS = (*OF_X, *OF_Y, Slab(6.8, 0.25, 0.01), Slab(5.0, 0.0, 0.004))
FREE = Obstacles(torch.zeros(0, 3), torch.zeros(0, 4), torch.zeros(0, 3), torch.zeros(0))


def room_of_slabs() -> PointSources:
    """The box from the origin to SIZE with walls of `WALLS`, whose levels are ripples over nothing."""
    normals = torch.cat([torch.stack((row, -row)) for row in torch.eye(3)])
    offsets = torch.stack([value for size in SIZE for value in (torch.tensor(0.0), -size)])
    slabs = torch.tensor([(wall.permittivity, wall.conductivity, wall.thickness) for wall in WALLS])
    levels = slab_levels(slabs.double()[:, None], torch.linspace(0, 1, RIPPLE, dtype=torch.float64), FREQUENCY)
    rows = sequences(6, 2, third=torch.arange(6))
    return PointSources(
        TX, FREQUENCY, Planes(normals, offsets), None, rows, torch.zeros(6, 3), ripple=levels.float(), slabs=slabs
    )


@pytest.fixture(scope="module")
def receivers() -> torch.Tensor:
    return 0.3 + (SIZE - 0.6) * torch.rand(20, 3, generator=torch.Generator().manual_seed(0))


@pytest.fixture(scope="module")
def ways(receivers) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Planes, cosines and departures of all ways in the room."""
    sources = room_of_slabs()
    found = ways_over(sources.plan, receivers.double().numpy())
    return sources.plan.sequence[found.source], found.cosine, found.departure


def test_a_room_of_slabs_is_the_shoebox(receivers):
    """Gains of up to three reflections, but where a ripple's straight lines cut a notch; without polarisation ways of
    two and three are several dB off."""
    truth = shoebox(SIZE.tolist(), Pose(TX), Pose(receivers), FREQUENCY, 3, WALLS)
    sources = room_of_slabs()
    plain = replace(sources, slabs=None)
    errors: dict[str, list[float]] = {"whole": [], "plain": []}
    for number in range(len(receivers)):
        for name, one in (("whole", sources), ("plain", plain)):
            rays = one.rays(receivers[number], FREE)
            late = (rays.delay.double()[:, None] - truth.delay[number]).abs()
            turned = (rays.arrival[:, None] - truth.aoa[number].float()).norm(dim=-1)
            match = (late * 1e9 + turned).argmin(-1)
            level_db = 10 * torch.log10(rays.power.double() / truth.path_gain[number][match])
            loud = (rays.order > 1) & (rays.power > 1e-5 * rays.power.max())
            errors[name] += level_db[loud].abs().tolist()
    assert len(errors["whole"]) > 300
    assert np.median(errors["whole"]) < 0.05
    assert np.quantile(errors["whole"], 0.9) < 0.5
    assert np.median(errors["plain"]) > 0.5


def test_the_core_keeps_what_the_specification_keeps(ways):
    slabs = room_of_slabs()._slabs
    assert slabs is not None
    assert slabs.held is not None
    mine, wanted = kept_db(slabs, *ways), kept_reference(slabs, *ways)
    assert np.ptp(wanted) > 5.0
    np.testing.assert_allclose(mine, wanted, atol=1e-9)
    assert np.array_equal(kept_db(pickle.loads(pickle.dumps(slabs)), *ways), mine)


def test_threads_change_no_bit(ways, monkeypatch):
    slabs = room_of_slabs()._slabs
    assert slabs is not None
    rows = [np.tile(each, (8, 1)) for each in ways]
    found = []
    for threads in ("1", "3"):
        monkeypatch.setenv("RF3DGS_THREADS", threads)
        found.append(kept_db(slabs, *rows))
    assert len(rows[0]) > polarisation.FEW
    assert np.array_equal(*found)


def test_metal_keeps_all_power_in_every_corner(ways):
    slabs = Slabs.of(room_of_slabs().planes.normals, torch.tensor(METAL).repeat(6, 1), FREQUENCY)
    assert np.abs(kept_db(slabs, *ways)).max() < 0.05


def test_one_reflection_keeps_as_much_as_its_level_says(ways):
    slabs = room_of_slabs()._slabs
    assert slabs is not None
    few = ways[0][:, 1] < 0
    assert few.any()
    assert not kept_db(slabs, *ways)[few].any()


def test_parallel_walls_keep_up_to_twice_the_power():
    """At the Brewster angle TM is not reflected: half the power is left, and all of it is reflected again."""
    slabs = Slabs.of(torch.tensor([[0.0, 0.0, 1.0], [0.0, 0.0, -1.0]]), torch.tensor([[4.0, 0.0, 0.1]] * 2), FREQUENCY)
    cosine = np.full((1, 3), np.cos(np.arctan(2.0)))
    departure = np.array([[np.sin(np.arctan(2.0)), 0.0, -np.cos(np.arctan(2.0))]])
    (level_db,) = kept_db(slabs, np.array([[0, 1, -1]]), cosine, departure)
    assert level_db == pytest.approx(10 * np.log10(2.0), abs=1e-6)


def test_way_and_slabs_of_other_planes_are_refused(ways):
    slabs = Slabs.of(torch.tensor([[0.0, 0.0, 1.0]]), torch.tensor([[4.0, 0.0, 0.1]]), FREQUENCY)
    with pytest.raises(ValueError, match="planes that there are"):
        kept_db(slabs, *ways)
    with pytest.raises(InputError, match=r"slabs must be \[6, 3\]"):
        replace(room_of_slabs(), slabs=torch.ones(5, 3))
    with pytest.raises(InputError, match="permittivities of 1 or more"):
        replace(room_of_slabs(), slabs=torch.zeros(6, 3))
