"""RF-3DGS as published: jet colours in 8 bits, and the same recipe with levels and with per-view ranges."""

from dataclasses import asdict
from typing import Any

from benchmarks.quality.methods.method import Method, Scale, Task
from rf3dgs.evaluation.baselines.published import PublishedConfig, PublishedField, fit_published
from rf3dgs.evaluation.baselines.scales import Target

STEPS: dict[Scale, int] = {"smoke": 60, "laptop": 3_000, "paper": 10_000}
TARGETS: dict[str, Target] = {
    "rf3dgs-jet": "jet",
    "rf3dgs-db": "db",
    "rf3dgs-view": "view-db",
    "rf3dgs-view-linear": "view-linear",
}


def config_of(task: Task, target: Target) -> PublishedConfig:
    """The recipe with the iterations of the task's scale."""
    return PublishedConfig(target=target, steps=STEPS[task.scale], seed=task.seed)


def method(name: str, target: Target) -> Method:
    def fit(task: Task) -> PublishedField:
        assert task.geometry is not None
        return fit_published(task.geometry, task.spectra, config_of(task, target), window=task.window)

    def settings(task: Task) -> dict[str, Any]:
        return asdict(config_of(task, target))

    return Method(name, fit, ("geometry",), settings)


METHODS = tuple(method(name, target) for name, target in TARGETS.items())
