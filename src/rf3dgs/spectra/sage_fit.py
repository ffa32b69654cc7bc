"""SAGE itself: the waves of one receiver's sounding, found one by one and moved uphill in turn.

Space-alternating generalized expectation maximisation (Fessler and Hero 1994; Fleury et al. 1999). Paths are found one
after the other, the strongest first, on coarse grids of what the paths before leave over. Then each path in turn is
given everything that the others do not explain (expectation) and moved uphill in all its parameters (maximisation),
until none moves by more than a hundredth of its deviation; a joint step of all paths after each sweep shortens the way
where paths overlap. Everything is computed in complex128. docs/theory.md has the equations.
"""

import math

import torch
from torch import Tensor

from rf3dgs.spectra.apertures import Aperture

SWEEPS = 200
MOVED = 0.01  # of its deviation: a path that moves less in a sweep has arrived
EARLY = 8  # sweeps after each new path, fewer where they explain nothing that noise does not
ALONE, TOGETHER = 8, 4  # the first come one by one, then two, three, at most four at a time
LITTLE = 0.1  # of the unexplained power of an entry: more than ALONE have arrived where a sweep explains less
ENOUGH = 0.02  # and, where there are more than ALONE, less than this share of what the new ones explain
SHARED = 0.05  # of its wave: a path that has less in common with the new ones need not move at once
HALVINGS = 3
CANCELLING = 4.0  # times the mean power of the response: no path is so strong by itself
LEAPS = 3  # joint steps tried, each damped more than the one before


class Fit:
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
        """Add the strongest waves of the residual, a few at a time, and let them and their neighbours settle a little.

        Waves that come together have little in common, and each is worth its description by itself.
        """
        while len(self.gain) < most and self.residual_power > 1e-24 * self.power:
            before = self.theta, self.gain, self.residual_power
            together = min(1 + len(self.gain) // ALONE, TOGETHER, most - len(self.gain))
            fresh = self.aperture.strongest(self.residual, together, floor=self.penalty * self.noise)
            self._set(torch.cat((self.theta, fresh)), torch.cat((self.gain, self.gain.new_zeros(len(fresh)))))
            added = range(len(before[1]), len(self.gain))
            for index in added:
                for _ in range(4):
                    self._improve(index)
            self._weigh()
            near, brought = self._overlapping(added), before[2] - self.residual_power
            for _ in range(EARLY if len(self.gain) > 1 else 0):
                left = self.residual_power
                self._sweep(near)
                self._leap()
                explained = left - self.residual_power
                crowd = len(self.gain) > ALONE
                if self.aperture.size * explained < self.noise or (crowd and explained < ENOUGH * brought):
                    break
            explained = self.aperture.size * (before[2] - self.residual_power)
            if selective and len(fresh) == 1 and explained < self.penalty * self.noise:
                self._set(*before[:2])
                self._weigh()
                return

    def settle(self, *, selective: bool) -> None:
        """Sweep over all paths until none moves any more; then drop what explains less than it costs, and again.

        Paths much stronger than the whole response are two that share one place and cancel: one of them goes, always.
        """
        self._until_settled()
        while len(self.gain) > 1:
            worth = self._worth()
            cancelling = self.gain.abs().square() > CANCELLING * self.power
            if bool(cancelling.any()):
                worth = torch.where(cancelling, worth, torch.inf)
            elif not selective or float(worth.min()) >= self.penalty * self.noise:
                return
            kept = torch.arange(len(self.gain)) != int(worth.argmin())
            self._set(self.theta[kept], self.gain[kept])
            self._until_settled()

    def _until_settled(self) -> None:
        self.converged, sweeps = not len(self.gain), 0
        while not self.converged and sweeps < SWEEPS:
            sweeps += 1
            before, left = self.theta.clone(), self.residual_power
            self._sweep()
            self._leap()
            moved = ((self.theta - before) / self.aperture.cell).abs().amax(-1)
            disturbance = max(self.noise, self.residual_power)
            deviation = (3 * disturbance / (2 * math.pi**2 * self.aperture.size * self.gain.abs().square())).sqrt()
            explained = self.aperture.size * (left - self.residual_power)
            still = bool((moved <= MOVED * deviation.clamp_min(1e-9)).all())
            self.converged = still or (len(self.gain) > ALONE and explained < LITTLE * disturbance)
        self.sweeps += sweeps

    def _overlapping(self, those: range) -> list[int]:
        """The paths whose waves have something in common with one of those, which are among them."""
        share = self._gram()[list(those)].abs().amax(0) / self.aperture.size
        return torch.nonzero(share > SHARED).flatten().tolist()

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

    def _sweep(self, those: list[int] | None = None) -> None:
        """Improve every path once, or those named, one after the other."""
        for index in range(len(self.gain)) if those is None else those:
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
