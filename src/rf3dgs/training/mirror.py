"""The mirror model's radio stage: spectra and frozen geometry to a `RadioField` whose parts are laws of physics.

Closed form: surfaces of the geometry, point sources (the transmitter and its mirror images), and then the surface part
on what the point sources leave over, which is then refined in one picture with them. The same spectra, geometry and
seed give the same field.
"""

from dataclasses import replace

import torch
from torch import Tensor

from rf3dgs.core.frames import Pose
from rf3dgs.core.progress import Progress
from rf3dgs.field.lit import CSI_HARMONICS, HARMONICS, LitSurface
from rf3dgs.field.radio_field import RadioField
from rf3dgs.geometry import Surfaces, find_surfaces
from rf3dgs.spectra.codec import DbWindow
from rf3dgs.spectra.spectrum import Spectrum
from rf3dgs.splats.gaussians import Gaussians
from rf3dgs.splats.obstacles import Obstacles, visibility_of
from rf3dgs.training.config import RadioConfig, SourceConfig
from rf3dgs.training.explain import explained
from rf3dgs.training.joint import refine_jointly
from rf3dgs.training.lit_fit import Scattering, fit_ambient, fit_laws
from rf3dgs.training.lit_views import LitView, lit_views, observe
from rf3dgs.training.residual import PASSES, refine_residual
from rf3dgs.training.source_fit import fit_sources

CELL = 4  # cells of the patches: 0.4 m unless Gaussians are large
MIRROR_ORDER = 3  # unless the configuration says otherwise
JOINT = 120  # steps, likewise
DEEPEST_DB = 90.0  # under the window's ceiling; what is darker is the tail of a beam, or directions that no ray reached
STAGES = ("surfaces", "point sources", "observations", "laws", "residual", "joint refinement")


def fit_mirror(
    geometry: Gaussians,
    spectra: Spectrum,
    config: RadioConfig,
    tx: Pose,
    window: DbWindow,
    colour: Tensor,
    meta: dict[str, str | int | float | bool],
    progress: Progress,
) -> RadioField:
    """The mirror model of checked `spectra` over checked `geometry`; see `fit_radio`.

    `window` is that of the field's pictures, `colour` `[N, 3]` uint8 how a viewer paints it, `meta` what is known of
    the run.
    """
    progress.start("radio stage", len(STAGES))
    positions = spectra.pose.position
    surfaces = find_surfaces(geometry, positions)
    progress.update(1)
    solidity = geometry.opacities.detach()
    if "visibility" in config.without:
        solidity = torch.zeros_like(solidity)
    shape = geometry.means, geometry.quats, geometry.scales
    obstacles = Obstacles(*shape, solidity, surfaces.plane_of).without_strays()
    order = MIRROR_ORDER if config.mirror_order is None else config.mirror_order
    mirrors = SourceConfig(order=order, seed=config.seed)
    found = fit_sources(spectra, surfaces, obstacles, tx, mirrors, geometry=geometry)
    progress.update(2)
    views = lit_views(spectra, found.rays)
    obstacles = replace(obstacles, opacities=found.obstacles.opacities)
    surface = fit_surface(
        geometry, surfaces, obstacles, views, tx.position, window, spectra.instrument.lobe, config, progress
    )
    steps = JOINT if config.joint is None else config.joint
    if steps:
        surface = refine_jointly(
            surface,
            found.rays,
            spectra,
            steps=steps,
            seed=config.seed,
            floor_db=_floored(window).floor_db,
            residual="residual" not in config.without,
            backend=config.backend,
        )
    progress.update(6)
    parts = explained(surface, found.rays, spectra, _floored(window), config.backend)
    progress.finish()
    return RadioField(
        surface=surface,
        sources=found.sources,
        plane_of=found.obstacles.labels,
        solidity=found.obstacles.opacities,
        frequency=spectra.frequency,
        instrument=spectra.instrument,
        tx=tx,
        bounds=torch.stack((positions.amin(0), positions.amax(0))),
        colour=colour,
        meta=meta | {"positions in sight": int(found.seen.sum()), "segments": len(surface.laws)} | parts.meta(),
        backend=config.backend,
    )


def fit_surface(
    geometry: Gaussians,
    surfaces: Surfaces,
    obstacles: Obstacles,
    views: list[LitView],
    tx: Tensor,
    window: DbWindow,
    lobe: float,
    config: RadioConfig,
    progress: Progress,
) -> LitSurface:
    """The surface part of the model, fitted to `views` through a `lobe` [rad], in which point sources are taken out."""
    visibility = visibility_of(obstacles, geometry.means, surfaces.normals, tx, surfaces.plane_of)
    cells = cells_of(geometry.means, surfaces.segment_of, CELL * surfaces.patches.cell)
    scattering = Scattering.of(geometry.means, surfaces.normals, visibility, surfaces.segment_of, cells, tx)
    seen = observe(geometry, views, unit=10 ** (window.ceil_db / 10), backend=config.backend)
    floor_db = _floored(window).floor_db
    seen = replace(seen, level_db=seen.level_db.clamp_min(floor_db))
    progress.update(3)
    laws = fit_laws(scattering, seen, config.without)
    progress.update(4)
    bare = LitSurface(
        means=geometry.means.detach(),
        quats=geometry.quats.detach(),
        log_scales=geometry.log_scales.detach(),
        logit_opacities=geometry.logit_opacities.detach(),
        normals=scattering.normals,
        visibility=scattering.visibility,
        segment_of=scattering.segment_of,
        cell_of=scattering.cell_of,
        laws=laws,
        segment_sh=torch.zeros(len(laws), HARMONICS),
        cell_sh=torch.zeros(int(cells.max()) + 1, HARMONICS),
        level=torch.zeros(len(geometry)),
        ambient=fit_ambient(scattering, seen, laws),
        segment_csi=torch.zeros(len(laws), CSI_HARMONICS, 4),
        cell_csi=torch.zeros(int(cells.max()) + 1, CSI_HARMONICS, 4),
        own_csi=torch.zeros(len(geometry), 4),
        tx=tx,
        window=window,
        lobe=lobe,
    )
    passes = 0 if "residual" in config.without else PASSES
    surface = refine_residual(bare, views, passes=passes, floor_db=floor_db, backend=config.backend)
    progress.update(5)
    return surface


def _floored(window: DbWindow) -> DbWindow:
    return DbWindow(max(window.floor_db, window.ceil_db - DEEPEST_DB), window.ceil_db)


def cells_of(means: Tensor, segment_of: Tensor, width: float) -> Tensor:
    """The cell `[N]` of each Gaussian: numbers, from 0 without gaps, for cubes of `width` [m] of every segment."""
    key = torch.cat((torch.floor(means / width).long(), segment_of[:, None]), -1)
    return torch.unique(key, dim=0, return_inverse=True)[1]
