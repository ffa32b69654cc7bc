"""Pictures of an array explained by what a field predicts there: the second and later looks at them.

A first look has to find everything in the pictures themselves. A field knows from all positions together where mirror
images stand and how surfaces scatter between two lobes of the array; a few steps from there (see `spectra.inversion`)
change only what the pictures contradict.
"""

from dataclasses import replace

from rf3dgs.core.progress import Progress
from rf3dgs.field.radio_field import RadioField
from rf3dgs.field.waves import waves_of
from rf3dgs.spectra.spectrum import Spectrum
from rf3dgs.spectra.targets import ideal_targets

DARKEST = 1e-9  # of the strongest wave of a place: what has no power at all could never get any


def explained_by(
    field: RadioField, pictures: Spectrum, targets: Spectrum, progress: Progress | None = None
) -> Spectrum:
    """The ideal spectra behind `pictures` `[picture, row, col]`, begun with what `field` predicts at each place.

    `targets` `[place, row, col]` are those of a first look, whose grid and places are taken.
    """
    start = []
    for number in range(len(targets)):
        waves = waves_of(field, targets.pose[number], targets.grid)
        start.append(replace(waves, power=waves.power.clamp_min(DARKEST * float(waves.power.max()))))
    return ideal_targets(pictures, targets.grid, lobe=targets.instrument.lobe, start=start, progress=progress)
