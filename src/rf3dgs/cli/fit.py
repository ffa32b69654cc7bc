"""`fit`, `fit-geometry` and `fit-radio`: from a dataset to a field, in one go or stage by stage."""

import shutil
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import tyro

from rf3dgs.cli.show import console, note, out
from rf3dgs.core.errors import DataError, InputError
from rf3dgs.training.config import RadioConfig, VisualConfig

Preset = Literal["fast", "paper", "best"]

if TYPE_CHECKING:
    from torch import Tensor

    from rf3dgs.data.dataset import Dataset
    from rf3dgs.data.photo import Photo
    from rf3dgs.spectra.spectrum import Spectrum
    from rf3dgs.splats.gaussians import Gaussians


@dataclass(frozen=True)
class FitGeometry:
    """Visual stage: Gaussians from photographs, from the mesh of a scene, from a floor plan, or from spectra."""

    dataset: tyro.conf.Positional[Path | None] = None
    """A dataset folder, or a folder of photographs with poses (COLMAP, nerfstudio, Blender); a .ply with --spectra."""
    out: Path = Path("geometry.ply")
    """The 3DGS .ply to write."""
    poses: Literal["given", "sfm"] = "given"
    """"sfm" finds poses and first points from the JPEG and PNG files below the folder by structure from motion (extra
    sfm); their world has arbitrary scale and tilt, so that walls stay free (--visual.walls)."""
    lens: Literal["radial", "pinhole"] = "radial"
    """With --poses sfm: estimate a radial distortion, or take rendered and undistorted pictures as they are."""
    mesh: str | None = None
    """Take the geometry from this scene's mesh instead of photographs ("lobby", "box", an XML file)."""
    plan: Path | None = None
    """Take the geometry from this floor plan (TOML or JSON) instead of photographs."""
    spectra: str | None = None
    """Take the geometry from the training spectra of this dataset; with photographs or a .ply, correct it by them."""
    mesh_count: int = 40_000
    """Gaussians on a mesh or a floor plan."""
    flatten: bool = False
    """Put the Gaussians of walls and other planes flat on them, where the photographs have them: better for radio,
    worse to look at."""
    visual: VisualConfig = field(default_factory=VisualConfig)
    """The visual stage."""

    def run(self) -> int:
        """Fit, write the .ply, and drop the checkpoints."""
        from rf3dgs.data.formats.detect import read_photos
        from rf3dgs.data.sfm import poses_from_photos
        from rf3dgs.splats.ply import read_ply, write_ply
        from rf3dgs.training.radio_geometry import corrected, geometry_from_spectra
        from rf3dgs.training.visual import fit_geometry

        if self.out.is_dir():
            raise InputError(f"{self.out} is a folder; name the .ply file to write with --out")
        given = [name for name in ("dataset", "mesh", "plan") if getattr(self, name) is not None]
        others = ("mesh" in given) + ("plan" in given) + (self.spectra is not None)
        if others > 1 or not (given or self.spectra):
            got = " and ".join([*given, *(["spectra"] if self.spectra else [])])
            raise InputError(
                "geometry comes from a folder of photographs, from --mesh, from --plan or from --spectra; "
                f"got {got or 'none of them'}"
            )
        spectra = None if self.spectra is None else spectra_of(self.spectra)
        if spectra is not None and self.dataset is None:
            geometry = geometry_from_spectra(spectra, seed=self.visual.seed)
        elif spectra is not None and self.dataset is not None and self.dataset.suffix == ".ply":
            geometry = corrected(read_ply(self.dataset), spectra, seed=self.visual.seed)
        elif self.mesh is not None:
            geometry = _from_mesh(self.mesh, self.mesh_count, self.visual.seed)
        elif self.plan is not None:
            geometry = geometry_of_plan(self.plan, self.mesh_count, self.visual.seed)
        else:
            assert self.dataset is not None
            if self.poses == "sfm":
                found = poses_from_photos(self.dataset, lens=self.lens, progress=console())
            else:
                found = read_photos(self.dataset)
            for text in found.notes:
                note(text)
            roles = found.roles or ("train",) * len(found.photos)
            photos = [photo for photo, role in zip(found.photos, roles, strict=True) if role == "train"]
            with_checkpoints = checkpoints(self.out)
            visual = replace(self.visual, walls="free") if self.poses == "sfm" else self.visual
            geometry = fit_geometry(
                photos, visual, initial=found.points, progress=console(), checkpoint_dir=with_checkpoints
            )
            geometry = flat_on_planes(geometry, photos) if self.flatten else geometry
            geometry = geometry if spectra is None else corrected(geometry, spectra, seed=self.visual.seed)
        write_ply(self.out, geometry)
        drop_checkpoints(self.out)
        out(f"{self.out}: {len(geometry):,} Gaussians")
        return 0


