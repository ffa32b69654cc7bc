"""`spectrum_of`: from paths to what an instrument sees."""

import math
from dataclasses import replace
from functools import lru_cache
from typing import Literal

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
from rf3dgs.spectra.covariance import covariance_of
from rf3dgs.spectra.decorrelation import forward_backward, smoothed
from rf3dgs.spectra.loading import Loading
from rf3dgs.spectra.order import Criterion, source_count
from rf3dgs.spectra.spectrum import Instrument, Spectrum
from rf3dgs.spectra.steering import PlanarSteering, Steering
from rf3dgs.spectra.synthesis import ideal_spectrum, pose_for

Method = Literal["ideal", "bartlett", "tapered", "capon", "music", "cbf", "tcbf", "mvdr"]
Averaging = Literal["forward", "forward-backward"]
ALIASES = {"cbf": "bartlett", "tcbf": "tapered", "mvdr": "capon"}
METHODS = ("ideal", "bartlett", "tapered", "capon", "music")
AVERAGINGS = ("forward", "forward-backward")


def spectrum_of(
    paths: Paths,
    array: PlanarArray | None = None,
    grid: DirectionGrid | None = None,
    *,
    method: Method = "ideal",
    lobe: float | None = None,
    snr_db: float | None = None,
    snapshots: int | None = 256,
    bandwidth: float = 2e9,
    taps: tuple[float, float] | None = None,
    averaging: Averaging = "forward",
    subarray: tuple[int, int] | None = None,
    loading: float | Loading = 1e-3,
    sources: int | Criterion | None = None,
    pose: Pose | None = None,
    seed: int = 0,
    progress: Progress | None = None,
) -> Spectrum:
    """The spectrum of paths `[*batch, path]` on `grid`: power [linear] per direction, `[*batch, row, col]`.

    "ideal": power summed through a Gaussian lobe of half-power width `lobe` [rad]; with delay and AoD, without array.
    "bartlett" (CBF), "tapered" (TCBF, Hann), "capon" (MVDR, with diagonal `loading`) and "music" (of so many `sources`,
    or as many as "mdl" or "aic" find): through `array`, from `snapshots` coherent frequencies over `bandwidth` [Hz]
    (None: uncorrelated paths), or only their delay `taps` between first and last [s], with white noise at `snr_db`
    (none by default) drawn from `seed`. The covariance may be averaged "forward-backward" and over `subarray` (rows,
    cols), which then is the array. Levels of arrays are relative to the element's peak gain, so that a path of gain g
    at boresight gives g; "music" has no level, see `beamformers.music`. `pose` (default: the receivers') turns the grid
    and the array.
    """
    if grid is None:
        raise InputError("spectrum_of needs a grid; use pinhole_grid, equirect_grid or list_grid")
    name = ALIASES.get(method, method)
    if name not in METHODS:
        raise InputError(f"method must be one of {', '.join((*METHODS, *ALIASES))}; got {method!r}")
    if name == "ideal":
        if snr_db is not None:
            raise InputError('an ideal spectrum has no elements to add noise to; use snr_db with method="bartlett"')
        return ideal_spectrum(paths, grid, lobe=lobe, pose=pose, progress=progress)
    if array is None:
        raise InputError(f'method {name!r} needs an array, such as planar_array(8, 8); only "ideal" does without')
    if lobe is not None:
        raise InputError(f'lobe belongs to method "ideal"; the lobe of {name!r} is that of its array')
    if averaging not in AVERAGINGS:
        raise InputError(f"averaging must be one of {', '.join(AVERAGINGS)}; got {averaging!r}")
    if sources is not None and name != "music":
        raise InputError(f'sources belong to method "music"; {name!r} does not count them')
    if isinstance(sources, str) and sources not in ("mdl", "aic"):
        raise InputError(f'sources must be a number, "mdl" or "aic"; got {sources!r}')
    if name == "music" and snapshots is None and not isinstance(sources, int):
        raise InputError("to count sources takes snapshots, such as 256; or give sources as a number")
    pose = pose_for(paths, pose)
    batch = paths.coeff.shape[:-1]
    rows = replace(paths, rx=pose).flat()
    seen = array if subarray is None else smoothed(torch.zeros(array.count, array.count), array, *subarray)[1]
    steering = PlanarSteering(seen, grid.directions)
    unit = 1.0 if name == "music" else array.peak_gain
    power = torch.empty(len(rows.rx), *grid.shape)
    reporter = Silent() if progress is None else progress
    reporter.start(f"{name} spectra", len(rows.rx))
    for index in range(len(rows.rx)):
        R = covariance_of(
            rows[index],
            array,
            snapshots=snapshots,
            bandwidth=bandwidth,
            taps=taps,
            snr_db=snr_db,
            seed=seed + index,
        )
        if subarray is not None:
            R, _ = smoothed(R, array, *subarray)
        if averaging == "forward-backward":
            R = forward_backward(R)
        found = sources if isinstance(sources, int) else None
        if name == "music" and found is None and snapshots is not None:
            found = int(source_count(R, snapshots, "aic" if sources == "aic" else "mdl"))
        power[index] = (beamform(name, R, steering, seen, loading=loading, sources=found) / unit).float()
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
    )


def beamform(
    method: str,
    R: Tensor,
    A: Tensor | Steering,
    array: PlanarArray,
    *,
    loading: float | Loading = 1e-3,
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
def array_instrument(array: PlanarArray, method: str) -> Instrument:
    """The instrument of an array: half-power width in azimuth and solid angle of its beam at boresight.

    Capon and MUSIC adapt their beams to the signals; they are given the Bartlett beam's figures.
    """
    taper = hann_taper(array) if method == "tapered" else torch.ones(array.count, dtype=torch.float64)
    weights = (taper / taper.sum() / math.sqrt(array.peak_gain)).to(torch.complex64)
    sphere = equirect_grid(180, 90)
    beam = (manifold(array, sphere.directions) @ weights).abs().square()
    angle = torch.linspace(0.0, math.pi / 2, 1001)
    cut = torch.stack((torch.cos(angle), torch.sin(angle), torch.zeros_like(angle)), -1)
    below = torch.nonzero((manifold(array, cut) @ weights).abs().square() < 0.5)
    half = float(angle[below[0, 0]]) if len(below) else math.pi / 2
    return Instrument(f"{array.label} {method}", 2 * half, float((beam * sphere.solid_angle).sum()))
