"""What stands behind pictures of an array: waves whose pictures, through the same array and beamformer, are those.

A picture is a trigonometric polynomial, of the powers for "bartlett" and "tapered" and of their inverse for "capon",
with as many coefficients as the array has lags (225 for 8x8). These are all that a picture tells; found once, they give
the level in any direction, between the pixels, too, where the thin peaks of Capon are missed.

At one place waves of power S arrive from directions u, and the elements add noise n. A picture is p_i = w_i^H R w_i
with R = sum_u S_u a_u a_u^H + n I and the beamformer's weights w_i; Capon's follow R, and as they make p_i least their
change does not change it. The powers grow and fall by factors

    S_u <- S_u  sum_i B_iu y_i / p_i^2  /  sum_i B_iu / p_i,   B_iu = |w_i^H a_u|^2                        (1)

towards the least sum_i y_i / p_i + ln p_i: the likelihood of levels y_i known to a factor. Loading and receiver noise
are the same to (1): both are n, and nobody needs to know them.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import torch
from torch import Tensor

from rf3dgs.channel.arrays import PlanarArray
from rf3dgs.channel.patterns import power_pattern
from rf3dgs.channel.response import phasors
from rf3dgs.channel.sounding import seen
from rf3dgs.core.grids import DirectionGrid
from rf3dgs.spectra.beamformers import hann_taper
from rf3dgs.spectra.covariance import plane_waves
from rf3dgs.spectra.spectrum import Spectrum
from rf3dgs.spectra.steering import PlanarSteering

LEAST = 1e-30  # of a power that others are divided by
SLIGHT = 1e-9  # of the mean element power: noise that keeps a covariance invertible
SMALL = 1e-4  # of the mean level: below it errors do not count as shares of the level
RIDGE = 1e-11  # of the mean square of the polynomial's terms: what the pixels do not tell stays small


@lru_cache(maxsize=4)
def _terms(grid: DirectionGrid, array: PlanarArray) -> Tensor:
    """The polynomial's terms `[pixel, term]` towards the pixels: lags of rows alone, then those of columns."""
    _, y, z = grid.directions.reshape(-1, 3).double().unbind(-1)
    rows, columns = phasors(-array.vertical * z, 0.0, array.rows), phasors(array.horizontal * y, 0.0, array.cols)
    down = rows[1:]
    every = torch.cat((rows[1:].flip(0).conj(), rows))
    right = (columns[1:, None] * every[None]).flatten(0, 1)
    waves = 2.0 * torch.cat((down, right)).mT
    return torch.cat((torch.ones(len(waves), 1, dtype=torch.float64), waves.real, -waves.imag), -1)


def lags_of(picture: Spectrum, array: PlanarArray) -> Tensor:
    """The polynomial behind a picture `[row, col]` of one pose: sums `[2 rows - 1, cols]` as of `lag_sums`.

    Of R times the beamformer's factors, or of its inverse for Capon; raw levels, as the array measures them. Least
    squares of relative errors over the pixels in which the elements hear something.
    """
    power = picture.power.reshape(-1).double() * array.peak_gain
    there = torch.nonzero(power > 0).squeeze(-1)
    level = power[there] if picture.method != "capon" else 1.0 / power[there]
    weight = 1.0 / (level + SMALL * level.mean())
    design = _terms(picture.grid, array)[there] * weight[:, None]
    normal = design.mT @ design
    normal += RIDGE * normal.diagonal().mean() * torch.eye(len(normal), dtype=torch.float64)
    found = torch.linalg.solve(normal, design.mT @ (weight * level))
    count = (len(found) - 1) // 2
    waves = torch.complex(found[1 : 1 + count], found[1 + count :])
    sums = torch.zeros(2 * array.rows - 1, array.cols, dtype=torch.complex128)
    down = waves[: array.rows - 1]
    sums[array.rows :, 0], sums[: array.rows - 1, 0] = down, down.conj().flip(0)
    sums[array.rows - 1, 0] = found[0]
    sums[:, 1:] = waves[array.rows - 1 :].reshape(array.cols - 1, -1).mT
    return sums


