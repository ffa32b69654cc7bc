"""The methods that know physics: every one is made from a task, answers on its grid, and says what decides it."""

import importlib.util
import json
import math
from dataclasses import replace

import pytest
import torch
from benchmarks.quality.methods import path_loss, tr38901, twin
from benchmarks.quality.methods.method import Task

from rf3dgs.channel.path_loss import LogDistance
from rf3dgs.core.errors import InputError
from rf3dgs.core.frames import Pose
from rf3dgs.core.grids import equirect_grid
from rf3dgs.propagation.llvm import find_llvm
from rf3dgs.propagation.sites.scene import Scene, SceneObject
from rf3dgs.propagation.sites.shapes import box
from rf3dgs.spectra.codec import DbWindow
from rf3dgs.spectra.spectrum import Instrument, Spectrum

METHODS = {method.name: method for subject in (path_loss, tr38901, twin) for method in subject.METHODS}
FREE = ("friis", "log-distance", "itu-indoor", "tr38901-inh")


@pytest.fixture(scope="module")
def task() -> Task:
    """Eight positions whose gains follow 72 dB + 15 dB a decade, from everywhere alike."""
    generator = torch.Generator().manual_seed(0)
    position = torch.tensor([1.0, 2.0, 1.0]) + torch.tensor([10.0, 10.0, 1.0]) * torch.rand(8, 3, generator=generator)
    tx, grid, beam = Pose((0.6, 0.8, 2.6)), equirect_grid(48, 24), Instrument.gaussian(math.radians(12))
    gain = 10 ** (-LogDistance(72.0, 1.5).loss((position - tx.position).norm(dim=-1)) / 10)
    power = (gain * beam.beam_solid_angle / (4 * math.pi))[:, None, None].expand(8, *grid.shape).contiguous()
    return Task(Spectrum(power, grid, Pose(position), 60e9, beam, tx=tx), DbWindow(-140.0, -60.0), scale="smoke")


def test_methods_have_names_of_their_own_and_settings_that_json_holds(task):
    assert set(METHODS) == {
        *FREE,
        *("okumura-hata", "cost231-hata", "twin", "twin-2cm", "twin-5cm", "twin-10cm", "twin-materials"),
    }
    assert sum(len(subject.METHODS) for subject in (path_loss, tr38901, twin)) == len(METHODS)
    said = [json.dumps(dict(METHODS[name].settings(task)), sort_keys=True) for name in METHODS if name[:4] == "twin"]
    assert len(set(said)) == 5


@pytest.mark.parametrize("name", FREE)
def test_what_needs_no_scene_answers_within_a_few_db_of_an_indoor_room(task, name):
    predictor = METHODS[name].made(task)
    answer = predictor.render(task.spectra.pose[3], task.spectra.grid)
    assert answer.power.shape == task.spectra.grid.shape
    error_db = 10 * math.log10(float(answer.path_gain / task.spectra.path_gain[3]))
    assert abs(error_db) < (0.05 if name == "log-distance" else 12.0)


@pytest.mark.parametrize("name", ["okumura-hata", "cost231-hata"])
def test_models_for_cities_refuse_60_ghz_and_name_what_does_not(task, name):
    with pytest.raises(InputError, match=r"takes a frequency .MHz. from .* got 60000. Use tr38901_indoor_loss"):
        METHODS[name].made(task)


@pytest.mark.parametrize("name", ["twin", "twin-2cm", "twin-materials"])
def test_twins_need_a_scene(task, name):
    with pytest.raises(InputError, match=f"'{name}' needs a task with scene"):
        METHODS[name].made(task)


def test_a_twin_whose_walls_moved_still_sees_the_transmitter_and_nearly_the_same_gain(task):
    if importlib.util.find_spec("sionna") is None:
        pytest.skip("sionna-rt is not installed")
    if find_llvm().path is None:
        pytest.skip(f"no LLVM for the ray tracer: {find_llvm().reason}")
    shell, crate = box((0.0, 0.0, 0.0), (12.0, 13.0, 3.0)), box((9.0, 1.0, 0.0), (10.0, 2.0, 1.0))
    things = (
        SceneObject("shell", shell[0], shell[1].flip(1), "concrete", 0.6),
        SceneObject("crate", crate[0], crate[1], "wood", 0.4, solid=True),
    )
    bounds = ((0.0, 0.0, 0.0), (12.0, 13.0, 3.0))
    tx = task.spectra.tx
    room = replace(task, scene=Scene("room", things, tx, bounds, bounds, bounds, 60e9))
    pose = task.spectra.pose[0]
    true, moved = (METHODS[name].made(room).render(pose, task.spectra.grid) for name in ("twin", "twin-5cm"))
    assert not torch.equal(true.power, moved.power)
    # Most of the gain is the line of sight, which is where it was.
    assert abs(10 * math.log10(float(moved.path_gain / true.path_gain))) < 1.0
    assert int(true.power.argmax()) == int(moved.power.argmax())
