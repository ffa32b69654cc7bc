"""Fit a `GatewayField`: responses out of pictures, then sources that explain them, then what the sources leave over.

Nobody knows the phase and gain of a picture: all responses are given one length, and what they were multiplied with is
left to the field's gain. Sources are fitted by how parallel their sum m_i is to the responses h_i,

    loss = 1 - mean_i |<h_i, m_i>|^2 / (|h_i|^2 |m_i|^2)

and the phases z_i that the rest needs minimise sum_ij (K^-1)_ij <z_i h_i - m_i, z_j h_j - m_j>. Each h_i may be its
twin (`phase_retrieval`): the one is taken that agrees better with the sources and with its neighbours. How many
sources, how far the rest is alike and how noisy it is, is chosen by leaving out blocks of the training places.
"""

from dataclasses import dataclass
from itertools import product

import numpy as np
import torch
from torch import Tensor

from rf3dgs.core.errors import InputError
from rf3dgs.core.threads import one_torch_thread
from rf3dgs.core.units import wavelength
from rf3dgs.data.formats.gateway import GatewaySpectra
from rf3dgs.field.gateway import GAIN_LENGTH, GatewayField, Waves, kernel
from rf3dgs.training.gateway_sources import agreed, fit_waves, twins_of
from rf3dgs.training.phase_retrieval import element_responses, sampled

ROUNDS = 12  # of coordinate descent over the phases
Choice = tuple[int, float, float]


@dataclass(frozen=True)
class GatewayConfig:
    """What may be tried; the best of it on left-out blocks of the training places is taken."""

    sources: tuple[int, ...] = (0, 1, 2, 4)
    """How many sources, the transmitter itself first; the most may take a second."""
    lengths: tuple[float, ...] = (0.15, 0.3, 0.6)
    """How far the rest is alike [wavelengths]."""
    noises: tuple[float, ...] = (0.01, 0.1)
    """The share of the rest's power that does not belong to its place."""
    blocks: int = 3
    """Into how many blocks the training places are cut."""
    steps: int = 60
    """Quasi-Newton steps after each new source."""
    seed: int = 0
    """Decides the random starts of the phase retrieval."""

    def __post_init__(self) -> None:
        if not self.sources or min(self.sources) < 0:
            raise InputError(f"sources must be counts to try, such as (0, 2); got {self.sources}")
        if not (self.lengths and self.noises) or min(*self.lengths, *self.noises) <= 0:
            raise InputError(
                f"lengths and noises must be above 0, one each at least; got {self.lengths}, {self.noises}"
            )
        if self.blocks < 2 or self.steps < 1:
            raise InputError(f"blocks must be 2 or more and steps 1 or more; got {self.blocks} and {self.steps}")


@dataclass(frozen=True, eq=False)
class GatewayFit:
    """The field, what was chosen, and what was tried.

    choice: number of sources, length [wavelengths], noise. errors: the root mean square error of amplitude on left-out
    blocks of each that was tried; empty where there was nothing to choose. misfit: that of the responses to the
    training pictures; much above 0.003, the pictures are not those of this array.
    """

    field: GatewayField
    choice: Choice
    errors: dict[Choice, float]
    misfit: float


@one_torch_thread()
def fit_gateway(spectra: GatewaySpectra, config: GatewayConfig | None = None) -> GatewayFit:
    """A field over the transmitter's places out of measured pictures; InputError for fewer than eight of them."""
    config = config or GatewayConfig()
    if len(spectra) < 8:
        raise InputError(f"a field needs pictures of at least 8 transmitter places; got {len(spectra)}")
    responses, misfits = element_responses(spectra, seed=config.seed)
    length = torch.linalg.vector_norm(responses, dim=-1)
    loudness = length.log() - length.log().mean()
    responses = responses / loudness.exp()[:, None]
    tried = list(product(sorted(set(config.sources)), config.lengths, config.noises))
    errors = _errors(spectra, responses, loudness, tried, config) if len(tried) > 1 else {}
    choice = min(errors, key=lambda key: errors[key]) if errors else tried[0]
    ladder = _ladder(spectra, responses, choice[0], config.steps)
    field = with_rest(spectra, *ladder[-1], loudness, choice[1] * wavelength(spectra.frequency), choice[2])
    return GatewayFit(field, choice, errors, float(misfits.median()))


