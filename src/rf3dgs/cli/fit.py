"""`fit`, `fit-geometry` and `fit-radio`: from a dataset to a field, in one go or stage by stage."""

import shutil
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import tyro

from rf3dgs.cli.show import console, out
from rf3dgs.core.errors import InputError
from rf3dgs.training.config import RadioConfig, VisualConfig

if TYPE_CHECKING:
    from rf3dgs.data.dataset import Dataset
    from rf3dgs.splats.gaussians import Gaussians


@dataclass(frozen=True)
class FitGeometry:
    """Visual stage: Gaussians from photographs, or from the mesh of a scene."""

    dataset: tyro.conf.Positional[Path]
    """A dataset folder, or a folder of photographs with poses (COLMAP, nerfstudio, Blender)."""
    out: Path = Path("geometry.ply")
    """The 3DGS .ply to write."""
    poses: Literal["given", "sfm"] = "given"
    """"sfm" finds poses and first points from the JPEG and PNG files below the folder by structure from motion (extra
    sfm); their world has arbitrary scale and tilt."""
    lens: Literal["radial", "pinhole"] = "radial"
    """With --poses sfm: estimate a radial distortion, or take rendered and undistorted pictures as they are."""
    mesh: str | None = None
    """Take the geometry from this scene's mesh instead of photographs ("lobby", "box", an XML file)."""
    mesh_count: int = 40_000
    """Gaussians on a mesh."""
    visual: VisualConfig = field(default_factory=VisualConfig)
    """The visual stage."""

    def run(self) -> int:
        """Fit, write the .ply, and drop the checkpoints."""
        from rf3dgs.data.formats.detect import read_photos
        from rf3dgs.data.sfm import poses_from_photos
        from rf3dgs.splats.ply import write_ply
        from rf3dgs.training.visual import fit_geometry

        if self.mesh is not None:
            geometry = _from_mesh(self.mesh, self.mesh_count, self.visual.seed)
        else:
            if self.poses == "sfm":
                found = poses_from_photos(self.dataset, lens=self.lens, progress=console())
            else:
                found = read_photos(self.dataset)
            for note in found.notes:
                out(f"note: {note}")
            roles = found.roles or ("train",) * len(found.photos)
            photos = [photo for photo, role in zip(found.photos, roles, strict=True) if role == "train"]
            with_checkpoints = checkpoints(self.out)
            geometry = fit_geometry(
                photos, self.visual, initial=found.points, progress=console(), checkpoint_dir=with_checkpoints
            )
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
    radio: RadioConfig = field(default_factory=RadioConfig)
    """The radio stage."""

    def run(self) -> int:
        """Fit, write the field, and drop the checkpoints."""
        from rf3dgs.cli.facts import open_dataset
        from rf3dgs.splats.ply import read_ply

        fit_field(read_ply(self.geometry), open_dataset(self.dataset), self.out, self.radio, self.estimate_tx)
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
    visual: VisualConfig = field(default_factory=VisualConfig)
    """The visual stage."""
    radio: RadioConfig = field(default_factory=RadioConfig)
    """The radio stage."""

    def run(self) -> int:
        """Fit both stages; a killed run goes on from its last checkpoint."""
        from rf3dgs.cli.facts import open_dataset
        from rf3dgs.training.visual import fit_geometry

        dataset = open_dataset(self.dataset)
        if self.mesh is not None:
            geometry = _from_mesh(self.mesh, self.mesh_count, self.visual.seed)
        elif not dataset.train.photos:
            raise InputError(f"{self.dataset} has no photographs; add some, or name a scene's mesh with --mesh")
        else:
            folder = checkpoints(self.out) / "visual"
            geometry = fit_geometry(dataset.train.photos, self.visual, progress=console(), checkpoint_dir=folder)
        fit_field(geometry, dataset, self.out, self.radio, self.estimate_tx)
        return 0


def fit_field(
    geometry: "Gaussians", dataset: "Dataset", path: Path, config: RadioConfig, estimate_tx: bool = False
) -> None:
    """Train the radio stage with checkpoints, save the field, and say how large it is."""
    from dataclasses import replace

    from rf3dgs.training.radio import fit_radio

    spectra = dataset.train.spectra
    if spectra is None or not len(spectra):
        raise InputError("the dataset has no training spectra; make some with rf3dgs spectra")
    spectra = replace(spectra, tx=None) if estimate_tx else spectra
    folder = checkpoints(path) / "radio"
    trained = fit_radio(geometry, spectra, config, progress=console(), checkpoint_dir=folder)
    trained.save(path)
    drop_checkpoints(path)
    size = sum(file.stat().st_size for file in path.iterdir()) / 1e6
    out(f"{path}: {len(trained.surface):,} Gaussians, {size:.1f} MB")


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
