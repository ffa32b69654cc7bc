"""The indoor office of 3GPP TR 38.901: clusters of a standard, the true line of sight, no measurement."""

from benchmarks.quality.methods.method import Method, Task
from rf3dgs.evaluation.baselines.tr38901 import IndoorOffice


def _fit(task: Task) -> IndoorOffice:
    return IndoorOffice(task.spectra, seed=task.seed)


METHODS = (Method("tr38901-inh", _fit, settings=lambda task: {"profiles": ["CDL-D", "CDL-A"], "sight": "open office"}),)
