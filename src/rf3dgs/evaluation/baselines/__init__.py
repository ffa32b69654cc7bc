"""What a field must beat: predictors that copy the training spectra."""

from typing import TYPE_CHECKING

from rf3dgs.core.lazy import lazy_names

if TYPE_CHECKING:
    from rf3dgs.evaluation.baselines.lookup import InverseDistance as InverseDistance
    from rf3dgs.evaluation.baselines.lookup import NearestNeighbour as NearestNeighbour

__all__ = ["NearestNeighbour", "InverseDistance"]  # noqa: RUF022
__getattr__, __dir__ = lazy_names(__name__, {"NearestNeighbour": ".lookup", "InverseDistance": ".lookup"})
