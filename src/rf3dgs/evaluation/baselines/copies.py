"""What every baseline that copies shares: the training pictures by place, turned to an asked pose, and mixed.

Several training views of one position (the four yaws of a pinhole set) are one place that sees more; directions that no
view has seen get no power.
"""

from collections.abc import Sequence

import torch
from torch import Tensor

from rf3dgs.core.errors import InputError
from rf3dgs.core.frames import Pose
from rf3dgs.core.grids import DirectionGrid, sample_grid
from rf3dgs.spectra.spectrum import Spectrum, stack_spectra

SAME_PLACE = 1e-3  # [m], views closer than this belong to one place
Copy = tuple[Tensor, Tensor | None, Tensor | None]


class Places:
    """The training spectra `train` `[view, row, col]`, grouped by where they stand: `position` `[place, 3]` [m]."""

    def __init__(self, train: Spectrum) -> None:
        if not train.pose.batch_shape or len(train) == 0:
            raise InputError("a lookup needs training spectra with a pose axis and at least one position")
        self.train = train
        self.position, self.views = _group(train.pose.position)

    def copy(self, place: int, pose: Pose, grid: DirectionGrid) -> Copy:
        """Power, delay and AoD of one place in the directions of `grid` as turned by `pose`.

        A view of that very orientation and grid is given as it is.
        """
        train = self.train
        for view in self.views[place]:
            unturned = torch.allclose(train.pose.orientation[view].abs(), pose.orientation.abs(), atol=1e-6)
            unturned = unturned and torch.allclose(
                train.pose[view].world_from_device, pose.world_from_device, atol=1e-5
            )
            if unturned and train.grid.same_as(grid):
                delay = None if train.delay is None else train.delay[view]
                return train.power[view], delay, None if train.aod is None else train.aod[view]
        return turned(train, self.views[place], pose, grid)

    def mixed(self, places: Sequence[int], weight: Tensor, pose: Pose, grid: DirectionGrid) -> Copy:
        """The mean of some places' copies by `weight` `[place]`, which sums to 1.

        Power is averaged linearly, delay and angle of departure with the power as weight.
        """
        if len(places) == 1:
            return self.copy(places[0], pose, grid)
        copies = [self.copy(place, pose, grid) for place in places]
        shares = torch.stack([w * copy[0].double() for w, copy in zip(weight, copies, strict=True)])
        power = shares.sum(0)
        shares = shares / power.clamp_min(1e-300)
        delay = aod = None
        if self.train.delay is not None:
            delays = torch.stack([copy[1] for copy in copies if copy[1] is not None])
            delay = (shares * delays).sum(0).float()
        if self.train.aod is not None:
            aods = torch.stack([copy[2] for copy in copies if copy[2] is not None])
            aod = torch.nn.functional.normalize((shares[..., None] * aods).sum(0), dim=-1).float()
        return power.float(), delay, aod


class Copying:
    """A predictor whose answer is made of copies; what they are is said by `_at`."""

    name = "copy"

    def __init__(self, train: Spectrum) -> None:
        self.train, self.places = train, Places(train)

    def render(self, pose: Pose, grid: DirectionGrid) -> Spectrum:
        """The copied spectrum on `grid` at one pose, or `[n, row, col]` at n poses."""
        if not pose.batch_shape:
            return self._one(pose, grid)
        return stack_spectra([self._one(pose[index], grid) for index in range(len(pose))])

    def _one(self, pose: Pose, grid: DirectionGrid) -> Spectrum:
        power, delay, aod = self._at(pose, grid)
        train = self.train
        return Spectrum(power, grid, pose, train.frequency, train.instrument, self.name, delay, aod, train.tx)

    def _at(self, pose: Pose, grid: DirectionGrid) -> Copy:
        raise NotImplementedError


def turned(
    train: Spectrum, views: Sequence[int], pose: Pose, grid: DirectionGrid, counts: Tensor | None = None
) -> Copy:
    """Power, delay and AoD that some `views` of `train` saw together in the directions of `grid` as turned by `pose`.

    Where several saw a direction their mean counts, each as often as `counts` `[view of train]` says (None: once).
    """
    if train.grid.kind == "list":
        raise InputError("spectra on a list of directions cannot be turned; use an equirectangular or pinhole grid")
    world = pose.to_world(grid.directions)
    total, seen = torch.zeros(*grid.shape, 5, dtype=torch.float64), torch.zeros(grid.shape, dtype=torch.float64)
    for view in views:
        local = train.pose[view].to_device(world)
        _, inside = train.grid.pixel_of(local)
        inside = inside if counts is None else inside * counts[view]
        total += inside[..., None] * sample_grid(channels_of(train[view]), train.grid, local)
        seen += inside
    power = total[..., 0] / torch.where(seen > 0, seen, 1.0)
    delay = total[..., 1] / total[..., 0].clamp_min(1e-300)
    aod = torch.nn.functional.normalize(total[..., 2:] / total[..., :1].clamp_min(1e-300), dim=-1)
    return (
        power.float(),
        None if train.delay is None else delay.float(),
        None if train.aod is None else aod.float(),
    )


def channels_of(one: Spectrum) -> Tensor:
    """Power, power times delay and power times AoD `[*batch, row, col, 5]` (float64); zeros for what is not there."""
    power = one.power.double()[..., None]
    delay = torch.zeros_like(power) if one.delay is None else one.delay.double()[..., None]
    aod = torch.zeros(*one.power.shape, 3) if one.aod is None else one.aod
    return torch.cat((power, power * delay, power * aod.double()), -1)


def _group(position: Tensor) -> tuple[Tensor, list[list[int]]]:
    """The distinct positions `[place, 3]` and the views that stand at each."""
    places: list[int] = []
    views: list[list[int]] = []
    for index in range(len(position)):
        if places:
            distance = torch.linalg.vector_norm(position[places] - position[index], dim=-1)
            nearest = int(distance.argmin())
            if distance[nearest] < SAME_PLACE:
                views[nearest].append(index)
                continue
        places.append(index)
        views.append([index])
    return position[places], views
