"""What a predictor shows of a pose, as the instrument of the truth would see it.

A field that was fitted to the waves behind pictures, or to an ideal lobe, knows how any other instrument sees it. What
copies pictures, or was fitted to them at face value, shows the instrument it was trained with, whoever judges it.
"""

from dataclasses import replace

from rf3dgs.evaluation.protocol import Predictor
from rf3dgs.field.radiance import Radiance
from rf3dgs.field.radio_field import RadioField, add_rays
from rf3dgs.field.waves import seen_by_array
from rf3dgs.spectra.spectrum import Instrument, Spectrum


def seen(predictor: Predictor, truth: Spectrum) -> Spectrum:
    """What `predictor` shows `[row, col]` at the pose and on the grid of `truth` `[row, col]`."""
    if not isinstance(predictor, RadioField) or not _is_lobe(predictor.instrument):
        return predictor.render(truth.pose, truth.grid)
    if truth.instrument.array is not None:
        return seen_by_array(predictor, truth.pose, truth.instrument.array, truth.grid, method=truth.method)
    if predictor.instrument == truth.instrument or not _is_lobe(truth.instrument):
        return predictor.render(truth.pose, truth.grid)
    return through(predictor, truth)


def through(field: RadioField, truth: Spectrum) -> Spectrum:
    """`field` through the lobe of `truth` in place of its own.

    The surface's power grows with the lobe's solid angle; that of a point source stays, and its picture widens.
    """
    bare = field.without_sources().render(truth.pose, truth.grid)
    share = truth.instrument.beam_solid_angle / field.instrument.beam_solid_angle
    found = Radiance(bare.power * share, bare.delay, bare.aod)
    if field.sources is not None:
        rays = field.sources.rays(truth.pose.position, field.obstacles)
        add_rays(found, rays, truth.pose, truth.grid, truth.instrument)
    return replace(bare, power=found.power, delay=found.delay, aod=found.aod, instrument=truth.instrument)


def _is_lobe(instrument: Instrument) -> bool:
    return instrument == Instrument.gaussian(instrument.lobe)
