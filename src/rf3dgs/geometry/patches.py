"""Where planes have surface: occupied cells in each plane's own axes, 10 cm wide or more where Gaussians are large."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from functools import cached_property

import torch
from torch import Tensor

from rf3dgs.core.errors import InputError
from rf3dgs.geometry.planes import Planes

CELL = 0.10  # m
CELL_OF_SIZE = 0.75  # cells per standard deviation, at least: wide enough for the spots of a Gaussian to touch
REACH = 1.5  # standard deviations of a Gaussian that count as surface
SPOTS = 5  # points along each axis of a Gaussian by which its cells are found
MOST_CELLS = 50_000_000
LARGE, HANGS = 5.0, 2  # m^2 in one piece, and cells by which its parts are widened to touch


@dataclass(frozen=True, eq=False)
class Patches:
    """Occupancy of square cells on each plane.

    axes `[plane, 2, 3]` are unit vectors in the plane, low `[plane, 2]` [m] the corner of the first cell along them,
    shape `[plane, 2]` the number of cells, cells `[cell]` the occupancy of all planes one after another, row by row.
    cell [m] is the width of a cell.
    """

    axes: Tensor
    low: Tensor
    shape: Tensor
    cells: Tensor
    cell: float = CELL

    @classmethod
    def of(cls, planes: Planes, points: Sequence[Tensor], cell: float = CELL) -> "Patches":
        """The cells, `cell` [m] wide, that `points`, `[point, 3]` [m] for each plane, fall into along its normal."""
        axes = plane_axes(planes.normals)
        lows, shapes, cells = [], [], []
        for index, part in enumerate(points):
            local = part @ axes[index].mT
            if not len(local):
                local = torch.zeros(1, 2)
            low = (local.amin(0) / cell).floor() * cell
            place = ((local - low) / cell + 1e-4).long()
            rows, columns = (int(value) + 1 for value in place.amax(0))
            if rows * columns > MOST_CELLS:
                raise InputError(
                    f"a plane reaches over {rows * cell:.0f} m x {columns * cell:.0f} m; expected a site in metres"
                )
            grid = torch.zeros(rows, columns, dtype=torch.bool)
            if len(part):
                grid[place[:, 0], place[:, 1]] = True
            lows.append(low)
            shapes.append(torch.tensor([rows, columns]))
            cells.append(grid.flatten())
        if not cells:
            none = torch.zeros(0, 2)
            return cls(axes, none, none.long(), torch.zeros(0, dtype=torch.bool), cell)
        return cls(axes, torch.stack(lows), torch.stack(shapes), torch.cat(cells), cell)

    def __len__(self) -> int:
        return len(self.low)

    def holds(self, points: Tensor, plane: Tensor) -> Tensor:
        """True `[*batch]` where points `[*batch, 3]` [m], projected onto their `plane` `[*batch]`, lie on its surface.

        Points up to a cell beside an occupied one count, so that gaps between Gaussians close. False for plane
        -1.
        """
        plane = torch.as_tensor(plane).expand(points.shape[:-1])
        known = plane >= 0
        if not len(self):
            return torch.zeros_like(known)
        index = plane.clamp_min(0)
        local = (self.axes[index].to(points.dtype) @ points[..., None]).squeeze(-1)
        cell = ((local - self.low[index]) / self.cell).floor().long()
        found = torch.zeros_like(known)
        for row in (-1, 0, 1):
            for column in (-1, 0, 1):
                found |= self.occupied(index, cell + torch.tensor([row, column]))
        return found & known

    def occupied(self, plane: Tensor, cell: Tensor) -> Tensor:
        """True `[*batch]` where `cell` `[*batch, 2]` (row, column; any integers) of `plane` `[*batch]` is occupied."""
        shape = self.shape[plane]
        inside = ((cell >= 0) & (cell < shape)).all(-1)
        start = (self.shape.prod(-1).cumsum(0) - self.shape.prod(-1))[plane]
        place = start + cell[..., 0] * shape[..., 1] + cell[..., 1]
        return inside & self.cells[torch.where(inside, place, 0)]

    def cell_of(self, points: Tensor, plane: Tensor) -> Tensor:
        """Row and column `[point, 2]` of points `[point, 3]` on their `plane` `[point]`; may lie outside the grid."""
        local = (self.axes[plane] @ points[..., None]).squeeze(-1)
        return ((local - self.low[plane]) / self.cell).floor().long()

    def grid(self, plane: int) -> Tensor:
        """The cells of one plane `[row, column]`."""
        sizes = self.shape.prod(-1)
        start = int(sizes[:plane].sum())
        return self.cells[start : start + int(sizes[plane])].reshape(*self.shape[plane].tolist())

    @property
    def areas(self) -> Tensor:
        """Occupied area `[plane]` [m^2]."""
        return torch.tensor([float(self.grid(plane).sum()) * self.cell**2 for plane in range(len(self))])

    @cached_property
    def large(self) -> Tensor:
        """Which planes `[plane]` have 5 m^2 of surface in one piece, gaps of some cells aside.

        Tops of a table and of benches, however many, are no wall.
        """
        large = self.areas >= LARGE
        for plane in torch.nonzero(large).squeeze(-1).tolist():
            grid = self.grid(plane)
            largest = torch.bincount(connected(grid, HANGS)[grid]).max()
            large[plane] = float(largest) * self.cell**2 >= LARGE
        return large

    def tensors(self) -> dict[str, Tensor]:
        """The tensors by name, for files."""
        parts = {field.name: getattr(self, field.name) for field in fields(self)}
        return parts | {"cell": torch.tensor([self.cell], dtype=torch.float64)}

    @classmethod
    def from_tensors(cls, tensors: Mapping[str, Tensor]) -> "Patches":
        """The patches of a mapping as `tensors()` gives it; cells are 10 cm wide where it does not say."""
        parts = {field.name: tensors[field.name] for field in fields(cls) if field.name != "cell"}
        return cls(**parts, cell=float(tensors["cell"]) if "cell" in tensors else CELL)


def surface_points(planes: Planes, patches: Patches) -> list[Tensor]:
    """The middles, `[cell, 3]` [m] of each plane, of the cells that are surface."""
    points = []
    for plane in range(len(planes)):
        local = patches.low[plane] + (torch.nonzero(patches.grid(plane)) + 0.5) * patches.cell
        points.append(local @ patches.axes[plane] + planes.offsets[plane] * planes.normals[plane])
    return points


def connected(grid: Tensor, gap: int) -> Tensor:
    """The number, from 1, of the piece that each cell `[row, column]` is of; 0 elsewhere.

    What touches, corners too, after it was widened by `gap` cells is one piece, with the cells by which it was widened.
    """
    from scipy.ndimage import label

    pieces = torch.zeros(grid.shape, dtype=torch.int32)
    label(widened(grid, gap).numpy(), [[1] * 3] * 3, output=pieces.numpy())
    return pieces


def without_holes(grid: Tensor, most: int) -> Tensor:
    """Cells `[row, column]` that are True, and holes among them of fewer than `most` cells."""
    from scipy.ndimage import binary_fill_holes, label

    holes = torch.zeros(grid.shape, dtype=torch.int32)
    label((torch.from_numpy(binary_fill_holes(grid.numpy())) & ~grid).numpy(), output=holes.numpy())
    small = torch.bincount(holes.flatten()) < most
    small[0] = False
    return grid | small[holes]


def closed(grid: Tensor) -> Tensor:
    """Cells `[row, column]` that are True with gaps closed, up to two cells wide; the outline stays."""
    wide = widened(torch.nn.functional.pad(grid, (1, 1, 1, 1)), 1)
    return ~widened(~wide, 1)[1:-1, 1:-1]


def rim(grid: Tensor) -> Tensor:
    """Cells `[row, column]` that are True and have one beside them, or beyond the grid, that is not."""
    return grid & widened(~torch.nn.functional.pad(grid, (1, 1, 1, 1)), 1)[1:-1, 1:-1]


def widened(grid: Tensor, cells: int) -> Tensor:
    """Cells `[row, column]` that are True, and those up to so many `cells` beside one. Beyond the grid nothing is."""
    return torch.nn.functional.max_pool2d(grid[None, None].float(), 2 * cells + 1, 1, cells)[0, 0] > 0


def cell_for(scales: Tensor) -> float:
    """The width of cells [m] for Gaussians of `scales` `[gaussian, 3]` [m]: 10 cm, or wider where most are larger."""
    if not len(scales):
        return CELL
    return max(CELL, CELL_OF_SIZE * float(scales.sort(-1).values[:, 1].median()))


def plane_axes(normals: Tensor) -> Tensor:
    """Two unit vectors `[plane, 2, 3]` in planes of unit `normals` `[plane, 3]`, the first of them level."""
    up = normals.new_tensor([0.0, 0.0, 1.0]).expand_as(normals)
    level = torch.linalg.cross(up, normals, dim=-1)
    length = torch.linalg.vector_norm(level, dim=-1, keepdim=True)
    level = torch.where(length > 1e-3, level / length.clamp_min(1e-3), normals.new_tensor([1.0, 0.0, 0.0]))
    other = torch.nn.functional.normalize(torch.linalg.cross(normals, level, dim=-1), dim=-1)
    return torch.stack((torch.linalg.cross(other, normals, dim=-1), other), -2)


def footprints(means: Tensor, axes: Tensor, scales: Tensor) -> Tensor:
    """Points `[gaussian, spot, 3]` spread over the ellipse of `REACH` standard deviations of each Gaussian.

    `axes` `[gaussian, 3, 2]` are its two longer axes, `scales` `[gaussian, 2]` [m] their standard deviations.
    """
    span = torch.linspace(-1, 1, SPOTS)
    u, v = (part.flatten() for part in torch.meshgrid(span, span, indexing="ij"))
    inside = torch.hypot(u, v) <= 1 + 1e-6
    spot = REACH * torch.stack((u[inside], v[inside]), -1)
    return means[:, None] + torch.einsum("nij,sj->nsi", axes * scales[:, None], spot)


def widths(points: Tensor, axes: Tensor) -> tuple[float, float]:
    """Lengths [m], the longer first, of the rectangle that spreads as points `[point, 3]` do along `axes` `[2, 3]`."""
    local = points @ axes.mT
    spread = torch.linalg.eigvalsh(torch.cov(local.mT.double()) if len(local) > 1 else torch.zeros(2, 2))
    short, long = (math.sqrt(12 * max(float(value), 0.0)) for value in spread)
    return long, short
