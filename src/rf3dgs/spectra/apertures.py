"""Arrays and frequency comb as one aperture: the plane wave of a path, and where in a sounding it is strongest.

A plane wave is a product of five waves, one along each axis of the aperture,

    s = product over axes d of exp(j 2 pi q_d theta_d),

with the coordinates theta = (y and z of the direction cosines at the receiver, the same at the transmitter, delay) and
the points q (columns and rows of both arrays [wavelengths], minus the frequencies [Hz]), all centred. The elements'
pattern scales a wave but does not bend it, so it plays no part here.
"""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from rf3dgs.channel.arrays import PlanarArray
from rf3dgs.channel.sounding import Sounding, seen

AT_ONCE = 2**23  # complex numbers of an intermediate result
FINER = 2  # points of the coarse grids per resolution cell
WEAKER = 0.25  # of the strongest wave's power: how weak others may be that are taken with it
SIDE_LOBE = 0.1  # of a wave's power: what those before it may leak into it


@dataclass(frozen=True, eq=False)
class Aperture:
    """The aperture of a sounding without its measurements.

    rx, tx: points `[3, element]` of the arrays: ones, y, z. comb: `[2, frequency]`: ones, minus the centred offsets.
    cell: resolution `[5]` in theta, one over the aperture's length; infinite along an axis of one point.
    """

    sounding: Sounding
    rx: Tensor
    tx: Tensor
    comb: Tensor
    cell: Tensor

    @classmethod
    def of(cls, sounding: Sounding) -> "Aperture":
        offsets = sounding.offsets
        comb = torch.stack((torch.ones_like(offsets), offsets.mean() - offsets))
        cells = [*_cells(sounding.array_rx), *_cells(sounding.array_tx), sounding.period / len(offsets)]
        cell = torch.tensor(cells, dtype=torch.float64)
        return cls(sounding, _points(sounding.array_rx), _points(sounding.array_tx), comb, cell)

    @property
    def size(self) -> int:
        """Number of entries of a sounding of one receiver."""
        return self.rx.shape[1] * self.tx.shape[1] * self.comb.shape[1]

    @property
    def curvature(self) -> Tensor:
        """Expected curvature `[5]` of log |<s, x>|^2 at its maximum: 2 (2 pi)^2 times the variance of the points."""
        points = (*self.rx[1:], *self.tx[1:], self.comb[1])
        return torch.stack([8 * math.pi**2 * axis.square().mean() for axis in points])

    def waves(self, theta: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """The factors `[..., rx_ant]`, `[..., tx_ant]` and `[..., frequency]` of s at theta `[..., 5]`."""
        return (
            _wave(theta[..., 0:2] @ self.rx[1:]),
            _wave(theta[..., 2:4] @ self.tx[1:]),
            _wave(theta[..., 4:5] @ self.comb[1:]),
        )

    def model(self, theta: Tensor, gain: Tensor) -> Tensor:
        """Sum of the waves theta `[path, 5]` with gains `[path]`: `[rx_ant, tx_ant, frequency]`."""
        a, b, e = self.waves(theta)
        pairs = (a[:, :, None] * b[:, None, :]).flatten(1) * gain[:, None]
        return (pairs.mT @ e).reshape(self.rx.shape[1], self.tx.shape[1], self.comb.shape[1])

    def correlate(self, theta: Tensor, x: Tensor) -> Tensor:
        """<s, x> and <q_d s, x> for the five axes, `[path, 6]`, of the waves theta `[path, 5]` with a response x."""
        a, b, e = self._weighted(theta)
        late = (x @ e.reshape(-1, e.shape[-1]).mT).reshape(*x.shape[:2], len(theta), 2)
        left = (a @ late.permute(2, 0, 1, 3).flatten(2)).unflatten(2, late.shape[1::2])
        total = (b[:, :, None, :, None] * left[:, None]).sum(3)
        orders = ((0, 0, 0), (0, 1, 0), (0, 2, 0), (1, 0, 0), (2, 0, 0), (0, 0, 1))
        return torch.stack([total[:, tx, rx, comb] for tx, rx, comb in orders], -1)

    def overlap(self, theta: Tensor, others: tuple[Tensor, Tensor, Tensor]) -> Tensor:
        """`correlate` of the wave theta `[5]` with other waves, given by their factors `[path, ...]`: `[path, 6]`."""
        weighted = self._weighted(theta[None])
        a, b, e = (one[0] @ other.mT for one, other in zip(weighted, others, strict=True))
        plain = b[0] * e[0]
        return torch.stack(
            (a[0] * plain, a[1] * plain, a[2] * plain, a[0] * b[1] * e[0], a[0] * b[2] * e[0], a[0] * b[0] * e[1]), -1
        )

    def information(self, theta: Tensor, gain: Tensor) -> Tensor:
        """Re(D^H D) `[7 path, 7 path]`, D the derivative of `model` in real and imaginary gain and the five axes."""
        a, b, e = self.waves(theta)
        late = self.comb[1] * e
        factors = (
            (a, a, self.rx[1] * a, self.rx[2] * a, a, a, a),
            (b, b, b, b, self.tx[1] * b, self.tx[2] * b, b),
            (e, e, e, e, e, e, late),
        )
        turn = 2j * math.pi * gain
        scale = torch.stack((torch.ones_like(gain), torch.full_like(gain, 1j), *(turn,) * 5), 1).reshape(-1)
        gram = scale[:, None].conj() * scale
        for factor in factors:
            columns = torch.stack(factor, 1).reshape(len(scale), -1)
            gram = gram * (columns.conj() @ columns.mT)
        return gram.real

    def _weighted(self, theta: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Conjugate factors of the waves theta `[path, 5]`, plain and times their points: `[path, 3 or 2, point]`."""
        a, b, e = (factor.conj()[:, None] for factor in self.waves(theta))
        return self.rx * a, self.tx * b, self.comb * e

    def moved(self, theta: Tensor, step: Tensor) -> Tensor:
        """theta `[5]` plus as much of the step as leaves arrival and departure ahead of the arrays and in view.

        A direction that leaves on one side comes back on the other where half-wavelength spacing makes both one.
        """
        there = theta + step
        ends = ((self.sounding.array_rx, self.sounding.fov_rx), (self.sounding.array_tx, self.sounding.fov_tx))
        for end, (array, fov) in enumerate(ends):
            part = slice(2 * end, 2 * end + 2)
            if array is not None and not bool(_seen(array, fov, there[part])):
                there[part] = _in_view(array, fov, theta[part], step[part])
        return there

    def strongest(self, x: Tensor, count: int = 1, *, floor: float = 0.0) -> Tensor:
        """The thetas `[wave, 5]` on a grid of two points per cell at which |<s, x>| is largest, at most `count`.

        Fourier transform over frequency, products with the arrays' waves over the directions in view. Each wave is the
        strongest from its arrival, no side lobe of those before it, at most 6 dB weaker than the first, and explains
        at least `floor` of the sum of |x|^2; the first is always there.
        """
        arrivals = _grid(self.sounding.array_rx, self.sounding.fov_rx)
        departures = _grid(self.sounding.array_tx, self.sounding.fov_tx)
        a = _wave(arrivals @ self.rx[1:]).conj().to(torch.complex64)
        b = _wave(departures @ self.tx[1:]).conj().to(torch.complex64)
        bins = FINER * x.shape[-1] if x.shape[-1] > 1 else 1
        profile = torch.fft.ifft(x.to(torch.complex64), n=bins, dim=-1)
        seen_from = (a @ profile.reshape(len(x), -1)).reshape(len(arrivals), -1, bins)
        found = []
        step = max(1, AT_ONCE // (len(departures) * bins))
        for first in range(0, len(arrivals), step):
            power = torch.view_as_real(b @ seen_from[first : first + step]).square().sum(-1)
            found.append(power.flatten(1).max(-1))
        best = torch.cat([part.values for part in found]).double() * (bins**2 / self.size)
        where = torch.cat([part.indices for part in found])
        period = self.sounding.period / bins if bins > 1 else 0.0
        delay = (where % bins).double() * period
        theta = torch.cat((arrivals, departures[where // bins], delay[:, None]), -1)
        order = best.argsort(descending=True, stable=True)
        order = order[best[order] >= max(WEAKER * float(best[order[0]]), floor)].tolist() or [int(order[0])]
        return theta[self._apart(theta, best, order, count)]

    def _apart(self, theta: Tensor, power: Tensor, order: list[int], count: int) -> list[int]:
        """Of the waves in this order the first `count` that are no side lobes of those chosen before."""
        waves, chosen = self.waves(theta), order[:1]
        for index in order[1:]:
            if len(chosen) >= count:
                break
            shares = [wave[chosen].conj() @ wave[index] / wave.shape[-1] for wave in waves]
            leaked = (shares[0] * shares[1] * shares[2]).abs().square() * power[chosen]
            if float(leaked.sum()) < SIDE_LOBE * float(power[index]):
                chosen.append(index)
        return chosen


def device_direction(cosines: Tensor) -> Tensor:
    """Device-frame unit vectors `[..., 3]`, ahead of the array, of direction cosines y and z `[..., 2]`."""
    ahead = (1.0 - cosines.square().sum(-1, keepdim=True)).clamp_min(0.0).sqrt()
    return torch.cat((ahead, cosines), -1)


def _in_view(array: PlanarArray, fov: float, here: Tensor, step: Tensor) -> Tensor:
    """Direction cosines `[2]` in view: an alias of here + step, or else what of the step leads no further."""
    there = here + step
    period = torch.tensor([1.0 / array.horizontal, 1.0 / array.vertical], dtype=torch.float64)
    alias = there - period * torch.round(there / period)
    tries = torch.stack((torch.stack((alias[0], there[1])), torch.stack((there[0], alias[1])), alias))
    share = torch.cat((0.5 ** torch.arange(1, 12, dtype=torch.float64), torch.zeros(1, dtype=torch.float64)))
    whole = torch.ones_like(share)
    shorter = torch.stack((whole, share, share, whole, share, share), -1).reshape(-1, 2)
    tries = torch.cat((tries, here + step * shorter, here[None]))
    return tries[int(_seen(array, fov, tries).int().argmax())]


def _seen(array: PlanarArray | None, fov: float, cosines: Tensor) -> Tensor:
    return (cosines.square().sum(-1) <= 1.0) & seen(array, fov, device_direction(cosines))


def _grid(array: PlanarArray | None, fov: float) -> Tensor:
    """Direction cosines y and z `[direction, 2]` of a grid over what the array sees."""
    axes = []
    for cell in _cells(array):
        count = 0 if math.isinf(cell) else math.floor(FINER / cell + 1e-9)
        axes.append(torch.arange(-count, count + 1, dtype=torch.float64) * (cell / FINER if count else 1.0))
    grid = torch.cartesian_prod(*axes)
    return grid[_seen(array, fov, grid)]


def _cells(array: PlanarArray | None) -> tuple[float, float]:
    """Resolution in the direction cosines y and z: one over the array's width and height [wavelengths]."""
    if array is None:
        return math.inf, math.inf
    return (
        1.0 / (array.cols * array.horizontal) if array.cols > 1 else math.inf,
        1.0 / (array.rows * array.vertical) if array.rows > 1 else math.inf,
    )


def _points(array: PlanarArray | None) -> Tensor:
    positions = torch.zeros(1, 3, dtype=torch.float64) if array is None else array.positions
    return torch.stack((torch.ones_like(positions[:, 0]), positions[:, 1], positions[:, 2]))


def _wave(turns: Tensor) -> Tensor:
    """exp(j 2 pi turns), complex128."""
    return torch.polar(torch.ones_like(turns), 2 * math.pi * torch.remainder(turns, 1.0))
