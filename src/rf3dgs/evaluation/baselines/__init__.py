"""What a field must beat: predictors that copy the training spectra, formulas, and the ray tracer itself."""

from typing import TYPE_CHECKING

from rf3dgs.core.lazy import lazy_names

if TYPE_CHECKING:
    from rf3dgs.evaluation.baselines.lookup import InverseDistance as InverseDistance
    from rf3dgs.evaluation.baselines.lookup import NearestNeighbour as NearestNeighbour
    from rf3dgs.evaluation.baselines.path_loss import PathLossPredictor as PathLossPredictor
    from rf3dgs.evaluation.baselines.tr38901 import IndoorOffice as IndoorOffice
    from rf3dgs.evaluation.baselines.twin import Twin as Twin
    from rf3dgs.evaluation.baselines.twin import misplaced as misplaced
    from rf3dgs.evaluation.baselines.twin import mistaken as mistaken

_HOMES = {
    "NearestNeighbour": ".lookup",
    "InverseDistance": ".lookup",
    "PathLossPredictor": ".path_loss",
    "IndoorOffice": ".tr38901",
    "Twin": ".twin",
    "misplaced": ".twin",
    "mistaken": ".twin",
}
__all__ = [  # noqa: RUF022 (reading order)
    "NearestNeighbour",
    "InverseDistance",
    "PathLossPredictor",
    "IndoorOffice",
    "Twin",
    "misplaced",
    "mistaken",
]
__getattr__, __dir__ = lazy_names(__name__, _HOMES)
