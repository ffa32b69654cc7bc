"""Which layout a folder of photographs has."""

from pathlib import Path

from rf3dgs.core.errors import DataError
from rf3dgs.data.formats.blender import files_of, read_blender
from rf3dgs.data.formats.colmap import model_folder, read_colmap
from rf3dgs.data.formats.native import MANIFEST, photo_roles
from rf3dgs.data.formats.nerfstudio import FILE_NAME, read_nerfstudio
from rf3dgs.data.formats.rf3dgs_v0 import is_rf3dgs_v0, read_rf3dgs_v0_pictures
from rf3dgs.data.photo import PhotoSet


def layout_of(path: str | Path) -> str | None:
    """The first layout whose files a folder has: "native", "nerfstudio", "blender", "rf3dgs_v0", "colmap", or None."""
    path = Path(path)
    if (path / MANIFEST).is_file():
        return "native"
    if (path / FILE_NAME).is_file():
        return "nerfstudio"
    if files_of(path):
        return "blender"
    if model_folder(path) is None:
        return "nerfstudio" if (path / "photos" / FILE_NAME).is_file() else None
    return "rf3dgs_v0" if is_rf3dgs_v0(path) else "colmap"


def read_photos(path: str | Path) -> PhotoSet:
    """Read the photos of a folder in whatever known layout it has; `layout` of the result says which."""
    path = Path(path)
    if not path.is_dir():
        raise DataError(f"{path}: there is no such folder")
    layout = layout_of(path)
    if layout in ("native", "nerfstudio"):
        folder = path if (path / FILE_NAME).is_file() else path / "photos"
        if not (folder / FILE_NAME).is_file():
            raise DataError(f"{path}: this dataset has no photographs; add some, or take the geometry from a mesh")
        found = read_nerfstudio(folder)
        roles = photo_roles(path, len(found)) if layout == "native" else None
        return PhotoSet(found.photos, layout, roles=roles, notes=found.notes)
    if layout == "blender":
        return read_blender(path)
    if layout == "rf3dgs_v0":
        return read_rf3dgs_v0_pictures(path)
    if layout == "colmap":
        return read_colmap(path)
    raise DataError(
        f"{path}: expected photos as COLMAP (sparse/0), nerfstudio (transforms.json), Blender (transforms_train.json), "
        "rf3dgs_v0 (train_index.txt) or a dataset (dataset.json); found none of these"
    )
