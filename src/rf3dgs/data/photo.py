"""`Photo`: a picture and the camera that took it."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from rf3dgs.core.errors import DataError, InputError
from rf3dgs.core.grids import Camera
from rf3dgs.data.safe import picture_size, read_picture


@dataclass(frozen=True, eq=False)
class Photo:
    """A picture named `name`, taken by `camera`, in the file `path` or in memory as `pixels` `[row, col, 3]`, 0 to 1.

    `note` says what a reader must know, such as "uncalibrated" for pictures of radio levels without units.
    """

    name: str
    camera: Camera
    path: Path | None = None
    pixels: Tensor | None = None
    note: str = ""

    def load(self) -> Tensor:
        """The picture `[row, col, 3]`, 0 to 1; DataError when the file is damaged or not of the camera's size."""
        expected = (self.camera.height, self.camera.width, 3)
        if self.pixels is not None:
            if tuple(self.pixels.shape) != expected:
                raise InputError(f"photo {self.name}: pixels must be {list(expected)}; got {list(self.pixels.shape)}")
            return self.pixels
        if self.path is None:
            raise InputError(f"photo {self.name} has neither a file nor pixels; give it one of them")
        picture = torch.from_numpy(read_picture(self.path))
        if tuple(picture.shape) != expected:
            size = f"{picture.shape[1]}x{picture.shape[0]}"
            raise DataError(f"{self.path}: expected {self.camera.width}x{self.camera.height} pixels; got {size}")
        return picture.float() / 255.0


@dataclass(frozen=True, eq=False)
class PhotoSet:
    """What a reader found: `photos`, the `layout` by name ("colmap", "nerfstudio", "blender", "rf3dgs_v0", "native").

    `points` `[n, 3]` and `colours` `[n, 3]` (0 to 1) are the reconstruction's, when it has them. `roles` is one of
    "train", "validation", "test" per photo when the layout has a split. `notes` are sentences for people: what was
    assumed or left out. The world of photogrammetry has arbitrary scale and tilt until it is aligned.
    """

    photos: tuple[Photo, ...]
    layout: str
    points: Tensor | None = None
    colours: Tensor | None = None
    roles: tuple[str, ...] | None = None
    notes: tuple[str, ...] = ()

    def __iter__(self) -> Iterator[Photo]:
        return iter(self.photos)

    def __len__(self) -> int:
        return len(self.photos)

    def __getitem__(self, index: int) -> Photo:
        return self.photos[index]


def photo_of_file(name: str, camera: Camera, path: Path, *, note: str = "") -> Photo:
    """A photo whose camera fits its file: intrinsics are scaled when the file is larger or smaller by one factor."""
    width, height = picture_size(path)
    if (width, height) != (camera.width, camera.height):
        if abs(width * camera.height - height * camera.width) > max(width, height, camera.width, camera.height) // 2:
            raise DataError(
                f"{path}: has {width}x{height} pixels, but its camera {camera.width}x{camera.height}; "
                "expected the same picture at one scale. Use the pictures the cameras were made from"
            )
        camera = camera.resized(width, height)
    return Photo(name, camera, path, note=note)


def check_camera(viewmat: Tensor, K: Tensor, *, where: str) -> None:
    """Refuse a camera that is not finite, not rigid or has no focal length: DataError naming `where` it came from.

    `viewmat` `[4, 4]` is camera_from_world, `K` `[3, 3]` in pixels.
    """
    if not bool(torch.isfinite(viewmat).all() and torch.isfinite(K).all()):
        raise DataError(f"{where}: the camera pose or intrinsics hold NaN or infinity; remove that picture")
    rotation = viewmat[:3, :3].double()
    wrong = (rotation @ rotation.mT - torch.eye(3, dtype=torch.float64)).abs().max() > 1e-3
    if bool(wrong) or float(torch.linalg.det(rotation)) < 0:
        raise DataError(
            f"{where}: the camera pose is no rotation with determinant +1; remove scale and mirroring from it"
        )
    if not (float(K[0, 0]) > 0 and float(K[1, 1]) > 0):
        raise DataError(f"{where}: the focal lengths must be positive pixels; got {float(K[0, 0])}, {float(K[1, 1])}")
