"""The walks of a camera through a scene."""

import math
from typing import NamedTuple

import torch
from torch import Tensor

from rf3dgs.core.errors import InputError
from rf3dgs.core.frames import Pose
from rf3dgs.core.grids import Camera, DirectionGrid, pinhole_grid
from rf3dgs.propagation.config import PhotoConfig
from rf3dgs.propagation.sites.scene import Scene

REACH = 0.8
"""How far the walk goes towards the edge of `camera_bounds`, as a share of half its size."""
SWAY = 0.3
"""How far camera heights swing about the middle of `camera_bounds`, as a share of half its height."""
PITCH_DEG, NOD_DEG = -3.0, 7.0
"""Mean pitch of the cameras, upwards positive, and how far it swings about it."""
SWAYS, NODS = 7, 5
"""Swings of height and of pitch in one round."""
CLEARANCE = 0.45
"""Distance of the cameras from every surface [m]."""


class Round(NamedTuple):
    """One part of a walk: its share of the photographs, how often it goes round, where it starts and ends (shares of
    half the size of `camera_bounds`), its height (from -1, low, to 1), where the camera looks: degrees to the left of
    straight across, and up."""

    share: float
    turns: int
    reach: tuple[float, float]
    height: float
    aside_deg: float
    pitch_deg: float


ROUNDS = (
    Round(0.2, 1, (0.5, 0.5), 0.0, 180.0, 0.0),
    Round(0.25, 2, (0.95, 0.3), 0.8, 90.0, -58.0),
    Round(0.25, 2, (0.95, 0.3), -0.5, 90.0, 58.0),
)
"""What the walk "coverage" adds to the level round: looking out at the near wall, down at the floor, up at the ceiling.
"""


def camera_tour(scene: Scene, count: int, seed: int, config: PhotoConfig | None = None) -> list[Camera]:
    """`count` cameras of one walk; `config.walk` says which.

    level: once round the middle of `camera_bounds`, in equal steps on a rounded rectangle, looking across it; height
    and pitch swing slowly, so that neighbours see nearly the same from places a step apart, and every wall is seen from
    the far side. coverage: three tenths of it, and the `ROUNDS`.
    Where something stands in the way the camera steps towards the middle, or, when all of that is blocked, to the
    nearest of many free places drawn with `seed`.
    """
    config = PhotoConfig() if config is None else config
    if config.walk not in ("level", "coverage"):
        raise InputError(f'the walk must be "level" or "coverage"; got {config.walk!r}')
    grid = pinhole_grid(config.width, config.height, config.fov_deg)
    if config.walk == "level":
        return _level(scene, count, seed, grid)
    counts = [round(part.share * count) for part in ROUNDS]
    cameras = _level(scene, count - sum(counts), seed, grid)
    for part, number in zip(ROUNDS, counts, strict=True):
        cameras += _round(scene, part, number, seed, grid)
    return cameras


def _level(scene: Scene, count: int, seed: int, grid: DirectionGrid) -> list[Camera]:
    low, high = (torch.tensor(corner, dtype=torch.float64) for corner in scene.camera_bounds)
    middle, half = (low + high) / 2, (high - low) / 2
    around = _rounded_rectangle(count) * REACH * half[:2]
    part = torch.arange(count, dtype=torch.float64) * (2 * math.pi / max(count, 1))
    height = SWAY * half[2] * torch.sin(SWAYS * part)
    pitch = torch.deg2rad(PITCH_DEG + NOD_DEG * torch.sin(NODS * part))
    ahead = -torch.nn.functional.normalize(around, dim=-1)
    return _cameras(scene, middle, torch.cat((around, height[:, None]), -1), ahead, pitch, seed, grid)


def _round(scene: Scene, part: Round, count: int, seed: int, grid: DirectionGrid) -> list[Camera]:
    low, high = (torch.tensor(corner, dtype=torch.float64) for corner in scene.camera_bounds)
    middle, half = (low + high) / 2, (high - low) / 2
    along = torch.arange(count) * part.turns % max(count, 1)
    reach = torch.linspace(*part.reach, count, dtype=torch.float64)[:, None]
    around = _rounded_rectangle(count)[along] * reach * half[:2]
    across = -torch.nn.functional.normalize(around, dim=-1)
    cosine, sine = math.cos(math.radians(part.aside_deg)), math.sin(math.radians(part.aside_deg))
    ahead = across @ torch.tensor([[cosine, sine], [-sine, cosine]], dtype=torch.float64)
    height = torch.full((count, 1), part.height, dtype=torch.float64) * half[2]
    pitch = torch.full((count,), math.radians(part.pitch_deg), dtype=torch.float64)
    return _cameras(scene, middle, torch.cat((around, height), -1), ahead, pitch, seed, grid)


def _cameras(
    scene: Scene, middle: Tensor, place: Tensor, ahead: Tensor, pitch: Tensor, seed: int, grid: DirectionGrid
) -> list[Camera]:
    """Cameras at `place` `[n, 3]`, given from the middle, or nearer to it where something is in the way."""
    count = len(place)
    if not count:
        return []
    nearer = torch.linspace(1.0, 0.3, 36, dtype=torch.float64)[:, None, None]
    level = torch.cat((nearer * place[:, :2], place[:, 2:].expand(len(nearer), -1, 1)), -1)
    places = (middle + level).float()
    free = scene.free(places, CLEARANCE)
    chosen = places[free.int().argmax(0), torch.arange(count)]
    blocked = ~free.any(0)
    if bool(blocked.any()):
        pool = scene.free_points(scene.camera_bounds, 4000, seed, clearance=CLEARANCE)
        chosen = torch.where(blocked[:, None], pool[torch.cdist(chosen, pool).argmin(-1)], chosen)
    forward = torch.cat((ahead, torch.tan(pitch)[:, None]), -1).float()
    return [Camera.of(Pose.look_at(at, at + way), grid) for at, way in zip(chosen, forward, strict=True)]


def _rounded_rectangle(count: int) -> Tensor:
    """Points `[count, 2]` in equal steps along x^4 + y^4 = 1, from the x axis counter-clockwise."""
    angle = torch.linspace(0.0, 2 * math.pi, 4001, dtype=torch.float64)
    curve = torch.stack((torch.cos(angle), torch.sin(angle)), -1)
    curve = curve / curve.pow(4).sum(-1, keepdim=True) ** 0.25
    length = torch.cat((curve.new_zeros(1), torch.linalg.vector_norm(curve[1:] - curve[:-1], dim=-1).cumsum(0)))
    at = torch.arange(count, dtype=torch.float64) * (length[-1] / max(count, 1))
    return curve[torch.searchsorted(length, at)]
