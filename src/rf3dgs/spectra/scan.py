"""`spectrum_of`: from paths to what an instrument sees."""

import math
from dataclasses import replace
from functools import lru_cache

import torch
from torch import Tensor

from rf3dgs.channel.arrays import PlanarArray
from rf3dgs.channel.paths import Paths
from rf3dgs.channel.response import manifold
from rf3dgs.core.errors import InputError
from rf3dgs.core.frames import Pose
from rf3dgs.core.grids import DirectionGrid, equirect_grid
from rf3dgs.core.progress import Progress, Silent
from rf3dgs.spectra.beamformers import bartlett, capon, hann_taper, music, tapered
from rf3dgs.spectra.config import ArrayProcessing, Loading, Method
from rf3dgs.spectra.covariance import covariance_of, tap_count
from rf3dgs.spectra.decorrelation import forward_backward, smoothed
from rf3dgs.spectra.loading import loading_power
from rf3dgs.spectra.order import source_count
from rf3dgs.spectra.spectrum import Instrument, Spectrum
from rf3dgs.spectra.steering import PlanarSteering, Steering
from rf3dgs.spectra.synthesis import ideal_spectrum, pose_for

ALIASES = {"cbf": "bartlett", "tcbf": "tapered", "mvdr": "capon"}
METHODS = ("ideal", "bartlett", "tapered", "capon", "music")


def spectrum_of(
    paths: Paths,
    array: PlanarArray | None = None,
    grid: DirectionGrid | None = None,
    *,
    method: Method = "ideal",
    lobe: float | None = None,
    processing: ArrayProcessing | None = None,
    pose: Pose | None = None,
    seed: int = 0,
    progress: Progress | None = None,
) -> Spectrum:
    """The spectrum of paths `[*batch, path]` on `grid`: power [linear] per direction, `[*batch, row, col]`.

    "ideal": power summed through a Gaussian lobe of half-power width `lobe` [rad]; with delay and AoD, without array.
    "bartlett" (CBF), "tapered" (TCBF, Hann), "capon" (MVDR) and "music": through `array`, from a covariance that
    `processing` says how to measure and read (256 frequencies over 2 GHz unless given), its noise drawn from `seed`.
    Levels of arrays are relative to the element's peak gain, so that a path of gain g at boresight gives g; "music" has
    no level, see `beamformers.music`. `pose` (default: the receivers') turns the grid and the array.
    """
    if grid is None:
        raise InputError("spectrum_of needs a grid; use pinhole_grid, equirect_grid or list_grid")
    name = ALIASES.get(method, method)
    if name not in METHODS:
        raise InputError(f"method must be one of {', '.join((*METHODS, *ALIASES))}; got {method!r}")
    if name == "ideal":
        if processing is not None:
            raise InputError('an ideal spectrum has no array to process; use processing with method="bartlett"')
        return ideal_spectrum(paths, grid, lobe=lobe, pose=pose, progress=progress)
    if array is None:
        raise InputError(f'method {name!r} needs an array, such as planar_array(8, 8); only "ideal" does without')
    if lobe is not None:
        raise InputError(f'lobe belongs to method "ideal"; the lobe of {name!r} is that of its array')
    how = ArrayProcessing() if processing is None else processing
    _check_method(name, how)
    pose = pose_for(paths, pose)
    batch = paths.coeff.shape[:-1]
    rows = replace(paths, rx=pose).flat()
    seen = array if how.subarray is None else smoothed(torch.zeros(array.count, array.count), array, *how.subarray)[1]
    steering = PlanarSteering(seen, grid.directions)
    unit = 1.0 if name == "music" else array.peak_gain
    power, noise = torch.empty(len(rows.rx), *grid.shape), torch.empty(len(rows.rx), dtype=torch.float64)
    reporter = Silent() if progress is None else progress
    reporter.start(f"{name} spectra", len(rows.rx))
    for index in range(len(rows.rx)):
        R = _averaged_covariance(rows[index], array, how, seed + index)
        sources = _sources(R, how) if name == "music" else None
        power[index] = (beamform(name, R, steering, seen, loading=how.loading, sources=sources) / unit).float()
        noise[index] = _noise(R, name, how) / unit
        reporter.update(index + 1)
    reporter.finish()
    return Spectrum(
        power=power.reshape(*batch, *grid.shape),
        grid=grid,
        pose=pose,
        frequency=paths.frequency,
        instrument=array_instrument(seen, name),
        method=name,
        tx=paths.tx,
        noise=None if name == "music" else noise.reshape(batch),
    )


