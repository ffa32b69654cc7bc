"""Drawing without training: Gaussians, a view, a picture."""

import torch
from torch import Tensor

from rf3dgs.core.grids import View
from rf3dgs.core.threads import thread_count
from rf3dgs.splats.backends import native
from rf3dgs.splats.backends.trainer import look_arguments
from rf3dgs.splats.compositing import Compositing
from rf3dgs.splats.engine import BLEND_ONLY, make_look
from rf3dgs.splats.gaussians import Gaussians
from rf3dgs.splats.raster import Raster
from rf3dgs.splats.rasterize import Backend, pick_backend
from rf3dgs.splats.trainer import Trainer


def draw(
    gaussians: Gaussians,
    view: View,
    *,
    offset: float = 0.5,
    clamp: bool = True,
    extra: Tensor | None = None,
    depth: bool = False,
    background: Tensor | None = None,
    compositing: Compositing = BLEND_ONLY,
    added: Tensor | None = None,
    backend: Backend = "auto",
) -> Raster:
    """What a view sees of the Gaussians, outside any graph: their harmonics, `extra` channels and depth.

    The arguments are as in `Trainer` and `Trainer.draw`. Only the Gaussians in view cost an evaluation of their
    harmonics. Who draws the same Gaussians often draws a little faster with a `Trainer`, which keeps them in order.
    """
    chosen = pick_backend()[0] if backend == "auto" else backend
    if chosen != "native":
        trainer = Trainer(*gaussians.tensors().values(), train=(), offset=offset, clamp=clamp, backend=backend)
        return trainer.draw(view, extra=extra, depth=depth, background=background, compositing=compositing, added=added)
    now = gaussians.detach()
    look = make_look(
        view, (len(now), now.sh.shape[1], now.channels), extra, depth, background, compositing, added, now.means
    )
    picture, weight = torch.empty(view.height, view.width, look.width), torch.empty(view.height, view.width)
    radii = torch.empty(len(now))
    parameters = (*now.tensors().values(), offset, clamp)
    native.core().draw(*parameters, *look_arguments(look), picture, weight, radii, thread_count())
    return Raster(picture, weight, radii)
