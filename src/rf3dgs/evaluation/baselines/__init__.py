"""What a field must beat: predictors that copy the training spectra, and models that others published."""

from typing import TYPE_CHECKING

from rf3dgs.core.lazy import lazy_names

if TYPE_CHECKING:
    from rf3dgs.evaluation.baselines.lookup import InverseDistance as InverseDistance
    from rf3dgs.evaluation.baselines.lookup import NearestNeighbour as NearestNeighbour
    from rf3dgs.evaluation.baselines.nerf2 import Nerf2 as Nerf2
    from rf3dgs.evaluation.baselines.nerf2 import fit_nerf2 as fit_nerf2
    from rf3dgs.evaluation.baselines.nerf2_config import Nerf2Config as Nerf2Config

_MODULES = {
    "NearestNeighbour": ".lookup",
    "InverseDistance": ".lookup",
    "fit_nerf2": ".nerf2",
    "Nerf2": ".nerf2",
    "Nerf2Config": ".nerf2_config",
}
__all__ = ["NearestNeighbour", "InverseDistance", "fit_nerf2", "Nerf2", "Nerf2Config"]  # noqa: RUF022
__getattr__, __dir__ = lazy_names(__name__, _MODULES)
