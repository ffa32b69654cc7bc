"""What each plane reflects: which smooth slab it is, told by its single reflections, and what deviates from that; see
docs/theory/radiance.md.
"""

from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
import torch
from torch import Tensor

from rf3dgs.core.threads import on_threads
from rf3dgs.core.units import VACUUM_PERMITTIVITY, wavelength
from rf3dgs.field.polarisation import METAL
from rf3dgs.field.reflections import RIPPLE
from rf3dgs.field.sources import PointSources
from rf3dgs.propagation.fresnel import slab_coefficients
from rf3dgs.training.marks import Paint, fit_deviations
from rf3dgs.training.reflection import Glints, expected_db, fit_reflection, law_levels

TOLD_BY = 2  # reflections at most of the peaks that tell levels
LEAST_PEAKS, MOST_PEAKS = 8, 120
PERMITTIVITIES = torch.logspace(0.115, 0.955, 16, dtype=torch.float64)  # 1.3 to 9
LOSSES = torch.tensor([0.0, 0.01, 0.03, 0.1, 0.3, 1.0], dtype=torch.float64)  # of the relative permittivity
THICKNESSES = torch.arange(0.4, 8.0, 0.03, dtype=torch.float64)  # of wavelengths
SHELF_COSINES = 128  # of incidence, between which a shelf's levels are interpolated
LARGEST = (12.0, 3.0, 9.0)  # of these three
SMALL_LOSS = 3e-3
ROUGH_DB, BRIGHT_DB = -14.0, 0.5  # what a surface may have beside a smooth slab: rough ones scatter
LIKE_DB, OTHER = 1.5, 2.5  # an error counts as its square up to the first, and as another material from the second on
TRIED = 4
HIT_DB, HIT_SHARE, HIT_RMS_DB = 1.0, 0.75, 0.5  # a plane is a slab if so many peaks are that near
LEAST_DB = -60.0


def fit_levels(sources: PointSources, found: Glints, paint: Paint | None = None) -> PointSources:
    """The sources with what planes reflect as `found` tells: laws, slabs, ripples and marks."""
    reflection = fit_reflection(found, len(sources.planes))
    slabs, ripple = fit_slabs(found, reflection, sources.frequency)
    sources = replace(sources, reflection=reflection, slabs=slabs, ripple=ripple, marks=None)
    if slabs is not None:
        sources = _polarised(sources, found)
    marks, more = fit_deviations(found, sources, paint)
    if sources.ripple is not None:
        more = sources.ripple if more is None else sources.ripple + more
    return replace(sources, marks=marks, ripple=more)


def fit_slabs(found: Glints, reflection: Tensor, frequency: float) -> tuple[Tensor, Tensor] | tuple[None, None]:
    """Slabs `[P, 3]`, relative permittivity, conductivity [S/m] and thickness [m], and by how much they and the
    roughness of each differ from the laws `reflection` `[P, 3]`: a ripple `[P, RIPPLE]` [dB].

    Planes of which no slab tells most single reflections keep their law, and polarisation as metal does; None for all.
    """
    single = found.only(found.alone & found.seen & (found.order == 1))
    law_db, plane = law_levels(single, reflection), single.plane[:, 0]
    metal = torch.tensor(METAL).repeat(len(reflection), 1)
    slabs, ripple = metal.clone(), torch.zeros(len(reflection), RIPPLE)
    angles = torch.linspace(0, 1, RIPPLE, dtype=torch.float64)
    enough = torch.nonzero(torch.bincount(plane, minlength=1) >= LEAST_PEAKS).squeeze(-1).tolist()
    if not enough:
        return None, None
    shelf = _Shelf.at(frequency)

    def fitted(number: int) -> None:
        own = torch.nonzero(plane == number).squeeze(-1)
        own = own[torch.linspace(0, len(own) - 1, min(len(own), MOST_PEAKS)).long()]
        cosine, level_db = single.cosine[own, 0], single.level_db[own]
        slab, rough_db = _slab_of(cosine, level_db, shelf)
        error_db = level_db - slab_levels(slab, cosine, frequency) - rough_db
        hit = error_db.abs() < HIT_DB
        near = float(hit.double().mean()) >= HIT_SHARE and float(error_db[hit].square().mean().sqrt()) < HIT_RMS_DB
        if near and float(_misfit(error_db)) <= float(_misfit(level_db - law_db[own])):
            a, b, c = reflection[number].double()
            whole = (slab_levels(slab, angles, frequency) + rough_db).clamp_max(0.0)
            slabs[number], ripple[number] = slab.float(), (whole - (a + angles * (b + angles * c))).float()

    on_threads(fitted, enough)
    return (slabs, ripple) if bool((slabs != metal).any()) else (None, None)


