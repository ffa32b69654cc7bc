"""Images of the transmitter in mirrors.

Pure functions of arrays. A sequence names the planes that a wave meets, in the order from the transmitter; its image is
the transmitter mirrored in each of them in turn. Which ways lead over them to a receiver is asked in `field.ways`.
"""

import torch
from torch import Tensor

HIGHEST_ORDER = 3


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
