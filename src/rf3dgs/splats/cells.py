"""Which Gaussians are near and alike enough to become one: cells in the planes of their normals.

Normals are sorted into bins of about 20 degrees, either sign in the same one, and each bin divides space into cells of
its own: squares in the bin's plane, half as thick as wide. Their widths are powers of two of one unit, so that smaller
cells nest in larger ones. Walls that meet at an edge belong to different bins and never share a cell.
"""

import math

import torch
from torch import Tensor

from rf3dgs.splats.gaussians import Gaussians
from rf3dgs.splats.harmonics import C0
from rf3dgs.splats.surface import normals

FINEST = 1e-3  # width of the smallest cells [m]
THICK = 0.5  # thickness / width of a cell
OWN = 0.8  # a Gaussian whose largest scale exceeds this share of a cell's width is not merged in it
PHASE = 0.37  # shifts cells against whole multiples of their width, where walls like to stand
SIDES = 5  # bins along each side of a cube's face
_BITS = 18  # of a cell's number along each axis
_ALONG_U, _ALONG_V = 1 << (2 * _BITS), 1 << _BITS


def shared_cells(gaussians: Gaussians, finest: Tensor, widest: float, doublings: int, colour: float) -> Tensor:
    """Numbers `[gaussian]` from 0 without gaps, equal for Gaussians that share a cell.

    `finest` `[gaussian]` [m] is the width below which nobody can tell a Gaussian from its neighbours. Cells may be
    wider by up to `doublings` factors of two where all four neighbouring cells hold Gaussians of like normals too and
    the standard deviation of the constant colour is at most `colour`, but no wider than `widest` [m].
    """
    bin_number, frame = _bins(normals(gaussians))
    means = gaussians.means.double()
    local = ((means - means.mean(0).round())[:, None] @ frame[bin_number]).squeeze(1)
    unit = FINEST * 2.0 ** float((local.abs().max() / (FINEST * 2 ** (_BITS - 3))).log2().ceil().clamp_min(0))
    low = (finest.double() / unit).clamp_min(1.0).log2().floor().long()
    high = torch.maximum(low, (low + doublings).clamp_max(math.floor(math.log2(widest / unit))))
    largest, shade = gaussians.scales.amax(-1), gaussians.sh[:, 0].double() * C0
    cluster = torch.full((len(gaussians),), -1, dtype=torch.long)
    made = 0
    for level in range(int(high.max()), int(low.min()) - 1, -1):
        width = unit * 2.0**level
        fits = (cluster < 0) & (low <= level) & (high >= level) & (largest <= OWN * width)
        some = fits.nonzero().squeeze(-1)
        if len(some) == 0:
            continue
        every = _cell_numbers(bin_number, local, width)
        cell, of = torch.unique(every[some], return_inverse=True)
        wide = _continues(cell, torch.unique(every)) & (_deviation(shade[some], of, len(cell)) <= colour)
        taken = wide[of] | (low[some] == level)
        found, number = torch.unique(of[taken], return_inverse=True)
        cluster[some[taken]] = made + number
        made += len(found)
    alone = (cluster < 0).nonzero().squeeze(-1)
    cluster[alone] = made + torch.arange(len(alone))
    return cluster


def _cell_numbers(bin_number: Tensor, local: Tensor, width: float) -> Tensor:
    """One number `[gaussian]` for the bin and the cell of `width` [m] that holds `local` `[gaussian, 3]` [m]."""
    u, v, w = torch.floor(local / local.new_tensor([width, width, THICK * width]) + PHASE).long().unbind(-1)
    middle = 1 << (_BITS - 1)
    return (((((bin_number << _BITS) + u + middle) << _BITS) + v + middle) << _BITS) + w + middle


def _continues(cell: Tensor, occupied: Tensor) -> Tensor:
    """True `[cell]` where the surface goes on to all four sides: `occupied` (sorted) holds those neighbours, at the
    same height or one cell off."""
    goes_on = torch.ones(len(cell), dtype=torch.bool)
    for step in (_ALONG_U, -_ALONG_U, _ALONG_V, -_ALONG_V):
        neighbour = (cell + step)[:, None] + torch.arange(-1, 2)
        place = torch.searchsorted(occupied, neighbour).clamp_max(len(occupied) - 1)
        goes_on &= (occupied[place] == neighbour).any(-1)
    return goes_on


def _deviation(values: Tensor, group: Tensor, count: int) -> Tensor:
    """The largest standard deviation `[group]` of any channel of `values` `[row, channel]`."""
    members = torch.bincount(group, minlength=count)[:, None]
    empty = values.new_zeros(count, values.shape[1])
    mean = empty.index_add(0, group, values) / members
    return (empty.index_add(0, group, (values - mean[group]).square()) / members).sqrt().amax(-1)


def _bins(normal: Tensor) -> tuple[Tensor, Tensor]:
    """The bin `[gaussian]` of each normal and a rotation `[bin, 3, 3]` whose columns are two tangents and the normal.

    The bins are squares on three faces of a cube; the axes of the world lie in the middle of theirs.
    """
    normal = normal.double()
    face = normal.abs().argmax(-1)
    other = torch.tensor([[1, 2], [2, 0], [0, 1]])
    slope = normal.gather(1, other[face]) / normal.gather(1, face[:, None])
    row, column = ((slope + 1) * (0.5 * SIDES)).long().clamp(0, SIDES - 1).unbind(-1)
    grid = torch.cartesian_prod(torch.arange(3), torch.arange(SIDES), torch.arange(SIDES))
    centre = torch.ones(len(grid), 3, dtype=torch.float64)
    centre.scatter_(1, other[grid[:, 0]], (2.0 * grid[:, 1:].double() + 1) / SIDES - 1)
    centre = torch.nn.functional.normalize(centre, dim=-1)
    axis = torch.eye(3, dtype=torch.float64)[other[grid[:, 0], 0]]
    u = torch.nn.functional.normalize(axis - (axis * centre).sum(-1, keepdim=True) * centre, dim=-1)
    return (face * SIDES + row) * SIDES + column, torch.stack((u, torch.linalg.cross(centre, u, dim=-1), centre), -1)
