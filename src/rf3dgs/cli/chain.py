"""The steps of the main job, composed from the layers: what `demo` runs in one go and other commands one by one."""

import math
import tempfile
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import torch

from rf3dgs.channel.paths import Paths
from rf3dgs.core.errors import InputError
from rf3dgs.core.frames import Pose
from rf3dgs.core.grids import Camera, DirectionGrid
from rf3dgs.core.progress import Progress, track
from rf3dgs.data.dataset import Dataset, Part
from rf3dgs.data.photo import Photo
from rf3dgs.data.split import every_kth
from rf3dgs.evaluation.protocol import evaluate
from rf3dgs.evaluation.report import PhotoPair, ReportInputs, SpectrumExample
from rf3dgs.evaluation.table import Evaluation
from rf3dgs.propagation.config import PhotoConfig, TraceConfig
from rf3dgs.spectra.scan import spectrum_of
from rf3dgs.spectra.spectrum import Spectrum, stack_spectra
from rf3dgs.splats.gaussians import Gaussians
from rf3dgs.splats.surface import sample_mesh
from rf3dgs.training.photographs import render_photo

if TYPE_CHECKING:
    from rf3dgs.field.radio_field import RadioField
    from rf3dgs.propagation.jobs.photo_job import Shot
    from rf3dgs.propagation.sites.scene import Scene

HOLD_OUT_EVERY = 7
"""Every seventh photograph of a tour is held out: its neighbours on the walk are not."""
REPEAT_SEED = 100_003
REPEAT_RAYS = 5 / 3  # the second solve shoots this many times the rays: a lattice of its own


def spectra_of_scene(
    scene: "Scene", rx: Pose, grid: DirectionGrid, config: TraceConfig, progress: Progress
) -> Spectrum:
    """Trace every receiver and keep its ideal spectrum; the paths themselves are dropped, so memory stays flat."""
    from rf3dgs.propagation.sionna import trace_each

    def spectrum(paths: Paths) -> Spectrum:
        return spectrum_of(paths, None, grid, method="ideal")

    return stack_spectra([spectrum(paths) for paths in trace_each(scene, scene.tx, rx, config, progress)])


def shots_of_tour(scene: "Scene", count: int, seed: int, config: PhotoConfig) -> "list[Shot]":
    """A walk through the scene, photograph by photograph; what is held out may have more light paths a pixel.

    Held-out photographs and the others count their seeds on their own.
    """
    from rf3dgs.propagation.jobs.photo_job import Shot
    from rf3dgs.propagation.photographer import camera_tour

    clean = replace(config, samples=config.held_out_samples or config.samples, seed=config.seed + count)
    taken = {"test": 0}
    shots = []
    for camera, role in zip(camera_tour(scene, count, seed, config), every_kth(count, HOLD_OUT_EVERY), strict=True):
        how = clean if role == "test" else config
        place = taken.get(role, 0)
        shots.append(Shot(camera, replace(how, seed=how.seed + place)))
        taken[role] = place + 1
    return shots


def photos_of(shots: "Sequence[Shot]", folder: Path) -> list[Photo]:
    """The photographs of these shots, whose files lie in `folder`."""
    from rf3dgs.propagation.jobs.photo_job import photo_name

    photos = []
    for number, shot in enumerate(shots):
        assert isinstance(shot.camera, Camera)
        photos.append(Photo(photo_name(number), shot.camera, folder / photo_name(number)))
    return photos


def photograph(
    scene: "Scene", count: int, seed: int, config: PhotoConfig, folder: Path, progress: Progress
) -> list[Photo]:
    """Render a tour of the scene into JPEG files in `folder`."""
    from rf3dgs.propagation.jobs.photo_job import photo_name, take

    shots = shots_of_tour(scene, count, seed, config)
    for number, content in track(take(scene, shots, lambda: None), "photographs", count, progress):
        (folder / photo_name(number)).write_bytes(content)
    return photos_of(shots, folder)