def _check_method(name: str, how: ArrayProcessing) -> None:
    """Refuse what belongs to another method."""
    if how.sources is not None and name != "music":
        raise InputError(f'sources belong to method "music"; {name!r} does not count them')
    if how.loading != Loading() and name != "capon":
        raise InputError(f'loading belongs to method "capon"; {name!r} inverts nothing')
    if name == "music" and how.snapshots is None and not isinstance(how.sources, int):
        raise InputError("to count sources takes snapshots, such as 256; or give sources as a number")


def _averaged_covariance(paths: Paths, array: PlanarArray, how: ArrayProcessing, seed: int) -> Tensor:
    """Covariance `[element, element]` of one receiver, of the subarray where there is one."""
    R = covariance_of(
        paths,
        array,
        snapshots=how.snapshots,
        bandwidth=how.bandwidth,
        taps=how.taps,
        snr_db=how.snr_db,
        seed=seed,
    )
    if how.subarray is not None:
        R, _ = smoothed(R, array, *how.subarray)
    return forward_backward(R) if how.averaging == "forward-backward" else R


def _noise(R: Tensor, name: str, how: ArrayProcessing) -> float:
    """Mean noise power in an element of R `[element, element]`, with what Capon loads."""
    mean = float(R.diagonal().real.mean())
    noise = 0.0 if how.snr_db is None else mean / (1.0 + 10.0 ** (how.snr_db / 10.0))
    return noise + float(loading_power(R, how.loading)) if name == "capon" else noise


def _sources(R: Tensor, how: ArrayProcessing) -> int:
    """How many sources MUSIC looks for in R; delay taps that are kept are its snapshots."""
    if isinstance(how.sources, int):
        return how.sources
    assert how.snapshots is not None
    snapshots = how.snapshots if how.taps is None else tap_count(how.snapshots, how.bandwidth, how.taps)
    return int(source_count(R, snapshots, how.sources or "mdl"))


def beamform(
    method: str,
    R: Tensor,
    A: Tensor | Steering,
    array: PlanarArray,
    *,
    loading: Loading | None = None,
    sources: int | None = None,
) -> Tensor:
    """Power `[*batch, *direction]` by the method's name; see `beamformers`."""
    if method == "bartlett":
        return bartlett(R, A)
    if method == "tapered":
        return tapered(R, A, hann_taper(array))
    if method == "music":
        if sources is None:
            raise InputError('"music" needs the number of sources; source_count estimates it')
        return music(R, A, sources)
    return capon(R, A, loading)


@lru_cache(maxsize=16)
def array_instrument(array: PlanarArray, method: str, *, fov: float = math.pi) -> Instrument:
    """The instrument of an array: half-power width in azimuth and solid angle of its beam at boresight.

    Capon and MUSIC adapt their beams to the signals; they are given the Bartlett beam's figures. `fov` [rad]: vertical
    field of view of the elements, see `Sounder`.
    """
    taper = hann_taper(array) if method == "tapered" else torch.ones(array.count, dtype=torch.float64)
    weights = (taper / taper.sum() / math.sqrt(array.peak_gain)).to(torch.complex64)
    sphere = equirect_grid(180, 90)
    beam = (manifold(array, sphere.directions) @ weights).abs().square()
    angle = torch.linspace(0.0, math.pi / 2, 1001)
    cut = torch.stack((torch.cos(angle), torch.sin(angle), torch.zeros_like(angle)), -1)
    below = torch.nonzero((manifold(array, cut) @ weights).abs().square() < 0.5)
    half = float(angle[below[0, 0]]) if len(below) else math.pi / 2
    return Instrument(f"{array.label} {method}", 2 * half, float((beam * sphere.solid_angle).sum()), array, fov)