@dataclass(frozen=True)
class FitRadio:
    """Radio stage: a field from Gaussians and the training spectra of a dataset."""

    geometry: tyro.conf.Positional[Path]
    """A 3DGS .ply."""
    dataset: tyro.conf.Positional[str]
    """A dataset folder, or "lobby" for the one that ships with the package."""
    out: Path = Path("site.field")
    """The field folder to write."""
    estimate_tx: bool = False
    """Estimate where the transmitter stands although the dataset knows it."""
    fraction: float | None = None
    """Train on this share of the training positions, such as 0.2; smaller shares are part of larger ones."""
    preset: Preset | None = None
    """All settings of the radio stage at once, in place of --radio.* (the seed stays)."""
    radio: RadioConfig = field(default_factory=RadioConfig)
    """The radio stage."""

    def run(self) -> int:
        """Fit, write the field, and drop the checkpoints."""
        from rf3dgs.cli.facts import open_dataset
        from rf3dgs.splats.ply import read_ply

        radio = chosen_radio(self.preset, self.radio)
        geometry, dataset = read_ply(self.geometry), reduced(open_dataset(self.dataset), self.fraction)
        fit_field(geometry, dataset, self.out, radio, self.estimate_tx, source=str(self.geometry))
        return 0


@dataclass(frozen=True)
class Fit:
    """Both stages: a field from a dataset folder."""

    dataset: tyro.conf.Positional[str]
    """A dataset folder, or "lobby" for the one that ships with the package."""
    out: Path = Path("site.field")
    """The field folder to write."""
    mesh: str | None = None
    """Take the geometry from this scene's mesh instead of photographs ("lobby", "box", an XML file)."""
    mesh_count: int = 40_000
    """Gaussians on a mesh."""
    estimate_tx: bool = False
    """Estimate where the transmitter stands although the dataset knows it."""
    fraction: float | None = None
    """Train on this share of the training positions, such as 0.2; smaller shares are part of larger ones."""
    visual: VisualConfig = field(default_factory=VisualConfig)
    """The visual stage."""
    preset: Preset | None = None
    """All settings of the radio stage at once, in place of --radio.* (the seed stays)."""
    radio: RadioConfig = field(default_factory=RadioConfig)
    """The radio stage."""

    def run(self) -> int:
        """Fit both stages; a killed run goes on from its last checkpoint."""
        from rf3dgs.cli.facts import open_dataset
        from rf3dgs.training.visual import fit_geometry

        radio = chosen_radio(self.preset, self.radio)
        if self.mesh is not None:  # which is known, so that spectra have nothing to correct
            radio = replace(radio, geometry="given")
        dataset = reduced(open_dataset(self.dataset), self.fraction)
        check_output(self.out)
        training_spectra(dataset)
        if self.mesh is not None:
            geometry = _from_mesh(self.mesh, self.mesh_count, self.visual.seed)
        elif not dataset.train.photos:
            raise InputError(f"{self.dataset} has no photographs; add some, or name a scene's mesh with --mesh")
        else:
            folder = checkpoints(self.out) / "visual"
            geometry = fit_geometry(dataset.train.photos, self.visual, progress=console(), checkpoint_dir=folder)
        source = self.mesh or str(dataset.path)
        fit_field(geometry, dataset, self.out, radio, self.estimate_tx, source=source)
        return 0


def chosen_radio(preset: Preset | None, radio: RadioConfig) -> RadioConfig:
    """The preset with the seed of `radio`, or `radio` itself; raises InputError where both say something."""
    if preset is None:
        return radio
    if radio != RadioConfig(seed=radio.seed):
        raise InputError(f"--preset {preset} sets all of the radio stage; give it or --radio.*, not both")
    return RadioConfig.preset(preset, seed=radio.seed)


def reduced(dataset: "Dataset", fraction: float | None) -> "Dataset":
    """The dataset with a share of its training positions; all of them when `fraction` is None."""
    return dataset if fraction is None else dataset.with_fraction(fraction)


