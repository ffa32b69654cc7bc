"""A field of the mirror model corrected by a few spectra: a warm start where its transmitter or its site changed."""

from dataclasses import replace

import torch

from rf3dgs.core.errors import InputError
from rf3dgs.core.threads import one_torch_thread
from rf3dgs.field.lit import LitSurface
from rf3dgs.field.radio_field import RadioField
from rf3dgs.spectra.spectrum import Spectrum
from rf3dgs.training.lit_views import lit_views
from rf3dgs.training.mirror import DEEPEST_DB
from rf3dgs.training.radio import check_spectra
from rf3dgs.training.residual import refine_residual

SAME_PLACE = 0.05  # m


@one_torch_thread()
def refine_field(field: RadioField, spectra: Spectrum) -> RadioField:
    """The field with its residual corrected by what `spectra` `[position, row, col]` show beside it.

    Laws, shadows and point sources stay. Raises InputError for a field of the paper's model, for spectra that nothing
    can be learned from, and for spectra of another frequency or transmitter than the field's.
    """
    surface = field.surface
    if not isinstance(surface, LitSurface):
        raise InputError('refining needs a field of the mirror model; train it with RadioConfig(model="mirror")')
    check_spectra(spectra)
    if abs(spectra.frequency / field.frequency - 1) > 1e-6:
        raise InputError(
            f"spectra must be of the field's frequency, {field.frequency / 1e9:g} GHz; got "
            f"{spectra.frequency / 1e9:g} GHz. Train another field"
        )
    if spectra.tx is not None:
        apart = float(torch.linalg.vector_norm(spectra.tx.position - field.tx.position))
        if apart > SAME_PLACE:
            raise InputError(
                f"the spectra's transmitter stands {apart:.2f} m from the field's; use field.moved_to(spectra.tx) first"
            )
    rays = None
    if field.sources is not None:
        rays = field.sources.rays_each(spectra.pose.position, field.obstacles)
    window = field.window
    floor_db = max(window.floor_db, window.ceil_db - DEEPEST_DB)
    views = lit_views(spectra, rays)
    refined = refine_residual(surface, views, floor_db=floor_db, backend=field.backend)
    return replace(field, surface=refined, meta=field.meta | {"refined by positions": len(spectra)})
