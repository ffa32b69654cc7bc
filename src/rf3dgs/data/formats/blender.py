"""Blender / NeRF-synthetic: `transforms_{train,val,test}.json`, one `camera_angle_x`, file names without a suffix."""

from pathlib import Path

from rf3dgs.core.errors import DataError
from rf3dgs.data.formats.nerfstudio import frames_of, photo_of_frame
from rf3dgs.data.photo import PhotoSet
from rf3dgs.data.safe import read_json

SPLITS = {"train": "train", "val": "validation", "test": "test"}


def files_of(path: Path) -> dict[str, Path]:
    """The transforms files that the folder has, by role."""
    files = {role: path / f"transforms_{split}.json" for split, role in SPLITS.items()}
    return {role: file for role, file in files.items() if file.is_file()}


def read_blender(path: str | Path) -> PhotoSet:
    """The photos of a NeRF-synthetic folder with the roles of its three files; transparent pixels lie over black."""
    path = Path(path)
    files = files_of(path)
    if not files:
        raise DataError(f"{path}: expected transforms_train.json, transforms_val.json or transforms_test.json")
    photos, roles = [], []
    for role, file in files.items():
        content = read_json(file)
        if "camera_angle_x" not in content:
            raise DataError(f'{file}: expected "camera_angle_x" [rad]; this is no Blender transforms file')
        for index, frame in enumerate(frames_of(content, file)):
            photos.append(photo_of_frame(content, frame, index, file))
            roles.append(role)
    return PhotoSet(tuple(photos), "blender", roles=tuple(roles))
