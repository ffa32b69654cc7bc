"""Lookups: what was measured nearby, copied."""

from functools import partial

from benchmarks.quality.methods.method import Method, Task
from rf3dgs.evaluation.baselines.lookup import InverseDistance, NearestNeighbour
from rf3dgs.evaluation.protocol import Predictor


def copied(task: Task, *, neighbours: int) -> Predictor:
    """The nearest training position's spectrum, or the inverse-distance mean of several."""
    return NearestNeighbour(task.spectra) if neighbours == 1 else InverseDistance(task.spectra, neighbours=neighbours)


def _lookup(name: str, neighbours: int) -> Method:
    return Method(name, partial(copied, neighbours=neighbours), settings=lambda task: {"neighbours": neighbours})


METHODS = (_lookup("nearest", 1), _lookup("idw4", 4), _lookup("idw8", 8))
