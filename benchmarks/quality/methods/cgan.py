"""The conditional GAN, in the dB window that all methods are judged in."""

import time
from collections.abc import Mapping
from dataclasses import asdict, replace
from typing import Any

import torch

from benchmarks.quality.methods.method import Method, Task
from rf3dgs.core.frames import Pose
from rf3dgs.core.grids import pinhole_grid
from rf3dgs.evaluation.baselines import Cgan, CganConfig, fit_cgan
from rf3dgs.spectra.spectrum import Spectrum

PUBLISHED_PICTURES, PUBLISHED_SIZE = 2560, (300, 200)


def config_of(task: Task) -> CganConfig:
    """The sizes of the task's scale; the published training is counted in passes over its pictures."""
    return CganConfig.for_scale(task.scale, pictures=len(task.spectra), seed=task.seed)


def fit(task: Task) -> Cgan:
    """A generator of the task's pictures, trained against a discriminator."""
    return fit_cgan(task.spectra, config_of(task), task.window)


def settings(task: Task) -> Mapping[str, Any]:
    """The sizes and weights of both networks and their training."""
    return {name: value for name, value in asdict(config_of(task)).items() if name not in ("seed", "device")}


METHODS = (Method("cgan", fit, settings=settings),)


def published_cost(task: Task) -> dict[str, Any]:
    """What a fit and a 300x200 picture of the published networks cost here [s]: a few steps, times the rest.

    On CUDA steps of eight pictures; on a CPU steps of one, as CPU time, whose cost is taken eight times. The first step
    does not count. The pictures are noise, which costs the same.
    """
    published = CganConfig.for_scale("paper", pictures=PUBLISHED_PICTURES, seed=task.seed)
    on_gpu = torch.cuda.is_available()
    clock = time.perf_counter if on_gpu else time.process_time
    steps, pictures = (50, 8) if on_gpu else (2, 1)
    grid = pinhole_grid(*PUBLISHED_SIZE, 90.0)
    random = torch.Generator().manual_seed(task.seed)
    power = task.window.decode(torch.rand(pictures, *grid.shape, generator=random))
    pose = Pose(torch.rand(pictures, 3, generator=random))
    noise = Spectrum(power, grid, pose, task.spectra.frequency, task.spectra.instrument)

    marks: list[float] = []
    cgan = fit_cgan(noise, replace(published, steps=1 + steps), task.window, on_step=lambda *_: marks.append(clock()))
    step = (marks[-1] - marks[0]) / steps * (8 / pictures)
    began = clock()
    cgan.render(pose[0], grid)
    picture = clock() - began
    return {
        "measured_on": torch.cuda.get_device_name() if on_gpu else "CPU, CPU time",
        "how": f"{steps} steps of {pictures} pictures; extrapolated to {published.steps} of 8",
        "steps": published.steps,
        "seconds_per_step": step,
        "fit_seconds": step * published.steps,
        "picture_seconds": picture,
    }
