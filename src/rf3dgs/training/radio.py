"""The radio stage: spectra and frozen geometry to a `RadioField`. Paper IV.B, IV.C.

Means, rotations and scales stay as they are. Opacity and the gain's harmonics follow L1 + D-SSIM of the gain in the
field's one dB window; delay and departure follow their own weighted L1 through the opacities as they are. The line of
sight is a point source, fitted in closed form before the surface is trained on what remains.
"""

from dataclasses import asdict, replace
from pathlib import Path

import torch
from torch import Tensor

from rf3dgs.core.errors import InputError
from rf3dgs.core.frames import Pose
from rf3dgs.core.grids import equirect_grid
from rf3dgs.core.progress import Progress, Silent
from rf3dgs.core.threads import one_torch_thread
from rf3dgs.field.radiance import Surface
from rf3dgs.field.radio_field import RadioField
from rf3dgs.field.transmitter import estimate_transmitter
from rf3dgs.geometry import find_surfaces
from rf3dgs.spectra.codec import DbWindow, PaperEncoding, window_of
from rf3dgs.spectra.spectrum import Spectrum
from rf3dgs.spectra.targets import ideal_targets
from rf3dgs.splats.detail import level_of_detail
from rf3dgs.splats.gaussians import Gaussians
from rf3dgs.splats.harmonics import C0
from rf3dgs.splats.obstacles import Obstacles
from rf3dgs.training.array_targets import explained_by
from rf3dgs.training.checkpoint import fingerprint
from rf3dgs.training.config import RadioConfig, SourceConfig
from rf3dgs.training.loop import train
from rf3dgs.training.mirror import fit_mirror
from rf3dgs.training.radio_geometry import corrected
from rf3dgs.training.radio_stage import RadioStage
from rf3dgs.training.radio_views import radio_views
from rf3dgs.training.source_fit import fit_sources

PARTS = ("lit", "ambient", "residual", "visibility")
MANY = 150_000  # Gaussians beyond which their level of detail is worth its pass


@one_torch_thread()
def fit_radio(
    geometry: Gaussians,
    spectra: Spectrum,
    config: RadioConfig | None = None,
    *,
    tx: Pose | None = None,
    progress: Progress | None = None,
    checkpoint_dir: str | Path | None = None,
) -> RadioField:
    """Train a field on `spectra` `[position, row, col]` over frozen `geometry`.

    `tx` is the transmitter's pose; None takes that of the spectra, or estimates its position from the strongest
    bearings. Pictures of an array, whose instrument names it, become ideal spectra first (see `ideal_targets`); the
    mirror model then explains them anew by what it predicts, `config.array_rounds` times. The field renders the ideal
    lobe. More Gaussians than the spectra can tell apart are merged first, as `config.detail` says. With a
    `checkpoint_dir` a killed run goes on where it stopped and ends with the same bits. Raises InputError for spectra
    that are empty, constant or not finite, and TrainingError when training cannot go on.
    """
    config = RadioConfig() if config is None else config
    progress = Silent() if progress is None else progress
    if config.steps < 0:
        raise InputError(f"steps must be 0 (the closed-form start alone) or more; got {config.steps}")
    if config.model == "mirror" and config.of_the_paper:
        raise InputError(
            f'{", ".join(config.of_the_paper)}: settings of the paper\'s model; choose model="paper" or leave them out'
        )
    if config.uncertainty and config.model != "mirror":
        raise InputError('uncertainty belongs to the mirror model; choose model="mirror" or leave it out')
    if config.joint is not None and (config.joint < 0 or config.model != "mirror"):
        raise InputError(
            f"joint counts steps of the mirror model's joint refinement, 0 or more; got {config.joint} with the model "
            f"{config.model!r}. Leave it out"
        )
    unknown = [name for name in config.without if name not in PARTS]
    if unknown or (config.without and config.model != "mirror"):
        raise InputError(
            f"without names parts of the mirror model, {', '.join(PARTS)}; got {', '.join(config.without)} with the "
            f"model {config.model!r}. Leave it out"
        )
    geometry.check()
    check_spectra(spectra)
    pictures, spectra = _looked_through(spectra, config, progress)
    given, geometry = len(geometry), _detail(geometry, spectra, config)
    where = spectra.tx if tx is None else tx
    estimated = where is None
    where = estimate_transmitter(spectra) if where is None else where
    timed = spectra.delay is not None and spectra.aod is not None
    if timed and config.model == "mirror" and config.geometry == "corrected":
        geometry = corrected(geometry, spectra, where, seed=config.seed)
    window = _window(spectra, config)
    meta: dict[str, str | int | float | bool] = {
        "model": config.model,
        "seed": config.seed,
        "positions": len(spectra),
        "transmitter": "estimated" if estimated else "given",
        "Gaussians given": given,
    }
    if config.model == "mirror":
        field = fit_mirror(geometry, spectra, config, where, window, _colour(geometry), meta, progress)
        for _ in range(config.array_rounds if pictures is not None else 0):
            assert pictures is not None
            spectra = explained_by(field, pictures, spectra, progress)
            field = fit_mirror(geometry, spectra, config, where, window, _colour(geometry), meta, progress)
        return _with_uncertainty(field, spectra, progress) if config.uncertainty else field
    found = None
    if config.line_of_sight == "source":
        order = config.mirror_order or 0
        surfaces = find_surfaces(geometry, spectra.pose.position) if order else None
        obstacles = Obstacles(geometry.means, geometry.quats, geometry.scales, geometry.opacities)
        mirrors = SourceConfig(order=order, seed=config.seed)
        found = fit_sources(spectra, surfaces, obstacles, where, mirrors)
    span = PaperEncoding.of(spectra).delay_span if config.encoding == "paper" and spectra.delay is not None else 1e-7
    bare = Surface.bare(
        geometry,
        tx=where.position,
        window=window,
        encoding=config.encoding,
        degree=config.degree,
        delay_span=span,
    )
    views = radio_views(
        spectra,
        window,
        rays=None if found is None else found.rays,
        encoding=PaperEncoding(window, span) if config.encoding == "paper" else None,
    )
    stage = RadioStage(bare, views, config)
    pose = spectra.pose
    measured = (spectra.power, spectra.delay, spectra.aod, pose.position, pose.orientation, spectra.grid.directions)
    identity = {
        "stage": "radio",
        "config": asdict(config),
        "tx": where.position.tolist(),
        "instrument": asdict(spectra.instrument),
        "frequency": spectra.frequency,
        "data": fingerprint([*geometry.tensors().values(), *(part for part in measured if part is not None)]),
    }
    train(
        stage,
        config.steps,
        label="radio stage",
        identity=identity,
        progress=progress,
        checkpoint_dir=checkpoint_dir,
        every_steps=config.checkpoint_every,
    )
    meta |= {"steps": config.steps, "positions in sight": 0 if found is None else int(found.seen.sum())}
    return RadioField(
        surface=stage.surface(),
        sources=None if found is None else found.sources,
        plane_of=None if found is None else found.obstacles.labels,
        solidity=geometry.opacities.detach() if found is None else found.obstacles.opacities,
        frequency=spectra.frequency,
        instrument=spectra.instrument,
        tx=where,
        bounds=torch.stack((pose.position.amin(0), pose.position.amax(0))),
        colour=_colour(geometry),
        meta=meta,
        backend=config.backend,
    )


