"""What a field must beat: predictors that copy the training spectra, and networks that learn from them."""

from typing import TYPE_CHECKING

from rf3dgs.core.lazy import lazy_names

if TYPE_CHECKING:
    from rf3dgs.evaluation.baselines.cgan import Cgan as Cgan
    from rf3dgs.evaluation.baselines.cgan import fit_cgan as fit_cgan
    from rf3dgs.evaluation.baselines.cgan_config import CganConfig as CganConfig
    from rf3dgs.evaluation.baselines.lookup import InverseDistance as InverseDistance
    from rf3dgs.evaluation.baselines.lookup import NearestNeighbour as NearestNeighbour

_MODULES = {
    "NearestNeighbour": ".lookup",
    "InverseDistance": ".lookup",
    "fit_cgan": ".cgan",
    "Cgan": ".cgan",
    "CganConfig": ".cgan_config",
}
__all__ = ["NearestNeighbour", "InverseDistance", "fit_cgan", "Cgan", "CganConfig"]  # noqa: RUF022
__getattr__, __dir__ = lazy_names(__name__, _MODULES)
