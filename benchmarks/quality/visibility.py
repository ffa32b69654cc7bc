"""Gates against the mesh: how often a segment through the Gaussians is open where the mesh blocks it, and the reverse.

    python -m benchmarks.quality.visibility [geometry.ply ...]

Segments in the built-in lobby: from the transmitter to receivers, between receivers, and from receivers to points on
large surfaces, whose own plane is skipped. The truth is cast exactly against the triangles. Gaussians are sampled on
the mesh, and those that photographs trained (the geometry of the shipped field, or of the files named). The plane of a
Gaussian is the mesh's own within 10 cm and 25 degrees, so that the table shows the gates and not who finds planes.

How near a silhouette a segment is: the least distance by which it can be shifted so that the truth changes, looked for
in eight directions. Printed for each gate and threshold: the share of blocked segments that are open, of free ones that
are closed, of all that are wrong, and how many of the wrong ones have a silhouette within 5 and 15 cm.
"""

import argparse
import math
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from rf3dgs.cli.chain import geometry_of_mesh
from rf3dgs.cli.facts import open_field
from rf3dgs.propagation.sites.lobby import lobby
from rf3dgs.propagation.sites.scene import Scene
from rf3dgs.splats.obstacles import Obstacles
from rf3dgs.splats.ply import read_ply

THRESHOLDS = (0.02, 0.05, 0.1, 0.2, 0.3, 0.5)
LARGE = 3.0  # m^2: planes with less surface reflect little
SHIFTS = (0.02, 0.05, 0.1, 0.15, 0.3)  # m


@dataclass(frozen=True, eq=False)
class Legs:
    """Segments `[segment, 3]` [m] and the plane on which each ends, -1 for none."""

    start: Tensor
    end: Tensor
    plane: Tensor


def free(start: Tensor, end: Tensor, corners: Tensor, *, margin: float = 0.01) -> Tensor:
    """True `[segment]` where none of the triangles `[face, 3, 3]` stands between, `margin` [m] at the ends left out."""
    edge1, edge2 = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    result = []
    for first, last in zip(start.split(4096), end.split(4096), strict=True):
        span = last - first
        length = torch.linalg.vector_norm(span, dim=-1, keepdim=True)
        ray = span / length
        p = torch.linalg.cross(ray[:, None], edge2[None], dim=-1)
        scale = (edge1 * p).sum(-1)
        inverse = 1 / torch.where(scale.abs() < 1e-9, torch.inf, scale)
        away = first[:, None] - corners[:, 0]
        q = torch.linalg.cross(away, edge1.expand_as(away), dim=-1)
        u, v = (away * p).sum(-1) * inverse, (q * ray[:, None]).sum(-1) * inverse
        along = (edge2 * q).sum(-1) * inverse
        met = (u >= 0) & (v >= 0) & (u + v <= 1) & (along > margin) & (along < length - margin) & (inverse != 0)
        result.append(~met.any(-1))
    return torch.cat(result)


def planes_of(corners: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Normals `[plane, 3]`, offsets `[plane]` and the plane of each face `[face]`, both of its sides."""
    normal = torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0], dim=-1)
    normal = torch.nn.functional.normalize(normal, dim=-1)
    leading = normal.gather(1, normal.abs().argmax(-1, keepdim=True))
    normal = normal * leading.sign()
    offset = (normal * corners[:, 0]).sum(-1, keepdim=True)
    rows, plane = torch.unique(torch.cat((normal, offset), -1).mul(1e3).round(), dim=0, return_inverse=True)
    return rows[:, :3] / 1e3, rows[:, 3] / 1e3, plane


def labels_of(means: Tensor, normal: Tensor, corners: Tensor) -> Tensor:
    """The plane `[gaussian]` of the mesh's nearest face within 10 cm and 25 degrees, or -1."""
    plane_normal, offset, plane = planes_of(corners)
    labels = []
    for points, axis in zip(means.split(2048), normal.split(2048), strict=True):
        distance = (points @ plane_normal.mT - offset)[:, plane].abs()
        distance = distance.where((axis @ plane_normal.mT).abs()[:, plane] > math.cos(math.radians(25)), torch.inf)
        distance = distance.where(distance < 0.1, torch.inf)
        distance = torch.maximum(distance, outside(points, corners)).where(distance.isfinite(), torch.inf)
        least, face = distance.min(-1)
        labels.append(torch.where(least < 0.1, plane[face], -1))
    return torch.cat(labels)


def outside(points: Tensor, corners: Tensor) -> Tensor:
    """How far `[point, face]` [m] the foot of a point on a face's plane lies beyond the face's sides, at least 0."""
    normal = torch.nn.functional.normalize(
        torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0], dim=-1), dim=-1
    )
    beyond = torch.zeros(len(points), len(corners))
    for side in range(3):
        edge = torch.nn.functional.normalize(corners[:, (side + 1) % 3] - corners[:, side], dim=-1)
        outwards = torch.linalg.cross(edge, normal, dim=-1)
        beyond = torch.maximum(beyond, points @ outwards.mT - (corners[:, side] * outwards).sum(-1))
    return beyond


