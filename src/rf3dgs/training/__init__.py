"""Training: photographs become Gaussians (the visual stage), spectra become a radio field on them (the radio stage)."""

from typing import TYPE_CHECKING

from rf3dgs.core.lazy import lazy_names

if TYPE_CHECKING:
    from rf3dgs.training.checkpoint import CheckpointFolder as CheckpointFolder
    from rf3dgs.training.checkpoint import State as State
    from rf3dgs.training.config import RadioConfig as RadioConfig
    from rf3dgs.training.config import VisualConfig as VisualConfig
    from rf3dgs.training.gateway_fit import GatewayConfig as GatewayConfig
    from rf3dgs.training.gateway_fit import GatewayFit as GatewayFit
    from rf3dgs.training.gateway_fit import fit_gateway as fit_gateway
    from rf3dgs.training.loop import TrainingStopped as TrainingStopped
    from rf3dgs.training.loop import train as train
    from rf3dgs.training.photographs import render_photo as render_photo
    from rf3dgs.training.radio import fit_radio as fit_radio
    from rf3dgs.training.radio_geometry import corrected as corrected
    from rf3dgs.training.radio_geometry import geometry_from_spectra as geometry_from_spectra
    from rf3dgs.training.refine import refine_field as refine_field
    from rf3dgs.training.uncertainty_fit import fit_uncertainty as fit_uncertainty
    from rf3dgs.training.visual import fit_geometry as fit_geometry

__all__ = [  # noqa: RUF022 (reading order)
    "VisualConfig",
    "fit_geometry",
    "render_photo",
    "geometry_from_spectra",
    "corrected",
    "RadioConfig",
    "fit_radio",
    "refine_field",
    "fit_uncertainty",
    "GatewayConfig",
    "GatewayFit",
    "fit_gateway",
    "train",
    "TrainingStopped",
    "State",
    "CheckpointFolder",
]

__getattr__, __dir__ = lazy_names(
    __name__,
    {
        "VisualConfig": ".config",
        "fit_geometry": ".visual",
        "render_photo": ".photographs",
        "geometry_from_spectra": ".radio_geometry",
        "corrected": ".radio_geometry",
        "RadioConfig": ".config",
        "fit_radio": ".radio",
        "refine_field": ".refine",
        "fit_uncertainty": ".uncertainty_fit",
        "GatewayConfig": ".gateway_fit",
        "GatewayFit": ".gateway_fit",
        "fit_gateway": ".gateway_fit",
        "train": ".loop",
        "TrainingStopped": ".loop",
        "State": ".checkpoint",
        "CheckpointFolder": ".checkpoint",
    },
)
