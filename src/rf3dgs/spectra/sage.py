"""SAGE: gain, delay, arrival and departure of the dominant paths out of a sounding.

Space-alternating generalized expectation maximisation (Fessler and Hero 1994; Fleury et al. 1999). Paths are found one
after the other, the strongest first, on coarse grids of what the paths before leave over. Then each path in turn is
given everything that the others do not explain (expectation) and moved uphill in all its parameters (maximisation),
until none moves by more than a hundredth of its deviation; a joint step of all paths after each sweep shortens the way
where paths overlap. Everything is computed in complex128; `apertures` has the waves.
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

MOST = 20  # paths per receiver unless told otherwise
SWEEPS = 200
MOVED = 0.01  # of its deviation: a path that moves less in a sweep has arrived
EARLY = 8  # sweeps after each new path, fewer where they explain nothing that noise does not
HALVINGS = 3
LEAPS = 3  # joint steps tried, each damped more than the one before
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

    count: how many per receiver; None stops by itself where one more path explains less than its description costs
    (minimum description length), at the latest at `limit`. The noise power counts there; unknown, it is taken from the
    residual. What an array cannot tell (one row: zenith, one column: azimuth) raises InputError, unless `untold` is
    "ahead": then it is taken to be straight ahead of the device. Arrivals and departures are ahead of the arrays, in
    their fields of view.

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


ZENITHS = ("aoa_zenith", "aod_zenith")


def _estimated(
    sounding: Sounding, count: int | None, limit: int, untold: Untold, progress: Progress | None
) -> tuple[Paths, Tensor, Tensor, Tensor, Tensor, Tensor]:
    _check(sounding, count, limit, untold)
    progress = Silent() if progress is None else progress
    rows, aperture = sounding.flat(), Aperture.of(sounding)
    known = rows.noise_power
    progress.start("SAGE", len(rows.rx))
    found: list[_Fit] = []
    for index, response in enumerate(rows.response):
        noise = float(known[index]) if isinstance(known, Tensor) else None
        fit = _Fit(aperture, response, noise)
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


class _Fit:
    """The paths of one receiver while they are being found: theta `[path, 5]` and gain `[path]`."""

    def __init__(self, aperture: Aperture, response: Tensor, noise: float | None) -> None:
        self.aperture = aperture
        self.response = response
        self.known = noise
        self.theta = torch.zeros(0, 5, dtype=torch.float64)
        self.gain = torch.zeros(0, dtype=torch.complex128)
        self.power = self.residual_power = float(response.abs().square().mean())
        self.residual = response
        varied = int(torch.isfinite(aperture.cell).sum())
        self.penalty = 0.5 * (2 + varied) * math.log(2 * aperture.size)  # in units of the noise power
        self.damping = 1e-3
        self.sweeps = 0
        self.converged = True
        self._waves = aperture.waves(self.theta)

    @property
    def noise(self) -> float:
        """Noise power per entry: the known one, or that of the residual; never less than rounding leaves."""
        return max(self.residual_power if self.known is None else self.known, 1e-26 * self.power)

    def search(self, most: int, *, selective: bool) -> None:
        """Add the strongest wave of the residual, one after the other, and let all settle a little each time."""
        while len(self.gain) < most and self.residual_power > 1e-24 * self.power:
            before = self.theta, self.gain, self.residual_power
            fresh = self.aperture.strongest(self.residual)
            self._set(torch.cat((self.theta, fresh[None])), torch.cat((self.gain, self.gain.new_zeros(1))))
            for _ in range(4):
                self._improve(len(self.gain) - 1)
            self._weigh()
            for _ in range(EARLY if len(self.gain) > 1 else 0):
                left = self.residual_power
                self._sweep()
                self._leap()
                if self.aperture.size * (left - self.residual_power) < self.noise:
                    break
            if selective and self.aperture.size * (before[2] - self.residual_power) < self.penalty * self.noise:
                self._set(*before[:2])
                self._weigh()
                return

    def settle(self, *, selective: bool) -> None:
        """Sweep over all paths until none moves any more; then drop what explains less than it costs, and again."""
        self._until_settled()
        while selective and len(self.gain) > 1:
            worth = self._worth()
            least = int(worth.argmin())
            if float(worth[least]) >= self.penalty * self.noise:
                return
            kept = torch.arange(len(self.gain)) != least
            self._set(self.theta[kept], self.gain[kept])
            self._until_settled()

    def _until_settled(self) -> None:
        self.converged, sweeps = not len(self.gain), 0
        while not self.converged and sweeps < SWEEPS:
            sweeps += 1
            before = self.theta.clone()
            self._sweep()
            self._leap()
            moved = ((self.theta - before) / self.aperture.cell).abs().amax(-1)
            deviation = (3 * self.noise / (2 * math.pi**2 * self.aperture.size * self.gain.abs().square())).sqrt()
            self.converged = bool((moved <= MOVED * deviation.clamp_min(1e-9)).all())
        self.sweeps += sweeps

    def _worth(self) -> Tensor:
        """How much more power `[path]` would be left over, in all entries, without each path."""
        inverse = torch.linalg.pinv(self._gram(), hermitian=True)
        return self.gain.abs().square() / inverse.diagonal().real.clamp_min(1e-300)

    def _gram(self) -> Tensor:
        """Products of the waves with each other `[path, path]`."""
        a, b, e = self._waves
        return (a.conj() @ a.mT) * (b.conj() @ b.mT) * (e.conj() @ e.mT)

    def _set(self, theta: Tensor, gain: Tensor) -> None:
        self.theta, self.gain, self._waves = theta.clone(), gain.clone(), self.aperture.waves(theta)

    def _weigh(self) -> None:
        self.residual = self.response - self.aperture.model(self.theta, self.gain)
        self.residual_power = float(self.residual.abs().square().mean())

    def _sweep(self) -> None:
        """Improve every path once, one after the other."""
        for index in range(len(self.gain)):
            self._improve(index)
        self._weigh()

    def _leap(self) -> None:
        """One scoring step of all paths at once, gains by least squares, kept only where it explains more.

        Sweeps alone creep where paths overlap, because each path has to wait for the others.
        """
        aperture, theta, gain, left = self.aperture, self.theta, self.gain, self.residual_power
        slopes = aperture.correlate(theta, self.residual)
        climb = 2 * math.pi * (gain.conj()[:, None] * slopes[:, 1:]).imag
        gradient = torch.cat((torch.view_as_real(slopes[:, 0]), climb), 1).reshape(-1)
        information = aperture.information(theta, gain)
        scale = information.diagonal().clamp_min(1e-300).rsqrt()
        free = torch.cat((torch.ones(2).bool(), torch.isfinite(aperture.cell))).repeat(len(gain))
        scale = torch.where(free, scale, 0.0)
        scaled = information * scale[:, None] * scale + torch.diag((~free).double())
        for _ in range(LEAPS):
            solved = torch.linalg.solve(scaled + self.damping * torch.eye(len(scaled)), gradient * scale) * scale
            move = solved.reshape(-1, 7)[:, 2:].clamp(-0.5 * aperture.cell, 0.5 * aperture.cell)
            there = torch.stack([aperture.moved(*pair) for pair in zip(theta, move, strict=True)])
            self._set(there, gain)
            self.gain = torch.linalg.pinv(self._gram(), hermitian=True) @ aperture.correlate(there, self.response)[:, 0]
            self._weigh()
            if self.residual_power <= left:
                self.damping = max(0.2 * self.damping, 1e-9)
                return
            self.damping = min(4.0 * self.damping, 1.0)
        self._set(theta, gain)
        self._weigh()

    def _improve(self, index: int) -> None:
        """Move one path uphill on |<s, x>|^2, x what the others leave of the response; its gain is <s, x> / size.

        A scoring step: gradient over expected curvature, exact but for the third order; halved while it leads down.
        """
        aperture, theta = self.aperture, self.theta[index]
        gain = self.gain.clone()
        gain[index] = 0.0

        def correlation(at: Tensor) -> Tensor:
            return aperture.correlate(at[None], self.response)[0] - gain @ aperture.overlap(at, self._waves)

        here = correlation(theta)
        if float(here[0].abs()) > 0:
            slope = 4 * math.pi * (here[1:] / here[0]).imag
            step = torch.where(torch.isfinite(aperture.cell), slope / aperture.curvature, 0.0)
            step = step.clamp(-0.5 * aperture.cell, 0.5 * aperture.cell)
            for _ in range(HALVINGS):
                there = aperture.moved(theta, step)
                value = correlation(there)
                if float(value[0].abs()) >= float(here[0].abs()):
                    theta, here = there, value
                    break
                step = 0.5 * step
        self.theta[index], self.gain[index] = theta, here[0] / aperture.size
        for cache, wave in zip(self._waves, aperture.waves(theta), strict=True):
            cache[index] = wave


def _paths(found: list[_Fit], rows: Sounding) -> tuple[Paths, Tensor]:
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


def _columns(fit: _Fit, rows: Sounding, index: int) -> dict[str, Tensor]:
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
    centre = float(sounding.offsets.mean())
    delay, shift = _unwrapped(theta[:, 4], sounding, distance)
    # The wave is centred on the comb and late by its measured delay; the gain sought is at the carrier. Its phase is
    # taken off for the delay as it will be stored, rounded to float32.
    turn = centre * (delay + shift) + rows.frequency * delay.float().double()
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


def _lost(fit: _Fit, sounding: Sounding) -> Tensor:
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
