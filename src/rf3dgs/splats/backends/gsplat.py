"""gsplat's CUDA rasterizer behind the package's own signature (for machines with an NVIDIA GPU)."""

import importlib
import math
from types import ModuleType

import torch
from torch import Tensor

from rf3dgs.core.cube import face_cameras, sample_faces
from rf3dgs.core.errors import InputError, MissingDependencyError
from rf3dgs.core.grids import Camera, View
from rf3dgs.splats.constants import BLUR, NEAR
from rf3dgs.splats.raster import Raster


def load_gsplat() -> ModuleType:
    """The gsplat module; raises MissingDependencyError without it or without a CUDA device."""
    try:
        module = importlib.import_module("gsplat")
    except ImportError as error:
        raise MissingDependencyError(
            'the "gsplat" backend needs the gsplat package; install it with: pip install "rf3dgs[cuda]"'
        ) from error
    if not torch.cuda.is_available():
        raise MissingDependencyError(
            'the "gsplat" backend needs a CUDA device and a CUDA build of torch; use backend="native" on the CPU'
        )
    return module


def rasterize_gsplat(
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    opacities: Tensor,
    values: Tensor,
    view: View,
    *,
    background: Tensor | None = None,
    screen_offset: Tensor | None = None,
    blur: float = BLUR,
    depth_gate: float | None = None,
    module: ModuleType | None = None,
) -> Raster:
    """Blended channels of `rasterize` by gsplat (`module`, or the installed one); see there.

    The constants are gsplat's own: alpha cut and stop agree with this package, its boxes end at 3.33 standard
    deviations. The gradient with respect to the projected centres, which passes gsplat's `means2d`, is added to
    `screen_offset.grad`; offsets other than zero are not supported. A panorama costs six pictures, which are
    interpolated: faces of a cube whose middle pixels are as wide as the panorama's, six tenths of its width squared in
    all. gsplat knows no depth gate.
    """
    if depth_gate is not None:
        raise InputError(
            'the gsplat backend has no depth gate; use backend="native" or "reference", or leave depth_gate out'
        )
    gsplat = load_gsplat() if module is None else module
    gaussians = (means, quats, scales, opacities, values)
    if isinstance(view, Camera):
        return _pinhole(gsplat, *gaussians, view, background, screen_offset, blur)
    size = max(8, math.ceil(view.width / math.pi))
    faces = [_pinhole(gsplat, *gaussians, camera, background, None, blur) for camera in face_cameras(view.pose, size)]
    pictures = torch.stack([torch.cat((face.values, face.weight[..., None]), -1) for face in faces])
    sampled = sample_faces(pictures, size, view.grid.directions.to(means))
    radii = torch.stack([face.radii for face in faces]).amax(0)
    return Raster(sampled[..., :-1], sampled[..., -1], radii)


def _pinhole(
    gsplat: ModuleType,
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    opacities: Tensor,
    values: Tensor,
    camera: Camera,
    background: Tensor | None,
    screen_offset: Tensor | None,
    blur: float,
) -> Raster:
    device = means.device
    viewmat, K = camera.viewmat.to(device), camera.K.to(device)
    values_out, weight, info = gsplat.rasterization(
        means=means,
        quats=quats,
        scales=scales,
        opacities=opacities,
        colors=values[None],
        viewmats=viewmat[None],
        Ks=K[None],
        width=camera.width,
        height=camera.height,
        sh_degree=None,
        packed=False,
        near_plane=NEAR,
        eps2d=blur,
        backgrounds=None if background is None else background[None],
    )
    radii = info["radii"][0]
    radii = radii.amax(-1) if radii.dim() == 2 else radii
    means2d = info["means2d"]
    if screen_offset is not None and screen_offset.requires_grad and means2d.requires_grad:
        means2d.register_hook(lambda gradient: _add_gradient(screen_offset, gradient.reshape(-1, 2)))
    return Raster(values_out[0], weight[0, ..., 0], radii.to(means.dtype))


def _add_gradient(screen_offset: Tensor, gradient: Tensor) -> None:
    gradient = gradient.detach().to(screen_offset.dtype)
    screen_offset.grad = gradient if screen_offset.grad is None else screen_offset.grad + gradient
