"""Channels: paths, the arrays that receive them, and what they respond."""

from typing import TYPE_CHECKING

from rf3dgs.core.lazy import lazy_names

if TYPE_CHECKING:
    from rf3dgs.channel.arrays import PlanarArray as PlanarArray
    from rf3dgs.channel.arrays import ofdm as ofdm
    from rf3dgs.channel.arrays import planar_array as planar_array
    from rf3dgs.channel.binning import bin_diffuse as bin_diffuse
    from rf3dgs.channel.binning import stack_paths as stack_paths
    from rf3dgs.channel.cdl import cdl_paths as cdl_paths
    from rf3dgs.channel.cdl import indoor_office_spreads as indoor_office_spreads
    from rf3dgs.channel.cdl import scaled_rays as scaled_rays
    from rf3dgs.channel.io import PathsReader as PathsReader
    from rf3dgs.channel.io import load_paths as load_paths
    from rf3dgs.channel.io import save_paths as save_paths
    from rf3dgs.channel.path_loss import cost231_hata_loss as cost231_hata_loss
    from rf3dgs.channel.path_loss import fit_log_distance as fit_log_distance
    from rf3dgs.channel.path_loss import free_space_loss as free_space_loss
    from rf3dgs.channel.path_loss import itu_indoor_loss as itu_indoor_loss
    from rf3dgs.channel.path_loss import okumura_hata_loss as okumura_hata_loss
    from rf3dgs.channel.path_loss import tr38901_indoor_loss as tr38901_indoor_loss
    from rf3dgs.channel.paths import Paths as Paths
    from rf3dgs.channel.paths_writer import PathsWriter as PathsWriter
    from rf3dgs.channel.patterns import power_pattern as power_pattern
    from rf3dgs.channel.response import cfr as cfr
    from rf3dgs.channel.response import cir as cir
    from rf3dgs.channel.response import manifold as manifold
    from rf3dgs.channel.sounding import Sounding as Sounding

_HOMES = {
    "Paths": ".paths",
    "planar_array": ".arrays",
    "PlanarArray": ".arrays",
    "ofdm": ".arrays",
    "power_pattern": ".patterns",
    "manifold": ".response",
    "cfr": ".response",
    "cir": ".response",
    "bin_diffuse": ".binning",
    "stack_paths": ".binning",
    "save_paths": ".io",
    "load_paths": ".io",
    "PathsWriter": ".paths_writer",
    "PathsReader": ".io",
    "Sounding": ".sounding",
    "free_space_loss": ".path_loss",
    "fit_log_distance": ".path_loss",
    "itu_indoor_loss": ".path_loss",
    "tr38901_indoor_loss": ".path_loss",
    "okumura_hata_loss": ".path_loss",
    "cost231_hata_loss": ".path_loss",
    "indoor_office_spreads": ".cdl",
    "scaled_rays": ".cdl",
    "cdl_paths": ".cdl",
}
__all__ = [  # noqa: RUF022 (reading order)
    "Paths",
    "planar_array",
    "PlanarArray",
    "ofdm",
    "power_pattern",
    "manifold",
    "cfr",
    "cir",
    "bin_diffuse",
    "stack_paths",
    "save_paths",
    "load_paths",
    "PathsWriter",
    "PathsReader",
    "Sounding",
    "free_space_loss",
    "fit_log_distance",
    "itu_indoor_loss",
    "tr38901_indoor_loss",
    "okumura_hata_loss",
    "cost231_hata_loss",
    "indoor_office_spreads",
    "scaled_rays",
    "cdl_paths",
]
__getattr__, __dir__ = lazy_names(__name__, _HOMES)