def check_spectra(spectra: Spectrum, numbers: Tensor | None = None) -> None:
    """Raise InputError for spectra that nothing can be learned from, naming the position.

    `numbers` `[position]` are what the positions are called in the message, such as their places in a file.
    """
    if not spectra.pose.batch_shape or len(spectra.pose.batch_shape) != 1 or len(spectra) == 0:
        raise InputError(f"the radio stage needs spectra at a list of positions; got batch {spectra.pose.batch_shape}")
    if spectra.method == "music":
        raise InputError('"music" spectra have no level to learn; make spectra of power, such as method "capon"')
    power = spectra.power
    rules = (
        (~torch.isfinite(power).all((-2, -1)), "has NaN or infinite power"),
        ((power < 0).any(-1).any(-1), "has negative power; spectra are linear power, not dB"),
        (power.amax((-2, -1)) <= 0, "is empty: no power from any direction"),
        (power.amax((-2, -1)) == power.amin((-2, -1)), "is constant: the same power from every direction"),
    )
    for wrong, text in rules:
        if bool(wrong.any()):
            first = int(wrong.nonzero()[0])
            number = first if numbers is None else int(numbers[first])
            raise InputError(f"the spectrum of position {number} {text}; remove or repair it")


def _looked_through(spectra: Spectrum, config: RadioConfig, progress: Progress) -> tuple[Spectrum | None, Spectrum]:
    """The pictures of an array, None for others, and the spectra to learn from."""
    if spectra.floor is not None:  # what stands where nobody looked must not matter
        spectra = replace(spectra, power=torch.where(spectra.looked, spectra.power, torch.zeros(())))
    if spectra.instrument.array is None:
        return None, spectra
    if config.array_pictures == "face-value":
        return None, replace(spectra, instrument=replace(spectra.instrument, array=None))
    return spectra, ideal_targets(spectra, equirect_grid(*config.array_grid), progress=progress)


def _with_uncertainty(field: RadioField, spectra: Spectrum, progress: Progress) -> RadioField:
    from rf3dgs.training.uncertainty_fit import fit_uncertainty  # which asks this module to check spectra

    return fit_uncertainty(field, spectra, progress=progress)


def _detail(geometry: Gaussians, spectra: Spectrum, config: RadioConfig) -> Gaussians:
    """The geometry, merged where a pixel of the spectra, or half a lobe of their instrument, cannot tell it apart."""
    if config.detail == "keep" or (config.detail == "auto" and len(geometry) <= MANY):
        return geometry
    pixel = max(spectra.grid.spacing, 0.5 * spectra.instrument.lobe)
    return level_of_detail(geometry, spectra.pose.position, pixel=pixel).gaussians


def _window(spectra: Spectrum, config: RadioConfig) -> DbWindow:
    window = window_of(spectra)
    floor_db = window.floor_db if config.floor_db is None else config.floor_db
    ceil_db = window.ceil_db if config.ceil_db is None else config.ceil_db
    if not ceil_db > floor_db:
        raise InputError(f"the dB window needs floor_db < ceil_db; got {floor_db} and {ceil_db}")
    return DbWindow(floor_db, ceil_db)


def _colour(geometry: Gaussians) -> Tensor:
    """How a viewer paints the Gaussians `[N, 3]` uint8: their constant colour, or grey."""
    if geometry.channels != 3:
        return torch.full((len(geometry), 3), 160, dtype=torch.uint8)
    return ((geometry.sh[:, 0] * C0 + 0.5).clamp(0, 1) * 255).round().to(torch.uint8)
