"""What a field must beat: copies of the training spectra, formulas, the ray tracer, and other learned models."""

from typing import TYPE_CHECKING

from rf3dgs.core.lazy import lazy_names

if TYPE_CHECKING:
    from rf3dgs.evaluation.baselines.cgan import Cgan as Cgan
    from rf3dgs.evaluation.baselines.cgan import fit_cgan as fit_cgan
    from rf3dgs.evaluation.baselines.cgan_config import CganConfig as CganConfig
    from rf3dgs.evaluation.baselines.constant import Constant as Constant
    from rf3dgs.evaluation.baselines.interpolation import LinearInterpolation as LinearInterpolation
    from rf3dgs.evaluation.baselines.line_of_sight import LineOfSight as LineOfSight
    from rf3dgs.evaluation.baselines.lookup import InverseDistance as InverseDistance
    from rf3dgs.evaluation.baselines.lookup import NearestNeighbour as NearestNeighbour
    from rf3dgs.evaluation.baselines.nerf2 import Nerf2 as Nerf2
    from rf3dgs.evaluation.baselines.nerf2 import fit_nerf2 as fit_nerf2
    from rf3dgs.evaluation.baselines.nerf2_config import Nerf2Config as Nerf2Config
    from rf3dgs.evaluation.baselines.path_loss import PathLossPredictor as PathLossPredictor
    from rf3dgs.evaluation.baselines.published import PublishedConfig as PublishedConfig
    from rf3dgs.evaluation.baselines.published import PublishedField as PublishedField
    from rf3dgs.evaluation.baselines.published import fit_published as fit_published
    from rf3dgs.evaluation.baselines.tr38901 import IndoorOffice as IndoorOffice
    from rf3dgs.evaluation.baselines.twin import Twin as Twin
    from rf3dgs.evaluation.baselines.twin import misplaced as misplaced
    from rf3dgs.evaluation.baselines.twin import mistaken as mistaken

_HOMES = {
    "NearestNeighbour": ".lookup",
    "InverseDistance": ".lookup",
    "LinearInterpolation": ".interpolation",
    "Constant": ".constant",
    "LineOfSight": ".line_of_sight",
    "fit_published": ".published",
    "PublishedConfig": ".published",
    "PublishedField": ".published",
    "fit_nerf2": ".nerf2",
    "Nerf2": ".nerf2",
    "Nerf2Config": ".nerf2_config",
    "fit_cgan": ".cgan",
    "Cgan": ".cgan",
    "CganConfig": ".cgan_config",
    "PathLossPredictor": ".path_loss",
    "IndoorOffice": ".tr38901",
    "Twin": ".twin",
    "misplaced": ".twin",
    "mistaken": ".twin",
}
__all__ = [  # noqa: RUF022 (reading order)
    "NearestNeighbour",
    "InverseDistance",
    "LinearInterpolation",
    "Constant",
    "LineOfSight",
    "fit_published",
    "PublishedConfig",
    "PublishedField",
    "fit_nerf2",
    "Nerf2",
    "Nerf2Config",
    "fit_cgan",
    "Cgan",
    "CganConfig",
    "PathLossPredictor",
    "IndoorOffice",
    "Twin",
    "misplaced",
    "mistaken",
]
__getattr__, __dir__ = lazy_names(__name__, _HOMES)
