"""The transmitter and its mirror images out of an array's responses, one after the other, then all together.

Responses have no phase of their own, so what is made small is how far they are from parallel to the sources' sum.
"""

from dataclasses import replace

import torch
from torch import Tensor

from rf3dgs.core.units import wavelength
from rf3dgs.data.formats.gateway import GatewaySpectra
from rf3dgs.field.gateway import Waves, element_places

RANGES = (1.02, 1.2, 1.5, 2.0, 3.0, 5.0)  # distance of an image over that of the transmitter
BEARINGS = 240
TWIN_ROUNDS = 2


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
