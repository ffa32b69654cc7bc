"""Spectra: power per direction, how instruments see it, and how it is encoded, resampled and searched."""

from typing import TYPE_CHECKING

from rf3dgs.core.lazy import lazy_names

if TYPE_CHECKING:
    from rf3dgs.spectra import sage as sage
    from rf3dgs.spectra.beamformers import bartlett as bartlett
    from rf3dgs.spectra.beamformers import capon as capon
    from rf3dgs.spectra.beamformers import hann_taper as hann_taper
    from rf3dgs.spectra.beamformers import music as music
    from rf3dgs.spectra.beamformers import tapered as tapered
    from rf3dgs.spectra.codec import DbWindow as DbWindow
    from rf3dgs.spectra.codec import PaperEncoding as PaperEncoding
    from rf3dgs.spectra.codec import PerViewLinear as PerViewLinear
    from rf3dgs.spectra.codec import paper_scale as paper_scale
    from rf3dgs.spectra.codec import window_of as window_of
    from rf3dgs.spectra.config import ArrayProcessing as ArrayProcessing
    from rf3dgs.spectra.config import Loading as Loading
    from rf3dgs.spectra.covariance import covariance_of as covariance_of
    from rf3dgs.spectra.covariance import covariance_of_snapshots as covariance_of_snapshots
    from rf3dgs.spectra.covariance import covariance_of_spectrum as covariance_of_spectrum
    from rf3dgs.spectra.covariance import delay_taps as delay_taps
    from rf3dgs.spectra.crb import Bound as Bound
    from rf3dgs.spectra.crb import cramer_rao as cramer_rao
    from rf3dgs.spectra.decorrelation import forward_backward as forward_backward
    from rf3dgs.spectra.decorrelation import smoothed as smoothed
    from rf3dgs.spectra.loading import loaded as loaded
    from rf3dgs.spectra.order import source_count as source_count
    from rf3dgs.spectra.path_lists import path_targets as path_targets
    from rf3dgs.spectra.peaks import find_peaks as find_peaks
    from rf3dgs.spectra.peaks import main_peak as main_peak
    from rf3dgs.spectra.resampling import resample as resample
    from rf3dgs.spectra.sage import Estimate as Estimate
    from rf3dgs.spectra.sage import estimate_paths as estimate_paths
    from rf3dgs.spectra.scan import array_instrument as array_instrument
    from rf3dgs.spectra.scan import spectrum_of as spectrum_of
    from rf3dgs.spectra.sounded import spectrum_of_sounding as spectrum_of_sounding
    from rf3dgs.spectra.spectrum import Instrument as Instrument
    from rf3dgs.spectra.spectrum import Spectrum as Spectrum
    from rf3dgs.spectra.steering import PlanarSteering as PlanarSteering
    from rf3dgs.spectra.synthesis import default_lobe as default_lobe
    from rf3dgs.spectra.targets import ideal_targets as ideal_targets
    from rf3dgs.spectra.yaws import at_yaws as at_yaws

_HOMES = {
    "Spectrum": ".spectrum",
    "Instrument": ".spectrum",
    "spectrum_of": ".scan",
    "spectrum_of_sounding": ".sounded",
    "ArrayProcessing": ".config",
    "Loading": ".config",
    "at_yaws": ".yaws",
    "default_lobe": ".synthesis",
    "array_instrument": ".scan",
    "covariance_of": ".covariance",
    "covariance_of_snapshots": ".covariance",
    "covariance_of_spectrum": ".covariance",
    "delay_taps": ".covariance",
    "forward_backward": ".decorrelation",
    "smoothed": ".decorrelation",
    "loaded": ".loading",
    "source_count": ".order",
    "bartlett": ".beamformers",
    "tapered": ".beamformers",
    "capon": ".beamformers",
    "music": ".beamformers",
    "hann_taper": ".beamformers",
    "PlanarSteering": ".steering",
    "DbWindow": ".codec",
    "window_of": ".codec",
    "PerViewLinear": ".codec",
    "paper_scale": ".codec",
    "PaperEncoding": ".codec",
    "find_peaks": ".peaks",
    "main_peak": ".peaks",
    "resample": ".resampling",
    "ideal_targets": ".targets",
    "path_targets": ".path_lists",
    "sage": ".sage",
    "estimate_paths": ".sage",
    "Estimate": ".sage",
    "cramer_rao": ".crb",
    "Bound": ".crb",
}
__all__ = [  # noqa: RUF022 (reading order)
    "Spectrum",
    "Instrument",
    "spectrum_of",
    "spectrum_of_sounding",
    "ArrayProcessing",
    "Loading",
    "at_yaws",
    "default_lobe",
    "array_instrument",
    "covariance_of",
    "covariance_of_snapshots",
    "covariance_of_spectrum",
    "delay_taps",
    "forward_backward",
    "smoothed",
    "loaded",
    "source_count",
    "bartlett",
    "tapered",
    "capon",
    "music",
    "hann_taper",
    "PlanarSteering",
    "DbWindow",
    "window_of",
    "PerViewLinear",
    "paper_scale",
    "PaperEncoding",
    "find_peaks",
    "main_peak",
    "resample",
    "ideal_targets",
    "path_targets",
    "sage",
    "estimate_paths",
    "Estimate",
    "cramer_rao",
    "Bound",
]
__getattr__, __dir__ = lazy_names(__name__, _HOMES)
