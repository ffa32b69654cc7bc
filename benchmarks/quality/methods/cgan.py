"""The conditional GAN, in the dB window that all methods are judged in."""

from dataclasses import asdict

from benchmarks.quality.methods.method import Method, Task
from rf3dgs.evaluation.baselines import Cgan, CganConfig, fit_cgan


def config_of(task: Task) -> CganConfig:
    """The sizes of the task's scale; the published training is counted in passes over its pictures."""
    return CganConfig.for_scale(task.scale, pictures=len(task.spectra), seed=task.seed)


def fit(task: Task) -> Cgan:
    """A generator of the task's pictures, trained against a discriminator."""
    return fit_cgan(task.spectra, config_of(task), task.window)


METHODS = (Method("cgan", fit, settings=lambda task: asdict(config_of(task))),)
