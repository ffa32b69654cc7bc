"""One entry for drawing Gaussians, whichever backend does it."""

import logging
from functools import cache
from typing import Literal

import torch
from torch import Tensor

from rf3dgs.core.errors import InputError
from rf3dgs.core.grids import Camera, Panorama, View
from rf3dgs.core.native import native_core, native_failure
from rf3dgs.core.threads import thread_count
from rf3dgs.splats.compositing import Compositing, finish
from rf3dgs.splats.raster import Raster

Backend = Literal["auto", "native", "reference", "gsplat"]
_BACKENDS = ("auto", "native", "reference", "gsplat")
_log = logging.getLogger(__name__)


def pick_backend(device: str = "cpu", dtype: torch.dtype = torch.float32) -> tuple[str, str]:
    """The backend that `"auto"` means for tensors of a device type and dtype, and why."""
    if device == "cuda":
        return "gsplat", "the tensors are on a CUDA device"
    if dtype != torch.float32:
        return "reference", f"the native core works in float32; the tensors are {dtype}"
    core = native_core()
    if core is None:
        return "reference", f"the native core cannot be loaded ({native_failure()})"
    return "native", f"native core with {core.info()['instruction_set']} on {thread_count()} threads"


@cache
def _log_once(name: str, reason: str) -> None:
    _log.info("rasterizer: %s (%s)", name, reason)


_BLEND_ONLY = Compositing()


def rasterize(
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    opacities: Tensor,
    values: Tensor,
    view: View,
    *,
    background: Tensor | None = None,
    screen_offset: Tensor | None = None,
    compositing: Compositing = _BLEND_ONLY,
    added: Tensor | None = None,
    backend: Backend = "auto",
) -> Raster:
    """Blend `values` `[gaussian, channel]` front to back into the picture that a camera or panorama sees.

    `means` `[gaussian, 3]` [m], `quats` `[gaussian, 4]` (wxyz, any length), `scales` `[gaussian, 3]` [m], `opacities`
    `[gaussian]` and `values` (any number of channels, blended as given) are activated. `background` `[channel]` fills
    what the Gaussians let through. `screen_offset` `[gaussian, 2]` [pixel] moves the projected centres in a camera's
    view; a zero tensor collects d loss / d centre. `compositing` says what else is done to the channels, and `added`
    `[row, col, channel]` is added before their transfer. Differentiable in every tensor that requires a gradient; the
    others cost nothing. The result does not depend on the number of threads. Gaussians that are not finite, have a zero
    quaternion, a negative scale or an opacity below 1/255, or lie nearer than the near plane or beside the picture, are
    not drawn.

    Raises InputError for wrong shapes or devices and for what a backend cannot do, MissingDependencyError for a backend
    that is not installed. The specification is `splats.reference` and `splats.compositing`.
    """
    if backend not in _BACKENDS:
        raise InputError(f"backend must be one of {', '.join(_BACKENDS)}; got {backend!r}")
    check_inputs(means, quats, scales, opacities, values, background, screen_offset)
    check_view(view, values, background, screen_offset, compositing, added)
    name, reason = backend, "asked for by name"
    if backend == "auto":
        name, reason = pick_backend(means.device.type, means.dtype)
    _log_once(name, reason)
    arguments = (means, quats, scales, opacities, values, view)
    options = {
        "background": background,
        "screen_offset": screen_offset,
        "blur": compositing.blur,
        "depth_gate": compositing.depth_gate,
    }
    if name == "native":
        if means.dtype != torch.float32 or means.device.type != "cpu":
            raise InputError(
                f"the native backend needs float32 tensors on the CPU; got {means.dtype} on {means.device}. "
                "Call .float().cpu() or choose another backend"
            )
        from rf3dgs.splats.backends.native import rasterize_native as draw
    elif name == "gsplat":
        from rf3dgs.splats.backends.gsplat import rasterize_gsplat as draw
    else:
        from rf3dgs.splats.reference import rasterize_reference as draw
    raster = draw(*arguments, **options)
    if compositing == _BLEND_ONLY and added is None:
        return raster
    return Raster(finish(raster.values, raster.weight, compositing, added), raster.weight, raster.radii)


def check_view(
    view: View,
    values: Tensor,
    background: Tensor | None,
    screen_offset: Tensor | None,
    compositing: Compositing,
    added: Tensor | None,
) -> None:
    """Raises InputError for options that do not go together or do not fit the picture."""
    if not isinstance(view, Camera | Panorama):
        raise InputError(f"view must be a Camera or a Panorama; got {type(view).__name__}. view_of makes one")
    if isinstance(view, Panorama) and screen_offset is not None:
        raise InputError("screen_offset moves what a camera sees; a panorama has no screen, leave it out")
    if compositing.normalise and background is not None:
        raise InputError(
            "normalise divides by the weight, which leaves no room for a background; leave one of them out"
        )
    compositing.transfers(values.shape[1])
    if added is None:
        return
    shape = (view.height, view.width, values.shape[1])
    if added.shape != shape:
        raise InputError(f"added must be [row, col, channel] = {list(shape)}; got {list(added.shape)}")
    if added.dtype != values.dtype or added.device != values.device:
        raise InputError(
            f"added must be {values.dtype} on {values.device} as values are; got {added.dtype} on {added.device}"
        )


def check_inputs(
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    opacities: Tensor,
    values: Tensor,
    background: Tensor | None,
    screen_offset: Tensor | None,
) -> None:
    """Raises InputError naming the first tensor of a wrong shape, dtype or device."""
    _check_columns("means", means, 3)
    count = len(means)
    for name, tensor, columns in (("quats", quats, 4), ("scales", scales, 3), ("screen_offset", screen_offset, 2)):
        if tensor is not None:
            _check_columns(name, tensor, columns)
    if opacities.dim() != 1:
        raise InputError(f"opacities must be [gaussian]; got {list(opacities.shape)}")
    if values.dim() != 2 or values.shape[1] < 1:
        raise InputError(f"values must be [gaussian, channel]; got {list(values.shape)}")
    rows = {"quats": quats, "scales": scales, "opacities": opacities, "values": values, "screen_offset": screen_offset}
    for name, tensor in rows.items():
        if tensor is None:
            continue
        if len(tensor) != count:
            raise InputError(f"{name} must have one row per Gaussian ({count}, as means); got {len(tensor)}")
    if background is not None and background.shape != (values.shape[1],):
        raise InputError(f"background must be [channel] = [{values.shape[1]}]; got {list(background.shape)}")
    for name, tensor in (rows | {"background": background}).items():
        if tensor is not None and (tensor.dtype != means.dtype or tensor.device != means.device):
            raise InputError(
                f"{name} must be {means.dtype} on {means.device} as means are; got {tensor.dtype} on {tensor.device}"
            )


def _check_columns(name: str, tensor: Tensor, columns: int) -> None:
    if tensor.dim() == 2 and tensor.shape[1] == columns:
        return
    transposed = tensor.dim() == 2 and tensor.shape[0] == columns
    hint = ". Transpose it?" if transposed else ""
    raise InputError(f"{name} must be [gaussian, {columns}]; got {list(tensor.shape)}{hint}")
