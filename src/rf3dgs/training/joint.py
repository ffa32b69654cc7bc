"""Joint refinement of a mirror field's surface: laws and residual, in one differentiable picture with the point
sources, by Adam.

The closed form fits one part after the other, and hides from the surface what point sources rule. Here one loss over
all pixels of a training spectrum, of level, delay and departure, moves laws and residual together. Point sources stay
(peaks that stand alone tell them better than pixels that they share with the surface), and so do Gaussians and shadows.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import torch
from torch import Tensor

from rf3dgs.core.threads import on_threads
from rf3dgs.field.lit import CSI_HARMONICS, LARGEST_RESIDUAL_DB, LitSurface
from rf3dgs.field.rays import Rays
from rf3dgs.spectra.spectrum import Spectrum
from rf3dgs.splats.harmonics import C0
from rf3dgs.splats.rasterize import Backend
from rf3dgs.training.joint_views import JointView, joint_views, misfit
from rf3dgs.training.lit_fit import BAND, LAW_HIGH, LAW_LOW, LAW_SPREAD, OFF_DB, SHRINK, SOFT_DB
from rf3dgs.training.lit_views import SOFT_NS, SOFT_TURN

AT_ONCE = 2
RATE = 0.07  # Adam's first step, in units of `SCALES`; it falls to zero
CSI_UNIT = torch.tensor([SOFT_NS, SOFT_TURN, SOFT_TURN, SOFT_TURN])
SCALES = {
    "laws": LAW_SPREAD,
    "segment_sh": 1 / (C0 * (1 + BAND)),
    "cell_sh": 1 / (C0 * (1 + BAND)),
    "level": torch.ones(()),
    "segment_csi": CSI_UNIT / (C0 * (1 + BAND[:CSI_HARMONICS, None])),
    "cell_csi": CSI_UNIT / (C0 * (1 + BAND[:CSI_HARMONICS, None])),
    "own_csi": CSI_UNIT,
}
"""What moves, and by how much one of it counts 1: dB, ns, radians, and what the laws of segments vary by."""
PRIOR = {
    "laws": SHRINK * SOFT_DB,
    "segment_sh": 30.0,
    "cell_sh": 30.0,
    "level": 2.0,
    "segment_csi": 5.0,
    "cell_csi": 5.0,
    "own_csi": 2.0,
}
"""How many pixels say that each stays where the closed form has it."""
RESIDUAL = ("segment_sh", "cell_sh", "level", "segment_csi", "cell_csi", "own_csi")
CSI = ("segment_csi", "cell_csi", "own_csi")


def picture(surface: LitSurface, found: Mapping[str, Tensor], one: JointView, backend: Backend = "auto") -> Tensor:
    """Power over the unit, that times delay [ns] and times departure `[row, col, 1 (+ 4)]` of surface and sources.

    `found`: the numbers of `SCALES`, in which it is differentiable; all else is the surface's and the view's.
    """
    part = replace(surface, **found).subset(one.hit)
    return part.seen(part.values(one.view.position, csi=one.has_csi), one.view, backend) + one.sources


def loss_of(
    surface: LitSurface,
    start: Mapping[str, Tensor],
    moved: Mapping[str, Tensor],
    one: JointView,
    views: int,
    backend: Backend = "auto",
) -> Tensor:
    """Mean misfit of a view's pixels and this view's share, one of `views`, in the cost of having `moved` from `start`.

    `moved` is in units of `SCALES`; names that it lacks stay.
    """
    found = {name: start[name] + SCALES[name].to(x) * x for name, x in moved.items()}
    away = sum((PRIOR[name] * x.square().sum() for name, x in moved.items()), torch.zeros(()))
    return (misfit(picture(surface, {**start, **found}, one, backend), one) + away / views) / one.worth.numel()


def refine_jointly(
    surface: LitSurface,
    rays: Sequence[Rays],
    spectra: Spectrum,
    *,
    steps: int,
    seed: int,
    floor_db: float,
    residual: bool = True,
    backend: Backend = "auto",
) -> LitSurface:
    """The surface after `steps` of Adam on the spectra `[position, row, col]`, `AT_ONCE` positions a step.

    rays: what reaches each position from point sources. The closed form's values are start and prior. Without
    `residual` only laws move. `seed` decides the order of positions.
    """
    views = joint_views(surface, spectra, rays, floor_db=floor_db, backend=backend)
    start = {name: getattr(surface, name) for name in ("laws", *RESIDUAL)}
    still = (() if residual else RESIDUAL) + (() if views[0].has_csi else CSI)
    moved = {name: torch.zeros_like(x).requires_grad_() for name, x in start.items() if name not in still}
    adam = torch.optim.Adam(list(moved.values()), lr=RATE, fused=True)
    generator = torch.Generator().manual_seed(seed)
    rounds = 1 + steps * AT_ONCE // len(views)
    order = torch.cat([torch.randperm(len(views), generator=generator) for _ in range(rounds)])

    def slopes(number: int) -> tuple[Tensor, ...]:
        with torch.enable_grad():
            loss = loss_of(surface, start, moved, views[number], len(views), backend)
            return torch.autograd.grad(loss, list(moved.values()))

    for step, numbers in enumerate(order[: steps * AT_ONCE].view(steps, AT_ONCE).tolist()):
        adam.param_groups[0]["lr"] = RATE * (1 - step / steps)
        for x, *parts in zip(moved.values(), *on_threads(slopes, numbers), strict=True):
            x.grad = torch.stack(parts).mean(0)
        adam.step()
    found = {name: (start[name] + SCALES[name] * x).detach() for name, x in moved.items()}
    # Adam moves what has next to no gradient as well: a part that was left out stays so.
    level, ambient = (start["laws"][:, at : at + 1] > OFF_DB for at in (0, 3))
    present = torch.cat((level.expand(-1, 3), ambient.expand(-1, 2)), -1)
    found["laws"] = torch.where(present, found["laws"].clamp(LAW_LOW, LAW_HIGH), start["laws"])
    if "level" in found:
        found["level"] = found["level"].clamp(-LARGEST_RESIDUAL_DB, LARGEST_RESIDUAL_DB)
    return replace(surface, **found)
