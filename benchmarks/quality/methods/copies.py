"""What learns nothing: copies of the training pictures, their mean, and the line of sight."""

from benchmarks.quality.methods.method import Method, Task
from rf3dgs.evaluation.baselines.constant import Constant
from rf3dgs.evaluation.baselines.interpolation import FLAT, LinearInterpolation
from rf3dgs.evaluation.baselines.line_of_sight import LineOfSight
from rf3dgs.evaluation.baselines.lookup import InverseDistance, NearestNeighbour
from rf3dgs.splats.obstacles import Obstacles


def idw(neighbours: int) -> Method:
    return Method(
        f"idw{neighbours}",
        lambda task: InverseDistance(task.spectra, neighbours=neighbours),
        settings=lambda task: {"neighbours": neighbours, "power": 2.0},
    )


def line_of_sight(task: Task) -> LineOfSight:
    """Hidden by the task's geometry where it has one; a training task tells the transmitter, never a held-out one."""
    one = task.geometry
    hidden = None if one is None else Obstacles(one.means, one.quats, one.scales, one.opacities)
    return LineOfSight.of(task.spectra, hidden)


METHODS = (
    Method("constant", lambda task: Constant(task.spectra)),
    Method("nearest", lambda task: NearestNeighbour(task.spectra)),
    idw(4),
    idw(8),
    Method("linear", lambda task: LinearInterpolation(task.spectra), settings=lambda task: {"flat": FLAT}),
    Method("los", line_of_sight, settings=lambda task: {"hidden": task.geometry is not None}),
)
