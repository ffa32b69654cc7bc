"""Ideal spectra: the power of all paths summed through a narrow Gaussian lobe.

Few paths (line of sight, mirrors, the strongest of the others) are summed exactly, pixel by pixel. The many weak
diffuse ones are deposited on a fine sphere, five channels each (power, power x delay, power x departure vector), and
smoothed by the lobe: along azimuth by FFT, between pairs of rows by a sum. Both ways cut the lobe where it falls below
-80 dB of a path; further away that path has exactly no power.
"""

import math
from functools import lru_cache

import numpy as np
import torch
from torch import Tensor

from rf3dgs.channel.binning import DIFFUSE
from rf3dgs.channel.paths import Paths
from rf3dgs.core.errors import InputError
from rf3dgs.core.frames import Pose
from rf3dgs.core.grids import DirectionGrid, equirect_grid, sample_grid
from rf3dgs.core.progress import Progress, Silent
from rf3dgs.spectra.deposit import CHANNELS, deposited, values_of
from rf3dgs.spectra.spectrum import Instrument, Spectrum

CUT = 1e-8  # relative power at which the lobe ends
FLOOR = 1e-12  # of the strongest diffuse pixel: below it the FFT's rounding begins
EXACT_ALWAYS = 1024  # a receiver with at most so many paths is summed exactly
EXACT_STRONGEST = 256  # so many of the strongest paths are exact beside the line of sight and mirrors
NARROWEST = 1.4  # lobe over pixel spacing: below it the sum over pixels loses path gain


def default_lobe(grid: DirectionGrid) -> float:
    """Half-power width [rad] for ideal spectra on `grid`: 2 degrees, or 1.5 pixels where those are wider."""
    least = math.radians(2.0)
    return least if grid.kind == "list" else max(least, 1.5 * grid.spacing)


def ideal_spectrum(
    paths: Paths,
    grid: DirectionGrid,
    *,
    lobe: float | None = None,
    pose: Pose | None = None,
    progress: Progress | None = None,
) -> Spectrum:
    """Power-weighted sums over the paths `[*batch, path]` through a lobe: power, mean delay and mean departure.

    power(r) = sum_p |a_p|^2 K(angle(r, r_p)), K = exp(-4 ln 2 (angle / lobe)^2). `lobe` [rad] is the half-power width
    (default: `default_lobe`); InputError where it is narrower than 1.4 pixels. `pose` (default: the receivers') turns
    the grid. On an equirectangular grid every lobe is scaled so that its sum over the pixels is exactly its path's
    gain: at most 0.6 dB within one pixel of a pole, hundredths elsewhere. delay and aod are zero where power is.
    """
    width = default_lobe(grid) if lobe is None else float(lobe)
    if not 0.0 < width < math.pi:
        raise InputError(f"lobe must lie between 0 and pi, in radians; got {width}")
    if grid.kind != "list" and width < NARROWEST * grid.spacing * (1 - 1e-6):
        raise InputError(
            f"lobe must be at least {NARROWEST} pixels ({math.degrees(NARROWEST * grid.spacing):.2f} degrees) wide on "
            f"this grid, or path gain is lost between pixels; got {math.degrees(width):.2f} degrees. Use more pixels"
        )
    batch = paths.coeff.shape[:-1]
    pose = pose_for(paths, pose)
    rows = paths.flat()
    world_from_device = pose.world_from_device.reshape(-1, 3, 3)
    lobe_sum = _lobe_sum(grid, width)
    sums = torch.empty(len(rows.rx), *grid.shape, CHANNELS)
    power = torch.empty(len(rows.rx), *grid.shape)
    reporter = Silent() if progress is None else progress
    reporter.start("ideal spectra", len(rows.rx))
    for index in range(len(rows.rx)):
        total = lobe_sum(rows[index], world_from_device[index])
        power[index] = total[..., 0].float()
        total[..., 1] /= total[..., 0].clamp_min(torch.finfo(torch.float64).tiny)
        total[..., 2:] = torch.nn.functional.normalize(total[..., 2:], dim=-1, eps=1e-300)
        sums[index] = torch.where((power[index] > 0)[..., None], total, torch.zeros_like(total)).float()
        reporter.update(index + 1)
    reporter.finish()
    return Spectrum(
        power=power.reshape(*batch, *grid.shape),
        grid=grid,
        pose=pose,
        frequency=paths.frequency,
        instrument=Instrument.gaussian(width),
        method="ideal",
        delay=sums[..., 1].reshape(*batch, *grid.shape),
        aod=sums[..., 2:].reshape(*batch, *grid.shape, 3),
        tx=paths.tx,
    )


