"""Radio radiance fields: which paths arrive at a receiver, from where, how strong, how late, and how they left.

The names below are the whole public face, in the order in which one meets them.
"""

from typing import TYPE_CHECKING

from rf3dgs.core.lazy import lazy_names

if TYPE_CHECKING:
    from rf3dgs import propagation as propagation
    from rf3dgs.channel.arrays import ofdm as ofdm
    from rf3dgs.channel.arrays import planar_array as planar_array
    from rf3dgs.channel.paths import Paths as Paths
    from rf3dgs.core.frames import Pose as Pose
    from rf3dgs.core.grids import DirectionGrid as DirectionGrid
    from rf3dgs.core.grids import equirect_grid as equirect_grid
    from rf3dgs.core.grids import pinhole_grid as pinhole_grid
    from rf3dgs.data.dataset import Dataset as Dataset
    from rf3dgs.evaluation.protocol import evaluate as evaluate
    from rf3dgs.field.radio_field import RadioField as RadioField
    from rf3dgs.spectra.scan import spectrum_of as spectrum_of
    from rf3dgs.spectra.spectrum import Spectrum as Spectrum
    from rf3dgs.splats.gaussians import Gaussians as Gaussians
    from rf3dgs.training.radio import fit_radio as fit_radio
    from rf3dgs.training.visual import fit_geometry as fit_geometry
    from rf3dgs.viewer.app import view as view

__version__ = "0.1.0"

_MODULES = {
    "Pose": ".core.frames",
    "DirectionGrid": ".core.grids",
    "pinhole_grid": ".core.grids",
    "equirect_grid": ".core.grids",
    "Paths": ".channel.paths",
    "planar_array": ".channel.arrays",
    "ofdm": ".channel.arrays",
    "Spectrum": ".spectra.spectrum",
    "spectrum_of": ".spectra.scan",
    "propagation": ".propagation",
    "Dataset": ".data.dataset",
    "Gaussians": ".splats.gaussians",
    "fit_geometry": ".training.visual",
    "fit_radio": ".training.radio",
    "RadioField": ".field.radio_field",
    "evaluate": ".evaluation.protocol",
    "view": ".viewer.app",
}
__all__ = [  # noqa: RUF022 (reading order)
    "Pose",
    "DirectionGrid",
    "pinhole_grid",
    "equirect_grid",
    "Paths",
    "planar_array",
    "ofdm",
    "Spectrum",
    "spectrum_of",
    "propagation",
    "Dataset",
    "Gaussians",
    "fit_geometry",
    "fit_radio",
    "RadioField",
    "evaluate",
    "view",
]
__getattr__, __dir__ = lazy_names(__name__, _MODULES)
