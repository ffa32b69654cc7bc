"""Adaptive density control: where the picture asks for detail Gaussians are cloned or split, useless ones are removed.

The arithmetic is that of 3DGS (Kerbl et al. 2023, section 5.2). Every function returns a `Change`, which tells from
which old row each new row comes, so that optimiser states can follow. Training decides when each of them is called.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

from rf3dgs.core.errors import InputError, TrainingError
from rf3dgs.core.frames import matrix_from_quaternion
from rf3dgs.splats.gaussians import Gaussians

SPLIT_COUNT = 2
SPLIT_SHRINK = 0.8 * SPLIT_COUNT


@dataclass(frozen=True, eq=False)
class Change:
    """New Gaussians; the old row `source` `[new]` of each; `fresh` `[new]` where an optimiser has to begin anew."""

    gaussians: Gaussians
    source: Tensor
    fresh: Tensor

    def follow(self, state: Tensor) -> Tensor:
        """An optimiser's state `[old, ...]` for the new rows: taken from the source, zero where the row is fresh."""
        moved = state[self.source]
        moved[self.fresh] = 0
        return moved

    def then(self, later: "Change") -> "Change":
        """This change and a later one as one."""
        return Change(later.gaussians, self.source[later.source], later.fresh | self.fresh[later.source])


class DensityState:
    """What the views since the last change said about each Gaussian.

    `gradient` `[gaussian]` sums the norms of d loss / d centre, `seen` `[gaussian]` counts the views that drew it, and
    `radius` `[gaussian]` is its largest radius on a screen [pixel].
    """

    def __init__(self, count: int) -> None:
        self.gradient = torch.zeros(count)
        self.seen = torch.zeros(count)
        self.radius = torch.zeros(count)

    def observe(self, screen_gradient: Tensor, radii: Tensor, width: int, height: int) -> None:
        """Take in one view: d loss / d projected centre `[gaussian, 2]` [1 / pixel] and `radii` `[gaussian]` [pixel].

        The gradient is scaled by half the picture's size to 3DGS's units (a picture is 2 wide and 2 high), which makes
        the threshold independent of the resolution. Only Gaussians with a radius above 0 count.
        """
        if screen_gradient.shape != (len(self.seen), 2) or radii.shape != self.seen.shape:
            raise InputError(
                f"screen_gradient must be [{len(self.seen)}, 2] and radii [{len(self.seen)}]; got "
                f"{list(screen_gradient.shape)} and {list(radii.shape)}. Make a new DensityState after each change"
            )
        drawn = radii > 0
        scaled = screen_gradient.detach() * screen_gradient.new_tensor([0.5 * width, 0.5 * height])
        self.gradient += torch.where(drawn, torch.linalg.vector_norm(scaled, dim=-1), 0.0)
        self.seen += drawn
        self.radius = torch.maximum(self.radius, torch.where(drawn, radii.detach(), 0.0))

    @property
    def mean_gradient(self) -> Tensor:
        """Mean gradient norm `[gaussian]` over the views that drew each Gaussian; 0 for those never drawn."""
        return self.gradient / self.seen.clamp_min(1.0)

    def follow(self, change: Change) -> "DensityState":
        """The state of the new rows; fresh ones have seen nothing."""
        return DensityState.from_tensors({name: change.follow(tensor) for name, tensor in self.tensors().items()})

    def tensors(self) -> dict[str, Tensor]:
        """The three tensors by name, for a checkpoint."""
        return {"gradient": self.gradient, "seen": self.seen, "radius": self.radius}

    @classmethod
    def from_tensors(cls, tensors: Mapping[str, Tensor]) -> "DensityState":
        """The state of a mapping as `tensors()` gives it."""
        state = cls(0)
        state.gradient, state.seen, state.radius = (tensors[name].clone() for name in ("gradient", "seen", "radius"))
        return state


