"""Planes, the large ones among surface points, such as walls and table tops, and the directions they face."""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

SAMPLE = 6000
TRIALS = 1500
LEAST_SHARE = 0.01
LEAST_POINTS = 60
NEAR = 40
REFINEMENTS = 3
TURN_DEG, FINEST_TURN_DEG = 5, 0.05


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


def main_directions(points: Tensor, tolerance: float, generator: torch.Generator) -> Tensor:
    """Three directions at right angles `[3, 3]` that surfaces at `points` `[point, 3]` face, as they do in buildings.

    Those along which the points' coordinates crowd most into layers `tolerance` [m] thick: all walls have their say,
    where the plane that fits most points of a noisy cloud may cut through several. None, `[0, 3]`, of few points.
    """
    if len(points) < LEAST_POINTS:
        return torch.zeros(0, 3)
    points = points[torch.randperm(len(points), generator=generator)].double()
    frame = _right_angles(_best_plane(points[:SAMPLE], tolerance, generator)[0])
    turns = [_turned(frame, 0, math.radians(angle)) for angle in range(0, 90, TURN_DEG)]
    frame = max(turns, key=lambda turn: _crowding(points, turn, tolerance))
    most, step = _crowding(points, frame, tolerance), math.radians(TURN_DEG)
    while step > math.radians(FINEST_TURN_DEG):
        trials = [_turned(frame, axis, angle) for axis in range(3) for angle in (-step, step)]
        found = [_crowding(points, trial, tolerance) for trial in trials]
        best = max(range(len(trials)), key=lambda trial: found[trial])
        if found[best] > most:
            frame, most = trials[best], found[best]
        else:
            step /= 2
    return frame.float()


def _right_angles(first: Tensor) -> Tensor:
    """Unit vector `first` `[3]` and two at right angles to it and each other: `[3, 3]`."""
    second = torch.linalg.cross(first, torch.eye(3, dtype=first.dtype)[first.abs().argmin()])
    second = torch.nn.functional.normalize(second, dim=-1)
    return torch.stack((first, second, torch.linalg.cross(first, second)))


def _turned(frame: Tensor, axis: int, angle: float) -> Tensor:
    """Three vectors `[3, 3]` at right angles, turned about one of them by `angle` [rad]."""
    one, other = (axis + 1) % 3, (axis + 2) % 3
    result = frame.clone()
    result[one] = math.cos(angle) * frame[one] + math.sin(angle) * frame[other]
    result[other] = math.cos(angle) * frame[other] - math.sin(angle) * frame[one]
    return result


def _crowding(points: Tensor, frame: Tensor, thickness: float) -> float:
    """Sum of squares of how many points lie in each layer along each of the directions `[3, 3]`."""
    total = 0.0
    for heights in (points @ frame.mT / thickness).mT:
        heights = heights - heights.min()
        layer = heights.floor()
        upper, layer = heights - layer, layer.long()  # a point counts for the two layers that it is between
        counts = heights.new_zeros(int(layer.max()) + 2)
        total += float(counts.index_add_(0, layer, 1 - upper).index_add_(0, layer + 1, upper).square().sum())
    return total
