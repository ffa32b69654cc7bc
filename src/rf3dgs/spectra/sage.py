"""SAGE: gain, delay, arrival and departure of the dominant paths out of a sounding.

`sage_fit` is the algorithm, `apertures` has the waves; here the results become paths in the world, and what a sounding
does not tell is said.
"""

import math
from dataclasses import dataclass, replace
from typing import Literal

import torch
from torch import Tensor

from rf3dgs.channel.paths import Paths
from rf3dgs.channel.patterns import field_pattern
from rf3dgs.channel.sounding import Sounding
from rf3dgs.core.angles import angles_of
from rf3dgs.core.errors import InputError
from rf3dgs.core.progress import Progress, Silent
from rf3dgs.core.units import SPEED_OF_LIGHT, shortest_delay
from rf3dgs.spectra.apertures import Aperture, device_direction
from rf3dgs.spectra.crb import Bound, cramer_rao, told_by
from rf3dgs.spectra.sage_fit import Fit

MOST = 40  # paths per receiver unless told otherwise
ZENITHS = ("aoa_zenith", "aod_zenith")
Untold = Literal["refuse", "ahead"]


@dataclass(frozen=True, eq=False)
class Estimate:
    """What `estimate_paths` found.

    paths: `[*batch, path]`, as of `sage`. deviation: Cramer-Rao bound at the estimates and the noise power in use;
        infinite where the sounding does not tell a quantity. Such an angle is no estimate: it is the horizon (zenith)
        or straight ahead (azimuth) of the device.
    noise_power `[*batch]`: the sounding's, or where unknown that of the residual. residual_power `[*batch]`: mean power
        per entry that the paths leave unexplained. sweeps `[*batch]`: how many; converged `[*batch]`: whether the last
        moved nothing any more.
    """

    paths: Paths
    deviation: Bound
    noise_power: Tensor
    residual_power: Tensor
    sweeps: Tensor
    converged: Tensor


def sage(
    sounding: Sounding,
    count: int | None = None,
    *,
    limit: int = MOST,
    untold: Untold = "refuse",
    progress: Progress | None = None,
) -> Paths:
    """The dominant paths `[*batch, path]` of a sounding, strongest first; `order` and `kind` are None.

    count: how many per receiver, fewer where two would share one place and cancel; None stops by itself where one more
    path explains less than its description costs (minimum description length), at the latest at `limit`. The noise
    power counts there; unknown, it is taken from the residual. What an array cannot tell (one row: zenith, one column:
    azimuth) raises InputError, unless `untold` is "ahead": then it is taken to be straight ahead of the device.
    Arrivals and departures are ahead of the arrays, in their fields of view.

    Delays lie between that of the straight line and one period of the comb more. With an unknown delay offset the
    earliest path found is taken to be the straight line. `coeff` times e^{-j 2 pi f delay} is the gain measured, but
    the phase of `coeff` alone means nothing unless the delay is exact to a fraction of the carrier's period.
    """
    return _estimated(sounding, count, limit, untold, progress)[0]


def estimate_paths(
    sounding: Sounding,
    count: int | None = None,
    *,
    limit: int = MOST,
    untold: Untold = "refuse",
    progress: Progress | None = None,
) -> Estimate:
    """`sage` with what is needed to judge it: deviations, residual, convergence. Arguments as there."""
    paths, noise, residual, sweeps, converged, lost = _estimated(sounding, count, limit, untold, progress)
    bound = cramer_rao(paths, replace(sounding, noise_power=noise))
    zeniths = {name: torch.where(lost[..., end], torch.inf, getattr(bound, name)) for end, name in enumerate(ZENITHS)}
    return Estimate(paths, replace(bound, **zeniths), noise, residual, sweeps, converged)


def _estimated(
    sounding: Sounding, count: int | None, limit: int, untold: Untold, progress: Progress | None
) -> tuple[Paths, Tensor, Tensor, Tensor, Tensor, Tensor]:
    _check(sounding, count, limit, untold)
    progress = Silent() if progress is None else progress
    rows, aperture = sounding.flat(), Aperture.of(sounding)
    known = rows.noise_power
    progress.start("SAGE", len(rows.rx))
    found: list[Fit] = []
    for index, response in enumerate(rows.response):
        noise = float(known[index]) if isinstance(known, Tensor) else None
        fit = Fit(aperture, response, noise)
        fit.search(limit if count is None else count, selective=count is None)
        fit.settle(selective=count is None)
        found.append(fit)
        progress.update(index + 1)
    progress.finish()
    batch = sounding.response.shape[:-3]
    paths, lost = _paths(found, rows)
    paths = paths._map(lambda value: value.reshape(*batch, value.shape[-1]), rx=sounding.rx)

    def column(values: list) -> Tensor:
        return torch.tensor(values, dtype=torch.float64).reshape(batch)

    return (
        paths,
        column([fit.noise for fit in found]),
        column([fit.residual_power for fit in found]),
        column([fit.sweeps for fit in found]).long(),
        column([fit.converged for fit in found]).bool(),
        lost.reshape(*batch, *lost.shape[1:]),
    )


def _paths(found: list[Fit], rows: Sounding) -> tuple[Paths, Tensor]:
    """Paths `[rx, path]`, and where the zenith at receiver and transmitter is not told `[rx, path, 2]`."""
    most = max(len(fit.gain) for fit in found)
    columns: dict[str, list[Tensor]] = {}
    for index, fit in enumerate(found):
        for name, value in _columns(fit, rows, index).items():
            padding = value.new_zeros(most - len(value), *value.shape[1:])
            columns.setdefault(name, []).append(torch.cat((value, padding)))
    stacked = {name: torch.stack(values) for name, values in columns.items()}
    lost = stacked.pop("lost")
    return Paths(**stacked, frequency=rows.frequency, tx=rows.tx, rx=rows.rx), lost


