"""Ideal spectra out of pictures of an array: what a field of narrow lobes can be fitted to.

The pictures of one place, such as four of an array that turns, are explained together by waves from a sphere of
directions and from points, the sharp peaks (see `inversion`). The waves seen through the ideal lobe are the spectrum.
Few steps are made: the smooth start fills in what an array does not resolve, and many would break it into spots.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from rf3dgs.channel.arrays import PlanarArray
from rf3dgs.channel.paths import Paths
from rf3dgs.channel.patterns import power_pattern
from rf3dgs.channel.sounding import DEAF
from rf3dgs.core.angles import angle_between, angles_of
from rf3dgs.core.errors import InputError
from rf3dgs.core.frames import Pose
from rf3dgs.core.grids import DirectionGrid, equirect_grid
from rf3dgs.core.progress import Progress, Silent
from rf3dgs.spectra.config import Loading
from rf3dgs.spectra.inversion import Panel, fitted, lags_of
from rf3dgs.spectra.loading import loaded
from rf3dgs.spectra.spectrum import Spectrum, stack_spectra
from rf3dgs.spectra.steering import PlanarSteering, lag_sums
from rf3dgs.spectra.synthesis import ideal_spectrum

INVERTED = ("bartlett", "tapered", "capon")
SAME_PLACE = 1e-3  # m
FIRST_STEPS, STEPS, SHARP_STEPS = 6, 4, 24
SEARCH = math.radians(1.5)  # between directions in which peaks are looked for
RING = 0.75  # lobes round a peak, over whose median it stands by
STANDS_OUT = 2.0  # this factor
MOST_POINTS = 12
TOLD = 0.1  # of the noise, where its mean is known: what a picture of many frequencies tells from it
QUIET = 0.05  # of the least level: the noise to begin with where it is not known


@dataclass(frozen=True, eq=False)
class Waves:
    """Uncorrelated plane waves at one place: directions `[n, 3]` (unit vectors, world frame), power `[n]`: path gains.

    The first are those of the pixels of a grid, the others points."""

    directions: Tensor
    power: Tensor


def ideal_targets(
    pictures: Spectrum,
    grid: DirectionGrid | None = None,
    *,
    lobe: float | None = None,
    start: Sequence[Waves] | None = None,
    progress: Progress | None = None,
) -> Spectrum:
    """The ideal spectra `[place, row, col]` behind pictures `[picture, row, col]` of an array.

    The method is "bartlett", "tapered" or "capon". Pictures taken at one place, within a millimetre, are explained
    together; places come in the order of their first picture. `grid`: whole spheres, 120x60 unless given. `lobe` [rad]
    as of `spectrum_of`. `start`: waves at each place to begin with, those of the grid first, such as a field predicts;
    None finds points and begins with the same power from everywhere. `floor` is the noise after the beam has gathered
    the wave, infinite where no picture looks. InputError for pictures without an array, or of another method.
    """
    check_pictures(pictures)
    grid = equirect_grid(120, 60) if grid is None else grid
    if grid.kind != "equirect":
        raise InputError(f"targets are whole spheres; use equirect_grid, not a grid of kind {grid.kind!r}")
    groups = places_of(pictures.pose.position)
    if start is not None and len(start) != len(groups):
        raise InputError(f"start must have waves for each of the {len(groups)} places; got {len(start)}")
    progress = Silent() if progress is None else progress
    progress.start("array pictures", len(groups))
    spectra = []
    for number, group in enumerate(groups):
        spectra.append(_target(pictures[group], grid, lobe, None if start is None else start[number]))
        progress.update(number + 1)
    progress.finish()
    return stack_spectra(spectra)


def check_pictures(pictures: Spectrum) -> None:
    """InputError for what `ideal_targets` cannot invert."""
    if pictures.instrument.array is None:
        raise InputError(
            f"{pictures.method!r} spectra say nothing of their array; give them an instrument by "
            "array_instrument(planar_array(8, 8), method)"
        )
    if pictures.method not in INVERTED:
        raise InputError(f"pictures must be by one of {', '.join(INVERTED)}; got {pictures.method!r}")
    if pictures.grid.kind == "list" or len(pictures.pose.batch_shape) != 1:
        raise InputError("pictures must be [picture, row, col] on a pinhole or equirectangular grid")


def places_of(positions: Tensor) -> list[Tensor]:
    """The numbers of the positions `[n, 3]` [m] that are one place, for each place in the order of its first."""
    left = torch.ones(len(positions), dtype=torch.bool)
    groups = []
    for number in range(len(positions)):
        if left[number]:
            same = left & (torch.linalg.vector_norm(positions - positions[number], dim=-1) < SAME_PLACE)
            groups.append(torch.nonzero(same).squeeze(-1))
            left &= ~same
    return groups


def _target(pictures: Spectrum, grid: DirectionGrid, lobe: float | None, start: Waves | None) -> Spectrum:
    """The ideal spectrum `[1, row, col]` of the pictures `[picture, row, col]` of one place."""
    array = pictures.instrument.array
    assert array is not None
    sums = [lags_of(pictures[number], array) for number in range(len(pictures))]
    smooth = grid.directions.reshape(-1, 3)
    area = grid.solid_angle.reshape(-1).double()
    level = torch.stack([one.power[one.power > 0].median() for one in pictures]).double().mean() * array.peak_gain
    flat = area * level / pictures.instrument.beam_solid_angle / array.peak_gain
    steps = STEPS
    if start is None:
        start, steps = Waves(smooth, flat), FIRST_STEPS
        points, power = _points(pictures, sums, start, area)
        start = Waves(torch.cat((smooth, points)), torch.cat((flat, power)))
    panels = _panels(pictures, sums, start.directions, area)
    power, noise = fitted(panels, start.power.double(), _noise(pictures), steps, known=pictures.noise is not None)
    points = Waves(start.directions[len(smooth) :], power[len(smooth) :])
    spectrum = ideal_spectrum(_paths(points, pictures, Pose(pictures.pose.position[:1])), grid, lobe=lobe)
    beam = spectrum.instrument.beam_solid_angle
    shown = (power[: len(smooth)] / area * beam).reshape(grid.shape).float()
    least = noise if pictures.noise is None else TOLD * noise
    floor = _floor(panels, least, len(smooth), beam / pictures.instrument.beam_solid_angle)
    looked = torch.isfinite(floor).reshape(grid.shape)
    shown = torch.where(looked, shown + spectrum.power[0], torch.zeros(()))
    floor = floor.reshape(1, *grid.shape).float()
    return replace(spectrum, power=shown[None], floor=floor, delay=None, aod=None, tx=pictures.tx)


def _panels(pictures: Spectrum, sums: Sequence[Tensor], directions: Tensor, area: Tensor) -> list[Panel]:
    """The pictures of one place with waves from `directions` `[n, 3]`; points count as a mean pixel."""
    weight = torch.cat((area, area.mean().expand(len(directions) - len(area))))
    return [Panel.of(pictures[number], one, directions, weight) for number, one in enumerate(sums)]


def _noise(pictures: Spectrum) -> Tensor:
    """Raw noise in an element `[picture]`, or a little to begin with."""
    array = pictures.instrument.array
    assert array is not None
    if pictures.noise is not None:
        return pictures.noise.double() * array.peak_gain
    least = torch.stack([one.power[one.power > 0].min() for one in pictures]).double()
    return least * array.peak_gain * array.count * QUIET


def _floor(panels: Sequence[Panel], least: Tensor, count: int, share: float) -> Tensor:
    """Power `[count]` in a lobe, a `share` of the array's beam, of a surface that the array gathers as strongly as the
    noise; infinite where none looks."""
    floor = torch.full((count,), torch.inf, dtype=torch.float64)
    for panel, one in zip(panels, least, strict=True):
        mine = (panel.heard < count) & (panel.weight > 0) & (panel.gain > DEAF * panel.array.peak_gain)
        own = min(share, 1.0) * one / (panel.array.count * panel.gain[mine])
        floor[panel.heard[mine]] = torch.minimum(floor[panel.heard[mine]], own)
    return floor


def _points(pictures: Spectrum, sums: Sequence[Tensor], smooth: Waves, area: Tensor) -> tuple[Tensor, Tensor]:
    """Directions `[k, 3]` (world) and powers `[k]` of sharp peaks in the pictures of one place.

    They are looked for in Capon's pictures. Those of other methods are explained by smooth waves first, in steps enough
    to make them sharp, and Capon's pictures are those of the waves.
    """
    array = pictures.instrument.array
    assert array is not None
    if pictures.method != "capon":
        panels = _panels(pictures, sums, smooth.directions, area)
        noise = _noise(pictures)
        power, noise = fitted(panels, smooth.power, noise, SHARP_STEPS, known=pictures.noise is not None)
        rows = [one.covariance(power, n) for one, n in zip(panels, noise, strict=True)]
        sums = [lag_sums(torch.linalg.inv(loaded(one, Loading())), array) for one in rows]
    found, power = [torch.zeros(0, 3)], [torch.zeros(0, dtype=torch.float64)]
    for number, one in enumerate(sums):
        direction, strength = _sharp_peaks(pictures[number], one, array)
        found.append(pictures.pose[number].to_world(direction))
        power.append(strength)
    directions, powers = torch.cat(found), torch.cat(power)
    kept: list[int] = []
    for number in powers.argsort(descending=True, stable=True).tolist():
        apart = angle_between(directions[kept], directions[number].expand(len(kept), 3))
        if not bool((apart < 0.25 * pictures.instrument.lobe).any()):
            kept.append(number)
    return directions[kept[:MOST_POINTS]], powers[kept[:MOST_POINTS]]


def _sharp_peaks(picture: Spectrum, sums: Tensor, array: PlanarArray) -> tuple[Tensor, Tensor]:
    """Device-frame directions `[k, 3]` and powers `[k]` of peaks that stand out of the picture `1 / sums`."""
    columns = 2 * math.ceil(math.pi / SEARCH)
    sphere = equirect_grid(columns, columns // 2)
    directions = sphere.directions
    ahead = (directions[..., 0] > math.sqrt(DEAF)) & picture.grid.pixel_of(directions)[1]
    level = 1.0 / PlanarSteering(array, directions).of_sums(sums).reshape(sphere.shape).clamp_min(1e-30)
    level = torch.where(ahead, level, torch.zeros_like(level))
    around = torch.nn.functional.max_pool2d(level[None], 3, stride=1, padding=1)[0]
    peaks = directions[(level == around) & ahead]
    step = SEARCH
    for _ in range(5):
        near = _around(peaks, step * torch.linspace(-1, 1, 5))
        value = PlanarSteering(array, near).of_sums(sums).reshape(near.shape[:-1])
        peaks = near[torch.arange(len(peaks)), value.argmin(-1)]
        step = 0.5 * step
    top = 1.0 / PlanarSteering(array, peaks).of_sums(sums).clamp_min(1e-30)
    turn = torch.linspace(0, 2 * math.pi, 17)[:16]
    ring = _around(
        peaks, RING * picture.instrument.lobe * torch.cos(turn), RING * picture.instrument.lobe * torch.sin(turn)
    )
    beside = 1.0 / PlanarSteering(array, ring).of_sums(sums).reshape(len(peaks), -1).clamp_min(1e-30)
    sharp = top > STANDS_OUT * beside.median(-1).values
    return peaks[sharp], top[sharp] / power_pattern(array.pattern, peaks[sharp]).double()


def _around(middles: Tensor, across: Tensor, up: Tensor | None = None) -> Tensor:
    """Directions `[k, n, 3]` about `middles` `[k, 3]`: shifts [rad] across and up, or all pairs of one list."""
    if up is None:
        across, up = (part.reshape(-1) for part in torch.meshgrid(across, across, indexing="ij"))
    side = torch.nn.functional.normalize(
        torch.linalg.cross(torch.tensor([0.0, 0.0, 1.0]).expand_as(middles), middles + 1e-6), dim=-1
    )
    above = torch.linalg.cross(middles, side)
    shifted = middles[:, None] + across[:, None] * side[:, None] + up[:, None] * above[:, None]
    return torch.nn.functional.normalize(shifted, dim=-1)


def _paths(waves: Waves, pictures: Spectrum, place: Pose) -> Paths:
    """The waves as paths `[1, n]` of one receiver that stands level; delays and departures mean nothing."""
    zenith, azimuth = (angle[None].float() for angle in angles_of(waves.directions))
    nothing = torch.zeros_like(zenith)
    return Paths(
        coeff=waves.power.sqrt().to(torch.complex64)[None],
        delay=nothing,
        aoa_zenith=zenith,
        aoa_azimuth=azimuth,
        aod_zenith=nothing,
        aod_azimuth=nothing,
        valid=waves.power[None] > 0,
        frequency=pictures.frequency,
        tx=Pose(torch.zeros(3)) if pictures.tx is None else pictures.tx,
        rx=place,
    )
