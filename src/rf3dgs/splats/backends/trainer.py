"""The trainer of the native core: arrays in the Morton order of the means, and one call for a whole step."""

from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

from rf3dgs.core.grids import Camera, View
from rf3dgs.core.threads import thread_count
from rf3dgs.splats.backends.native import core
from rf3dgs.splats.engine import Look, Scheme, check_whole
from rf3dgs.splats.raster import Raster
from rf3dgs.splats.rates import Rates
from rf3dgs.splats.target import Target

SHARED = ("means", "quats", "log_scales", "logit_opacities")
ACTIVATED = ("scales", "opacities", "bounds")  # no bounds where the geometry moves


class NativeEngine:
    """See `engine.Engine`; the harmonics are kept as `[gaussian, channel, lane]`, 9 coefficients in 16 lanes."""

    def __init__(
        self, scheme: Scheme, tensors: Mapping[str, Tensor], base: Tensor | None, along: Tensor | None
    ) -> None:
        means = tensors["means"].contiguous()
        order = torch.empty(len(means), dtype=torch.int32)
        core().morton_order(means, order)
        rows = order.long()
        memory = {name: tensors[name][rows] for name in SHARED}
        memory |= {"order": order, **_activated(len(means), scheme)}
        self._begin(scheme, memory, tensors["sh"], base, along)
        self.trainer.activate()

    def _begin(
        self, scheme: Scheme, shared: dict[str, Tensor], sh: Tensor, base: Tensor | None, along: Tensor | None
    ) -> None:
        """Keep what engines share, and make the rest."""
        self.scheme, self.base, self.along = scheme, base, along
        self.count, self.coefficients, self.channels = sh.shape
        self.lanes = 16 if self.coefficients == 9 else self.coefficients
        self._activated = {name: shared[name] for name in ACTIVATED if name in shared}
        self.memory = {name: tensor for name, tensor in shared.items() if name not in ACTIVATED}
        self.memory["sh"] = torch.zeros(self.count, self.channels, self.lanes)
        for name in scheme.trained:
            for moment in ("first", "second"):
                kind = torch.bfloat16 if scheme.moments == "bfloat16" else torch.float32
                self.memory[f"{moment}.{name}"] = torch.zeros_like(self.memory[name], dtype=kind)
        if "geometry" in scheme.train:
            self.memory["screen"] = torch.zeros(self.count, 3)
        self._place("sh", sh)
        self._bind()

    def _bind(self) -> None:
        """Give the core the arrays that it works on."""
        scheme, rows = self.scheme, self.memory["order"].long()
        arrays = {
            name: tensor.view(torch.int16) if tensor.dtype == torch.bfloat16 else tensor
            for name, tensor in (self.memory | self._activated).items()
        }
        if self.base is not None:
            arrays["base"] = self.base.detach()[rows].contiguous()
        if self.along is not None:
            arrays["along"] = self.along.detach().contiguous()
        half = scheme.moments == "bfloat16"
        self.trainer = core().Trainer(arrays, scheme.offset, scheme.clamp, *scheme.betas, scheme.eps, half)

    def _place(self, name: str, values: Tensor) -> None:
        rows = values[self.memory["order"].long()]
        if name.endswith("sh"):
            self.memory[name][:, :, : self.coefficients] = rows.mT
        else:
            self.memory[name].copy_(rows)

    def read(self, name: str) -> Tensor:
        """A copy of one tensor in the caller's order."""
        kept = self.memory[name]
        if name.endswith("sh"):
            kept = kept[:, :, : self.coefficients].mT
        result = torch.empty(kept.shape, dtype=kept.dtype)
        result[self.memory["order"].long()] = kept
        return result

    def write(self, name: str, values: Tensor) -> None:
        """Set one tensor from the caller's order."""
        self._place(name, values)
        self.trainer.activate()

    def load(self, memory: Mapping[str, Tensor]) -> None:
        """In place where order and number of Gaussians are the same, so that engines beside this one see it."""
        if torch.equal(memory["order"], self.memory["order"]):
            for name, tensor in memory.items():
                self.memory[name].copy_(tensor)
        else:
            check_whole(memory)
            self.memory = {name: memory[name].clone() for name in self.memory}
            self.count = len(self.memory["means"])
            self._activated = _activated(self.count, self.scheme)
            self._bind()
        self.trainer.activate()

    def draw(self, look: Look) -> Raster:
        """Draw; radii are handed out in the caller's order."""
        view = look.view
        picture, weight = torch.empty(view.height, view.width, look.width), torch.empty(view.height, view.width)
        radii = torch.empty(self.count)
        self.trainer.draw(*look_arguments(look), picture, weight, radii, thread_count())
        return Raster(picture, weight, radii)

    def update(
        self, picture_gradient: Tensor, weight_gradient: Tensor | None, rates: Rates, shrink: float, steps: int
    ) -> float:
        """Back through the last drawing, and Adam."""
        of_weight = None if weight_gradient is None else weight_gradient.contiguous()
        return self.trainer.update(
            picture_gradient.contiguous(), of_weight, *self._rates(rates, shrink), steps, thread_count()
        )

    def step(self, look: Look, target: Target, ssim_weight: float, rates: Rates, shrink: float, steps: int) -> float:
        """All of a step in one call."""
        statistics = target.statistics if ssim_weight > 0 else None
        return self.trainer.step(
            *look_arguments(look),
            *(target.picture, target.weight, statistics, ssim_weight),
            *self._rates(rates, shrink),
            steps,
            thread_count(),
        )

    def _rates(self, rates: Rates, shrink: float) -> tuple[Any, ...]:
        shape = (rates.means, rates.quats, rates.log_scales, rates.logit_opacities)
        return (*shape, rates.of_sh(self.channels, self.lanes), shrink)

    def beside(self, scheme: Scheme, sh: Tensor, base: Tensor | None, along: Tensor | None) -> "NativeEngine":
        """The same Gaussians with other harmonics."""
        other = object.__new__(NativeEngine)
        names = (*SHARED, "order")
        other._begin(scheme, {name: self.memory[name] for name in names} | self._activated, sh, base, along)
        return other


def _activated(count: int, scheme: Scheme) -> dict[str, Tensor]:
    """Room for what follows from the parameters."""
    room = {"scales": torch.empty(count, 3), "opacities": torch.empty(count)}
    return room if "geometry" in scheme.train else room | {"bounds": torch.empty(core().bounds_shape(count))}


def look_arguments(look: Look) -> tuple[Any, ...]:
    """What the core has to know to draw."""
    return (*view_arguments(look.view), look.bases, look.extra, look.depth, look.background, *_finishing(look))


def view_arguments(view: View) -> tuple[Tensor, Tensor | None, int, int]:
    """camera_from_world, camera matrix (None for the sphere), width and height."""
    K = view.K.float().contiguous() if isinstance(view, Camera) else None
    return view.viewmat.detach().float().contiguous(), K, view.width, view.height


def _finishing(look: Look) -> tuple[Any, ...]:
    """Blur, depth gate, division by the weight, the channels in a window, its ends, and the added picture."""
    how = look.compositing
    names = how.transfers(1) if isinstance(how.transfer, str) else how.transfer
    in_window = [name == "db_window" for name in names]
    window = how.window if any(in_window) else (0.0, 1.0)
    return how.blur, how.depth_gate, how.normalise, in_window, *window, look.added