def grow(
    gaussians: Gaussians,
    state: DensityState,
    *,
    extent: float,
    generator: torch.Generator,
    gradient_threshold: float = 2e-4,
    dense_fraction: float = 0.01,
    max_count: int | None = None,
) -> Change:
    """Clone the small and split the large Gaussians whose mean screen gradient reaches the threshold.

    Small means that the largest scale is at most `dense_fraction` of the scene's `extent` [m]: a copy is added in the
    same place. A large one is replaced by two, 1.6 times smaller, drawn from the Gaussian itself. Both add one
    Gaussian; when `max_count` leaves room for fewer than ask, those with the largest gradients go first. Copies and
    parts are fresh.
    """
    _same_count(gaussians, state)
    gradient = state.mean_gradient
    asking = (gradient >= gradient_threshold).nonzero().squeeze(-1)
    room = len(asking) if max_count is None else max(0, max_count - len(gaussians))
    asking = asking[torch.argsort(gradient[asking], descending=True, stable=True)][:room].sort().values
    large = gaussians.scales.detach()[asking].amax(-1) > dense_fraction * extent
    cloned, divided = asking[~large], asking[large].repeat(SPLIT_COUNT)
    kept = torch.ones(len(gaussians), dtype=torch.bool)
    kept[asking[large]] = False
    kept = kept.nonzero().squeeze(-1)

    old = gaussians.detach()
    parts = old.subset(divided).tensors()
    step = torch.randn(len(divided), 3, generator=generator) * torch.exp(parts["log_scales"])
    rotation = matrix_from_quaternion(parts["quats"])
    parts["means"] = parts["means"] + (rotation @ step[..., None]).squeeze(-1)
    parts["log_scales"] = parts["log_scales"] - math.log(SPLIT_SHRINK)
    source = torch.cat((kept, cloned, divided))
    grown = Gaussians.join([old.subset(kept), old.subset(cloned), Gaussians.from_tensors(parts)])
    return Change(grown, source, torch.arange(len(source)) >= len(kept))


def prune(
    gaussians: Gaussians,
    state: DensityState | None = None,
    *,
    opacity_floor: float = 0.005,
    largest_scale: float | None = None,
    largest_radius: float | None = None,
) -> Change:
    """Remove Gaussians fainter than `opacity_floor` and, where limits are given, those that are too large.

    `largest_scale` [m] bounds the largest scale (3DGS: 0.1 of the scene's extent) and `largest_radius` [pixel] the
    radius on any screen (3DGS: 20, needs `state`); 3DGS gives both only after the first opacity reset. Raises
    TrainingError when nothing would remain.
    """
    old = gaussians.detach()
    useless = old.opacities < opacity_floor
    if largest_scale is not None:
        useless |= old.scales.amax(-1) > largest_scale
    if largest_radius is not None:
        if state is None:
            raise InputError(
                "largest_radius needs the DensityState that has seen the views; give state or leave it out"
            )
        _same_count(gaussians, state)
        useless |= state.radius > largest_radius
    source = (~useless).nonzero().squeeze(-1)
    if len(source) == 0:
        raise TrainingError(
            f"pruning would remove all {len(gaussians)} Gaussians; lower the opacity learning rate, prune less or "
            "check that the photographs and their poses belong together"
        )
    return Change(old.subset(source), source, torch.zeros(len(source), dtype=torch.bool))


def densify(
    gaussians: Gaussians,
    state: DensityState,
    *,
    extent: float,
    generator: torch.Generator,
    gradient_threshold: float = 2e-4,
    dense_fraction: float = 0.01,
    max_count: int | None = None,
    opacity_floor: float = 0.005,
    largest_scale: float | None = None,
    largest_radius: float | None = None,
) -> Change:
    """`grow`, then `prune`, as one change. The next views start with a new `DensityState(len(change.gaussians))`."""
    grown = grow(
        gaussians,
        state,
        extent=extent,
        generator=generator,
        gradient_threshold=gradient_threshold,
        dense_fraction=dense_fraction,
        max_count=max_count,
    )
    limits = {"opacity_floor": opacity_floor, "largest_scale": largest_scale, "largest_radius": largest_radius}
    return grown.then(prune(grown.gaussians, state.follow(grown), **limits))


def reset_opacity(gaussians: Gaussians, ceiling: float = 0.01) -> Gaussians:
    """The same Gaussians with opacities of at most `ceiling`; the optimiser of the opacities begins anew after it."""
    tensors = gaussians.detach().tensors()
    tensors["logit_opacities"] = tensors["logit_opacities"].clamp_max(math.log(ceiling / (1 - ceiling)))
    return Gaussians.from_tensors(tensors)


def scene_extent(centres: Tensor) -> float:
    """3DGS's measure of a scene [m]: 1.1 times the largest distance of camera `centres` `[camera, 3]` from their mean.

    One camera, or cameras in one place, give 1.1 m.
    """
    distance = float(torch.linalg.vector_norm(centres - centres.mean(0), dim=-1).max())
    return 1.1 * (distance if distance > 1e-6 else 1.0)


def _same_count(gaussians: Gaussians, state: DensityState) -> None:
    if len(gaussians) != len(state.seen):
        raise InputError(
            f"the DensityState must belong to these {len(gaussians)} Gaussians; it has {len(state.seen)}. Make a new "
            "one after each change"
        )
