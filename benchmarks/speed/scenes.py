"""A synthetic room of flattened Gaussians and views of it."""

import math
from functools import cache

import torch
from torch import Tensor

from rf3dgs.core.frames import Pose
from rf3dgs.core.grids import Camera, Panorama, equirect_grid, pinhole_grid
from rf3dgs.splats.detail import level_of_detail
from rf3dgs.splats.gaussians import Gaussians

ROOM = (14.0, 15.0, 3.5)  # m


def room(count: int, *, channels: int = 3, seed: int = 0) -> dict[str, Tensor]:
    """`count` Gaussians on the walls of the room, flat against them, their size chosen so that they cover the walls.

    Activated means, quats, scales, opacities and degree-3 harmonics.
    """
    generator = torch.Generator().manual_seed(seed)
    size = torch.tensor(ROOM)
    means = torch.rand(count, 3, generator=generator) * size
    area = torch.tensor([ROOM[1] * ROOM[2], ROOM[0] * ROOM[2], ROOM[0] * ROOM[1]])
    axis = torch.multinomial(area, count, replacement=True, generator=generator)
    far = torch.randint(0, 2, (count,), generator=generator)
    index = torch.arange(count)
    means[index, axis] = far * size[axis]
    spread = 0.03 * (200_000 / count) ** 0.5
    scales = spread * torch.exp(0.3 * torch.randn(count, 3, generator=generator))
    scales[index, axis] = 0.1 * spread
    quats = torch.tensor([1.0, 0.0, 0.0, 0.0]).repeat(count, 1)
    opacities = 0.1 + 0.88 * torch.rand(count, generator=generator)
    sh = 0.2 * torch.randn(count, 16, channels, generator=generator)
    return {"means": means, "quats": quats, "scales": scales, "opacities": opacities, "sh": sh}


@cache
def merged_room(count: int = 1_000_000) -> dict[str, Tensor]:
    """The room of `count` Gaussians of one channel, twice as large so that its walls are closed, at a level of detail
    of one degree for receivers at 80 of `poses`.
    """
    scene = room(count, channels=1)
    log_scales, logits = scene["scales"].log() + math.log(2.0), torch.logit(scene["opacities"])
    whole = Gaussians(scene["means"], scene["quats"], log_scales, logits, scene["sh"])
    places = torch.stack([pose.position for pose in poses(80)])
    merged = level_of_detail(whole, places, pixel=math.radians(1.0)).gaussians
    shapes = {"means": merged.means, "quats": merged.quats, "scales": merged.scales}
    return shapes | {"opacities": merged.opacities, "sh": merged.sh}


def poses(count: int, *, seed: int = 0) -> list[Pose]:
    """Where a visitor looks about: at least 1 m from the walls, 1.2 to 2 m high, any way, a little up or down."""
    generator = torch.Generator().manual_seed(seed)
    low, high = torch.tensor([1.0, 1.0, 1.2]), torch.tensor([ROOM[0] - 1.0, ROOM[1] - 1.0, 2.0])
    result = []
    for _ in range(count):
        place = low + (high - low) * torch.rand(3, generator=generator)
        yaw, pitch = (2 * math.pi, 0.4) * (torch.rand(2, generator=generator).numpy() - (0.0, 0.5))
        ahead = torch.tensor([math.cos(yaw), math.sin(yaw), math.tan(pitch)], dtype=torch.float32)
        result.append(Pose.look_at(position=tuple(place.tolist()), target=tuple((place + ahead).tolist())))
    return result


def cameras_of(count: int, width: int = 300, height: int = 200, *, seed: int = 0) -> list[Camera]:
    """Pinhole cameras of 90 degrees at `poses`."""
    return [Camera.of(pose, pinhole_grid(width, height, 90.0)) for pose in poses(count, seed=seed)]


def panoramas(count: int, width: int = 360, height: int = 180, *, seed: int = 0) -> list[Panorama]:
    """Whole spheres at `poses`."""
    return [Panorama.of(pose, equirect_grid(width, height)) for pose in poses(count, seed=seed)]
