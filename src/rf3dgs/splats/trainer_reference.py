"""The trainer in plain torch: the specification of the native one, and the way to rasterizers that it does not have.

Autograd goes back through `rasterize`, so any backend, device and (with the reference) dtype will do.
"""

from collections.abc import Mapping

import torch
from torch import Tensor

from rf3dgs.core.grids import Camera
from rf3dgs.splats.density import DensityState
from rf3dgs.splats.engine import PARAMETERS, Look, Scheme, check_whole
from rf3dgs.splats.harmonics import evaluate, view_directions
from rf3dgs.splats.image_loss import l1_ssim
from rf3dgs.splats.raster import Raster
from rf3dgs.splats.rasterize import Backend, rasterize
from rf3dgs.splats.rates import Rates
from rf3dgs.splats.target import Target


class TorchEngine:
    """See `engine.Engine`; the order is the caller's."""

    def __init__(
        self,
        scheme: Scheme,
        tensors: Mapping[str, Tensor],
        base: Tensor | None,
        along: Tensor | None,
        *,
        backend: Backend,
    ) -> None:
        self.scheme, self.base, self.along = scheme, base, along
        self.backend: Backend = backend
        self.count = len(tensors["means"])
        self.memory = {name: tensors[name].clone(memory_format=torch.contiguous_format) for name in PARAMETERS}
        self._begin_moments()
        self._drawn: tuple[Look, Raster, dict[str, Tensor]] | None = None

    def _begin_moments(self) -> None:
        means = self.memory["means"]
        kind = torch.bfloat16 if self.scheme.moments == "bfloat16" else means.dtype
        for name in self.scheme.trained:
            for moment in ("first", "second"):
                self.memory[f"{moment}.{name}"] = torch.zeros_like(self.memory[name], dtype=kind)
        if "geometry" in self.scheme.train:
            self.memory["screen"] = means.new_zeros(self.count, 3)

    def draw(self, look: Look) -> Raster:
        """Draw with a graph behind it."""
        leaves = {name: self.memory[name].detach() for name in PARAMETERS}
        for name in self.scheme.trained:
            leaves[name].requires_grad_()
        offset = None
        if "screen" in self.memory and isinstance(look.view, Camera):
            offset = leaves["offset"] = leaves["means"].detach().new_zeros(self.count, 2).requires_grad_()
        with torch.enable_grad():
            raster = rasterize(
                leaves["means"],
                leaves["quats"],
                torch.exp(leaves["log_scales"]),
                torch.sigmoid(leaves["logit_opacities"]),
                self._values(leaves, look),
                look.view,
                background=look.background,
                screen_offset=offset,
                compositing=look.compositing,
                added=look.added,
                backend=self.backend,
            )
        self._drawn = look, raster, leaves
        return Raster(raster.values.detach(), raster.weight.detach(), raster.radii)

    def _values(self, leaves: dict[str, Tensor], look: Look) -> Tensor:
        means, centre = leaves["means"], look.view.position.to(leaves["means"])
        still = means.detach()
        values = evaluate(leaves["sh"][:, : look.bases], view_directions(still, centre)) + self.scheme.offset
        if self.base is not None:
            values = values + self.base
        if self.along is not None:
            values = values + self.along * torch.linalg.vector_norm(still - centre, dim=-1, keepdim=True)
        parts = [values.clamp_min(0.0) if self.scheme.clamp else values]
        if look.extra is not None:
            parts.append(look.extra)
        if look.depth and isinstance(look.view, Camera):
            row = look.view.viewmat[2].to(means)
            parts.append((means @ row[:3] + row[3])[:, None])
        elif look.depth:
            parts.append(torch.linalg.vector_norm(means - centre, dim=-1, keepdim=True))
        return torch.cat(parts, -1)

    def update(
        self, picture_gradient: Tensor, weight_gradient: Tensor | None, rates: Rates, shrink: float, steps: int
    ) -> float:
        """Autograd, then Adam on the rows that were drawn."""
        assert self._drawn is not None
        look, raster, leaves = self._drawn
        self._drawn = None
        drawn = (raster.radii > 0).nonzero().squeeze(-1)
        outputs, gradients = [raster.values], [picture_gradient]
        if weight_gradient is not None:
            outputs, gradients = [*outputs, raster.weight], [*gradients, weight_gradient]
        if any(output.requires_grad for output in outputs):
            torch.autograd.backward(outputs, gradients)
        bands = leaves["sh"].detach()[drawn, 1 : look.bases]
        if "screen" in self.memory and "offset" in leaves:
            self._observe(look, raster, leaves["offset"].grad)
        for name in self.scheme.trained:
            gradient = leaves[name].grad
            gradient = torch.zeros_like(leaves[name]) if gradient is None else gradient
            gradient = gradient[drawn]
            if name == "sh" and shrink > 0:
                gradient[:, 1 : look.bases] += 2 * shrink / max(1, bands.numel()) * bands
            self._adam(name, drawn, gradient, rates, steps)
        return shrink * float(bands.square().sum()) / max(1, bands.numel())

    def _observe(self, look: Look, raster: Raster, gradient: Tensor | None) -> None:
        """Add a view to the statistic of the pull at projected centres."""
        screen = self.memory["screen"]
        state = DensityState.from_tensors(dict(zip(("gradient", "seen", "radius"), screen.unbind(-1), strict=True)))
        pull = screen.new_zeros(self.count, 2) if gradient is None else gradient
        state.observe(pull, raster.radii, look.view.width, look.view.height)
        screen.copy_(torch.stack(tuple(state.tensors().values()), -1))

    def _adam(self, name: str, rows: Tensor, gradient: Tensor, rates: Rates, steps: int) -> None:
        value = self.memory[name]
        first, second = (self.memory[f"{moment}.{name}"] for moment in ("first", "second"))
        beta1, beta2 = self.scheme.betas
        m = beta1 * first[rows].to(gradient.dtype) + (1 - beta1) * gradient
        v = beta2 * second[rows].to(gradient.dtype) + (1 - beta2) * gradient.square()
        first[rows], second[rows] = m.to(first.dtype), v.to(second.dtype)
        if name == "sh":
            rate: Tensor | float = rates.of_sh(value.shape[2], value.shape[1]).mT.to(value)
        else:
            rate = getattr(rates, name)
        spread = (v / (1 - beta2**steps)).sqrt().clamp_min(self.scheme.eps)
        value[rows] -= rate / (1 - beta1**steps) * m / spread

    def step(self, look: Look, target: Target, ssim_weight: float, rates: Rates, shrink: float, steps: int) -> float:
        """`draw`, loss and `update`, one after the other."""
        picture = self.draw(look).values.requires_grad_()
        with torch.enable_grad():
            loss = l1_ssim(picture, target.picture, ssim_weight=ssim_weight, weight=target.weight)
            (gradient,) = torch.autograd.grad(loss, picture)
        return float(loss.detach()) + self.update(gradient, None, rates, shrink, steps)

    def read(self, name: str) -> Tensor:
        """A copy of one tensor."""
        return self.memory[name].clone()

    def write(self, name: str, values: Tensor) -> None:
        """Set one tensor."""
        self.memory[name].copy_(values)

    def load(self, memory: Mapping[str, Tensor]) -> None:
        """In place where the number of Gaussians is the same, so that engines beside this one see it."""
        if len(memory["sh"]) == self.count:
            for name, tensor in memory.items():
                self.memory[name].copy_(tensor)
        else:
            check_whole(memory)
            self.memory = {name: memory[name].clone() for name in self.memory}
            self.count = len(self.memory["means"])

    def beside(self, scheme: Scheme, sh: Tensor, base: Tensor | None, along: Tensor | None) -> "TorchEngine":
        """The same Gaussians with other harmonics."""
        other = object.__new__(TorchEngine)
        other.scheme, other.base, other.along, other.backend = scheme, base, along, self.backend
        other.count, other._drawn = self.count, None
        other.memory = {name: self.memory[name] for name in PARAMETERS} | {"sh": sh.clone()}
        other._begin_moments()
        return other
