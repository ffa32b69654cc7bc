"""Peaks of a spectrum: local maxima on the sphere, refined below the pixel."""

import torch
from torch import Tensor

from rf3dgs.core.angles import angle_between
from rf3dgs.core.errors import InputError
from rf3dgs.core.grids import DirectionGrid
from rf3dgs.spectra.spectrum import Spectrum


def find_peaks(power: Tensor, grid: DirectionGrid, *, count: int, separation: float) -> tuple[Tensor, Tensor]:
    """Up to `count` local maxima, strongest first: device-frame directions `[n, 3]` and powers `[n]`, linear.

    power `[row, col]`, linear. Peaks are at least `separation` [rad], normally the lobe, apart on the sphere, so that
    none is found twice across the seam of azimuth or at a pole. Each is refined by a quadratic fit to the logarithm of
    power in the tangent plane, which is exact for one Gaussian lobe. n is 0 where there is no power.
    """
    if tuple(power.shape) != grid.shape:
        raise InputError(f"power must be {list(grid.shape)}, the grid's shape; got {list(power.shape)}")
    if not separation > 0:
        raise InputError(f"separation must be a positive angle in radians; got {separation}")
    flat, directions = power.reshape(-1), grid.directions.reshape(-1, 3)
    candidate = torch.nonzero((_is_maximum(power, grid) & (power > 0)).reshape(-1)).squeeze(-1)
    candidate = candidate[flat[candidate].argsort(descending=True, stable=True)]
    found: list[int] = []
    while len(candidate) and len(found) < count:
        found.append(int(candidate[0]))
        candidate = candidate[angle_between(directions[candidate], directions[candidate[:1]]) >= separation]
    if not found:
        return directions.new_zeros(0, 3), flat.new_zeros(0)
    radius = 0.75 * separation if grid.kind == "list" else max(0.75 * separation, 1.5 * grid.spacing)
    refined = [_refined(flat, directions, index, radius) for index in found]
    values = torch.stack([value for _, value in refined]).to(flat.dtype)
    order = values.argsort(descending=True, stable=True)
    return torch.stack([direction for direction, _ in refined]).to(directions.dtype)[order], values[order]


def main_peak(spectrum: Spectrum) -> Tensor:
    """World-frame direction `[*batch, 3]` of the strongest peak of each spectrum; zero where there is no power."""
    batch = spectrum.power.shape[:-2]
    rows = []
    for power in spectrum.power.reshape(-1, *spectrum.grid.shape):
        directions, _ = find_peaks(power, spectrum.grid, count=1, separation=spectrum.instrument.lobe)
        rows.append(directions[0] if len(directions) else torch.zeros(3))
    return spectrum.pose.to_world(torch.stack(rows).reshape(*batch, 3))


def _is_maximum(power: Tensor, grid: DirectionGrid) -> Tensor:
    """True where no neighbouring pixel is stronger `[row, col]`."""
    if grid.kind == "list":
        return torch.ones_like(power, dtype=torch.bool)
    least = torch.full_like(power[:, :1], -1.0)
    if grid.kind == "equirect":
        half = grid.width // 2
        wide = torch.cat((power[:1].roll(half, -1), power, power[-1:].roll(half, -1)), 0)
        wide = torch.cat((wide[:, -1:], wide, wide[:, :1]), 1)
    else:
        wide = torch.cat((least, power, least), 1)
        edge = torch.full_like(wide[:1], -1.0)
        wide = torch.cat((edge, wide, edge), 0)
    return torch.nn.functional.max_pool2d(wide[None, None], 3, stride=1)[0, 0] <= power


def _refined(flat: Tensor, directions: Tensor, index: int, radius: float) -> tuple[Tensor, Tensor]:
    """Direction `[3]` and power of the maximum near pixel `index`; the pixel itself where no quadratic has one."""
    centre, value = directions[index].double(), flat[index].double()
    candidate = torch.nonzero(directions @ directions[index] > 1 - 0.55 * radius**2 - 1e-6).squeeze(-1)
    angle = angle_between(directions[candidate].double(), centre.expand(len(candidate), 3))
    near = candidate[(angle <= radius * (1 + 1e-4)) & (flat[candidate] > 1e-3 * value)]
    if len(near) < 6:
        return centre, value
    first = torch.linalg.cross(centre, torch.eye(3, dtype=torch.float64)[centre.abs().argmin()])
    first = first / torch.linalg.vector_norm(first)
    second = torch.linalg.cross(centre, first)
    local = directions[near].double()
    angle = angle_between(local, centre.expand(len(near), 3))
    tangent = torch.stack((local @ first, local @ second), -1)
    u, v = (torch.nn.functional.normalize(tangent, dim=-1) * (angle / radius)[:, None]).unbind(-1)
    level = torch.log(flat[near].double() / value)
    weight = torch.exp(level)
    design = torch.stack((torch.ones_like(u), u, v, u * u, u * v, v * v), -1)
    normal = design.mT @ (design * weight[:, None]) + 1e-12 * torch.eye(6, dtype=torch.float64)
    c, bu, bv, huu, huv, hvv = torch.linalg.solve(normal, design.mT @ (weight * level)).tolist()
    determinant = 4 * huu * hvv - huv * huv
    if huu >= 0 or determinant <= 1e-9:
        return centre, value
    top_u, top_v = (huv * bv - 2 * hvv * bu) / determinant, (huv * bu - 2 * huu * bv) / determinant
    size = (top_u**2 + top_v**2) ** 0.5
    if size > 1.0:
        return centre, value
    angle = torch.tensor(size * radius, dtype=torch.float64)
    along = (top_u * first + top_v * second) / max(size, 1e-12)
    direction = torch.cos(angle) * centre + torch.sin(angle) * along
    top = value * torch.exp(torch.tensor(c + 0.5 * (bu * top_u + bv * top_v), dtype=torch.float64))
    return direction / torch.linalg.vector_norm(direction), top