def pose_for(paths: Paths, pose: Pose | None) -> Pose:
    """The given pose, or the receivers' own, with the batch shape of `paths`."""
    if pose is None:
        return paths.rx
    batch = tuple(paths.coeff.shape[:-1])
    if pose.batch_shape == batch:
        return pose
    if pose.batch_shape:
        raise InputError(f"pose must be one pose or {list(batch)}, one per receiver; got {list(pose.batch_shape)}")
    return Pose(pose.position.expand(*batch, 3), pose.orientation.expand(*batch, 4))


@lru_cache(maxsize=1)
def _lobe_sum(grid: DirectionGrid, lobe: float) -> "LobeSum":
    """The last one is kept for the next receivers on the same grid: preparing it is a third of the work of a sphere."""
    return LobeSum(grid, lobe)


class LobeSum:
    """The smoothing of one grid and lobe, prepared once for many receivers."""

    def __init__(self, grid: DirectionGrid, lobe: float) -> None:
        self.grid = grid
        self.lobe = lobe
        self.sharpness = 4.0 * math.log(2.0) / lobe**2
        self.cut = min(math.pi, math.sqrt(-math.log(CUT) / self.sharpness))
        self.directions = grid.directions.reshape(-1, 3)
        self.whole_sphere = grid.kind == "equirect"
        self.solid_angle = grid.solid_angle.reshape(-1).double()
        self.sphere: _Sphere | None = None

    def __call__(self, paths: Paths, world_from_device: Tensor) -> Tensor:
        """Sums `[row, col, 5]` (float64) of power, power x delay [s] and power x departure vector of one receiver."""
        gain = paths.path_gain
        directions, departures = paths.aoa @ world_from_device, paths.aod
        exact = _exact(paths, gain)
        total = self._sum_exactly(directions[exact], values_of(gain[exact], paths.delay[exact], departures[exact]))
        gain = torch.where(exact, torch.zeros_like(gain), gain)
        if bool((gain > 0).any()):
            if self.sphere is None:
                self.sphere = _Sphere(self.grid, self.lobe, self.sharpness, self.cut)
            total += self.sphere(directions, gain, paths.delay, departures)
        return total

    def _sum_exactly(self, directions: Tensor, values: Tensor) -> Tensor:
        """Sum every lobe at every pixel within its cut."""
        total = torch.zeros(len(self.directions), CHANNELS, dtype=torch.float64)
        nearest, blocks = math.cos(self.cut) - 1e-6, self.grid.blocks
        step = max(1, 2**21 // max(1, len(self.directions)))
        for start in range(0, len(directions), step):
            part = directions[start : start + step]
            block, path = blocks.near(part, self.cut)
            pixel = blocks.pixels[block]
            inside = (self.directions[pixel] * part[path, None]).sum(-1) >= nearest
            path = path[:, None].expand_as(pixel)[inside & (pixel >= 0)]
            pixel = pixel[inside & (pixel >= 0)]
            chord = (self.directions[pixel].double() - part[path].double()).square().sum(-1)
            kernel = torch.exp(-self.sharpness * (2 * torch.asin((chord.sqrt() / 2).clamp_max(1.0))) ** 2)
            kernel = torch.where(kernel >= CUT, kernel, torch.zeros_like(kernel))
            if self.whole_sphere:
                seen = torch.zeros(len(part), dtype=torch.float64)
                seen.index_add_(0, path, kernel * self.solid_angle[pixel])
                kernel = kernel * (math.pi / self.sharpness / seen)[path]
            total.index_add_(0, pixel, kernel[:, None] * values[start + path])
        return total.reshape(*self.grid.shape, CHANNELS)


def _exact(paths: Paths, gain: Tensor) -> Tensor:
    """Which of the paths that arrive are summed exactly `[path]`."""
    arriving = gain > 0
    if int(arriving.sum()) <= EXACT_ALWAYS:
        return arriving
    exact = torch.zeros_like(arriving)
    if paths.kind is not None:
        exact = arriving & ((paths.kind & DIFFUSE) == 0)
    elif paths.order is not None:
        exact = arriving & (paths.order == 0)
    if int(exact.sum()) > EXACT_ALWAYS:
        exact = torch.zeros_like(exact)
    exact[gain.topk(EXACT_STRONGEST).indices] = True
    return exact


class _Sphere:
    """A fine equirectangular sphere whose nodes take the diffuse paths and whose rows are smoothed into the grid's.

    Node (i, j) lies at zenith (i + 1/2) pi / rows and azimuth pi - (j + fold / 2) 2 pi / columns: every `fold`-th node
    of a row is a column of the smoothed picture. The lobe is narrowed by the mean variance of the bilinear deposit (and
    of the bilinear look-up, where the grid is no sphere), so that the result has the lobe's width on average.
    """

    def __init__(self, grid: DirectionGrid, lobe: float, sharpness: float, cut: float) -> None:
        step = lobe / 6.0
        self.grid = grid
        if grid.kind == "equirect":
            height, width, blurs = grid.height, grid.width, 1
            self.fold = math.ceil(2 * math.pi / (width * step))
            self.rows = height * math.ceil(math.pi / (height * step))
        else:
            height = math.ceil(math.pi / step)
            width, blurs = 2 * height, 2
            self.fold, self.rows = 1, height
        self.picture = equirect_grid(width, height) if grid.kind != "equirect" else grid
        self.columns = width * self.fold
        variance = 0.5 / sharpness - blurs * (math.pi / self.rows) ** 2 / 6.0
        solid_angle = self.picture.solid_angle[:, 0].double().numpy() * width
        zenith = (np.arange(self.rows) + 0.5) * (math.pi / self.rows)
        half = np.arange(self.columns // 2 + 1) * (2 * math.pi / self.columns)
        seen = np.zeros(self.rows)
        self.kernels: list[tuple[int, int, Tensor]] = []
        for row in range((height + 1) // 2):
            centre = (row + 0.5) * math.pi / height
            first = int(np.searchsorted(zenith, centre - cut))
            last = int(np.searchsorted(zenith, centre + cut, side="right"))
            near = zenith[first:last, None]
            square = np.sin((near - centre) / 2) ** 2 + math.sin(centre) * np.sin(near) * np.sin(half / 2) ** 2
            kernel = np.exp(-((2 * np.arcsin(np.sqrt(np.minimum(square, 1.0)))) ** 2) / (2 * variance))
            kernel[kernel < CUT] = 0.0
            circle = np.concatenate((kernel, kernel[:, (self.columns - 1) // 2 : 0 : -1]), 1)
            spectrum = np.fft.rfft(circle).real
            self.kernels.append((first, last, torch.from_numpy(spectrum)))
        below = [(self.rows - last, self.rows - first, kernel.flip(0)) for first, last, kernel in self.kernels]
        self.kernels += below[: height // 2][::-1]
        for row, (first, last, kernel) in enumerate(self.kernels):
            seen[first:last] += solid_angle[row] * kernel[:, 0].numpy() / self.columns
        self.scale = torch.from_numpy((math.pi / sharpness) / seen)

    def __call__(self, directions: Tensor, gain: Tensor, delay: Tensor, departures: Tensor) -> Tensor:
        """The smoothed sums `[row, col, 5]` on the grid of paths at device-frame `directions` `[path, 3]`."""
        sums = deposited(directions, gain, delay, departures, (self.rows, self.columns, self.fold))
        waves = torch.fft.rfft(sums * self.scale[:, None], dim=-1)
        lines = torch.stack([(waves[:, first:last] * kernel).sum(1) for first, last, kernel in self.kernels], 1)
        smooth = torch.fft.irfft(lines, self.columns)[..., :: self.fold]
        smooth = torch.where(smooth[0] < FLOOR * smooth[0].max(), torch.zeros_like(smooth), smooth)
        picture = smooth.movedim(0, -1).contiguous()
        if self.grid.kind == "equirect":
            return picture
        return sample_grid(picture, self.picture, self.grid.directions)
