"""Several pictures of one place: the same paths seen by a receiver that turns."""

import math
from collections.abc import Sequence

import torch

from rf3dgs.channel.paths import Paths
from rf3dgs.core.errors import InputError
from rf3dgs.core.frames import Pose


def at_yaws(paths: Paths, yaws: Sequence[float]) -> Paths:
    """The paths `[path]` of one receiver as paths `[yaw, path]` of receivers at its place, turned by `yaws` [rad].

    A turn is about the receiver's own vertical axis, to its left where positive. All see one and the same set of paths.
    """
    if paths.rx.batch_shape:
        raise InputError(f"at_yaws takes the paths of one receiver; got {list(paths.rx.batch_shape)}")
    if not len(yaws) or not all(math.isfinite(yaw) for yaw in yaws):
        raise InputError(f"yaws must be one or more finite angles in radians; got {list(yaws)}")
    turn = Pose.from_yaw((0.0, 0.0, 0.0), torch.tensor(list(yaws))).world_from_device
    rx = Pose.from_matrix(paths.rx.position.expand(len(yaws), 3), paths.rx.world_from_device @ turn)
    return paths._map(lambda value: value.expand(len(yaws), -1), rx=rx)
