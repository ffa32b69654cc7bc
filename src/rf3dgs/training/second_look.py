"""A second look at what photographs show and the growing Gaussians do not: small things, far from all cameras.

The first sweep compares small copies, on which a sign ten metres away is five pixels wide and no window fits. It begins
without the sign, and the training paints it onto the wall behind, for each photograph a little differently. So places
where a photograph differs most from its drawing are swept anew at the photograph's own size. A depth counts that is
clear, nearer than what is drawn, and where more of the photographs that look at the place differ from their drawings
than agree with them.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from rf3dgs.core.grids import Camera
from rf3dgs.core.threads import on_threads
from rf3dgs.splats.draw import draw
from rf3dgs.splats.gaussians import Gaussians
from rf3dgs.splats.rasterize import Backend
from rf3dgs.training.photographs import shrunk
from rf3dgs.training.sweep import CORRELATION, Surfaces, View, beside, met, sweep, window

ACROSS = 480  # larger photographs are looked at in copies about so many pixels wide
TILE, RIM = 24, 4  # what is swept at once, and what windows need around it [pixel]
TILES = 12  # of one photograph, those that differ most
DIFFERS = 3.0  # times the usual difference between photograph and drawing is one that asks for a look
LEAST_DIFFERENCE = 0.02
LEAST_SHARE = 0.1  # of a tile that must differ so much
NEARLY = 0.75  # pixels that differ so much of it may belong to the same thing, and speak for it
PARTNERS = 6
DEPTHS, NEAREST = 160, 0.08  # depths that are tried, and the least as a share of the farthest
BEFORE = 0.93  # a depth counts that is at most this share of what is drawn
HIDDEN = 0.03  # what is drawn so much nearer than a place hides it
WITNESSES = 2


@dataclass(frozen=True, eq=False)
class Drawn:
    """A photograph beside its drawing: `view`; `difference` `[row, col]`, the mean over a window and the colours, of
    values from 0 to 1; `depth` `[row, col]` [m] as drawn."""

    view: View
    difference: Tensor
    depth: Tensor


def missing_surfaces(
    gaussians: Gaussians, cameras: Sequence[Camera], pictures: Sequence[Tensor], far: float, backend: Backend = "auto"
) -> Surfaces:
    """What posed photographs, bytes `[row, col, 3]`, show nearer than the Gaussians have it, down to `far` [m]."""
    drawn = [_drawn(gaussians, camera, picture, backend) for camera, picture in zip(cameras, pictures, strict=True)]
    usual = float(torch.stack([one.difference.median() for one in drawn]).median())
    least = max(DIFFERS * usual, LEAST_DIFFERENCE)
    views = [one.view for one in drawn]
    tiles = [(one, *corner) for one in drawn for corner in _tiles(one.difference, least)]
    parts = on_threads(lambda tile: _swept(*tile, views, least, far), tiles)
    found = Surfaces.joined([part for part in parts if part is not None])
    return found.only(_upheld(found.points, drawn, least))


def _drawn(gaussians: Gaussians, camera: Camera, picture: Tensor, backend: Backend) -> Drawn:
    view = View(*shrunk(camera, picture, max(1, round(camera.width / ACROSS))))
    shown = draw(gaussians, view.camera, depth=True, backend=backend).values
    difference = (shown[..., :3].clamp(0.0, 1.0) - view.picture).abs().mean(-1)
    return Drawn(view, window(difference[None])[0], shown[..., 3])


def _tiles(difference: Tensor, least: float) -> list[tuple[int, int]]:
    """The first row and column of tiles of a picture that differ by `least` in a tenth or more, at most `TILES`."""
    row, col = (size // TILE for size in difference.shape)
    tiles = difference[: row * TILE, : col * TILE].reshape(row, TILE, col, TILE)
    share = (tiles > least).float().mean((1, 3)).flatten()
    worst = share.argsort(descending=True, stable=True)[:TILES]
    return [(int(tile) // col * TILE, int(tile) % col * TILE) for tile in worst if float(share[tile]) > LEAST_SHARE]


def _swept(one: Drawn, row: int, col: int, views: Sequence[View], least: float, far: float) -> Surfaces | None:
    """The surfaces that a sweep of one tile finds before what is drawn, or None without partners."""
    height, width = one.view.grey.shape
    first, last = (max(0, row - RIM), max(0, col - RIM)), (min(height, row + TILE + RIM), min(width, col + TILE + RIM))
    part = slice(first[0], last[0]), slice(first[1], last[1])
    intrinsics = one.view.camera.K.clone()
    intrinsics[:2, 2] -= torch.tensor([first[1], first[0]])
    camera = replace(one.view.camera, K=intrinsics, width=last[1] - first[1], height=last[0] - first[0])
    tile = View(camera, one.view.picture[part])
    partners = [views[other] for other in beside(camera, views, far)[:PARTNERS]]
    if not partners:
        return None
    sweep(tile, partners, torch.linspace(1 / far, 1 / (NEAREST * far), DEPTHS), torch.ones_like(tile.grey), None)
    clear = (tile.score > CORRELATION) & tile.textured & (tile.depth > 0)
    clear &= (one.difference[part] > NEARLY * least) & (tile.depth < BEFORE * one.depth[part])
    return Surfaces.of([tile], [clear])


def _upheld(points: Tensor, drawn: Sequence[Drawn], least: float) -> Tensor:
    """Which points `[point, 3]` photographs speak for: more of those that would show them differ from their drawings
    there than agree, and two at the least besides the one that has them."""
    balance, witnesses = torch.zeros(len(points)), torch.zeros(len(points))
    for one in drawn:
        inside, place, depth = met(one.view, points)
        shown = inside & (one.depth[place] > (1 + HIDDEN) * depth)
        differs = one.difference[place] > NEARLY * least
        witnesses += (shown & differs).float()
        balance += (shown & differs).float() - (shown & ~differs).float()
    return (balance > 1) & (witnesses > WITNESSES)
