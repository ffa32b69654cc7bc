"""The whole sphere as six pinhole pictures on the faces of a cube, for rasterizers that know pinholes alone."""

import torch
from torch import Tensor

from rf3dgs.core.frames import Pose
from rf3dgs.core.grids import Camera, DirectionGrid, pinhole_grid, sample_grid

FACE_FORWARD_UP = (
    ((1, 0, 0), (0, 0, 1)),
    ((0, 1, 0), (0, 0, 1)),
    ((-1, 0, 0), (0, 0, 1)),
    ((0, -1, 0), (0, 0, 1)),
    ((0, 0, 1), (-1, 0, 0)),
    ((0, 0, -1), (1, 0, 0)),
)


def face_grid(size: int, *, margin: int = 1) -> DirectionGrid:
    """One cube face of `size` x `size` pixels over 90 degrees, with `margin` more pixels on every side.

    The margin lets neighbouring faces overlap, so that interpolation needs no seam rules.
    """
    focal = 0.5 * size
    centre = 0.5 * size + margin
    K = torch.tensor([[focal, 0.0, centre], [0.0, focal, centre], [0.0, 0.0, 1.0]])
    return pinhole_grid(size + 2 * margin, size + 2 * margin, K=K)


def device_from_faces() -> Tensor:
    """Rotations `[6, 3, 3]` from each face's frame to the device frame: front, left, back, right, up, down."""
    forward = torch.tensor([face[0] for face in FACE_FORWARD_UP], dtype=torch.float32)
    up = torch.tensor([face[1] for face in FACE_FORWARD_UP], dtype=torch.float32)
    return torch.stack((forward, torch.linalg.cross(up, forward, dim=-1), up), -1)


def face_cameras(pose: Pose, size: int, *, margin: int = 1) -> list[Camera]:
    """The six cameras that see the whole sphere around one pose."""
    grid = face_grid(size, margin=margin)
    rotations = pose.world_from_device @ device_from_faces()
    return [Camera.of(Pose.from_matrix(pose.position, rotation), grid) for rotation in rotations]


def sample_faces(faces: Tensor, size: int, directions: Tensor, *, margin: int = 1) -> Tensor:
    """Values `[*batch, channel]` at device-frame directions of six face pictures `[6, row, col, channel]`."""
    rotations = device_from_faces().to(directions)
    along = directions @ rotations[:, :, 0].mT
    face = along.argmax(-1)
    grid = face_grid(size, margin=margin)
    result = faces.new_zeros(*directions.shape[:-1], faces.shape[-1])
    for index in range(6):
        chosen = face == index
        local = directions[chosen] @ rotations[index]
        result[chosen] = sample_grid(faces[index], grid, local)
    return result
