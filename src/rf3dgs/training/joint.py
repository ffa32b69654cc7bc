"""Joint refinement of a mirror field: point sources and surface in one differentiable picture, by Adam.

The closed form fits one part after the other, and hides from the surface what point sources rule. Here one loss over
all pixels of a training spectrum moves laws, residual, the level of all sources and the reflection of planes together.
Where things are stays: Gaussians, shadows, images and which of their ways are open.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import torch
from torch import Tensor
from torch.nn.functional import embedding

from rf3dgs.field.lit import BLENDING, CSI_HARMONICS, LARGEST_RESIDUAL_DB, LitSurface
from rf3dgs.field.rays import Rays
from rf3dgs.field.sources import PointSources
from rf3dgs.spectra.spectrum import Spectrum
from rf3dgs.splats.harmonics import C0
from rf3dgs.splats.rasterize import Backend, rasterize
from rf3dgs.training.joint_views import JointView, joint_views, misfit
from rf3dgs.training.lit_fit import BAND, CSI_RIDGE, LAW_HIGH, LAW_LOW, LAW_SPREAD, RIDGE, SHRINK, SOFT_DB
from rf3dgs.training.lit_views import SOFT_NS, SOFT_TURN

RATE = 0.06  # Adam's first step, in units of `SCALES`; it falls to zero
CSI_UNIT = torch.tensor([SOFT_NS, SOFT_TURN, SOFT_TURN, SOFT_TURN])
SCALES = {
    "laws": LAW_SPREAD,
    "segment_sh": 1 / (C0 * (1 + BAND)),
    "cell_sh": 1 / (C0 * (1 + BAND)),
    "level": torch.ones(()),
    "segment_csi": CSI_UNIT / (C0 * (1 + BAND[:CSI_HARMONICS, None])),
    "cell_csi": CSI_UNIT / (C0 * (1 + BAND[:CSI_HARMONICS, None])),
    "own_csi": CSI_UNIT,
    "reflection": torch.tensor([0.3, 0.3, 0.3]),
    "level_db": torch.tensor(0.03),
}
"""What moves, and by how much one of it counts 1: dB, ns, radians, and what the laws of segments vary by. Point sources
move a little only: peaks that stand alone tell them better than pixels that they share with the surface."""
PRIOR = {
    "laws": SHRINK * SOFT_DB,
    "segment_sh": RIDGE.segment,
    "cell_sh": RIDGE.cell,
    "level": RIDGE.level,
    "segment_csi": CSI_RIDGE.segment,
    "cell_csi": CSI_RIDGE.cell,
    "own_csi": CSI_RIDGE.level,
    "reflection": SHRINK,
    "level_db": SHRINK,
}
"""How many pixels say that each stays where the closed form has it."""
RESIDUAL = ("segment_sh", "cell_sh", "level", "segment_csi", "cell_csi", "own_csi")
CSI = ("segment_csi", "cell_csi", "own_csi")


def picture(surface: LitSurface, found: Mapping[str, Tensor], one: JointView, backend: Backend = "auto") -> Tensor:
    """Power over the unit, that times delay [ns] and times departure `[row, col, 1 (+ 4)]` of sources and surface.

    `found`: the numbers of `SCALES`, in which it is differentiable; all else is the surface's.
    """
    values = _alone(surface, found).values(one.view.position, csi=one.has_csi)
    shape = (surface.means, surface.quats, surface.scales, surface.opacities)
    blended = rasterize(*shape, values, one.view, compositing=BLENDING, backend=backend).values
    laws = embedding(one.plane, torch.cat((found["reflection"], found["reflection"].new_zeros(1, 3))))
    per_bounce = laws[..., 0] + one.cosine * (laws[..., 1] + one.cosine * laws[..., 2]) + one.mark_db
    power = one.free * 10 ** ((found["level_db"] + per_bounce.clamp_max(0.0).sum(-1)) / 10)
    sent = one.kernel[:, None] * torch.index_select(power[:, None] * one.known, 0, one.ray)
    return blended.flatten(0, 1).index_add(0, one.place, sent).reshape(blended.shape)


def _alone(surface: LitSurface, found: Mapping[str, Tensor]) -> LitSurface:
    """The surface with the numbers that were found, in which every Gaussian is a segment of its own.

    Gradients are summed over segments and cells by `embedding`, which adds in the same order every time.
    """

    def spread(name: str, group: Tensor) -> Tensor:
        return embedding(group, found[name].flatten(1)).unflatten(1, found[name].shape[1:])

    return replace(
        surface,
        segment_of=torch.arange(len(surface)),
        cell_of=torch.zeros_like(surface.cell_of),
        laws=spread("laws", surface.segment_of),
        segment_sh=spread("segment_sh", surface.segment_of) + spread("cell_sh", surface.cell_of),
        cell_sh=torch.zeros_like(surface.cell_sh[:1]),
        level=found["level"],
        segment_csi=spread("segment_csi", surface.segment_of) + spread("cell_csi", surface.cell_of),
        cell_csi=torch.zeros_like(surface.cell_csi[:1]),
        own_csi=found["own_csi"],
    )


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
    sources: PointSources,
    rays: Sequence[Rays],
    spectra: Spectrum,
    *,
    steps: int,
    seed: int,
    floor_db: float,
    residual: bool = True,
    backend: Backend = "auto",
) -> tuple[LitSurface, PointSources]:
    """Surface and sources after `steps` of Adam on the spectra `[position, row, col]`, one position a step.

    The closed form's values are start and prior. Without `residual` only laws, reflections and the level of the sources
    move. `seed` decides the order of positions.
    """
    views = joint_views(spectra, sources, rays, unit=surface.unit, floor_db=floor_db)
    start = {name: getattr(surface, name) for name in ("laws", *RESIDUAL)}
    start |= {"reflection": sources.reflection, "level_db": torch.tensor(sources.level_db)}
    still = (() if residual else RESIDUAL) + (() if views[0].has_csi else CSI)
    moved = {name: torch.zeros_like(x).requires_grad_() for name, x in start.items() if name not in still}
    adam = torch.optim.Adam(list(moved.values()), lr=RATE)
    generator = torch.Generator().manual_seed(seed)
    order = torch.cat([torch.randperm(len(views), generator=generator) for _ in range(1 + steps // len(views))])
    for step, number in enumerate(order[:steps].tolist()):
        adam.param_groups[0]["lr"] = RATE * (1 - step / steps)
        adam.zero_grad()
        with torch.enable_grad():
            loss_of(surface, start, moved, views[number], len(views), backend).backward()
        adam.step()
    found = {name: (start[name] + SCALES[name] * x).detach() for name, x in moved.items()}
    found["laws"] = found["laws"].clamp(LAW_LOW, LAW_HIGH)
    if "level" in found:
        found["level"] = found["level"].clamp(-LARGEST_RESIDUAL_DB, LARGEST_RESIDUAL_DB)
    reflection, level_db = found.pop("reflection"), float(found.pop("level_db"))
    return replace(surface, **found), replace(sources, reflection=reflection, level_db=level_db)
