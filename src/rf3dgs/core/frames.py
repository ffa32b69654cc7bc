"""Frames and poses: the only file of the package that flips an axis.

World: z up. Device (transmitter, receiver, array): x forward, y left, z up. Camera: x right, y down, z forward.
OpenGL camera: x right, y up, z backward. Matrices are named `target_from_source`; quaternions are unit `wxyz`.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from torch import Tensor

from rf3dgs.core.errors import InputError

CAMERA_FROM_DEVICE = torch.tensor([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])
OPENGL_FROM_CAMERA = torch.diag(torch.tensor([1.0, -1.0, -1.0]))


def matrix_from_quaternion(quaternion: Tensor) -> Tensor:
    """Rotation matrices `[*batch, 3, 3]` of `wxyz` quaternions `[*batch, 4]`, which are normalised first."""
    w, x, y, z = (quaternion / torch.linalg.vector_norm(quaternion, dim=-1, keepdim=True)).unbind(-1)
    rows = (
        torch.stack((1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)), -1),
        torch.stack((2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)), -1),
        torch.stack((2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)), -1),
    )
    return torch.stack(rows, -2)


def quaternion_from_matrix(matrix: Tensor) -> Tensor:
    """`wxyz` quaternions `[*batch, 4]` with w >= 0 of rotation matrices `[*batch, 3, 3]`.

    The largest of the four components is computed from a square root, the others from it, so that no case loses digits.
    """
    m = matrix
    squares = torch.stack(
        (
            1 + m[..., 0, 0] + m[..., 1, 1] + m[..., 2, 2],
            1 + m[..., 0, 0] - m[..., 1, 1] - m[..., 2, 2],
            1 - m[..., 0, 0] + m[..., 1, 1] - m[..., 2, 2],
            1 - m[..., 0, 0] - m[..., 1, 1] + m[..., 2, 2],
        ),
        -1,
    )
    wx, wy, wz = m[..., 2, 1] - m[..., 1, 2], m[..., 0, 2] - m[..., 2, 0], m[..., 1, 0] - m[..., 0, 1]
    xy, xz, yz = m[..., 0, 1] + m[..., 1, 0], m[..., 0, 2] + m[..., 2, 0], m[..., 1, 2] + m[..., 2, 1]
    by_largest = torch.stack(
        (
            torch.stack((squares[..., 0], wx, wy, wz), -1),
            torch.stack((wx, squares[..., 1], xy, xz), -1),
            torch.stack((wy, xy, squares[..., 2], yz), -1),
            torch.stack((wz, xz, yz, squares[..., 3]), -1),
        ),
        -2,
    )
    index = squares.argmax(-1)[..., None, None].expand(*squares.shape[:-1], 1, 4)
    chosen = by_largest.gather(-2, index).squeeze(-2)
    chosen = chosen / torch.linalg.vector_norm(chosen, dim=-1, keepdim=True)
    return torch.where(chosen[..., :1] < 0, -chosen, chosen)


def is_rotation(matrix: Tensor, *, tolerance: float = 1e-4) -> Tensor:
    """True where `[*batch, 3, 3]` is orthonormal and right-handed."""
    identity = torch.eye(3, dtype=matrix.dtype)
    orthonormal = (matrix @ matrix.mT - identity).abs().amax((-2, -1)) < tolerance
    return orthonormal & (torch.linalg.det(matrix) > 0)


@dataclass(frozen=True, eq=False)
class Pose:
    """Where a device stands and how it is turned, in the world frame.

    `position` `[*batch, 3]` [m]; `orientation` `[*batch, 4]`, the unit quaternion `wxyz` of `world_from_device`
    (device x forward, y left, z up). The two are broadcast against each other; both are copied, so that a pose stays
    what it was when the caller's array changes.
    """

    position: Tensor
    orientation: Tensor

    def __init__(self, position: Tensor | Sequence, orientation: Tensor | Sequence = (1.0, 0.0, 0.0, 0.0)) -> None:
        position = torch.as_tensor(position, dtype=torch.float32)
        orientation = torch.as_tensor(orientation, dtype=torch.float32)
        if position.shape[-1:] != (3,):
            raise InputError(f"position must be [*batch, 3] in metres; got shape {list(position.shape)}")
        if orientation.shape[-1:] != (4,):
            raise InputError(f"orientation must be [*batch, 4], a wxyz quaternion; got {list(orientation.shape)}")
        if not bool(torch.isfinite(position).all()):
            raise InputError("position has NaN or infinite values; remove those poses or mend their source")
        length = torch.linalg.vector_norm(orientation, dim=-1, keepdim=True)
        if not bool((torch.isfinite(length) & (length > 1e-6)).all()):
            raise InputError("orientation has a zero or non-finite quaternion; use (1, 0, 0, 0) for no rotation")
        try:  # torch's own broadcast_shapes would import sympy
            batch = np.broadcast_shapes(position.shape[:-1], orientation.shape[:-1])
        except ValueError as error:
            raise InputError(
                f"position and orientation must have batches that fit together; got {list(position.shape)} and "
                f"{list(orientation.shape)}. Give one orientation, or one for each position"
            ) from error
        object.__setattr__(self, "position", position.clone().expand(*batch, 3))
        object.__setattr__(self, "orientation", (orientation / length).expand(*batch, 4))

    @classmethod
    def from_matrix(cls, position: Tensor | Sequence, world_from_device: Tensor) -> "Pose":
        """A pose from a rotation matrix `[*batch, 3, 3]`; refuses what is not a proper rotation."""
        matrix = torch.as_tensor(world_from_device, dtype=torch.float32)
        if not bool(is_rotation(matrix).all()):
            raise InputError(
                "world_from_device must be a rotation: orthonormal with determinant +1. "
                "A left-handed or scaled frame must be converted first"
            )
        return cls(position, quaternion_from_matrix(matrix))

    @classmethod
    def from_viewmat(cls, viewmat: Tensor) -> "Pose":
        """The pose of a camera given `camera_from_world` `[*batch, 4, 4]` (x right, y down, z forward)."""
        viewmat = torch.as_tensor(viewmat, dtype=torch.float32)
        world_from_camera = viewmat[..., :3, :3].mT
        position = -(world_from_camera @ viewmat[..., :3, 3:]).squeeze(-1)
        return cls.from_matrix(position, world_from_camera @ CAMERA_FROM_DEVICE)

    @classmethod
    def look_at(cls, position: Tensor | Sequence, target: Tensor | Sequence) -> "Pose":
        """A pose at `position` `[*batch, 3]` whose forward axis points to `target` `[*batch, 3]` [m] and left is level.

        Straight up and down the left axis is the world's y. InputError where both are the same point.
        """
        position = torch.as_tensor(position, dtype=torch.float32)
        forward = torch.as_tensor(target, dtype=torch.float32) - position
        distance = torch.linalg.vector_norm(forward, dim=-1, keepdim=True)
        if not bool(torch.isfinite(distance).all()):
            raise InputError("look_at needs finite numbers [m]; position or target has NaN or infinity")
        if not bool((distance > 1e-6).all()):
            raise InputError("look_at needs a target away from the position; both are the same point")
        forward = forward / distance
        up = torch.tensor([0.0, 0.0, 1.0]).expand_as(forward)
        left = torch.linalg.cross(up, forward, dim=-1)
        length = torch.linalg.vector_norm(left, dim=-1, keepdim=True)
        sideways = torch.tensor([0.0, 1.0, 0.0]).expand_as(forward)
        left = torch.where(length > 1e-6, left / length.clamp_min(1e-6), sideways)
        up = torch.linalg.cross(forward, left, dim=-1)
        return cls.from_matrix(position, torch.stack((forward, left, up), -1))

    @classmethod
    def from_yaw(cls, position: Tensor | Sequence, yaw: Tensor | float) -> "Pose":
        """A level pose turned by `yaw` [rad] about the world's z axis."""
        half = 0.5 * torch.as_tensor(yaw, dtype=torch.float32)
        zero = torch.zeros_like(half)
        return cls(position, torch.stack((torch.cos(half), zero, zero, torch.sin(half)), -1))

    @classmethod
    def scatter(cls, bounds: tuple[Sequence[float], Sequence[float]], count: int, seed: int) -> "Pose":
        """`count` level poses drawn uniformly in a box ((x, y, z) low, (x, y, z) high) [m]."""
        low, high = (torch.tensor(corner, dtype=torch.float32) for corner in bounds)
        if not bool((high >= low).all()):
            raise InputError(f"bounds must be (low, high) corners with low <= high; got {bounds}")
        generator = torch.Generator().manual_seed(seed)
        return cls(low + (high - low) * torch.rand(count, 3, generator=generator))

    @cached_property
    def world_from_device(self) -> Tensor:
        """Rotation `[*batch, 3, 3]`; not to be changed in place."""
        return matrix_from_quaternion(self.orientation)

    @property
    def viewmat(self) -> Tensor:
        """`camera_from_world` `[*batch, 4, 4]` of a camera looking along the device's forward axis."""
        camera_from_world = CAMERA_FROM_DEVICE @ self.world_from_device.mT
        translation = -(camera_from_world @ self.position.unsqueeze(-1))
        top = torch.cat((camera_from_world, translation), -1)
        bottom = torch.tensor([0.0, 0.0, 0.0, 1.0]).expand(*top.shape[:-2], 1, 4)
        return torch.cat((top, bottom), -2)

    @property
    def batch_shape(self) -> tuple[int, ...]:
        return tuple(self.position.shape[:-1])

    def flat(self) -> "Pose":
        """The same poses with one axis `[pose]`, however many batch axes they have; one pose becomes a list of one."""
        return Pose(self.position.reshape(-1, 3), self.orientation.reshape(-1, 4))

    def __getitem__(self, index: int | slice | Tensor) -> "Pose":
        if not self.batch_shape:
            raise InputError("this is one pose; there is no axis of poses to index")
        return Pose(self.position[index], self.orientation[index])

    def __len__(self) -> int:
        if not self.batch_shape:
            raise InputError("this is one pose and has no length")
        return self.position.shape[0]

    def __bool__(self) -> bool:
        return True

    def turned(self, yaw: float, *, about: Sequence[float] = (0.0, 0.0, 0.0)) -> "Pose":
        """The pose after the whole world turns by `yaw` [rad] about the vertical axis through `about`."""
        turn = Pose.from_yaw(about, yaw).world_from_device
        centre = torch.as_tensor(about, dtype=torch.float32)
        position = (self.position - centre) @ turn.mT + centre
        return Pose.from_matrix(position, turn @ self.world_from_device)

    def to_world(self, direction: Tensor) -> Tensor:
        """Directions `[*batch, *n, 3]` given in the device frame, in the world frame."""
        return _rotate(self.world_from_device, direction)

    def to_device(self, direction: Tensor) -> Tensor:
        """Directions `[*batch, *n, 3]` given in the world frame, in the device frame."""
        return _rotate(self.world_from_device.mT, direction)


