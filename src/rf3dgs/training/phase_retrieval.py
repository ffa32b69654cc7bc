"""The complex response of each array element out of pictures of amplitude.

A Bartlett picture of one snapshot h is |a(u)^H h|. It tells the correlation of h with itself over the array, 49 real
numbers for 4 x 4 elements, and h has 32: h is found up to its phase and up to its twin, conj(h) read backwards, which
draws the same picture. Pictures of neighbouring places are alike, so each starts from its neighbour's answer, and the
likelier twin is the one nearer to it.
"""

import torch
from torch import Tensor

from rf3dgs.channel.response import manifold
from rf3dgs.core.errors import InputError
from rf3dgs.data.formats.gateway import GatewaySpectra

PIXELS = 600  # of a picture that are fitted: twelve times as many as it has degrees of freedom
STEPS = 60
GOOD = 0.003  # root mean square error of a picture whose largest amplitude is 1: the noise of 8 bits and a little
STARTS = 16


def element_responses(spectra: GatewaySpectra, *, seed: int = 0) -> tuple[Tensor, Tensor]:
    """Responses h `[place, element]` (complex128) with |a^H h| = amplitude, and the root mean square errors `[place]`.

    The phase of each h is arbitrary; of the two twins of all places together one is chosen by chance. InputError for
    fewer than two places, because a single picture has neither neighbour nor scale.
    """
    if len(spectra) < 2:
        raise InputError(f"responses are found from neighbouring places; got {len(spectra)}. Give two or more pictures")
    A, pictures = sampled(spectra)
    generator = torch.Generator().manual_seed(seed)
    found = torch.zeros(len(spectra), spectra.array.count, dtype=torch.complex128)
    error = torch.zeros(len(spectra), dtype=torch.float64)
    for index, parent in tree(spectra.places):
        tried = [] if parent is None else [fitted(pictures[index], found[parent], A)]
        if not tried or tried[0][0] > GOOD:
            random = torch.randn(STARTS, spectra.array.count, dtype=torch.complex128, generator=generator)
            scale = float(pictures[index].square().mean().sqrt()) / spectra.array.count**0.5
            tried += [fitted(pictures[index], scale * start, A) for start in random]
        error[index], response = min(tried, key=lambda pair: pair[0])
        if parent is not None:
            twin = response.conj().flip(0)
            if torch.vdot(twin, found[parent]).abs() > torch.vdot(response, found[parent]).abs():
                response = twin
        found[index] = response
    return found, error


def sampled(spectra: GatewaySpectra) -> tuple[Tensor, Tensor]:
    """Rows a(u)^H `[pixel, element]` and amplitudes `[place, pixel]`, float64, of evenly chosen pixels."""
    rows, columns = spectra.grid.shape
    step = max(1, round((rows * columns / PIXELS) ** 0.5))
    directions = spectra.grid.directions[step // 2 :: step, ::step].double().reshape(-1, 3)
    amplitude = spectra.amplitude[:, step // 2 :: step, ::step].double()
    return manifold(spectra.array, directions).conj(), amplitude.reshape(len(spectra), -1)


def tree(places: Tensor) -> list[tuple[int, int | None]]:
    """All places `[n, 3]` in an order in which each follows its nearest among the earlier ones: (place, that one)."""
    distance = torch.cdist(places.double(), places.double())
    nearest, parent = distance[0].clone(), torch.zeros(len(places), dtype=torch.long)
    order: list[tuple[int, int | None]] = [(0, None)]
    nearest[0] = torch.inf
    for _ in range(len(places) - 1):
        index = int(nearest.argmin())
        order.append((index, int(parent[index])))
        closer = (distance[index] < nearest) & torch.isfinite(nearest)
        parent[closer] = index
        nearest = torch.where(closer, distance[index], nearest)
        nearest[index] = torch.inf
    return order


def fitted(amplitude: Tensor, start: Tensor, A: Tensor) -> tuple[float, Tensor]:
    """Least squares of |A h| against `amplitude` `[pixel]` from `start` `[element]`: root mean square error and h.

    Levenberg and Marquardt's damped Gauss-Newton steps; d|f| = Re(conj(f) df) / |f| for f = A h.
    """
    response, damping, size = start, 1e-2, 2 * len(start)
    field = A @ response
    off = field.abs() - amplitude
    cost = float(off @ off)
    for _ in range(STEPS):
        slope = (field.conj() / field.abs().clamp_min(1e-9))[:, None] * A
        jacobian = torch.cat((slope.real, -slope.imag), 1)
        normal, gradient = jacobian.mT @ jacobian, jacobian.mT @ off
        while True:
            step = -torch.linalg.solve(normal + damping * torch.eye(size, dtype=torch.float64), gradient)
            tried = response + torch.complex(step[: size // 2], step[size // 2 :])
            tried_field = A @ tried
            tried_off = tried_field.abs() - amplitude
            tried_cost = float(tried_off @ tried_off)
            if tried_cost < cost or damping > 1e4:
                break
            damping *= 4.0
        if not tried_cost < cost:
            break
        done = cost - tried_cost < 1e-6 * cost
        response, field, off, cost, damping = tried, tried_field, tried_off, tried_cost, max(damping / 4.0, 1e-6)
        if done:
            break
    return (cost / len(amplitude)) ** 0.5, response
