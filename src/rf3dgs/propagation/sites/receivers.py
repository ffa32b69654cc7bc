"""Where receivers stand: drawn at random, on a grid, or along a walked route, always clear of every surface."""

import math

import torch
from torch import Tensor

from rf3dgs.core.errors import InputError
from rf3dgs.core.frames import Pose
from rf3dgs.propagation.config import ReceiverConfig
from rf3dgs.propagation.sites.scene import Bounds, Scene

COUNT = 72
"""Receivers that are drawn unless a number is given."""
MOST = 1_000_000
"""Largest number of places that are looked at."""


def receivers_of(scene: Scene, config: ReceiverConfig | None = None) -> Pose:
    """Poses `[rx]` of the receivers that `config` describes; the same ones on every run.

    random: drawn in the scene's `rx_bounds`, level. grid: level, rows along x, only places that are free. route: every
    `speed * interval` metres from the first waypoint on, looking where the walk goes.
    Raises InputError for values out of range, when no place is free, and for a route that leaves the scene or comes
    closer to an object than the clearance, naming both.
    """
    config = ReceiverConfig() if config is None else config
    count = COUNT if config.count is None else config.count
    _check(config, count)
    if config.kind == "route":
        return _walked(scene, config)
    bounds = _at_height(scene.rx_bounds, config.height)
    if config.kind == "grid":
        return Pose(_grid(scene, bounds, config))
    return Pose(scene.free_points(bounds, count, config.seed, clearance=config.clearance))


def _check(config: ReceiverConfig, count: int) -> None:
    if config.kind not in ("random", "grid", "route"):
        raise InputError(f'receivers are "random", on a "grid" or on a "route"; got {config.kind!r}')
    for name in ("spacing", "speed", "interval"):
        value = getattr(config, name)
        if not 0.0 < value < math.inf:
            raise InputError(f"receivers need a positive {name}; got {value}")
    if not 0.0 <= config.clearance < math.inf or not 1 <= count <= MOST:
        raise InputError(
            f"receivers need a clearance of at least 0 m and a count from 1 to {MOST}; "
            f"got {config.clearance} and {count}"
        )


def _at_height(bounds: Bounds, height: float | None) -> Bounds:
    """The bounds, or the part of them at one height [m]."""
    if height is None:
        return bounds
    (x0, y0, _), (x1, y1, _) = bounds
    return (x0, y0, height), (x1, y1, height)


def _grid(scene: Scene, bounds: Bounds, config: ReceiverConfig) -> Tensor:
    """Free places `[rx, 3]` of a grid that lies in the middle of the bounds, row after row along x."""
    (x0, y0, z0), (x1, y1, z1) = bounds
    cols, rows = (int((high - low) / config.spacing + 1e-9) + 1 for low, high in ((x0, x1), (y0, y1)))
    if rows * cols > MOST:
        raise InputError(
            f"a grid of {config.spacing} m has {rows} x {cols} places in the scene {scene.name!r}; at most {MOST} are "
            "looked at, choose a wider spacing"
        )
    x = (x0 + x1) / 2 + config.spacing * (torch.arange(cols) - (cols - 1) / 2)
    y = (y0 + y1) / 2 + config.spacing * (torch.arange(rows) - (rows - 1) / 2)
    level = torch.full((rows, cols), (z0 + z1) / 2)
    places = torch.stack((x.expand(rows, cols), y[:, None].expand(rows, cols), level), -1).reshape(-1, 3)
    places = places[(places - scene.tx.position).norm(dim=-1) > 1.0]
    places = places[scene.free(places, config.clearance)]
    if not len(places):
        raise InputError(
            f"scene {scene.name!r} has no free place on a grid of {config.spacing} m with {config.clearance} m "
            "clearance; choose a smaller spacing or clearance"
        )
    return places


def _walked(scene: Scene, config: ReceiverConfig) -> Pose:
    """Poses along the straight lines between the waypoints."""
    corners = torch.tensor(config.route, dtype=torch.float64).reshape(-1, 2) if config.route else torch.empty(0, 2)
    lengths = (corners[1:] - corners[:-1]).norm(dim=-1)
    if len(corners) < 2 or not bool(torch.isfinite(corners).all()) or not bool((lengths > 0).all()):
        raise InputError(f"a route needs two or more different waypoints (x, y) in metres; got {list(config.route)}")
    step = config.speed * config.interval
    total = float(lengths.sum())
    if total / step > MOST:
        raise InputError(f"a route of {total:g} m in steps of {step:g} m has more than {MOST} places; walk faster")
    walked = torch.arange(int(total / step + 1e-9) + 1, dtype=torch.float64) * step
    ends = lengths.cumsum(0)
    leg = torch.searchsorted(ends, walked).clamp_max(len(lengths) - 1)
    ahead = (corners[1:] - corners[:-1]) / lengths[:, None]
    place = corners[leg] + (walked - (ends - lengths)[leg])[:, None] * ahead[leg]
    height = (scene.rx_bounds[0][2] + scene.rx_bounds[1][2]) / 2 if config.height is None else config.height
    position = torch.cat((place, torch.full((len(place), 1), height, dtype=torch.float64)), -1).float()
    _refuse_collisions(scene, position, config.clearance)
    forward = torch.cat((ahead[leg], torch.zeros(len(leg), 1)), -1).float()
    return Pose.look_at(position, position + forward)


def _refuse_collisions(scene: Scene, position: Tensor, clearance: float) -> None:
    blocked = ~scene.free(position, clearance)
    if not bool(blocked.any()):
        return
    index = int(blocked.int().argmax())
    where = "(" + ", ".join(f"{value:.2f}" for value in position[index].tolist()) + ")"
    occupant = scene.occupant(position[index])
    if occupant == "outside":
        raise InputError(f"the route leaves the scene {scene.name!r} at {where} m; keep its waypoints inside")
    name, distance = scene.nearest(position[index])
    how = f"is inside {occupant!r}" if occupant else f"is {distance:.2f} m from {name!r}, closer than {clearance} m"
    raise InputError(f"the route {how} at {where} m; walk round it, or allow less clearance")
