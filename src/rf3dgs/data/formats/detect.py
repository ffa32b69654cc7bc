"""Which layout a folder of photographs has."""

from pathlib import Path

from rf3dgs.core.errors import DataError
from rf3dgs.data.formats import nerfstudio
from rf3dgs.data.photo import PhotoSet


def read_photos(path: str | Path) -> PhotoSet:
    """Read the photos of a folder in whatever known layout it has; `layout` of the result says which."""
    path = Path(path)
    if not path.exists():
        raise DataError(f"{path}: there is no such folder")
    for folder in (path, path / "photos"):
        if (folder / nerfstudio.FILE_NAME).is_file():
            return nerfstudio.read_nerfstudio(folder)
    raise DataError(f"{path}: found no COLMAP, nerfstudio, Blender, rf3dgs_v0 or dataset layout there")
