"""Ray tracing on the true scene, on one whose things stand a little elsewhere, and on one of other materials."""

from collections.abc import Callable

from benchmarks.quality.methods.method import Method, Scale, Task
from rf3dgs.evaluation.baselines.twin import Twin, misplaced, mistaken
from rf3dgs.propagation.config import TraceConfig
from rf3dgs.propagation.sites.scene import Scene

RAYS: dict[Scale, int] = {"smoke": 20_000, "laptop": 100_000, "paper": 300_000}
SEED = 1_000_000  # far from the seeds that truths are traced with


def _twin(name: str, change: Callable[[Scene, int], Scene], what: str) -> Method:
    def fit(task: Task) -> Twin:
        assert task.scene is not None
        config = TraceConfig(rays=RAYS[task.scale], seed=SEED + task.seed)
        return Twin(change(task.scene, task.seed), task.spectra, config)

    return Method(name, fit, ("scene",), lambda task: {"scene": what, "rays": RAYS[task.scale]})


def _moved(centimetres: int) -> Method:
    deviation = centimetres / 100.0
    return _twin(
        f"twin-{centimetres}cm", lambda scene, seed: misplaced(scene, deviation, seed=seed), f"moved {deviation} m"
    )


METHODS = (
    _twin("twin", lambda scene, seed: scene, "true"),
    _moved(2),
    _moved(5),
    _moved(10),
    _twin("twin-materials", lambda scene, seed: mistaken(scene), "other materials"),
)
