"""Lookup: the nearest training position's spectrum, and the inverse-distance mean of the nearest few.

Both look at where the receiver stands and turn what they copy to the asked orientation. Several training views of one
position (the four yaws of a pinhole set) are one position that sees more; directions that no view has seen get no
power.
"""

import torch
from torch import Tensor

from rf3dgs.core.errors import InputError
from rf3dgs.core.frames import Pose
from rf3dgs.core.grids import DirectionGrid, sample_grid
from rf3dgs.spectra.spectrum import Spectrum, stack_spectra

SAME_PLACE = 1e-3  # [m], views closer than this belong to one position


class InverseDistance:
    """Mean of the `neighbours` nearest training positions, weighted by distance to the power of -`power`.

    Power is averaged linearly; delay and angle of departure are averaged with the power as weight. At a training
    position the answer is that position's spectrum.
    """

    name = "inverse distance"

    def __init__(self, train: Spectrum, *, neighbours: int = 4, power: float = 2.0) -> None:
        if not train.pose.batch_shape or len(train) == 0:
            raise InputError("a lookup needs training spectra with a pose axis and at least one position")
        if neighbours < 1:
            raise InputError(f"neighbours must be at least 1; got {neighbours}")
        self.train, self.neighbours, self.power = train, neighbours, power
        self._places, self._views = _group(train.pose.position)

    def render(self, pose: Pose, grid: DirectionGrid) -> Spectrum:
        """The copied spectrum on `grid` at one pose, or `[n, row, col]` at n poses."""
        if not pose.batch_shape:
            return self._one(pose, grid)
        return stack_spectra([self._one(pose[index], grid) for index in range(len(pose))])

    def _one(self, pose: Pose, grid: DirectionGrid) -> Spectrum:
        power, delay, aod = self._at(pose, grid)
        train = self.train
        return Spectrum(power, grid, pose, train.frequency, train.instrument, self.name, delay, aod, train.tx)

    def _at(self, pose: Pose, grid: DirectionGrid) -> tuple[Tensor, Tensor | None, Tensor | None]:
        distance = torch.linalg.vector_norm(self._places - pose.position, dim=-1).double()
        nearest = distance.argsort(stable=True)[: self.neighbours]
        if len(nearest) == 1 or distance[nearest[0]] < 1e-6:
            return self._copy(int(nearest[0]), pose, grid)
        weight = distance[nearest] ** -self.power
        weight = weight / weight.sum()
        copies = [self._copy(int(place), pose, grid) for place in nearest]
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

    def _copy(self, place: int, pose: Pose, grid: DirectionGrid) -> tuple[Tensor, Tensor | None, Tensor | None]:
        """Power, delay and AoD of one training position in the directions of `grid` as turned by `pose`."""
        train, views = self.train, self._views[place]
        for view in views:
            unturned = torch.allclose(train.pose.orientation[view].abs(), pose.orientation.abs(), atol=1e-6)
            unturned = unturned and torch.allclose(
                train.pose[view].world_from_device, pose.world_from_device, atol=1e-5
            )
            if unturned and train.grid.same_as(grid):
                delay = None if train.delay is None else train.delay[view]
                return train.power[view], delay, None if train.aod is None else train.aod[view]
        if train.grid.kind == "list":
            raise InputError("spectra on a list of directions cannot be turned; use an equirectangular or pinhole grid")
        world = pose.to_world(grid.directions)
        total, seen = torch.zeros(*grid.shape, 5, dtype=torch.float64), torch.zeros(grid.shape, dtype=torch.float64)
        for view in views:
            local = train.pose[view].to_device(world)
            _, inside = train.grid.pixel_of(local)
            total += inside[..., None] * sample_grid(_channels(train, view), train.grid, local)
            seen += inside
        power = total[..., 0] / seen.clamp_min(1)
        delay = total[..., 1] / total[..., 0].clamp_min(1e-300)
        aod = torch.nn.functional.normalize(total[..., 2:] / total[..., :1].clamp_min(1e-300), dim=-1)
        return (
            power.float(),
            None if train.delay is None else delay.float(),
            None if train.aod is None else aod.float(),
        )


class NearestNeighbour(InverseDistance):
    """A copy of the nearest training position's spectrum, turned to the asked orientation."""

    name = "nearest neighbour"

    def __init__(self, train: Spectrum) -> None:
        super().__init__(train, neighbours=1)


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


def _channels(train: Spectrum, view: int) -> Tensor:
    """Power, power times delay and power times AoD `[row, col, 5]` (float64) of one training view."""
    power = train.power[view].double()[..., None]
    delay = torch.zeros_like(power) if train.delay is None else train.delay[view].double()[..., None]
    aod = torch.zeros(*power.shape[:2], 3) if train.aod is None else train.aod[view]
    return torch.cat((power, power * delay, power * aod.double()), -1)
