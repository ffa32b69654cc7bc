import json

import torch
from benchmarks.quality.methods import cgan
from benchmarks.quality.methods.method import Task

from rf3dgs.core.frames import Pose
from rf3dgs.core.grids import pinhole_grid
from rf3dgs.spectra.codec import DbWindow
from rf3dgs.spectra.spectrum import Instrument, Spectrum


def task_of_noise() -> Task:
    grid = pinhole_grid(18, 12, fov_deg=90)
    power = 10 ** (-6 - 3 * torch.rand(4, *grid.shape, generator=torch.Generator().manual_seed(0)))
    place = torch.rand(4, 3, generator=torch.Generator().manual_seed(1))
    spectra = Spectrum(power, grid, Pose(place), 28e9, Instrument.gaussian(0.05))
    return Task(spectra, DbWindow(-90.0, -60.0), seed=3, scale="smoke")


def test_the_cgan_learns_from_a_task_and_says_with_which_settings():
    (method,) = cgan.METHODS
    task = task_of_noise()
    predictor = method.made(task)
    settings = json.loads(json.dumps(method.settings(task)))
    assert settings["steps"] == predictor.history[-1].step
    drawn = predictor.render(Pose((0.5, 0.5, 0.5)), task.spectra.grid)
    assert drawn.power.shape == task.spectra.grid.shape
    assert bool(torch.isfinite(drawn.power).all())


def test_the_published_cost_is_steps_times_what_a_step_takes(monkeypatch):
    monkeypatch.setattr(cgan, "PUBLISHED_SIZE", (24, 16))
    cost = cgan.published_cost(task_of_noise())
    assert cost["seconds_per_step"] > 0
    assert cost["steps"] == 200 * 2560 // 8
    assert cost["fit_seconds"] == cost["steps"] * cost["seconds_per_step"]
    assert "extrapolated" in cost["how"]
