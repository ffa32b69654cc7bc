"""Grids of directions: what a spectrum's pixels look at, in the device frame (x forward, y left, z up).

Looking out of the array, row 0 is up and column 0 is left, so a spectrum and a photograph of the same pose overlay.
"""

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import torch
from torch import Tensor

from rf3dgs.core.angles import angle_between, angles_of, direction_of
from rf3dgs.core.errors import InputError
from rf3dgs.core.frames import CAMERA_FROM_DEVICE, Pose

MAX_PIXELS = 64_000_000
BLOCK = 12  # pixels on a side of the blocks that tell which pixels are near a direction
NOWHERE = 9.0  # each coordinate of the direction of a pixel that does not exist: far from every unit vector
GridKind = Literal["pinhole", "equirect", "list"]


@dataclass(frozen=True, eq=False)
class Blocks:
    """Small blocks of neighbouring pixels of a grid.

    pixels `[block, pixel]`: places in the flattened grid, -1 is none. directions `[block, 3, pixel]`: theirs, `NOWHERE`
    where there is none. middles `[block, 3]`: unit vectors. radius `[block]` [rad]: how far pixels are from it; pi of a
    block around the sphere.
    """

    pixels: Tensor
    directions: Tensor
    middles: Tensor
    radius: Tensor

    def near(self, directions: Tensor, cut: float) -> tuple[Tensor, Tensor]:
        """Blocks `[n]` and rows `[n]` of `directions` `[m, 3]`: those that may be within `cut` [rad] of each other."""
        least = torch.cos((cut + self.radius).clamp_max(math.pi)) - 1e-5
        block, row = torch.nonzero(self.middles @ directions.mT >= least[:, None], as_tuple=True)
        return block, row


