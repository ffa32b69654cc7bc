"""NeRF2 in its published configuration (linear power relative to each picture's peak) and in ours (one dB window)."""

import time
from collections.abc import Mapping
from dataclasses import asdict, replace
from typing import Any

import torch

from benchmarks.quality.methods.method import Method, Task
from rf3dgs.core.grids import pinhole_grid
from rf3dgs.evaluation.baselines.nerf2 import Nerf2, fit_nerf2
from rf3dgs.evaluation.baselines.nerf2_config import Nerf2Config, Target

PUBLISHED_GRID = pinhole_grid(300, 200, 90.0)


def _config(task: Task, target: Target) -> Nerf2Config:
    return Nerf2Config.for_scale(task.scale, target, task.seed)


def _method(name: str, target: Target) -> Method:
    def fit(task: Task) -> Nerf2:
        return fit_nerf2(task.spectra, _config(task, target), task.window)

    def settings(task: Task) -> Mapping[str, Any]:
        return {key: value for key, value in asdict(_config(task, target)).items() if key not in ("seed", "device")}

    return Method(name, fit, settings=settings)


METHODS = (_method("nerf2", "linear"), _method("nerf2-db", "db"))


def published_cost(task: Task) -> dict[str, Any]:
    """What a fit and a 300x200 picture of the published size cost here [s]: a few iterations and rays, times the rest.

    The time of a point on a ray is measured with the published network, on CUDA with the published number of rays, on a
    CPU with fewer and as CPU time, and multiplied by the published number of points.
    """
    published = replace(Nerf2Config.for_scale("paper"), seed=task.seed)
    on_gpu = torch.cuda.is_available()
    clock = time.perf_counter if on_gpu else time.process_time
    short = published if on_gpu else replace(published, rays=64, chunk=512)
    few = replace(short, steps=50 if on_gpu else 3)
    fit_nerf2(task.spectra, replace(few, steps=1), task.window)
    began = clock()
    model = fit_nerf2(task.spectra, few, task.window)
    fit_point = (clock() - began) / few.samples_seen
    directions = PUBLISHED_GRID.directions.reshape(-1, 3)[:: 1 if on_gpu else 50]
    began = clock()
    with torch.no_grad():
        for part in directions.split(few.chunk):
            model.values(torch.zeros_like(part), part).sum().item()
    picture_point = (clock() - began) / (len(directions) * published.samples)
    return {
        "measured_on": torch.cuda.get_device_name() if on_gpu else "CPU, CPU time",
        "how": f"{few.steps} iterations of {few.rays} rays; extrapolated to {published.steps} of {published.rays}",
        "points_of_fit": published.samples_seen,
        "seconds_per_point_of_fit": fit_point,
        "seconds_per_point_of_picture": picture_point,
        "fit_seconds": fit_point * published.samples_seen,
        "picture_seconds": picture_point * PUBLISHED_GRID.height * PUBLISHED_GRID.width * published.samples,
    }