@dataclass(frozen=True, eq=False)
class Panel:
    """One picture of `array` by `method`, and waves `[n]` that may be behind it.

    heard `[m]`: numbers of the waves in the elements' field of view. steering: their directions. gain `[m]`: the
    element's. level `[m]`: the picture's raw levels there. weight `[m]`: solid angle of the wave, zero outside it.
    """

    array: PlanarArray
    method: str
    heard: Tensor
    steering: PlanarSteering
    gain: Tensor
    level: Tensor
    weight: Tensor

    @classmethod
    def of(cls, picture: Spectrum, sums: Tensor, directions: Tensor, solid_angle: Tensor) -> "Panel":
        """A picture of one pose, its `lags_of`, and waves from world-frame `directions` `[n, 3]`."""
        array = picture.instrument.array
        assert array is not None
        local = picture.pose.to_device(directions)
        heard = torch.nonzero(seen(array, picture.instrument.fov, local)).squeeze(-1)
        local = local[heard]
        steering = PlanarSteering(array, local)
        level = steering.of_sums(sums)
        inside = picture.grid.pixel_of(local)[1] & (level > 0)
        level = torch.where(inside, 1.0 / level if picture.method == "capon" else level, 1.0)
        gain = power_pattern(array.pattern, local).double()
        return cls(array, picture.method, heard, steering, gain, level, solid_angle[heard].double() * inside)

    def covariance(self, power: Tensor, noise: float | Tensor) -> Tensor:
        """R `[element, element]` of waves of `power` `[n]` and white noise."""
        R = plane_waves(power[self.heard], self.steering.directions, self.array)
        noise = noise + SLIGHT * R.diagonal().real.mean()
        return R + noise * torch.eye(self.array.count, dtype=R.dtype)

    def sides(self, R: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """The predicted levels `[m]`, and Q of numerator and denominator of (1), which are a^H Q a."""
        count = self.array.count
        if self.method == "capon":
            inverse = torch.cholesky_inverse(torch.linalg.cholesky(R))
            shown = 1.0 / self.steering.forms(inverse).clamp_min(LEAST)
            Y, P = (inverse @ self._outer(one) @ inverse for one in (self.level, shown))
            return shown, Y, P
        taper = hann_taper(self.array) if self.method == "tapered" else torch.ones(count, dtype=torch.float64)
        weight = taper / taper.sum()
        both = weight[:, None] * weight
        shown = self.steering.forms(both * R).clamp_min(LEAST)
        return shown, both * self._outer(self.level / shown**2), both * self._outer(1.0 / shown)

    def _outer(self, share: Tensor) -> Tensor:
        """sum_i weight_i share_i v_i v_i^H."""
        return plane_waves(self.weight * share, self.steering.directions, replace(self.array, pattern="isotropic"))

    def forms(self, Q: Tensor) -> Tensor:
        """a^H Q a `[m]` of the waves that are heard."""
        return self.gain * self.steering.forms(Q).clamp_min(0.0)


def fitted(
    panels: Sequence[Panel], power: Tensor, noise: Tensor, steps: int, *, known: bool = False
) -> tuple[Tensor, Tensor]:
    """Powers `[n]` of waves and raw noise `[panel]` after so many steps of (1); `known` noise stays as it is."""
    for _ in range(steps):
        up, down = torch.zeros_like(power), torch.zeros_like(power)
        noise = noise.clone()
        for number, panel in enumerate(panels):
            _, Y, P = panel.sides(panel.covariance(power, noise[number]))
            up.index_add_(0, panel.heard, panel.forms(Y))
            down.index_add_(0, panel.heard, panel.forms(P))
            if not known:
                noise[number] *= Y.diagonal().real.sum() / P.diagonal().real.sum().clamp_min(LEAST)
        power = torch.where(down > 0, power * up / down.clamp_min(LEAST), power)
    return power, noise
