"""Paths made by hand, a hoarder of HDF5 objects and a watch on threads, for the tests of every layer."""

import math
from contextlib import contextmanager

import h5py
import pytest
import torch

from rf3dgs.channel.paths import Paths
from rf3dgs.core.angles import angles_of
from rf3dgs.core.frames import Pose
from rf3dgs.core.progress import Silent
from rf3dgs.core.units import SPEED_OF_LIGHT, friis_gain


def _random_paths(count, seed=0, *, diffuse=True, rx=None):
    generator = torch.Generator().manual_seed(seed)

    def uniform(low, high):
        return low + (high - low) * torch.rand(count, generator=generator)

    kind = 2 if diffuse else 1
    return Paths(
        coeff=torch.polar(uniform(1e-5, 1e-4), uniform(0.0, 2 * math.pi)),
        delay=uniform(2e-8, 1e-7),
        aoa_zenith=torch.acos(uniform(-1.0, 1.0)),
        aoa_azimuth=uniform(-math.pi, math.pi),
        aod_zenith=torch.acos(uniform(-1.0, 1.0)),
        aod_azimuth=uniform(-math.pi, math.pi),
        valid=torch.ones(count, dtype=torch.bool),
        frequency=60e9,
        tx=Pose([0.0, 0.0, 2.0]),
        rx=Pose([3.0, 4.0, 1.0]) if rx is None else rx,
        order=torch.randint(1, 4, (count,), generator=generator, dtype=torch.int8),
        kind=torch.full((count,), kind, dtype=torch.int8),
    )


def _paths_from(directions, gains=None, delays=None, rx=None):
    """Paths of unit gain, or `gains`, that arrive from world-frame vectors `[path, 3]`."""
    directions = torch.as_tensor(directions, dtype=torch.float32).reshape(-1, 3)
    count = len(directions)
    zenith, azimuth = angles_of(directions)
    gains = torch.ones(count) if gains is None else torch.as_tensor(gains, dtype=torch.float32)
    return Paths(
        coeff=gains.sqrt().to(torch.complex64),
        delay=torch.full((count,), 3e-8) if delays is None else torch.as_tensor(delays),
        aoa_zenith=zenith,
        aoa_azimuth=azimuth,
        aod_zenith=math.pi - zenith,
        aod_azimuth=torch.remainder(azimuth + 2 * math.pi, 2 * math.pi) - math.pi,
        valid=torch.ones(count, dtype=torch.bool),
        frequency=60e9,
        tx=Pose([0.0, 0.0, 2.0]),
        rx=Pose([3.0, 4.0, 1.0]) if rx is None else rx,
        order=torch.zeros(count, dtype=torch.int8),
        kind=torch.zeros(count, dtype=torch.int8),
    )


def _line_of_sight(tx, rx, frequency=60e9):
    """The line of sight between two poses, made by hand from Friis."""
    towards = tx.position - rx.position
    distance = torch.linalg.vector_norm(towards)
    paths = _paths_from(towards, gains=friis_gain(distance, frequency)[None], rx=rx)
    return Paths(**{**vars(paths), "delay": (distance / SPEED_OF_LIGHT)[None], "frequency": frequency, "tx": tx})


@pytest.fixture
def random_paths():
    return _random_paths


@pytest.fixture
def paths_from():
    return _paths_from


@pytest.fixture
def line_of_sight():
    return _line_of_sight


class _ThreadWatch(Silent):
    """Progress that notes on how many threads torch works."""

    def __init__(self) -> None:
        self.seen: set[int] = set()

    def update(self, done: int, note: str = "") -> None:
        self.seen.add(torch.get_num_threads())


@pytest.fixture
def torch_threads():
    """Torch has three threads; a progress whose `seen` are those it had while something ran."""
    before = torch.get_num_threads()
    torch.set_num_threads(3)
    yield _ThreadWatch()
    torch.set_num_threads(before)


@pytest.fixture
def held_by_others():
    """A block in which every HDF5 object that is made or opened stays alive, as a debugger keeps local variables."""

    @contextmanager
    def block():
        held: list[object] = []

        def holding(function):
            def called(*arguments, **named):
                held.append(function(*arguments, **named))
                return held[-1]

            return called

        with pytest.MonkeyPatch.context() as patch:
            for name in ("create_dataset", "create_group", "__getitem__"):
                patch.setattr(h5py.Group, name, holding(getattr(h5py.Group, name)))
            yield held

    return block