def _columns(fit: Fit, rows: Sounding, index: int) -> dict[str, Tensor]:
    """The columns `[path]` of one receiver's `Paths`, strongest first."""
    sounding, theta = fit.aperture.sounding, fit.theta.clone()
    lost = _lost(fit, sounding)
    theta[:, 1] = torch.where(lost[:, 0], 0.0, theta[:, 1])
    theta[:, 3] = torch.where(lost[:, 1], 0.0, theta[:, 3])
    arrival, departure = device_direction(theta[:, 0:2]), device_direction(theta[:, 2:4])
    level = torch.ones(len(theta), dtype=torch.float64)
    for array, directions in ((sounding.array_rx, arrival), (sounding.array_tx, departure)):
        if array is not None:
            level = level * field_pattern(array.pattern, directions)
    distance = float((rows.rx.position[index] - rows.tx.position).double().norm())
    delay, shift = _unwrapped(theta[:, 4], sounding, distance)
    # The gain is that of a wave centred on the comb. At the first frequency it does not change when the delay does by
    # whole periods; from there it is taken to the carrier, and its phase off for the delay as stored, in float32.
    first, centre = float(sounding.offsets[0]), float(sounding.offsets.mean())
    turn = (centre - first) * theta[:, 4] + first * (delay + shift) + rows.frequency * delay.float().double()
    turn = torch.remainder(turn, 1.0)
    coeff = fit.gain / level * torch.polar(torch.ones_like(turn), 2 * math.pi * turn)
    aoa = angles_of(arrival @ rows.rx.world_from_device[index].double().mT)
    aod = angles_of(departure @ rows.tx.world_from_device.double().mT)
    order = coeff.abs().argsort(descending=True, stable=True)
    values = {
        "coeff": coeff,
        "delay": delay,
        "aoa_zenith": aoa[0],
        "aoa_azimuth": aoa[1],
        "aod_zenith": aod[0],
        "aod_azimuth": aod[1],
        "valid": torch.ones(len(delay), dtype=torch.bool),
        "lost": lost,
    }
    values = {name: value.float() if value.dtype == torch.float64 else value for name, value in values.items()}
    return {name: value[order] for name, value in {**values, "coeff": coeff.to(torch.complex64)}.items()}


def _unwrapped(delay: Tensor, sounding: Sounding, distance: float) -> tuple[Tensor, Tensor]:
    """Delays [s] within one period of what is possible, and what was taken off the measured ones."""
    period = sounding.period
    straight = distance / SPEED_OF_LIGHT
    if not math.isfinite(period) or not len(delay):
        return torch.full_like(delay, straight), torch.zeros_like(delay)
    if sounding.delay_offset:
        # On the circle of one period, the paths begin after the widest gap between them.
        turned = torch.remainder(delay, period).sort().values
        gaps = torch.cat((turned[:1] + period - turned[-1:], turned.diff()))
        first = turned[gaps.argmax()]
        late = torch.remainder(delay - first + 1e-9 * period, period) - 1e-9 * period
        return late + straight, torch.full_like(delay, float(first) - straight)
    earliest = max(float(shortest_delay(distance)), 0.0)
    return earliest + torch.remainder(delay - earliest, period), torch.zeros_like(delay)


def _lost(fit: Fit, sounding: Sounding) -> Tensor:
    """True `[path, 2]` where the zenith at receiver or transmitter is no better known than the field of view tells.

    That is so with one row of elements, and where the deviation of a single path exceeds a uniform guess's.
    """
    power = (fit.aperture.size * fit.gain.abs().square()).clamp_min(1e-300)
    share = (3 * fit.noise / (2 * math.pi**2 * power)).sqrt()
    columns = []
    for axis, array, fov in ((1, sounding.array_rx, sounding.fov_rx), (3, sounding.array_tx, sounding.fov_tx)):
        guess = math.sin(0.5 * fov) / math.sqrt(3)
        columns.append(share * fit.aperture.cell[axis] > guess if told_by(array)[0] else torch.ones_like(share).bool())
    return torch.stack(columns, -1)


def _check(sounding: Sounding, count: int | None, limit: int, untold: Untold) -> None:
    if (count is not None and count < 1) or limit < 1:
        raise InputError(f"count and limit must be at least 1 path (count None: by itself); got {count} and {limit}")
    if not sounding.response.shape[:-3].numel():
        raise InputError("the sounding has no receivers; expected at least one")
    if untold not in ("refuse", "ahead"):
        raise InputError(f'untold must be "refuse" or "ahead"; got {untold!r}')
    ends = (("receiving", "arrival", sounding.array_rx), ("transmitting", "departure", sounding.array_tx))
    for end, what, array in ends:
        zenith, azimuth = told_by(array)
        if untold == "ahead" or (zenith and azimuth):
            continue
        missing = " and ".join(name for name, told in (("zenith", zenith), ("azimuth", azimuth)) if not told)
        size = "one element" if array is None else f"{array.rows}x{array.cols} elements"
        raise InputError(
            f"the {end} array of {size} does not tell the {missing} of {what}; use at least two rows and two columns, "
            'or untold="ahead" to take it as straight ahead of the device'
        )
