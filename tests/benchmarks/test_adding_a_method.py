"""The page about adding a method shows a real file, and that file is a method."""

import importlib.util
import re
from pathlib import Path
from types import ModuleType

import pytest
import torch
from benchmarks.quality.methods.method import Task

from rf3dgs.core.frames import Pose
from rf3dgs.core.grids import pinhole_grid
from rf3dgs.spectra.codec import DbWindow
from rf3dgs.spectra.spectrum import Instrument, Spectrum

ROOT = Path(__file__).parents[2]
FILE, PAGE = ROOT / "examples/07_adding_a_method.py", ROOT / "docs/how-to/adding-a-method.md"
GRID = pinhole_grid(6, 4, fov_deg=90)


@pytest.fixture(scope="module")
def example() -> ModuleType:
    spec = importlib.util.spec_from_file_location("adding_a_method", FILE)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def task_of(places: list[float], levels: list[float]) -> Task:
    """Pictures of even power at places on the x axis."""
    power = torch.tensor(levels)[:, None, None].expand(-1, *GRID.shape)
    pose = Pose(torch.tensor([[x, 0.0, 1.0] for x in places]))
    return Task(Spectrum(power, GRID, pose, 28e9, Instrument.gaussian(0.05)), DbWindow(-90.0, 0.0))


def test_the_page_shows_the_file_as_it_is():
    blocks = re.findall(r"```python\n(.*?)```", PAGE.read_text(encoding="utf-8"), flags=re.DOTALL)
    assert blocks == [FILE.read_text(encoding="utf-8")]


def test_a_method_takes_fewer_than_100_lines():
    assert len(FILE.read_text(encoding="utf-8").splitlines()) < 100


@pytest.mark.parametrize(("x", "expected"), [(0.1, 1e-7), (1.1, 1e-7), (2.1, 1e-8), (2.9, 1e-8)])
def test_the_stronger_of_the_two_nearest_wins(example, x, expected):
    task = task_of([0.0, 1.2, 2.0, 3.0], [1e-9, 1e-7, 1e-10, 1e-8])
    answer = example.METHODS[0].made(task).render(Pose((x, 0.0, 1.0)), GRID)
    torch.testing.assert_close(answer.power, torch.full(GRID.shape, expected))
    assert answer.method == "stronger of two"


def test_pictures_of_one_position_are_one_neighbour(example):
    task = task_of([0.0, 0.0, 1.0], [1e-8, 1e-8, 1e-7])
    answer = example.METHODS[0].made(task).render(Pose((0.1, 0.0, 1.0)), GRID)
    torch.testing.assert_close(answer.power, torch.full(GRID.shape, 1e-7))