def fit_field(
    geometry: "Gaussians",
    dataset: "Dataset",
    path: Path,
    config: RadioConfig,
    estimate_tx: bool = False,
    *,
    source: str = "the geometry",
) -> None:
    """Train the radio stage with checkpoints, save the field, and say how large it is; `source` names the geometry."""
    from rf3dgs.cli.chain import gaussian_count
    from rf3dgs.training.explain import Explained
    from rf3dgs.training.radio import fit_radio

    check_output(path)
    spectra = training_spectra(dataset)
    check_world(geometry, spectra.pose.position, source)
    spectra = replace(spectra, tx=None) if estimate_tx else spectra
    folder = checkpoints(path) / "radio"
    trained = fit_radio(geometry, spectra, config, progress=console(), checkpoint_dir=folder)
    trained.save(path)
    drop_checkpoints(path)
    size = sum(file.stat().st_size for file in path.iterdir()) / 1e6
    out(f"{path}: {gaussian_count(trained)} Gaussians, {size:.1f} MB")
    parts = Explained.of_meta(trained.meta)
    if parts is not None:
        out(parts.text())


def check_output(path: Path) -> None:
    """Refuse, before any training, a name where no field can be written."""
    if path.exists() and not path.is_dir():
        raise InputError(f"{path} is a file, but a field is a folder; choose another name with --out")
    if path.is_dir() and any(path.iterdir()) and not (path / "field.json").exists():
        raise InputError(f"{path} is a folder that holds something else than a field; choose another name with --out")


def training_spectra(dataset: "Dataset") -> "Spectrum":
    """The spectra to learn from, refused before any training when there are none or one of them teaches nothing."""
    from rf3dgs.data.formats.native import SPECTRA
    from rf3dgs.training.radio import check_spectra

    part = dataset.train
    if part.spectra is None or not len(part.spectra):
        raise InputError(f"{dataset.path} has no training spectra; make some with rf3dgs spectra")
    try:
        check_spectra(part.spectra, part.index)
    except InputError as error:
        raise DataError(f"{dataset.path}/{SPECTRA}: {error}") from error
    return part.spectra


def spectra_of(name: str) -> "Spectrum":
    """The training spectra of the dataset that `name` is."""
    from rf3dgs.cli.facts import open_dataset

    return training_spectra(open_dataset(name))


def check_world(geometry: "Gaussians", positions: "Tensor", source: str) -> None:
    """Refuse geometry that cannot be in the metric world of the receivers at `positions` `[n, 3]` [m]."""
    import numpy as np

    low, high = np.quantile(geometry.means.numpy(), (0.01, 0.99), axis=0)
    extent, reach = float((high - low).max()), float((positions.amax(0) - positions.amin(0)).max())
    if extent > 1000.0 and extent > 300.0 * max(reach, 1.0):
        raise DataError(
            f"{source}: the geometry spans {extent:.0f} m around receivers that span {reach:.1f} m, as millimetres do; "
            "convert it to metres"
        )
    away = np.abs(positions.numpy() - (low + high) / 2) > 1.5 * (high - low) + 1.0
    if away.any(1).mean() > 0.5:
        raise DataError(
            f"{source}: {int(away.any(1).sum())} of {len(positions)} receivers stand far outside the geometry, which "
            f"spans {extent:.3g} m; align it with the world of the spectra, in metres with z up"
        )


def checkpoints(path: Path) -> Path:
    """The folder beside an output that keeps checkpoints until the output is written."""
    return path.parent / f".{path.name}.checkpoints"


def drop_checkpoints(path: Path) -> None:
    """Remove the checkpoints of a finished output."""
    shutil.rmtree(checkpoints(path), ignore_errors=True)


def _from_mesh(name: str, count: int, seed: int) -> "Gaussians":
    from rf3dgs.cli.chain import geometry_of_mesh
    from rf3dgs.cli.facts import open_scene

    return geometry_of_mesh(open_scene(name), count, seed)


def geometry_of_plan(path: Path, count: int, seed: int) -> "Gaussians":
    """Flattened Gaussians on the surfaces of a floor plan."""
    from rf3dgs.geometry.plan import plan_mesh
    from rf3dgs.geometry.plan_file import read_plan
    from rf3dgs.splats.surface import sample_mesh

    mesh = plan_mesh(read_plan(path))
    return sample_mesh(mesh.vertices, mesh.faces, count=count, seed=seed, colours=mesh.colours)


def flat_on_planes(geometry: "Gaussians", photos: "Sequence[Photo]") -> "Gaussians":
    """The Gaussians, those on planes flat on them where the photographs agree on the plane."""
    import torch

    from rf3dgs.geometry.flatten import flatten
    from rf3dgs.training.photographs import picture_of

    cameras = [photo.camera for photo in photos]
    eyes = torch.stack([camera.position for camera in cameras])
    return flatten(geometry, eyes, cameras, [picture_of(photo) for photo in photos])
