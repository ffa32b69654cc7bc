"""Training of Gaussians, step by step: draw, compare, and move what was drawn by Adam.

`Trainer` is one interface to two engines: the native core, which does all of a step itself, and plain torch
(`trainer_reference`), which is the specification and the way to other rasterizers. Adam: Kingma and Ba (2015), with
max(sqrt(v), eps) in place of sqrt(v) + eps; bias correction counts the steps of the run. A step moves only the
Gaussians that its view drew: the others keep parameters and moments.
"""

from collections.abc import Collection, Mapping
from dataclasses import replace
from typing import Any, Literal

import torch
from torch import Tensor

from rf3dgs.core.errors import InputError
from rf3dgs.core.grids import Panorama, View
from rf3dgs.splats.compositing import Compositing
from rf3dgs.splats.density import Change, DensityState
from rf3dgs.splats.engine import BLEND_ONLY, Engine, Look, Scheme, check_tensors, make_engine, make_look
from rf3dgs.splats.gaussians import Gaussians
from rf3dgs.splats.harmonics import coefficient_count, degree_of
from rf3dgs.splats.raster import Raster
from rf3dgs.splats.rasterize import Backend
from rf3dgs.splats.rates import Rates
from rf3dgs.splats.target import Target

FIELDS = ("means", "quats", "log_scales", "logit_opacities", "sh")


