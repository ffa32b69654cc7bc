"""One entry for drawing Gaussians, whichever backend does it."""

import logging
from functools import cache
from typing import Literal

import torch
from torch import Tensor

from rf3dgs.core.errors import InputError
from rf3dgs.core.grids import Camera
from rf3dgs.splats.backends.core import native_core, native_failure, thread_count
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


def rasterize(
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    opacities: Tensor,
    values: Tensor,
    camera: Camera,
    *,
    background: Tensor | None = None,
    screen_offset: Tensor | None = None,
    backend: Backend = "auto",
) -> Raster:
    """Blend `values` `[gaussian, channel]` front to back into the picture that `camera` sees.

    `means` `[gaussian, 3]` [m], `quats` `[gaussian, 4]` (wxyz, any length), `scales` `[gaussian, 3]` [m], `opacities`
    `[gaussian]` and `values` (any number of channels, blended as given) are activated. `background` `[channel]` fills
    what the Gaussians let through. `screen_offset` `[gaussian, 2]` [pixel] moves the projected centres; a zero tensor
    collects d loss / d centre. Differentiable in every tensor that requires a gradient; the others cost nothing. The
    result does not depend on the number of threads. Gaussians that are not finite, have a zero quaternion, a negative
    scale or an opacity below 1/255, or lie before the near plane or beside the picture, are not drawn.

    Raises InputError for wrong shapes or devices, MissingDependencyError for a backend that is not installed. The
    specification is `splats.reference`.
    """
    if backend not in _BACKENDS:
        raise InputError(f"backend must be one of {', '.join(_BACKENDS)}; got {backend!r}")
    check_inputs(means, quats, scales, opacities, values, background, screen_offset)
    name, reason = backend, "asked for by name"
    if backend == "auto":
        name, reason = pick_backend(means.device.type, means.dtype)
    _log_once(name, reason)
    arguments = (means, quats, scales, opacities, values, camera)
    if name == "native":
        if means.dtype != torch.float32 or means.device.type != "cpu":
            raise InputError(
                f"the native backend needs float32 tensors on the CPU; got {means.dtype} on {means.device}. "
                "Call .float().cpu() or choose another backend"
            )
        from rf3dgs.splats.backends.native import rasterize_native

        return rasterize_native(*arguments, background=background, screen_offset=screen_offset)
    if name == "gsplat":
        from rf3dgs.splats.backends.gsplat import rasterize_gsplat

        return rasterize_gsplat(*arguments, background=background, screen_offset=screen_offset)
    from rf3dgs.splats.reference import rasterize_reference

    return rasterize_reference(*arguments, background=background, screen_offset=screen_offset)


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
