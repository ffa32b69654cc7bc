"""A field of the mirror model for another place of its transmitter: what geometry says is said anew, what was learned
of surfaces stays, and what was learned of the old light is dropped (docs/how-to/moving-transmitter.md).
"""

from dataclasses import replace
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from rf3dgs.core.errors import InputError
from rf3dgs.core.frames import Pose
from rf3dgs.field.bounced import bounced, shift_of
from rf3dgs.field.images import HIGHEST_ORDER, sequences
from rf3dgs.field.lit import LitSurface
from rf3dgs.field.radiance import bounce
from rf3dgs.field.sources import PointSources
from rf3dgs.splats.harmonics import C0
from rf3dgs.splats.obstacles import Obstacles, visibility_of

if TYPE_CHECKING:
    from rf3dgs.field.radio_field import RadioField

PROBES, PROBE_MARGIN = 300, 0.5  # receivers at which images are tried, and how far [m] their box is widened
MOST_PLANES, LARGEST = 40, 6  # largest planes that mirror, and that mirror three times
LEAST_DB, MOST_SOURCES = 40.0, 200
OUT_OF_SIGHT = 0.01  # of the usual strongest way: what a probe that only weak ways reach is compared with
ROWS_AT_ONCE = 400_000
UNLIT = 0.1
LEAST_LIT = 0.05  # of what was lit before


def moved(field: "RadioField", tx: Pose, *, order: int = 2) -> "RadioField":
    """The field with its transmitter at `tx`; see `RadioField.moved_to`."""
    surface = field.surface
    if not isinstance(surface, LitSurface):
        raise InputError(
            "moving the transmitter needs a field of the mirror model; this one is of the paper's, whose harmonics "
            'hold the light of one place. Train it with RadioConfig(model="mirror")'
        )
    if tx.batch_shape:
        raise InputError(f"tx must be one pose; got a batch {list(tx.batch_shape)}. Move to each place by itself")
    if not 0 <= order <= HIGHEST_ORDER:
        raise InputError(f"order must be from 0 to {HIGHEST_ORDER}; got {order}")
    lit = moved_surface(surface, field.obstacles, tx.position)
    sources = field.sources
    if sources is not None:
        sources = moved_sources(sources, field.obstacles, field.bounds, tx.position, order=order)
    trained = " ".join(f"{value:.3f}" for value in field.tx.position.tolist())
    meta = {"trained with the transmitter at": trained} | field.meta
    return replace(field, surface=lit, sources=sources, tx=tx, meta=meta, doubt=None)


def moved_surface(surface: LitSurface, obstacles: Obstacles, tx: Tensor) -> LitSurface:
    """The surface lit from `tx` `[3]` [m]: shadows baked anew, the lit laws kept, no residual, and an
    ambient level that follows from what is lit now.

    `obstacles` are the surface's own Gaussians. Raises InputError when hardly anything is lit from its free side.
    """
    visibility = visibility_of(obstacles, surface.means, surface.normals, tx, obstacles.labels)
    lit, before = _lit(surface, visibility, tx), _lit(surface, surface.visibility, surface.tx)
    if lit == 0.0 or lit < LEAST_LIT * before:
        place = ", ".join(f"{value:.2f}" for value in tx.tolist())
        raise InputError(
            f"tx must stand in the free space of this field; from ({place}) m {lit:.1%} of the surface is lit, from "
            f"where it stood {before:.1%}. Is it in a wall, or outside?"
        )
    laws = surface.laws.clone()
    laws[:, 3], laws[:, 4] = shared_ambient_db(surface, obstacles), 0.0
    there = replace(surface.without_residual(), visibility=visibility, laws=laws, tx=tx)
    got = bounced(there, obstacles)
    straight = bounce(surface.means, tx)
    once = got[:, 1:] / got[:, :1].clamp_min(1e-30)
    ambient = torch.where((got[:, 0] > 0)[surface.cell_of, None], once[surface.cell_of], straight)
    return replace(there, ambient=ambient, ambient_shift=shift_of(got[:, 0]))