def _rotate(matrix: Tensor, direction: Tensor) -> Tensor:
    extra = direction.dim() - (matrix.dim() - 1)
    matrix = matrix.reshape(*matrix.shape[:-2], *([1] * max(extra, 0)), 3, 3)
    return (matrix.to(direction.dtype) @ direction.unsqueeze(-1)).squeeze(-1)


def viewmat_from_opengl(world_from_opengl: Tensor) -> Tensor:
    """`camera_from_world` `[*batch, 4, 4]` of an OpenGL camera-to-world matrix (nerfstudio, Blender)."""
    world_from_opengl = torch.as_tensor(world_from_opengl, dtype=torch.float32)
    world_from_camera = world_from_opengl[..., :3, :3] @ OPENGL_FROM_CAMERA
    rotation = world_from_camera.mT
    translation = -(rotation @ world_from_opengl[..., :3, 3:])
    top = torch.cat((rotation, translation), -1)
    bottom = torch.tensor([0.0, 0.0, 0.0, 1.0]).expand(*top.shape[:-2], 1, 4)
    return torch.cat((top, bottom), -2)


def opengl_from_viewmat(viewmat: Tensor) -> Tensor:
    """The OpenGL camera-to-world matrix `[*batch, 4, 4]` of `camera_from_world`: inverse of `viewmat_from_opengl`."""
    rotation = viewmat[..., :3, :3].mT
    position = -(rotation @ viewmat[..., :3, 3:])
    top = torch.cat((rotation @ OPENGL_FROM_CAMERA, position), -1)
    bottom = torch.tensor([0.0, 0.0, 0.0, 1.0]).expand(*top.shape[:-2], 1, 4)
    return torch.cat((top, bottom), -2)


def mitsuba_from_viewmat(viewmat: Tensor) -> Tensor:
    """The Mitsuba sensor-to-world matrix `[*batch, 4, 4]` (x left, y up, z forward) of `camera_from_world`."""
    rotation = viewmat[..., :3, :3].mT
    position = -(rotation @ viewmat[..., :3, 3:])
    flip = torch.diag(torch.tensor([-1.0, -1.0, 1.0], dtype=viewmat.dtype))
    top = torch.cat((rotation @ flip, position), -1)
    bottom = torch.tensor([0.0, 0.0, 0.0, 1.0], dtype=viewmat.dtype).expand(*top.shape[:-2], 1, 4)
    return torch.cat((top, bottom), -2)