@dataclass(frozen=True, eq=False)
class DirectionGrid:
    """Directions `[row, col, 3]` (unit vectors, device frame) and their solid angles `[row, col]` [sr].

    `K` `[3, 3]` is the camera matrix in pixels of a pinhole grid, else None. A list of directions is one row whose
    solid angles are given by whoever makes it (zero when unknown).
    """

    kind: GridKind
    directions: Tensor
    solid_angle: Tensor
    K: Tensor | None = None

    @property
    def height(self) -> int:
        return self.directions.shape[0]

    @property
    def width(self) -> int:
        return self.directions.shape[1]

    @property
    def shape(self) -> tuple[int, int]:
        return self.height, self.width

    @property
    def spacing(self) -> float:
        """The largest angle [rad] between neighbouring pixel centres, as seen where pixels are widest."""
        if self.kind == "equirect":
            return max(2 * math.pi / self.width, math.pi / self.height)
        if self.K is not None:
            return float(torch.atan(1.0 / torch.minimum(self.K[0, 0], self.K[1, 1])))
        raise InputError("a list of directions has no pixel spacing; use a pinhole or equirectangular grid")

    @cached_property
    def blocks(self) -> Blocks:
        """The pixels in blocks, by which those near a direction are found without asking all."""
        height, width = self.shape
        tall = min(BLOCK, height)
        number = torch.arange(height * width).reshape(height, width)
        number = torch.nn.functional.pad(number, (0, -width % BLOCK, 0, -height % tall), value=-1)
        pixels = number.reshape(number.shape[0] // tall, tall, number.shape[1] // BLOCK, BLOCK)
        pixels = pixels.transpose(1, 2).reshape(-1, tall * BLOCK)
        members = self.directions.reshape(-1, 3)[torch.where(pixels < 0, pixels[:, :1], pixels)]
        middles = members.mean(1)
        radius = angle_between(members, middles[:, None].expand_as(members)).amax(1)
        radius = torch.where(torch.linalg.vector_norm(middles, dim=-1) < 0.01, torch.full_like(radius, math.pi), radius)
        members = torch.where(pixels[..., None] < 0, torch.full_like(members, NOWHERE), members)
        return Blocks(pixels, members.mT.contiguous(), torch.nn.functional.normalize(middles, dim=-1), radius)

    @cached_property
    def cone(self) -> tuple[Tensor, float]:
        """A direction `[3]` and the angle [rad] about it that holds all directions; pi where they lie all around."""
        every = self.directions.reshape(-1, 3)
        middle = every.mean(0)
        if float(torch.linalg.vector_norm(middle)) < 0.01:
            return torch.tensor([1.0, 0.0, 0.0]), math.pi
        middle = torch.nn.functional.normalize(middle, dim=0)
        return middle, float(angle_between(every, middle.expand_as(every)).amax())

    def same_as(self, other: "DirectionGrid") -> bool:
        """True when both grids look in the same directions, pixel by pixel."""
        same_shape = self.kind == other.kind and self.shape == other.shape
        return same_shape and bool(torch.allclose(self.directions, other.directions, atol=1e-5))

    def pixel_of(self, directions: Tensor) -> tuple[Tensor, Tensor]:
        """Pixel coordinates `[*batch, 2]` as (x, y), centres at +0.5, of device-frame directions; and who is inside."""
        if self.kind == "equirect":
            zenith, azimuth = angles_of(directions)
            x = (math.pi - azimuth) * (self.width / (2 * math.pi))
            y = zenith * (self.height / math.pi)
            return torch.stack((x, y), -1), torch.ones_like(x, dtype=torch.bool)
        if self.K is None:
            raise InputError("a list of directions has no pixels; use a pinhole or equirectangular grid")
        camera = directions @ CAMERA_FROM_DEVICE.to(directions).mT
        ahead = camera[..., 2] > 1e-9
        depth = torch.where(ahead, camera[..., 2], torch.ones_like(camera[..., 2]))
        x = self.K[0, 0] * camera[..., 0] / depth + self.K[0, 2]
        y = self.K[1, 1] * camera[..., 1] / depth + self.K[1, 2]
        inside = ahead & (x >= 0) & (x < self.width) & (y >= 0) & (y < self.height)
        return torch.stack((x, y), -1), inside


def pinhole_grid(width: int, height: int, fov_deg: float | None = None, *, K: Tensor | None = None) -> DirectionGrid:
    """A pinhole grid from a horizontal field of view [deg] or from a camera matrix `K` `[3, 3]` [pixel].

    Solid angles are exact integrals over each pixel's rectangle.
    """
    _check_size(width, height)
    if (fov_deg is None) == (K is None):
        raise InputError("pinhole_grid needs either fov_deg or K, not both and not neither")
    if fov_deg is not None:
        if not 0.0 < fov_deg < 180.0:
            raise InputError(f"fov_deg must lie between 0 and 180 degrees; got {fov_deg}")
        focal = 0.5 * width / math.tan(math.radians(fov_deg) / 2)
        K = torch.tensor([[focal, 0.0, width / 2], [0.0, focal, height / 2], [0.0, 0.0, 1.0]])
    assert K is not None
    K = torch.as_tensor(K, dtype=torch.float32)
    if K.shape != (3, 3) or not bool(torch.isfinite(K).all()) or not bool((K.diagonal() > 0).all()):
        raise InputError(f"K must be [3, 3], finite, with positive focal lengths in pixels; got {K.tolist()}")
    edge_x = (torch.arange(width + 1, dtype=torch.float64) - K[0, 2].double()) / K[0, 0].double()
    edge_y = (torch.arange(height + 1, dtype=torch.float64) - K[1, 2].double()) / K[1, 1].double()
    corner = torch.atan2(edge_x * edge_y[:, None], torch.sqrt(1 + edge_x**2 + edge_y[:, None] ** 2))
    solid_angle = corner[1:, 1:] - corner[:-1, 1:] - corner[1:, :-1] + corner[:-1, :-1]
    x = (torch.arange(width) + 0.5 - K[0, 2]) / K[0, 0]
    y = (torch.arange(height) + 0.5 - K[1, 2]) / K[1, 1]
    camera = torch.stack((x.expand(height, width), y[:, None].expand(height, width), torch.ones(height, width)), -1)
    directions = torch.nn.functional.normalize(camera, dim=-1) @ CAMERA_FROM_DEVICE
    return DirectionGrid("pinhole", directions, solid_angle.float(), K)


def equirect_grid(width: int, height: int) -> DirectionGrid:
    """The whole sphere: azimuth from +pi at the left edge down to -pi, zenith from 0 at the top to pi."""
    _check_size(width, height)
    azimuth = math.pi - (torch.arange(width) + 0.5) * (2 * math.pi / width)
    zenith = (torch.arange(height) + 0.5) * (math.pi / height)
    zenith_of_pixel, azimuth_of_pixel = torch.meshgrid(zenith, azimuth, indexing="ij")
    edge = torch.arange(height + 1, dtype=torch.float64) * (math.pi / height)
    band = (torch.cos(edge[:-1]) - torch.cos(edge[1:])) * (2 * math.pi / width)
    solid_angle = band.float()[:, None].expand(height, width).contiguous()
    return DirectionGrid("equirect", direction_of(zenith_of_pixel, azimuth_of_pixel), solid_angle)


def list_grid(directions: Tensor, solid_angle: Tensor | None = None) -> DirectionGrid:
    """A list of directions `[n, 3]` in the device frame as a grid of one row; `solid_angle` `[n]` [sr]."""
    directions = torch.nn.functional.normalize(torch.as_tensor(directions, dtype=torch.float32), dim=-1)
    if directions.dim() != 2 or directions.shape[-1] != 3:
        raise InputError(f"directions must be [direction, 3]; got {list(directions.shape)}")
    weight = torch.zeros(len(directions)) if solid_angle is None else torch.as_tensor(solid_angle, dtype=torch.float32)
    if weight.shape != directions.shape[:1]:
        raise InputError(f"solid_angle must be [{len(directions)}], one per direction [sr]; got {list(weight.shape)}")
    return DirectionGrid("list", directions[None], weight[None])


def _check_size(width: int, height: int) -> None:
    if width < 1 or height < 1:
        raise InputError(f"a grid needs at least one pixel each way; got {width}x{height}")
    if width * height > MAX_PIXELS:
        raise InputError(f"a grid has at most {MAX_PIXELS // 10**6} million pixels; got {width}x{height}")


@dataclass(frozen=True, eq=False)
class Camera:
    """A pinhole camera: `viewmat` `[4, 4]` camera_from_world, `K` `[3, 3]` [pixel], picture `width` x `height`."""

    viewmat: Tensor
    K: Tensor
    width: int
    height: int

    @classmethod
    def of(cls, pose: Pose, grid: DirectionGrid) -> "Camera":
        """The camera that sees what a pinhole `grid` sees at one `pose`."""
        if grid.K is None:
            raise InputError(f"a camera needs a pinhole grid; got {grid.kind}. view_of makes the view of either grid")
        return cls(_one_viewmat(pose), grid.K, grid.width, grid.height)

    @property
    def pose(self) -> Pose:
        return Pose.from_viewmat(self.viewmat)

    @property
    def position(self) -> Tensor:
        """The camera's centre `[3]` in the world [m]."""
        return _centre(self.viewmat)

    @property
    def grid(self) -> DirectionGrid:
        return pinhole_grid(self.width, self.height, K=self.K)

    def resized(self, width: int, height: int) -> "Camera":
        """The same view with another number of pixels."""
        scale = torch.tensor([width / self.width, height / self.height, 1.0])
        return Camera(self.viewmat, scale[:, None] * self.K, width, height)


@dataclass(frozen=True, eq=False)
class Panorama:
    """The whole sphere at one pose: `viewmat` `[4, 4]` camera_from_world, pixels as in `equirect_grid`."""

    viewmat: Tensor
    width: int
    height: int

    @classmethod
    def of(cls, pose: Pose, grid: DirectionGrid) -> "Panorama":
        """What an equirectangular `grid` sees at one `pose`."""
        if grid.kind != "equirect":
            raise InputError(f"a panorama needs an equirectangular grid; got {grid.kind}")
        return cls(_one_viewmat(pose), grid.width, grid.height)

    @property
    def pose(self) -> Pose:
        return Pose.from_viewmat(self.viewmat)

    @property
    def position(self) -> Tensor:
        """The centre of the sphere `[3]` in the world [m]."""
        return _centre(self.viewmat)

    @property
    def grid(self) -> DirectionGrid:
        return equirect_grid(self.width, self.height)

    def resized(self, width: int, height: int) -> "Panorama":
        """The same sphere with another number of pixels."""
        return Panorama(self.viewmat, width, height)


View = Camera | Panorama


def view_of(pose: Pose, grid: DirectionGrid) -> View:
    """What a pinhole or equirectangular `grid` sees at one `pose`, as the rasterizer takes it."""
    if grid.kind == "list":
        raise InputError("a view needs a pinhole or equirectangular grid; got a list of directions")
    return Camera.of(pose, grid) if grid.kind == "pinhole" else Panorama.of(pose, grid)


def _one_viewmat(pose: Pose) -> Tensor:
    if pose.batch_shape:
        raise InputError(f"a view stands at one pose; got {list(pose.batch_shape)}. Choose one, as in pose[0]")
    return pose.viewmat


def _centre(viewmat: Tensor) -> Tensor:
    return -(viewmat[:3, :3].mT @ viewmat[:3, 3])


def sample_grid(picture: Tensor, grid: DirectionGrid, directions: Tensor) -> Tensor:
    """Bilinear values `[*batch, channel]` of a `[row, col, channel]` picture at device-frame directions.

    Equirectangular pictures wrap around in azimuth and continue over the poles; outside a pinhole the edge is repeated.
    """
    pixel, _ = grid.pixel_of(directions)
    height, width = grid.shape
    x, y = pixel[..., 0] - 0.5, pixel[..., 1] - 0.5
    y0 = torch.floor(y)
    fy = (y - y0)[..., None]
    total = torch.zeros(())
    for dy, wy in ((0, 1 - fy), (1, fy)):
        row, across = (y0 + dy).long(), x
        if grid.kind == "equirect":
            across = torch.where((row < 0) | (row >= height), x + width / 2, x)
            row = torch.where(row < 0, -row - 1, torch.where(row >= height, 2 * height - 1 - row, row))
        row, x0 = row.clamp(0, height - 1), torch.floor(across)
        fx = (across - x0)[..., None]
        for dx, wx in ((0, 1 - fx), (1, fx)):
            col = (x0 + dx).long()
            col = col % width if grid.kind == "equirect" else col.clamp(0, width - 1)
            total = total + wx * wy * picture[row, col]
    return total