class Trainer:
    """Gaussians that learn: parameters, moments, and the last drawing, through which `update` goes back.

    means `[N, 3]` [m], quats `[N, 4]` (wxyz), log_scales `[N, 3]`, logit_opacities `[N]` and sh `[N, K, C]` with K = 1,
        4, 9 or 16, as in `Gaussians`; they are copied.
    train: which of "geometry" (means, quats, log_scales), "opacity" and "sh" are moved.
    offset, clamp, base, along: a Gaussian shows offset + base + along * distance [m] + SH(direction) in every channel,
        and with `clamp` nothing below 0; `base` `[N, C]` and `along` `[C]` are fixed, None for nothing.
    moments: "float32", or "bfloat16" for half of their memory (choose betas of at most 0.99 then).

    `degree` is the degree that is drawn and trained, at first that of sh; `steps` counts the updates. Directions count
    as fixed: means get no gradient from the harmonics. Memory of the native engine: 4 bytes for every
    parameter, 8 (4) for its moments if it is trained, 20 for the order and the activated scales and opacities, and
    where the geometry rests 1.25 for the bounds of sixteen neighbours; a Gaussian with 16 coefficients of one channel
    whose opacity is trained takes 265 bytes, with three channels and all trained 740.
    """

    def __init__(
        self,
        means: Tensor,
        quats: Tensor,
        log_scales: Tensor,
        logit_opacities: Tensor,
        sh: Tensor,
        *,
        train: Collection[str] = ("opacity", "sh"),
        offset: float = 0.5,
        clamp: bool = True,
        base: Tensor | None = None,
        along: Tensor | None = None,
        betas: tuple[float, float] = (0.9, 0.999),
        eps: float = 1e-15,
        moments: Literal["float32", "bfloat16"] = "float32",
        backend: Backend = "auto",
    ) -> None:
        given = (means, quats, log_scales, logit_opacities, sh)
        tensors = {name: tensor.detach() for name, tensor in zip(FIELDS, given, strict=True)}
        check_tensors(tensors, base, along)
        scheme = Scheme(frozenset(train), offset, clamp, betas, eps, moments)
        self._backend: Backend = backend
        self._begin(scheme, make_engine(backend, scheme, tensors, base, along), sh, base, along)

    def _begin(self, scheme: Scheme, engine: Engine, sh: Tensor, base: Tensor | None, along: Tensor | None) -> None:
        self._scheme, self._engine, self._base, self._along = scheme, engine, base, along
        self._sizes, self._like = sh.shape[1:], sh.new_empty(0)
        self._drawn: Look | None = None
        self.steps, self.degree = 0, degree_of(sh.shape[1])

    def __len__(self) -> int:
        return self._engine.count

    @property
    def channels(self) -> int:
        """Of the harmonics."""
        return self._sizes[1]

    def beside(
        self,
        sh: Tensor,
        *,
        offset: float = 0.5,
        clamp: bool = True,
        base: Tensor | None = None,
        along: Tensor | None = None,
    ) -> "Trainer":
        """A trainer of other harmonics `[N, K, C]` alone on the same Gaussians: it shares their memory, not a copy."""
        other = object.__new__(Trainer)
        scheme = replace(self._scheme, train=frozenset({"sh"}), offset=offset, clamp=clamp)
        other._backend = self._backend
        other._begin(scheme, self._engine.beside(scheme, sh.detach(), base, along), sh, base, along)
        return other

    def draw(
        self,
        view: View,
        *,
        extra: Tensor | None = None,
        depth: bool = False,
        background: Tensor | None = None,
        compositing: Compositing = BLEND_ONLY,
        added: Tensor | None = None,
    ) -> Raster:
        """What the view sees, outside any graph: C channels of the harmonics, `extra` `[N, E]`, and with `depth` the
        depth [m] that Gaussians are sorted by, as a last channel. The others are as in `rasterize`.
        """
        self._drawn = self._look(view, extra, depth, background, compositing, added)
        return self._engine.draw(self._drawn)

    def update(
        self, picture_gradient: Tensor, rates: Rates, *, weight_gradient: Tensor | None = None, shrink: float = 0.0
    ) -> float:
        """Move what was drawn last by d loss / d values and d loss / d weight of that raster.

        `shrink` adds this much of the mean square of the drawn Gaussians' coefficients above the first to the loss;
        returns that addition.
        """
        if self._drawn is None:
            raise InputError("an update goes back through a drawing; draw first, once for each update")
        self._check_trains(self._drawn)
        look, self._drawn = self._drawn, None
        shape = (look.view.height, look.view.width, look.width)
        if picture_gradient.shape != shape:
            raise InputError(f"picture_gradient must be {list(shape)}; got {list(picture_gradient.shape)}")
        if weight_gradient is not None and weight_gradient.shape != shape[:2]:
            raise InputError(f"weight_gradient must be {list(shape[:2])}; got {list(weight_gradient.shape)}")
        self.steps += 1
        return self._engine.update(picture_gradient, weight_gradient, rates, shrink, self.steps)

    def step(
        self,
        view: View,
        target: Target,
        rates: Rates,
        *,
        ssim_weight: float = 0.2,
        shrink: float = 0.0,
        extra: Tensor | None = None,
        depth: bool = False,
        background: Tensor | None = None,
        compositing: Compositing = BLEND_ONLY,
        added: Tensor | None = None,
    ) -> float:
        """`draw`, `image_loss.l1_ssim` with the target, and `update`, at once; returns the loss before the update."""
        look = self._look(view, extra, depth, background, compositing, added)
        self._check_trains(look)
        shape = (view.height, view.width, look.width)
        if target.picture.shape != shape:
            raise InputError(f"the target must be {list(shape)} as what is drawn; got {list(target.picture.shape)}")
        if not 0.0 <= ssim_weight <= 1.0:
            raise InputError(f"ssim_weight must lie between 0 and 1; got {ssim_weight}")
        self._drawn = None
        self.steps += 1
        return self._engine.step(look, target, ssim_weight, rates, shrink, self.steps)

    def tensors(self) -> dict[str, Tensor]:
        """Copies of the five parameters in the caller's order, as `Gaussians` names them."""
        return {name: self._engine.read(name) for name in FIELDS}

    def gaussians(self) -> Gaussians:
        """The Gaussians as they are now."""
        return Gaussians(**self.tensors())

    def density(self) -> DensityState:
        """What the updates since the last change of the population said about each Gaussian; needs "geometry"."""
        if "geometry" not in self._scheme.train:
            raise InputError('the density statistic belongs to training with "geometry"; this trainer has none')
        columns = self._engine.read("screen").unbind(-1)
        return DensityState.from_tensors(dict(zip(("gradient", "seen", "radius"), columns, strict=True)))

    def assign(self, name: str, values: Tensor) -> None:
        """Set one parameter from outside, such as opacities that are reset; its moments begin anew."""
        self.place(name, values)
        for moment in self._moments(name):
            self._engine.write(moment, torch.zeros_like(values))

    def place(self, name: str, values: Tensor) -> None:
        """Correct one parameter from outside by a little, such as means moved back onto a plane; its moments stay."""
        if name not in FIELDS or values.shape != self._engine.read(name).shape:
            raise InputError(f"a parameter is one of {', '.join(FIELDS)} in its own shape; got {name!r}")
        self._engine.write(name, values.detach())

    def follow(self, change: Change) -> None:
        """Go on with a changed population: moments follow their Gaussians, fresh ones begin anew, the density too."""
        moments = {name: change.follow(self._engine.read(name)) for name in self._moments(*self._scheme.trained)}
        self._base = None if self._base is None else self._base[change.source]
        tensors = {name: tensor.detach() for name, tensor in change.gaussians.tensors().items()}
        self._engine = make_engine(self._backend, self._scheme, tensors, self._base, self._along)
        for name, moment in moments.items():
            self._engine.write(name, moment)
        self._drawn = None

    def state(self) -> dict[str, Tensor]:
        """All that training changes, by name, for a checkpoint: the trainer's tensors, which steps change."""
        state = {name: self._engine.memory[name] for name in self._changing()}
        if "order" in state:  # trainers beside each other share it, files want it twice
            state["order"] = state["order"].clone()
        return {**state, "numbers": torch.tensor([self.steps, self.degree, *self._sizes])}

    def restore(self, state: Mapping[str, Tensor]) -> None:
        """Go on from a state, bit by bit. Raises InputError for one of another kind of training or backend."""
        if state.keys() != {*self._changing(), "numbers"}:
            raise InputError("the state must come from a trainer of the same tensors and backend; it has other names")
        self._engine.load({name: tensor for name, tensor in state.items() if name != "numbers"})
        self.steps, self.degree = (int(number) for number in state["numbers"][:2])
        self._drawn = None

    @classmethod
    def resume(cls, state: Mapping[str, Tensor], **options: Any) -> "Trainer":
        """A trainer from a state alone, where everything is trained; `options` as when it was made."""
        coefficients, channels = (int(number) for number in state["numbers"][2:])
        one = torch.zeros(1, 3), torch.zeros(1, 4), torch.zeros(1, 3), torch.zeros(1)
        trainer = cls(*one, torch.zeros(1, coefficients, channels), **options)
        trainer.restore(state)
        return trainer

    def _changing(self) -> list[str]:
        """The names of what training changes, and of the order it lies in."""
        frozen = set(FIELDS) - set(self._scheme.trained)
        return [name for name in self._engine.memory if name not in frozen]

    def _moments(self, *names: str) -> list[str]:
        return [f"{moment}.{name}" for name in names if name in self._scheme.trained for moment in ("first", "second")]

    def _look(
        self,
        view: View,
        extra: Tensor | None,
        depth: bool,
        background: Tensor | None,
        compositing: Compositing,
        added: Tensor | None,
    ) -> Look:
        bases = coefficient_count(self.degree)
        return make_look(
            view, (len(self), bases, self.channels), extra, depth, background, compositing, added, self._like
        )

    def _check_trains(self, look: Look) -> None:
        if not self._scheme.train:
            raise InputError("nothing is trained here; name what is to move in train")
        if "geometry" in self._scheme.train and isinstance(look.view, Panorama):
            raise InputError("geometry is trained on cameras; a panorama trains opacity and harmonics")
