"""Planes, and the large ones among surface points: walls, floors, ceilings, table tops."""

from dataclasses import dataclass

import torch
from torch import Tensor

SAMPLE = 6000
TRIALS = 1500
LEAST_SHARE = 0.01
LEAST_POINTS = 60
NEAR = 40
REFINEMENTS = 3
SAME_DIRECTION = 0.966  # cosine of 15 degrees


@dataclass(frozen=True)
class Planes:
    """Unit normals `[plane, 3]` and offsets `[plane]` [m] of planes normal . x = offset."""

    normals: Tensor
    offsets: Tensor

    def __len__(self) -> int:
        return len(self.offsets)


def find_planes(points: Tensor, tolerance: float, most: int, generator: torch.Generator) -> Planes:
    """At most `most` planes, the best supported first, that each hold 1 % of the `points` `[point, 3]` within
    `tolerance` [m].

    RANSAC over triplets of near points; the inliers of each plane refine it and are taken out of the search.
    """
    rest = points[torch.randperm(len(points), generator=generator)[:SAMPLE]].double()
    least = max(LEAST_POINTS, int(LEAST_SHARE * len(rest)))
    normals, offsets = [torch.zeros(0, 3)], [torch.zeros(0)]
    while len(normals) <= most and len(rest) >= least:
        normal, offset = _best_plane(rest, tolerance, generator)
        inliers = (rest @ normal - offset).abs() < 1.5 * tolerance
        if int(inliers.sum()) < least:
            break
        normals.append(normal[None].float())
        offsets.append(offset[None].float())
        rest = rest[~inliers]
    return Planes(torch.cat(normals), torch.cat(offsets))


def _best_plane(points: Tensor, tolerance: float, generator: torch.Generator) -> tuple[Tensor, Tensor]:
    """The best of many trial planes, refined by what lies on it: normal `[3]` and offset."""
    corner = torch.randint(len(points), (TRIALS,), generator=generator)
    near = torch.cdist(points[corner], points).topk(NEAR + 1, largest=False).indices[:, 1:]
    sides = points[near.gather(1, torch.randint(NEAR, (TRIALS, 2), generator=generator))] - points[corner][:, None]
    normals = torch.nn.functional.normalize(torch.linalg.cross(sides[:, 0], sides[:, 1], dim=-1), dim=-1)
    distance = (normals @ points.mT - (normals * points[corner]).sum(-1, keepdim=True)).abs()
    proper = torch.linalg.vector_norm(normals, dim=-1) > 0.5
    best = int(((distance < tolerance).sum(-1) * proper).argmax())
    normal, offset = normals[best], normals[best] @ points[corner[best]]
    for _ in range(REFINEMENTS):
        inliers = points[(points @ normal - offset).abs() < tolerance]
        centre = inliers.mean(0)
        normal = torch.linalg.eigh((inliers - centre).mT @ (inliers - centre)).eigenvectors[:, 0]
        offset = normal @ centre
    return normal, offset


def directions_of(planes: Planes, most: int) -> Tensor:
    """At most `most` distinct normals `[direction, 3]` of planes, the best supported first."""
    chosen: list[Tensor] = []
    for normal in planes.normals:
        if len(chosen) < most and all(abs(float(normal @ other)) < SAME_DIRECTION for other in chosen):
            chosen.append(normal)
    return torch.stack(chosen) if chosen else torch.zeros(0, 3)
