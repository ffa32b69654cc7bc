"""Fit a `GatewayField`: responses out of pictures, then sources that explain them, then what the sources leave over.

Nobody knows the phase and gain of a picture: all responses are given one length, and what they were multiplied with is
left to the field's gain. Sources are fitted by how parallel their sum m_i is to the responses h_i,

    loss = 1 - mean_i |<h_i, m_i>|^2 / (|h_i|^2 |m_i|^2)

and the phases z_i that the rest needs minimise sum_ij (K^-1)_ij <z_i h_i - m_i, z_j h_j - m_j>. Each h_i may be its
twin (`phase_retrieval`): the one is taken that agrees better with the sources and with its neighbours. How many
sources, how far the rest is alike and how noisy it is, is chosen by leaving out blocks of the training places.
"""

from dataclasses import dataclass, replace
from itertools import product

import numpy as np
import torch
from torch import Tensor

from rf3dgs.core.errors import InputError
from rf3dgs.core.units import wavelength
from rf3dgs.data.formats.gateway import GatewaySpectra
from rf3dgs.field.gateway import GAIN_LENGTH, GatewayField, Waves, element_places, kernel
from rf3dgs.training.phase_retrieval import element_responses, sampled

RANGES = (1.02, 1.2, 1.5, 2.0, 3.0, 5.0)  # distance of an image over that of the transmitter
BEARINGS = 240
ROUNDS = 12  # of coordinate descent over the phases
TWIN_ROUNDS = 2
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


def fit_waves(spectra: GatewaySpectra, responses: Tensor, most: int, steps: int) -> list[tuple[Tensor, Waves, float]]:
    """For 0, 1, ... `most` sources: responses, sources, loss. Each source is put where it explains most of the rest.

    Which twin a response is, is asked anew of the sources before they are polished, until the answer stays.
    """
    places, origin = spectra.places.double(), spectra.places.double().mean(0)
    elements = element_places(spectra.pose, spectra.array, spectra.frequency)
    nothing = torch.zeros(0, 3, dtype=torch.float64)
    silent = torch.zeros(0, dtype=torch.complex128)
    waves = Waves(origin, nothing, silent, elements, wavelength(spectra.frequency))
    ladder = [(responses, waves, 1.0)]
    if most == 0:
        return ladder
    candidates = replace(waves, images=_candidates(spectra, origin))
    parts = candidates.parts(places).reshape(len(candidates.images), -1)
    unit = parts / torch.linalg.vector_norm(parts, dim=-1, keepdim=True)
    waves = replace(waves, images=origin[None], amplitudes=torch.ones(1, dtype=torch.complex128))
    for count in range(1, most + 1):
        if count > 1:
            model = waves.responses(places)
            share = unit.conj() @ (agreed(responses, model, twins=False) - model).reshape(-1)
            best = int(share.abs().argmax())
            amplitude = share[best] / torch.linalg.vector_norm(parts[best])
            images = torch.cat((waves.images, candidates.images[best : best + 1]))
            waves = replace(waves, images=images, amplitudes=torch.cat((waves.amplitudes, amplitude[None])))
            for _ in range(TWIN_ROUNDS):
                before, responses = responses, agreed(responses, waves.responses(places))
                waves = _polished(waves, responses, places, steps)
                if bool(((before.conj() * responses).sum(-1).abs() > 0.999 * before.abs().square().sum(-1)).all()):
                    break
        waves = _scaled(waves, responses, places)
        ladder.append((responses, waves, float(misalignment(waves.responses(places), responses))))
    return ladder


def twins_of(responses: Tensor) -> Tensor:
    """The responses `[*place, element]` that draw the same pictures: conjugates, read backwards over the array."""
    return responses.conj().flip(-1)


def agreed(responses: Tensor, target: Tensor, *, twins: bool = True) -> Tensor:
    """Responses turned to the phase of `target`, both `[*place, element]`; their twins where those agree better."""
    best, agreement = responses, (responses.conj() * target).sum(-1, keepdim=True)
    if twins:
        twin = twins_of(responses)
        of_twin = (twin.conj() * target).sum(-1, keepdim=True)
        better = of_twin.abs() > agreement.abs()
        best, agreement = torch.where(better, twin, best), torch.where(better, of_twin, agreement)
    return best * (agreement / agreement.abs().clamp_min(1e-30))


def misalignment(model: Tensor, responses: Tensor) -> Tensor:
    """The loss: what share of the responses' power is not parallel to the model's, both `[place, element]`."""
    parallel = (responses.conj() * model).sum(-1).abs().square()
    return (1.0 - parallel / (responses.abs().square().sum(-1) * model.abs().square().sum(-1)).clamp_min(1e-30)).mean()


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


def _candidates(spectra: GatewaySpectra, origin: Tensor) -> Tensor:
    """Where images may be `[n, 3]`: even bearings over the hemisphere before the array, at several distances."""
    number = torch.arange(BEARINGS, dtype=torch.float64) + 0.5
    ahead, turn = 1.0 - number / BEARINGS, torch.pi * (1.0 + 5.0**0.5) * number
    side = (1.0 - ahead.square()).sqrt()
    bearing = torch.stack((ahead, side * torch.cos(turn), side * torch.sin(turn)), -1)
    world = bearing @ spectra.pose.world_from_device.double().mT
    centre = spectra.pose.position.double()
    distance = torch.linalg.vector_norm(origin - centre) * torch.tensor(RANGES, dtype=torch.float64)
    return (centre + distance[:, None, None] * world).reshape(-1, 3)


def _polished(waves: Waves, responses: Tensor, places: Tensor, steps: int) -> Waves:
    """The sources after quasi-Newton steps on images and amplitudes; the transmitter's own place stays."""
    images = (waves.images[1:] / waves.wavelength).clone().requires_grad_(True)
    amplitudes = torch.view_as_real(waves.amplitudes / waves.amplitudes.abs().square().sum().sqrt()).clone()
    amplitudes.requires_grad_(True)

    def current() -> Waves:
        placed = torch.cat((waves.images[:1], images * waves.wavelength))
        return replace(waves, images=placed, amplitudes=torch.view_as_complex(amplitudes))

    optimiser = torch.optim.LBFGS([images, amplitudes], max_iter=steps, line_search_fn="strong_wolfe", history_size=20)

    def closure() -> Tensor:
        optimiser.zero_grad()
        loss = misalignment(current().responses(places), responses)
        loss = loss + 1e-3 * (amplitudes.square().sum() - 1.0).square()
        loss.backward()
        return loss

    optimiser.step(closure)
    polished = current()
    return replace(polished, images=polished.images.detach(), amplitudes=polished.amplitudes.detach())


def _scaled(waves: Waves, responses: Tensor, places: Tensor) -> Waves:
    """The same sources, as strong as the responses are."""
    model = waves.responses(places)
    scale = (responses.conj() * model).sum(-1).abs().sum() / model.abs().square().sum()
    return replace(waves, amplitudes=waves.amplitudes * scale)
