"""Spectra on another grid of directions."""

from dataclasses import replace

import torch

from rf3dgs.core.grids import DirectionGrid, sample_grid
from rf3dgs.spectra.spectrum import Spectrum


def resample(spectrum: Spectrum, grid: DirectionGrid) -> Spectrum:
    """The spectrum as seen on `grid` from the same poses: power bilinear, delay and aod weighted by power.

    The floor is that of the nearest pixel.

    Directions outside a pinhole's picture have power zero. The lobe should be wider than the pixels of both grids.
    """
    if spectrum.grid.same_as(grid):
        return replace(spectrum, grid=grid)
    floor = None if spectrum.floor is None else _nearest(spectrum.floor, spectrum.grid, grid)
    batch = spectrum.power.shape[:-2]
    power = spectrum.power.reshape(-1, *spectrum.grid.shape)
    delay = None if spectrum.delay is None else spectrum.delay.reshape(-1, *spectrum.grid.shape)
    aod = None if spectrum.aod is None else spectrum.aod.reshape(-1, *spectrum.grid.shape, 3)
    inside = spectrum.grid.pixel_of(grid.directions)[1]
    powers, delays, aods = [], [], []
    for index, one in enumerate(power):
        channels = [one[..., None]]
        if delay is not None:
            channels.append((one * delay[index])[..., None])
        if aod is not None:
            channels.append(one[..., None] * aod[index])
        sampled = sample_grid(torch.cat(channels, -1).double(), spectrum.grid, grid.directions)
        sampled = torch.where(inside[..., None], sampled, torch.zeros_like(sampled))
        powers.append(sampled[..., 0])
        if delay is not None:
            late = sampled[..., 1] / sampled[..., 0].clamp_min(1e-300)
            delays.append(torch.where(sampled[..., 0] > 0, late, torch.zeros_like(late)))
        if aod is not None:
            aods.append(torch.nn.functional.normalize(sampled[..., -3:], dim=-1, eps=1e-300))

    def gathered(values: list[torch.Tensor], *channel: int) -> torch.Tensor:
        return torch.stack(values).float().reshape(*batch, *grid.shape, *channel)

    return replace(
        spectrum,
        grid=grid,
        power=gathered(powers),
        delay=gathered(delays) if delays else None,
        aod=gathered(aods, 3) if aods else None,
        floor=floor,
    )


def _nearest(floor: torch.Tensor, old: DirectionGrid, grid: DirectionGrid) -> torch.Tensor:
    """The floor of the nearest pixels of the `old` grid; infinite outside it."""
    pixel, inside = old.pixel_of(grid.directions)
    col, row = (pixel[..., axis].long().clamp(0, old.shape[1 - axis] - 1) for axis in (0, 1))
    return torch.where(inside, floor[..., row, col], torch.inf)
