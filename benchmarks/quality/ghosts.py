"""What shines through walls: ghosts of a lamp behind a wall with and without depth gate and normalisation.

    python -m benchmarks.quality.ghosts

Lamps are patches of the built-in lobby's surfaces, 60 dB above everything else. A direction is inner where the mesh
stands well before a lamp's patch, there and two pixels around. Printed for Gaussians sampled on the mesh and for those
that photographs trained (the shipped field): the share of inner directions that show less than -50 dB of the lamp; what
a smooth radiance on the surfaces loses against the mesh hit exactly, as RMSE in dB; the time of a picture.
"""

import argparse
import math
import time
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from rf3dgs.cli.chain import geometry_of_mesh
from rf3dgs.cli.facts import open_field
from rf3dgs.core.frames import Pose
from rf3dgs.core.grids import DirectionGrid, equirect_grid, view_of
from rf3dgs.propagation.lobby import lobby
from rf3dgs.splats.compositing import Compositing
from rf3dgs.splats.rasterize import rasterize

LAMP_RADIUS = 0.25  # m
WELL_BEFORE = 0.6  # m: how far before the lamp the wall that hides it stands at least
DARK = 1e-6
WAYS = {
    "as they are": Compositing(),
    "normalised": Compositing(normalise=True),
    "gate 0.3 m, normalised": Compositing(depth_gate=0.3, normalise=True),
    "gate 0.1 m, normalised": Compositing(depth_gate=0.1, normalise=True),
}


@dataclass(frozen=True, eq=False)
class Geometry:
    """Activated Gaussians."""

    means: Tensor
    quats: Tensor
    scales: Tensor
    opacities: Tensor

    def draw(self, pose: Pose, grid: DirectionGrid, values: Tensor, way: Compositing) -> Tensor:
        shape = (self.means, self.quats, self.scales, self.opacities)
        return rasterize(*shape, values, view_of(pose, grid), compositing=way).values


def first_hit(origin: Tensor, directions: Tensor, corners: Tensor) -> Tensor:
    """Range `[ray]` [m] of the first of the triangles `[face, 3, 3]` along rays; infinite where there is none."""
    edge1, edge2 = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    to_origin = origin - corners[:, 0]
    q = torch.linalg.cross(to_origin, edge1, dim=-1)
    height = (edge2 * q).sum(-1)
    nearest = []
    for rays in directions.split(256):
        p = torch.linalg.cross(rays[:, None], edge2[None], dim=-1)
        scale = (edge1 * p).sum(-1)
        inverse = 1 / torch.where(scale.abs() < 1e-9, torch.inf, scale)
        u, v = (to_origin * p).sum(-1) * inverse, (rays @ q.mT) * inverse
        distance = height * inverse
        hit = (u >= 0) & (v >= 0) & (u + v <= 1) & (distance > 1e-3) & (inverse != 0)
        nearest.append(torch.where(hit, distance, torch.inf).amin(-1))
    return torch.cat(nearest)


def smooth(points: Tensor) -> Tensor:
    """A radiance [linear] that varies by 20 dB over the room `[point, 1]`."""
    wave = torch.sin(1.3 * points[:, 0]) + torch.sin(1.1 * points[:, 1] + 1) + torch.sin(2 * points[:, 2])
    return 10 ** (wave[:, None] / 3 - 7)


def hidden(pose: Pose, grid: DirectionGrid, hit: Tensor, lamps: Tensor) -> Tensor:
    """Inner directions `[row, col, lamp]`: lamp patches `[lamp, 3]` with the mesh well before them there and around."""
    away = lamps - pose.position
    distance = away.norm(dim=-1)
    cosine = pose.to_world(grid.directions) @ torch.nn.functional.normalize(away, dim=-1).mT
    disc = cosine > torch.cos(torch.atan(LAMP_RADIUS / distance))
    behind = (hit[..., None] < distance - WELL_BEFORE).float().movedim(-1, 0)
    around = torch.nn.functional.pad(behind, (2, 2, 0, 0), mode="circular")
    around = torch.nn.functional.pad(around[:, None], (0, 0, 2, 2), mode="replicate")[:, 0]
    inner = -torch.nn.functional.max_pool2d(-around, 5, 1) > 0
    return disc & inner.movedim(0, -1)


def milliseconds(draw: Callable[[], object], repeats: int = 20) -> float:
    """Least processor time of a call [ms]."""
    spent = []
    for _ in range(repeats):
        begin = time.process_time()
        draw()
        spent.append(time.process_time() - begin)
    return 1e3 * min(spent)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--receivers", type=int, default=8)
    parser.add_argument("--lamps", type=int, default=24)
    parser.add_argument("--count", type=int, default=100_000, help="Gaussians on the mesh")
    wish = parser.parse_args()
    scene, grid = lobby(), equirect_grid(240, 120)
    vertices, faces, _ = scene.mesh()
    corners = vertices[faces].float()
    mesh = geometry_of_mesh(scene, wish.count, 0)
    trained = open_field("lobby").surface
    subjects = {
        f"mesh, {len(mesh)} Gaussians": Geometry(mesh.means, mesh.quats, mesh.scales, mesh.opacities),
        f"photographs, {len(trained)} Gaussians": Geometry(
            trained.means, trained.quats, trained.scales, trained.opacities
        ),
    }
    chosen = torch.randperm(len(mesh), generator=torch.Generator().manual_seed(1))[: wish.lamps]
    lamps, receivers = mesh.means[chosen], scene.receivers(wish.receivers, 3)
    views = []
    for index in range(len(receivers)):
        pose = receivers[index]
        directions = pose.to_world(grid.directions)
        hit = first_hit(pose.position, directions.reshape(-1, 3), corners).reshape(grid.shape)
        points = pose.position + torch.where(hit.isfinite(), hit, 0.0)[..., None] * directions
        views.append((pose, hit, points, hidden(pose, grid, hit, lamps)))
    inner_count = sum(int(inner.sum()) for *_, inner in views)
    print(f"{len(faces)} triangles, {len(receivers)} receivers, {len(lamps)} lamps, {inner_count} inner directions\n")
    print("| geometry | compositing | below -50 dB | worst 1 % [dB] | RMSE [dB] | bias [dB] | picture [CPU ms] |")
    print("|---|---|---|---|---|---|---|")
    for name, geometry in subjects.items():
        near = (torch.cdist(geometry.means, lamps) < LAMP_RADIUS).float()
        values, radiance = DARK + (1 - DARK) * near, smooth(geometry.means)
        for label, way in WAYS.items():
            shown, errors = [], []
            for pose, hit, points, inner in views:
                shown.append(geometry.draw(pose, grid, values, way)[inner])
                found = geometry.draw(pose, grid, radiance, way)[..., 0]
                exact = smooth(points.reshape(-1, 3)).reshape(grid.shape)
                usable = hit.isfinite() & (found > 0)
                errors.append(10 * torch.log10(found[usable] / exact[usable]))
            level = torch.cat(shown)
            error = torch.cat(errors)
            worst = 10 * math.log10(float(level.quantile(0.99)) if len(level) < 10**7 else float(level.max()))
            spent = milliseconds(lambda g=geometry, r=radiance, w=way: g.draw(views[0][0], grid, r, w))
            share = 100 * float((level < 1e-5).double().mean())
            rmse = float(error.square().mean().sqrt())
            row = f"{share:.2f} % | {worst:.1f} | {rmse:.2f} | {float(error.mean()):.2f} | {spent:.1f}"
            print(f"| {name} | {label} | {row} |")


if __name__ == "__main__":
    main()