def make_dataset(
    scene: "Scene",
    folder: Path,
    grid: DirectionGrid,
    *,
    receivers: int,
    photos: int,
    trace: TraceConfig,
    photo: PhotoConfig,
    seed: int,
    progress: Progress,
) -> Dataset:
    """Trace and photograph a scene and write the split dataset, with a second solve of its held-out positions."""
    rx = scene.receivers(receivers, seed)
    spectra = spectra_of_scene(scene, rx, grid, trace, progress)
    split = Dataset((), spectra).split(seed=seed)
    index = torch.cat((split.where("test"), split.where("region")))
    if not len(index):
        raise InputError(f"{receivers} receivers are too few to hold some out; take at least 10")
    again = replace(trace, seed=trace.seed + REPEAT_SEED, rays=round(trace.rays * REPEAT_RAYS))
    repeat = spectra_of_scene(scene, rx[index], grid, again, progress)
    meta = {
        "generator": f"{scene.name}, depth {trace.depth}, {trace.passes} x {trace.rays} rays; {photos} photographs",
        "seed": seed,
        "repeat": {"rays": again.rays, "seed": again.seed},
    }
    folder.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=folder.parent) as temporary:
        pictures = photograph(scene, photos, seed, photo, Path(temporary), progress) if photos else []
        whole = Dataset(pictures, spectra, repeat=repeat, repeat_index=index, meta=meta)
        return whole.split(seed=seed, photo_test_every=HOLD_OUT_EVERY).save(folder)


def geometry_of_mesh(scene: "Scene", count: int, seed: int) -> Gaussians:
    """Flattened Gaussians on the scene's meshes, painted in their colours."""
    vertices, faces, colour = scene.mesh()
    return sample_mesh(vertices, faces, count=count, seed=seed, colours=colour)


def photo_pairs(geometry: Gaussians, photos: Sequence[Photo]) -> list[PhotoPair]:
    """Held-out photographs beside their renderings."""
    return [PhotoPair(photo.name, photo.load(), render_photo(geometry, photo.camera)) for photo in photos]


def evaluate_parts(
    field: "RadioField", train: Spectrum, parts: dict[str, Part], progress: Progress, seed: int
) -> dict[str, Evaluation]:
    """Score the field on every hold-out that has spectra."""
    return {
        name: evaluate(field, part.spectra, train=train, repeat=part.repeat, holdout=name, seed=seed, progress=progress)
        for name, part in parts.items()
        if part.spectra is not None and len(part.spectra)
    }


def report_inputs(
    title: str,
    field: "RadioField",
    dataset: Dataset,
    parts: dict[str, Part],
    evaluations: dict[str, Evaluation],
    *,
    geometry: Gaussians | None = None,
    footprint: Sequence = (),
    timings: dict[str, float] | None = None,
    seed: int = 0,
    command: str = "",
) -> ReportInputs:
    """What the report shows, with one example position of each hold-out in the middle of its errors."""
    train = dataset.train.spectra
    assert train is not None
    examples = []
    for name, evaluation in evaluations.items():
        spectra = parts[name].spectra
        assert spectra is not None
        order = evaluation.column("field", "rmse_db").argsort()
        place = int(order[len(order) // 2])
        where = ", ".join(f"{value:.1f}" for value in spectra.pose.position[place].tolist())
        label = f"hold-out {name}, receiver at ({where}) m, the one with the median RMSE"
        examples.append(SpectrumExample.of(label, field, spectra[place], train))
    held_out = [photo for photo, role in zip(dataset.photos, dataset.photo_roles, strict=False) if role == "test"]
    facts = {
        "Frequency": f"{field.frequency / 1e9:g} GHz",
        "Training": f"{len(train)} positions, {len(dataset.train.photos)} photographs",
        "Instrument": field.instrument.name,
        "Grid": f"{train.grid.kind}, {train.grid.width} x {train.grid.height}",
        "Gaussians": gaussian_count(field),
        "Transmitter": "(" + ", ".join(f"{value:.2f}" for value in field.tx.position.tolist()) + ") m",
        "dB window": f"{field.window.floor_db:.1f} to {field.window.ceil_db:.1f} dB",
        "Path gain at the training positions": _range_db(train),
    }
    return ReportInputs(
        title=title,
        evaluations=evaluations,
        facts=facts,
        photos=photo_pairs(geometry, held_out[:4]) if geometry is not None else (),
        examples=examples,
        positions=dataset.pose.position,
        roles=dataset.roles,
        tx=field.tx.position,
        footprint=footprint,
        timings=timings or {},
        seed=seed,
        command=command,
        window=field.window,
    )


def gaussian_count(field: "RadioField") -> str:
    """How many Gaussians a field has, and of how many given ones they were made by merging or correcting."""
    count, given = len(field.surface), field.meta.get("Gaussians given")
    changed = isinstance(given, int) and given != count
    return f"{count:,} made of {given:,}" if changed else f"{count:,}"


def _range_db(spectra: Spectrum) -> str:
    low, high = (10 * math.log10(float(value)) for value in (spectra.path_gain.min(), spectra.path_gain.max()))
    return f"{low:.1f} to {high:.1f} dB"
