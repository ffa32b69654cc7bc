"""How good a field is: metrics, copying baselines, the protocol, and the report."""

from typing import TYPE_CHECKING

from rf3dgs.core.lazy import lazy_names

if TYPE_CHECKING:
    from rf3dgs.evaluation.baselines.lookup import InverseDistance as InverseDistance
    from rf3dgs.evaluation.baselines.lookup import NearestNeighbour as NearestNeighbour
    from rf3dgs.evaluation.lpips import Lpips as Lpips
    from rf3dgs.evaluation.pictures import save_spectrum_figure as save_spectrum_figure
    from rf3dgs.evaluation.pictures import spectrum_picture as spectrum_picture
    from rf3dgs.evaluation.protocol import Predictor as Predictor
    from rf3dgs.evaluation.protocol import evaluate as evaluate
    from rf3dgs.evaluation.report import PhotoPair as PhotoPair
    from rf3dgs.evaluation.report import ReportInputs as ReportInputs
    from rf3dgs.evaluation.report import SpectrumExample as SpectrumExample
    from rf3dgs.evaluation.report import write_report as write_report
    from rf3dgs.evaluation.table import Evaluation as Evaluation
    from rf3dgs.evaluation.table import format_table as format_table

_MODULES = {
    "evaluate": ".protocol",
    "Predictor": ".protocol",
    "Evaluation": ".table",
    "format_table": ".table",
    "NearestNeighbour": ".baselines.lookup",
    "InverseDistance": ".baselines.lookup",
    "Lpips": ".lpips",
    "ReportInputs": ".report",
    "PhotoPair": ".report",
    "SpectrumExample": ".report",
    "write_report": ".report",
    "spectrum_picture": ".pictures",
    "save_spectrum_figure": ".pictures",
}
__all__ = [  # noqa: RUF022
    "evaluate",
    "Predictor",
    "Evaluation",
    "format_table",
    "NearestNeighbour",
    "InverseDistance",
    "Lpips",
    "ReportInputs",
    "PhotoPair",
    "SpectrumExample",
    "write_report",
    "spectrum_picture",
    "save_spectrum_figure",
]
__getattr__, __dir__ = lazy_names(__name__, _MODULES)
