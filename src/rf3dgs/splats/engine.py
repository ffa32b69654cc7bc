"""What a `Trainer` asks of the engine that does its work."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal, Protocol

import torch
from torch import Tensor

from rf3dgs.core.errors import InputError
from rf3dgs.core.grids import View
from rf3dgs.splats.compositing import Compositing
from rf3dgs.splats.harmonics import degree_of
from rf3dgs.splats.raster import Raster
from rf3dgs.splats.rasterize import Backend, check_view, pick_backend
from rf3dgs.splats.rates import Rates
from rf3dgs.splats.target import Target

GROUPS = {
    "geometry": ("means", "quats", "log_scales"),
    "opacity": ("logit_opacities",),
    "sh": ("sh",),
}
BLEND_ONLY = Compositing()
PARAMETERS = tuple(name for names in GROUPS.values() for name in names)


@dataclass(frozen=True)
class Scheme:
    """What is trained, by which Adam, and how harmonics become values; see `Trainer`."""

    train: frozenset[str]
    offset: float
    clamp: bool
    betas: tuple[float, float]
    eps: float
    moments: Literal["float32", "bfloat16"]

    def __post_init__(self) -> None:
        unknown = self.train - GROUPS.keys()
        if unknown:
            raise InputError(f"train takes {', '.join(GROUPS)}; got {', '.join(sorted(unknown))}")
        if self.moments not in ("float32", "bfloat16"):
            raise InputError(f'moments must be "float32" or "bfloat16"; got {self.moments!r}')

    @property
    def trained(self) -> tuple[str, ...]:
        """The names of the tensors that move."""
        return tuple(name for group, names in GROUPS.items() if group in self.train for name in names)


@dataclass(frozen=True, eq=False)
class Look:
    """A picture of `width` channels: those of the first `bases` harmonics, `extra` `[gaussian, E]`, then the depth."""

    view: View
    bases: int
    width: int
    extra: Tensor | None
    depth: bool
    background: Tensor | None
    compositing: Compositing
    added: Tensor | None


def make_look(
    view: View,
    shape: tuple[int, int, int],
    extra: Tensor | None,
    depth: bool,
    background: Tensor | None,
    compositing: Compositing,
    added: Tensor | None,
    like: Tensor,
) -> Look:
    """The `Look` of harmonics of a `shape` (gaussian, bases, channel) and of the dtype and device of `like`.

    Raises InputError for what does not fit.
    """
    count, bases, channels = shape
    if extra is not None and (extra.dim() != 2 or len(extra) != count):
        raise InputError(f"extra must be [{count}, channel]; got {list(extra.shape)}")
    width = channels + (0 if extra is None else extra.shape[1]) + depth
    if background is not None and background.shape != (width,):
        raise InputError(f"background must be [channel] = [{width}]; got {list(background.shape)}")
    check_view(view, like.new_empty(0, width), background, None, compositing, added)
    for name, tensor in (("extra", extra), ("background", background)):
        if tensor is not None and (tensor.dtype, tensor.device) != (like.dtype, like.device):
            raise InputError(f"{name} must be {like.dtype} on {like.device}; got {tensor.dtype} on {tensor.device}")
    plain = [None if tensor is None else tensor.detach().contiguous() for tensor in (extra, background, added)]
    return Look(view, bases, width, plain[0], depth, plain[1], compositing, plain[2])


class Engine(Protocol):
    """Parameters with their moments, in an order of its own, and the last drawing."""

    count: int
    memory: dict[str, Tensor]
    """All that training changes, in an order and layout of the engine's own."""

    def draw(self, look: Look) -> Raster:
        """Draw, and remember what `update` needs."""
        ...

    def update(
        self, picture_gradient: Tensor, weight_gradient: Tensor | None, rates: Rates, shrink: float, steps: int
    ) -> float:
        """Move what was drawn; returns the loss of what `shrink` draws to zero."""
        ...

    def step(self, look: Look, target: Target, ssim_weight: float, rates: Rates, shrink: float, steps: int) -> float:
        """`draw`, `image_loss.l1_ssim` and `update`; returns the loss."""
        ...

    def read(self, name: str) -> Tensor:
        """A copy of one tensor in the caller's order; harmonics and their moments as `[gaussian, K, channel]`."""
        ...

    def write(self, name: str, values: Tensor) -> None:
        """The opposite of `read`."""
        ...

    def load(self, memory: Mapping[str, Tensor]) -> None:
        """Go on from what of `memory` training changes, perhaps of another number of Gaussians if all is trained."""
        ...

    def beside(self, scheme: Scheme, sh: Tensor, base: Tensor | None, along: Tensor | None) -> "Engine":
        """Another engine for other harmonics `[gaussian, K, channel]` on these Gaussians; memory is shared."""
        ...


def check_tensors(tensors: Mapping[str, Tensor], base: Tensor | None, along: Tensor | None) -> None:
    """Raises InputError naming the first tensor of a wrong shape."""
    means, sh = tensors["means"], tensors["sh"]
    count = len(means) if means.dim() else 0
    expected = {"means": (count, 3), "quats": (count, 4), "log_scales": (count, 3), "logit_opacities": (count,)}
    for name, shape in expected.items():
        if tensors[name].shape != shape:
            raise InputError(f"{name} must be {list(shape)}; got {list(tensors[name].shape)}. Transpose it?")
    if sh.dim() != 3 or len(sh) != count or sh.shape[2] < 1:
        raise InputError(f"sh must be [{count}, k, channel]; got {list(sh.shape)}")
    degree_of(sh.shape[1])
    for name, tensor, size in (("base", base, (count, sh.shape[2])), ("along", along, (sh.shape[2],))):
        if tensor is not None and tensor.shape != size:
            raise InputError(f"{name} must be {list(size)}; got {list(tensor.shape)}")


def check_whole(memory: Mapping[str, Tensor]) -> None:
    """Raises InputError for a state of other Gaussians that lacks what was frozen there."""
    if not memory.keys() >= set(PARAMETERS):
        raise InputError("the state is of other Gaussians than the trainer's; make the trainer from the same geometry")


def make_engine(
    backend: Backend, scheme: Scheme, tensors: Mapping[str, Tensor], base: Tensor | None, along: Tensor | None
) -> Engine:
    """The engine of a backend, or the one that "auto" means for these tensors."""
    means = tensors["means"]
    name = pick_backend(means.device.type, means.dtype)[0] if backend == "auto" else backend
    if name == "native":
        if means.dtype != torch.float32 or means.device.type != "cpu":
            raise InputError(
                f"the native trainer needs float32 tensors on the CPU; got {means.dtype} on {means.device}"
            )
        from rf3dgs.splats.backends.trainer import NativeEngine

        return NativeEngine(scheme, tensors, base, along)
    from rf3dgs.splats.trainer_reference import TorchEngine

    return TorchEngine(scheme, tensors, base, along, backend=backend)