def _errors(
    spectra: GatewaySpectra, responses: Tensor, loudness: Tensor, tried: list[Choice], config: GatewayConfig
) -> dict[Choice, float]:
    """The root mean square error of amplitude at blocks that took no part in the fit, for each choice."""
    A, pictures = sampled(spectra)
    total = dict.fromkeys(tried, 0.0)
    for left_out in blocks_of(spectra.places, config.blocks):
        kept = torch.ones(len(spectra), dtype=torch.bool)
        kept[left_out] = False
        part = spectra[torch.nonzero(kept)[:, 0]]
        ladder = _ladder(part, responses[kept], max(config.sources), config.steps)
        for choice in tried:
            count, length, noise = choice
            field = with_rest(part, *ladder[count], loudness[kept], length * wavelength(spectra.frequency), noise)
            off = field.seen(spectra.places[left_out], A) - pictures[left_out]
            total[choice] += float(off.square().mean(-1).sum())
    return {choice: (value / len(spectra)) ** 0.5 for choice, value in total.items()}


def blocks_of(places: Tensor, count: int) -> list[Tensor]:
    """Indices of `count` blocks of places `[n, 3]`, equally many in each: slabs across the longest axis."""
    centred = places.double() - places.double().mean(0)
    axis = torch.linalg.eigh(centred.mT @ centred)[1][:, -1]
    order = (centred @ axis).argsort(stable=True)
    return [block.sort()[0] for block in torch.tensor_split(order, count)]


def _ladder(spectra: GatewaySpectra, responses: Tensor, most: int, steps: int) -> list[tuple[Tensor, Waves]]:
    """For 0, 1, ... `most` sources the responses, as those of their twins that fit the sources, and the sources."""
    starts = (responses, twins_of(responses)) if most > 1 else (responses,)
    ladders = [fit_waves(spectra, start, most, steps) for start in starts]
    return [min(rungs, key=lambda rung: rung[2])[:2] for rungs in zip(*ladders, strict=True)]


def with_rest(
    spectra: GatewaySpectra, responses: Tensor, waves: Waves, loudness: Tensor, length: float, noise: float
) -> GatewayField:
    """The field of these sources and of a Gaussian process of kernel `length` [m] through what they leave over.

    loudness `[place]`: the logarithm of what each picture's response was divided by.
    """
    places = spectra.places.double()
    model = waves.responses(places)
    gram = kernel(places, places, length) + noise * torch.eye(len(places), dtype=torch.float64)
    inverse = torch.linalg.inv(gram)
    if len(waves):
        turned = agreed(responses, model)
    else:
        phases = torch.linalg.eigh(inverse * (responses.conj() @ responses.mT))[1][:, 0]
        turned = responses * (phases / phases.abs().clamp_min(1e-30))[:, None]
    rest = torch.from_numpy(_settled(turned.numpy(), model.numpy(), inverse.numpy())) - model
    covariance = rest.mT @ rest.conj() / len(rest)
    weights = inverse.to(torch.complex128) @ rest
    near = kernel(places, places, GAIN_LENGTH * length) + noise * torch.eye(len(places), dtype=torch.float64)
    gains = torch.linalg.solve(near, loudness)
    return GatewayField(spectra.pose, spectra.array, waves, places, weights, inverse, covariance, gains, length)


def _settled(responses: np.ndarray, model: np.ndarray, inverse: np.ndarray) -> np.ndarray:
    """Responses `[place, element]` in the phases, and as those of the twins, for which the rest is most alike.

    Coordinate descent: one place after the other is agreed with what all others say of it.
    """
    turned = responses.copy()
    pull = inverse @ model
    own = inverse.diagonal()
    for _ in range(ROUNDS):
        before = turned.copy()
        for index in range(len(turned)):
            target = pull[index] - inverse[index] @ turned + own[index] * turned[index]
            response, twin = turned[index], turned[index, ::-1].conj()
            as_is, mirrored = np.vdot(response, target), np.vdot(twin, target)
            best, agreement = (twin, mirrored) if abs(mirrored) > abs(as_is) else (response, as_is)
            turned[index] = best * (agreement / max(abs(agreement), 1e-30))
        if np.abs(turned - before).max() < 1e-6 * np.abs(turned).max():
            break
    return turned