def _polarised(sources: PointSources, found: Glints) -> PointSources:
    """The sources, whose planes are slabs, without those as which ways of two reflections do not see them.

    One reflection tells levels alone; a surface that takes the same of both polarisations may have a slab's. Where none
    is seen as one, levels that look like slabs' are taken for chance, and planes keep their laws.
    """
    slabs = sources.slabs
    assert slabs is not None
    twice = found.only(found.alone & found.seen & (found.order == 2))
    metal = slabs.new_tensor(METAL)
    for number in torch.nonzero((slabs != metal).any(-1)).squeeze(-1).tolist():
        own = twice.only((twice.plane == number).any(-1))
        others = slabs.index_put((torch.tensor([number]),), metal)
        with_slab, without = (
            float(_misfit(own.level_db - expected_db(own, replace(sources, slabs=each)))) for each in (slabs, others)
        )
        if without < with_slab:
            slabs = others
    if bool((slabs == metal).all()):
        return replace(sources, slabs=None, ripple=None)
    return replace(sources, slabs=slabs)


def slab_levels(slab: Tensor, cosine: Tensor, frequency: float) -> Tensor:
    """10 log10 of the mean power [dB] that slabs `[*batch, 3]` reflect of both polarisations; shapes broadcast."""
    te, tm = slab_coefficients(slab, cosine.clamp_min(1e-3), frequency)
    return 10 * torch.log10((0.5 * (te.abs().square() + tm.abs().square())).clamp_min(10 ** (LEAST_DB / 10)))


@dataclass(frozen=True, eq=False)
class _Shelf:
    """Slabs that are tried first at a `frequency` [Hz]: `[n, 3]` in units `unit` `[3]` of permittivity, conductivity
    [S/m] and thickness [m], and their levels [dB] `[n, SHELF_COSINES]`."""

    frequency: float
    unit: Tensor
    slabs: Tensor
    levels: Tensor

    @classmethod
    @lru_cache(maxsize=1)
    def at(cls, frequency: float) -> "_Shelf":
        """All of `PERMITTIVITIES`, `LOSSES` and `THICKNESSES`."""
        unit = torch.tensor(
            [1.0, 2 * torch.pi * frequency * VACUUM_PERMITTIVITY, wavelength(frequency)], dtype=torch.float64
        )
        slabs = torch.cartesian_prod(PERMITTIVITIES, LOSSES, THICKNESSES)
        angles = torch.linspace(0, 1, SHELF_COSINES, dtype=torch.float64)
        parts = [part * unit for part in slabs.split(len(LOSSES) * len(THICKNESSES))]
        levels = on_threads(lambda part: slab_levels(part[:, None], angles, frequency).float(), parts)
        return cls(frequency, unit, slabs, torch.cat(levels))

    def seen(self, cosine: Tensor) -> Tensor:
        """The levels [dB] `[n, m]` at cosines of incidence `[m]`."""
        place = (cosine * (SHELF_COSINES - 1)).float()
        below = place.long().clamp(0, SHELF_COSINES - 2)
        return torch.lerp(self.levels[:, below], self.levels[:, below + 1], place - below)


def _slab_of(cosine: Tensor, level_db: Tensor, shelf: _Shelf) -> tuple[Tensor, float]:
    """The slab `[3]` and the level [dB] beside it that tell most levels `[n]` at cosines of incidence `[n]`."""
    from scipy.optimize import least_squares

    left_db = level_db.float() - shelf.seen(cosine)
    rough_db = left_db.median(-1).values.clamp(ROUGH_DB, BRIGHT_DB)
    best = _misfit(left_db - rough_db[:, None]).argsort(stable=True)[:TRIED]
    low = (np.log(1.05), np.log(SMALL_LOSS), 0.2, ROUGH_DB - 1e-6)
    high = (*np.log(LARGEST[:2]), LARGEST[2], BRIGHT_DB + 1e-6)

    def slab(x: np.ndarray) -> Tensor:
        return torch.tensor([np.exp(x[0]), np.exp(x[1]) - SMALL_LOSS, x[2]], dtype=torch.float64) * shelf.unit

    def errors(x: np.ndarray) -> np.ndarray:
        return (level_db - slab_levels(slab(x), cosine, shelf.frequency) - x[3]).numpy()

    found = []
    for start, level in zip(shelf.slabs[best].tolist(), rough_db[best].tolist(), strict=True):
        first = np.clip((np.log(start[0]), np.log(start[1] + SMALL_LOSS), start[2], level), low, high)
        x = least_squares(errors, first, loss="cauchy", bounds=(low, high), max_nfev=60).x
        found.append((float(_misfit(torch.from_numpy(errors(x)))), x))
    _, x = min(found, key=lambda each: each[0])
    return slab(x), float(x[3])


def _misfit(error_db: Tensor) -> Tensor:
    """Sum over the last axis of errors `[..., n]`, of which large ones count alike."""
    size = error_db.abs()
    return torch.where(size < LIKE_DB, size.square() / (2 * LIKE_DB), size - LIKE_DB / 2).clamp_max(OTHER).sum(-1)