def shared_ambient_db(surface: LitSurface, obstacles: Obstacles) -> float:
    """The ambient level [dB] over what lit surfaces bring each cell: the median over the Gaussians that the transmitter
    does not light, residual included; over all where it lights all.

    Where the transmitter does light, the ambient law takes up what the lit one misses, and its falloff is that of one
    side of a site: neither says anything about another place.
    """
    level_db = 10 * torch.log10(surface.parts(torch.zeros_like(surface.means))[1])
    constant = surface.segment_sh[surface.segment_of, 0] + surface.cell_sh[surface.cell_of, 0]
    over_db = level_db + C0 * constant + surface.level - shift_of(bounced(surface, obstacles)[:, 0])[surface.cell_of]
    dark = surface.visibility < UNLIT
    return float((over_db[dark] if bool(dark.any()) else over_db).median())


def _lit(surface: LitSurface, visibility: Tensor, tx: Tensor) -> float:
    """The share of Gaussians that a transmitter lights from their free side."""
    faces = ((tx - surface.means) * surface.normals).sum(-1) > 0
    return float((faces & (visibility > 0.5)).float().mean())


def moved_sources(
    sources: PointSources, obstacles: Obstacles, bounds: Tensor, tx: Tensor, *, order: int = 2
) -> PointSources:
    """The transmitter at `tx` `[3]` and its images, those that matter somewhere in the box `bounds` `[2, 3]` [m]."""
    mirrors = sources.mirrors
    if mirrors is None:
        named = sources.sequence[sources.sequence >= 0]
        mirrors = torch.zeros(len(sources.planes), dtype=torch.bool).index_fill(0, named, True)
    bare = replace(sources, tx=tx, sequence=sources.sequence[:1], mirrors=mirrors)
    low, high = bounds[0] - PROBE_MARGIN, bounds[1] + PROBE_MARGIN
    probes = low + (high - low) * torch.rand(PROBES, 3, generator=torch.Generator().manual_seed(0))
    every = with_images(bare, probes, order=order, planes=MOST_PLANES, largest=LARGEST)
    return _strongest(every, probes, obstacles)


def with_images(sources: PointSources, probes: Tensor, *, order: int, planes: int, largest: int) -> PointSources:
    """The sources with all images up to `order` reflections that reach one of the `probes` `[n, 3]` over surface.

    Mirrors are at most `planes` planes of `sources.mirrors`, those that mirror the transmitter to a probe by themselves
    first, and of these the largest; a third reflection is tried over the `largest` only.
    """
    areas = torch.ones(len(sources.planes)) if sources.patches is None else sources.patches.areas
    if sources.mirrors is not None:
        areas = torch.where(sources.mirrors, areas, -1.0)
    if int((areas >= 0).sum()) > planes:
        alone = replace(sources, sequence=sequences(len(areas), 1)).reaching(probes)[1:]
        areas = torch.where(alone & (areas >= 0), areas + areas.max(), areas)
    chosen = areas.argsort(descending=True, stable=True)[:planes]
    chosen = chosen[areas[chosen] >= 0]
    rows = sequences(len(chosen), min(order, 2))
    if order >= 3:
        rows = torch.cat((rows, sequences(0, 0, third=torch.arange(min(largest, len(chosen))))[1:]))
    if len(chosen):
        rows = torch.where(rows >= 0, chosen[rows.clamp_min(0)], -1)
    kept = [torch.zeros(1, dtype=torch.long)]
    for chunk in torch.arange(1, len(rows)).split(max(1, ROWS_AT_ONCE // len(probes))):
        part = replace(sources, sequence=torch.cat((rows[:1], rows[chunk])))
        kept.append(chunk[part.reaching(probes)[1:]])
    return replace(sources, sequence=rows[torch.cat(kept)])


def _strongest(sources: PointSources, probes: Tensor, obstacles: Obstacles) -> PointSources:
    """The sources that at one of the probes come within `LEAST_DB` of the strongest way, at most `MOST_SOURCES`."""
    rays = [one for one in sources.rays_each(probes, obstacles) if len(one)]
    tops = [one.power.max() for one in rays]
    best = torch.zeros(len(sources))
    if rays:
        usual = torch.stack(tops).median()
        for one, top in zip(rays, tops, strict=True):
            share = one.power / torch.maximum(top, OUT_OF_SIGHT * usual)
            best = torch.maximum(best, torch.zeros_like(best).index_put((one.index,), share))
    order = best[1:].argsort(descending=True, stable=True)[:MOST_SOURCES] + 1
    kept = order[best[order] > 10 ** (-LEAST_DB / 10)].sort().values
    return replace(sources, sequence=sources.sequence[torch.cat((torch.zeros(1, dtype=torch.long), kept))])
