"""Array pictures of what a channel sounder measured."""

import torch

from rf3dgs.channel.sounding import Sounding
from rf3dgs.core.errors import InputError
from rf3dgs.core.grids import DirectionGrid
from rf3dgs.core.progress import Progress, Silent
from rf3dgs.spectra.config import AVERAGINGS, Averaging, Loading
from rf3dgs.spectra.covariance import covariance_of_snapshots
from rf3dgs.spectra.decorrelation import forward_backward
from rf3dgs.spectra.loading import loading_power
from rf3dgs.spectra.scan import ALIASES, array_instrument, beamform
from rf3dgs.spectra.spectrum import Spectrum
from rf3dgs.spectra.steering import PlanarSteering
from rf3dgs.spectra.targets import INVERTED


def spectrum_of_sounding(
    sounding: Sounding,
    grid: DirectionGrid,
    *,
    method: str = "bartlett",
    averaging: Averaging = "forward",
    loading: Loading | None = None,
    progress: Progress | None = None,
) -> Spectrum:
    """The picture that the receiving array of a sounding `[*batch, rx_ant, tx_ant, frequency]` makes by `method`.

    `method`: "bartlett", "tapered" or "capon". Frequencies and transmitting elements are the snapshots of the
    covariance. `loading` is Capon's. The levels, relative to the element's peak gain, are those of `spectrum_of`; they
    have a `noise` where the sounding knows its own. InputError without a receiving array, and for another method.
    """
    array, name = sounding.array_rx, ALIASES.get(method, method)
    if array is None:
        raise InputError("one element tells no direction; sound with an array_rx, such as planar_array(8, 8)")
    if name not in INVERTED:
        raise InputError(f"method must be one of {', '.join((*INVERTED, *ALIASES))}; got {method!r}")
    if averaging not in AVERAGINGS:
        raise InputError(f"averaging must be one of {', '.join(AVERAGINGS)}; got {averaging!r}")
    loading = Loading() if loading is None else loading
    progress = Silent() if progress is None else progress
    batch, rows = sounding.response.shape[:-3], sounding.flat()
    known = isinstance(rows.noise_power, torch.Tensor)
    noise = rows.noise_power.clone() if isinstance(rows.noise_power, torch.Tensor) else torch.zeros(len(rows.rx))
    steering, power = PlanarSteering(array, grid.directions), torch.empty(len(rows.rx), *grid.shape)
    progress.start(f"{name} spectra", len(rows.rx))
    for index, response in enumerate(rows.response):
        R = covariance_of_snapshots(response.flatten(-2))
        R = forward_backward(R) if averaging == "forward-backward" else R
        power[index] = (beamform(name, R, steering, array, loading=loading) / array.peak_gain).float()
        noise[index] += loading_power(R, loading) if name == "capon" else 0.0
        progress.update(index + 1)
    progress.finish()
    return Spectrum(
        power=power.reshape(*batch, *grid.shape),
        grid=grid,
        pose=sounding.rx,
        frequency=sounding.frequency,
        instrument=array_instrument(array, name, fov=sounding.fov_rx),
        method=name,
        tx=sounding.tx,
        noise=(noise / array.peak_gain).reshape(batch) if known else None,
    )
