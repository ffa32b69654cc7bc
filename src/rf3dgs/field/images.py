"""Images of the transmitter in mirrors, and the broken line from it over them to a receiver.

Pure functions of arrays. A sequence names the planes that a wave meets, in the order from the transmitter; its image is
the transmitter mirrored in each of them in turn. The straight line from the receiver to the image, folded back at the
planes, is the only candidate for a mirror path along this sequence: whether it is one depends on where the planes have
surface and on what stands in the way, which is asked elsewhere.
"""

from dataclasses import dataclass

import torch
from torch import Tensor

HIGHEST_ORDER = 3
NEAREST = 1e-6  # share of a leg below which an end lies on the plane itself


@dataclass(frozen=True, eq=False)
class Folded:
    """Broken lines from the transmitter over K sequences to receivers `[*batch]`.

    points `[*batch, K, 3, 3]`: where each plane of the sequence is met [m], the receiver beyond the last. possible
    `[*batch, K]`: every point lies between its neighbours. cosine `[*batch, K, 3]`: of the angle of incidence, 1 beyond
    the last. distance `[*batch, K]`: whole length [m]. arrival, departure `[*batch, K, 3]`: unit vectors from the
    receiver to the last point and from the transmitter to the first.
    """

    points: Tensor
    possible: Tensor
    cosine: Tensor
    distance: Tensor
    arrival: Tensor
    departure: Tensor


def mirrored(points: Tensor, normals: Tensor, offsets: Tensor) -> Tensor:
    """Images `[*batch, 3]` of points `[*batch, 3]` in planes of `normals` `[*batch, 3]` and `offsets` `[*batch]`."""
    return points - 2.0 * ((points * normals).sum(-1) - offsets)[..., None] * normals


def image_chain(tx: Tensor, normals: Tensor, offsets: Tensor, sequence: Tensor) -> Tensor:
    """The transmitter and its images `[K, 4, 3]` [m] after 0, 1, 2 and 3 planes of sequences `[K, 3]`.

    normals `[P, 3]` and offsets `[P]` are the planes'; -1 in a sequence is no plane and leaves the image where it is.
    """
    chain = [tx.expand(len(sequence), 3)]
    for step in range(HIGHEST_ORDER):
        plane = sequence[:, step]
        if len(offsets) == 0:
            chain.append(chain[-1])
            continue
        index = plane.clamp_min(0)
        image = mirrored(chain[-1], normals[index], offsets[index])
        chain.append(torch.where((plane >= 0)[:, None], image, chain[-1]))
    return torch.stack(chain, 1)


def fold(chain: Tensor, normals: Tensor, offsets: Tensor, sequence: Tensor, receivers: Tensor) -> Folded:
    """The broken lines to receivers `[*batch, 3]` for the images `[K, 4, 3]` of sequences `[K, 3]`."""
    order = (sequence >= 0).sum(-1)
    here = receivers[..., None, :]
    line = chain[:, -1] - here
    distance = torch.linalg.vector_norm(line, dim=-1).clamp_min(1e-3)
    arrival = line / distance[..., None]
    shape = (*receivers.shape[:-1], len(sequence))
    point = here.expand(*shape, 3)
    possible = torch.ones(shape, dtype=torch.bool)
    points, cosine = [], []
    for step in reversed(range(int(order.max()) if len(order) else 0)):
        plane = sequence[:, step]
        active, index = plane >= 0, plane.clamp_min(0)
        normal = normals[index]
        leg = chain[:, step + 1] - point
        fall = (leg * normal).sum(-1)
        share = (offsets[index] - (point * normal).sum(-1)) / torch.where(fall.abs() < 1e-12, 1e-12, fall)
        possible &= ~active | ((share > NEAREST) & (share < 1.0 - NEAREST))
        point = torch.where(active[:, None], point + share[..., None] * leg, point)
        length = torch.linalg.vector_norm(leg, dim=-1).clamp_min(1e-9)
        cosine.append(torch.where(active, fall.abs() / length, 1.0))
        points.append(point)
    while len(points) < HIGHEST_ORDER:
        points.insert(0, here.expand(*shape, 3))
        cosine.insert(0, distance.new_ones(shape))
    points.reverse()
    cosine.reverse()
    departure = torch.nn.functional.normalize(points[0] - chain[:, 0], dim=-1, eps=1e-9)
    return Folded(torch.stack(points, -2), possible, torch.stack(cosine, -1), distance, arrival, departure)


def sequences(count: int, order: int, *, third: Tensor | None = None) -> Tensor:
    """All sequences `[K, 3]` over `count` planes: the line of sight first, then orders 1 to `order` (2 at most here).

    `third` `[T]` names the planes over which sequences of order 3 are added. No plane follows itself.
    """
    rows = [torch.full((1, HIGHEST_ORDER), -1)]
    every = torch.arange(count)
    if order >= 1 and count:
        rows.append(torch.stack((every, torch.full_like(every, -1), torch.full_like(every, -1)), -1))
    if order >= 2 and count > 1:
        pairs = torch.cartesian_prod(every, every)
        pairs = pairs[pairs[:, 0] != pairs[:, 1]]
        rows.append(torch.cat((pairs, torch.full_like(pairs[:, :1], -1)), -1))
    if third is not None and len(third) > 1:
        triples = torch.cartesian_prod(third, third, third)
        rows.append(triples[(triples[:, 0] != triples[:, 1]) & (triples[:, 1] != triples[:, 2])])
    return torch.cat(rows)