def all_legs(scene: Scene, corners: Tensor, count: int) -> dict[str, Legs]:
    """The three kinds of segments, `count` of each."""
    receivers, others = scene.receivers(count, 21).position, scene.receivers(count, 22).position
    nowhere = torch.full((count,), -1)
    generator = torch.Generator().manual_seed(5)
    area = torch.linalg.vector_norm(
        torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0], dim=-1), dim=-1
    )
    plane = planes_of(corners)[2]
    whole = torch.zeros(int(plane.max()) + 1).index_add_(0, plane, 0.5 * area)
    area = torch.where(whole[plane] >= LARGE, area, 0.0)
    face = torch.multinomial(area, count, replacement=True, generator=generator)
    share = torch.rand(count, 2, generator=generator)
    share = torch.where(share.sum(-1, keepdim=True) > 1, 1 - share, share)[..., None]
    point = corners[face, 0] + share[:, 0] * (corners[face, 1] - corners[face, 0])
    point = point + share[:, 1] * (corners[face, 2] - corners[face, 0])
    assert scene.tx is not None
    return {
        "line of sight": Legs(scene.tx.position.expand(count, 3), receivers, nowhere),
        "between receivers": Legs(receivers, others, nowhere),
        "to a surface": Legs(receivers, point, plane[face]),
    }


def silhouette(legs: Legs, truth: Tensor, corners: Tensor) -> Tensor:
    """The least of `SHIFTS` `[segment]` [m] by which a shift changes the truth; infinite beyond them."""
    along = torch.nn.functional.normalize(legs.end - legs.start, dim=-1)
    least = torch.nn.functional.one_hot(along.abs().argmin(-1), 3).to(along.dtype)
    across = torch.nn.functional.normalize(torch.linalg.cross(along, least, dim=-1), dim=-1)
    up = torch.linalg.cross(along, across, dim=-1)
    distance = torch.full_like(along[:, 0], math.inf)
    for shift in reversed(SHIFTS):
        for turn in range(8):
            angle = turn * math.pi / 4
            by = shift * (math.cos(angle) * across + math.sin(angle) * up)
            changed = free(legs.start + by, legs.end + by, corners) != truth
            distance = torch.where(changed, shift, distance)
    return distance


def gates(obstacles: Obstacles, legs: Legs, radii: list[float]) -> dict[str, Tensor]:
    """Transmittance `[segment]` by the name of the gate."""
    options = {"skip_end": legs.plane, "stop_short": 0.10}
    result = {"hard": obstacles.transmittance(legs.start, legs.end, **options)}
    for radius in radii:
        result[f"soft {100 * radius:.0f} cm"] = obstacles.soft(legs.start, legs.end, radius=radius, **options)
    return result


def percent(part: Tensor, whole: Tensor) -> str:
    return f"{100 * float(part.sum()) / max(1, int(whole.sum())):.1f}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("files", nargs="*", type=Path, help="geometries; without any that of the shipped field")
    parser.add_argument("--count", type=int, default=4000, help="segments of each kind")
    parser.add_argument("--gaussians", type=int, default=100_000, help="on the mesh")
    parser.add_argument("--radii", type=float, nargs="*", default=[0.02, 0.05], help="of soft gates [m]")
    wish = parser.parse_args()
    scene = lobby()
    vertices, faces, _ = scene.mesh()
    corners = vertices[faces].float()
    mesh = geometry_of_mesh(scene, wish.gaussians, 0)
    subjects = {f"mesh, {len(mesh)}": subject(mesh.means, mesh.quats, mesh.scales, mesh.opacities)}
    if not wish.files:
        field = open_field("lobby")
        part = field.surface
        subjects[f"photographs, {len(part)}"] = subject(part.means, part.quats, part.scales, field.solidity)
    for file in wish.files:
        part = read_ply(file)
        subjects[f"{file.stem}, {len(part)}"] = subject(part.means, part.quats, part.scales, part.opacities)
    kinds = all_legs(scene, corners, wish.count)
    truths = {name: free(legs.start, legs.end, corners) for name, legs in kinds.items()}
    near = {name: silhouette(legs, truths[name], corners) for name, legs in kinds.items()}
    print("| segments | geometry | gate | open above | blocked but open % | free but closed % | wrong % | ", end="")
    print("within 5 cm % | 15 cm % |\n|---|---|---|---|---|---|---|---|---|")
    for name, legs in kinds.items():
        truth, distance = truths[name], near[name]
        print(f"| {name}: {int(truth.sum())} of {len(truth)} free | | | | | | | | |")
        for geometry, (means, quats, scales, opacities, axis) in subjects.items():
            obstacles = Obstacles(means, quats, scales, opacities, labels_of(means, axis, corners))
            for gate, passed in gates(obstacles, legs, wish.radii).items():
                rms = float((passed - truth.float()).square().mean().sqrt())
                print(f"| | {geometry} | {gate} | as a weight: rms error {rms:.3f} | | | | | |")
                for threshold in THRESHOLDS:
                    is_open = passed > threshold
                    wrong = is_open != truth
                    shares = (percent(wrong & ~truth, ~truth), percent(wrong & truth, truth))
                    shares += (percent(wrong, torch.ones_like(wrong)),)
                    shares += tuple(percent(wrong & (distance <= limit), wrong) for limit in (0.05, 0.15))
                    print(f"| | {geometry} | {gate} | {threshold} | {' | '.join(shares)} |", flush=True)


def subject(means: Tensor, quats: Tensor, scales: Tensor, opacities: Tensor) -> tuple[Tensor, ...]:
    """Gaussians as the gates need them, with the shortest axis of each."""
    return means, quats, scales, opacities, shortest_axis(quats, scales)


def shortest_axis(quats: Tensor, scales: Tensor) -> Tensor:
    """Unit vectors `[gaussian, 3]` along the shortest axes."""
    from rf3dgs.core.frames import matrix_from_quaternion

    shortest = scales.argmin(-1)[:, None, None].expand(-1, 3, 1)
    return matrix_from_quaternion(quats).gather(-1, shortest).squeeze(-1)


if __name__ == "__main__":
    torch.set_grad_enabled(False)
    main()
