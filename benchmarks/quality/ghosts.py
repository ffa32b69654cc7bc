"""What shines through walls: ghosts of a lamp behind a wall with and without depth gate and normalisation.

    python -m benchmarks.quality.ghosts

Lamps are opaque balls 60 dB above the built-in lobby's surfaces, each a metre behind the first surface in a random
direction from a random place: outside behind a wall, or inside behind something. A direction is inner where the mesh
stands before the lamp, there and two pixels around. Printed for Gaussians sampled on the mesh and for those that
photographs trained (the geometry of the shipped field): the share of inner directions that show less than -50 dB of the
lamp, and how often nothing there reaches half of all opacity; what a smooth radiance on the surfaces loses against the
mesh hit exactly, as RMSE in dB; the time of a picture.
"""

import argparse
import time
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from rf3dgs.cli.chain import geometry_of_mesh
from rf3dgs.cli.facts import open_field
from rf3dgs.core.frames import Pose
from rf3dgs.core.grids import DirectionGrid, equirect_grid, view_of
from rf3dgs.propagation.sites.lobby import lobby
from rf3dgs.propagation.sites.scene import Scene
from rf3dgs.splats.compositing import Compositing
from rf3dgs.splats.raster import Raster
from rf3dgs.splats.rasterize import rasterize

LAMP_RADIUS = 0.25  # m
BEHIND = 1.0  # m: how far behind a surface a lamp is
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

    def draw(self, pose: Pose, grid: DirectionGrid, values: Tensor, way: Compositing) -> Raster:
        shape = (self.means, self.quats, self.scales, self.opacities)
        return rasterize(*shape, values, view_of(pose, grid), compositing=way)

    def with_lamps(self, lamps: Tensor) -> "Geometry":
        """The same with a ball at each of `lamps` `[lamp, 3]`, last."""
        count = len(lamps)
        return Geometry(
            torch.cat((self.means, lamps)),
            torch.cat((self.quats, torch.tensor([[1.0, 0.0, 0.0, 0.0]]).expand(count, 4))),
            torch.cat((self.scales, torch.full((count, 3), 0.4 * LAMP_RADIUS))),
            torch.cat((self.opacities, torch.full((count,), 0.99))),
        )


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
    behind = (hit[..., None] < distance - 0.8 * BEHIND).float().movedim(-1, 0)
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


def behind_surfaces(scene: Scene, corners: Tensor, count: int) -> Tensor:
    """Lamps `[lamp, 3]` behind the first surfaces that random rays from random places meet."""
    places = scene.receivers(count, 11).position
    generator = torch.Generator().manual_seed(1)
    directions = torch.nn.functional.normalize(torch.randn(count, 3, generator=generator), dim=-1)
    hits = [first_hit(place, ray[None], corners) for place, ray in zip(places, directions, strict=True)]
    return places + (torch.cat(hits)[:, None] + BEHIND) * directions


def share(condition: Tensor) -> str:
    return f"{100 * float(condition.double().mean()):.2f} %"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--receivers", type=int, default=20)
    parser.add_argument("--lamps", type=int, default=80)
    parser.add_argument("--count", type=int, default=100_000, help="Gaussians on the mesh")
    wish = parser.parse_args()
    scene, grid = lobby(), equirect_grid(240, 120)
    vertices, faces, _ = scene.mesh()
    corners = vertices[faces].float()
    mesh = geometry_of_mesh(scene, wish.count, 0)
    field = open_field("lobby")
    trained = field.surface
    subjects = {
        f"mesh, {len(mesh)}": Geometry(mesh.means, mesh.quats, mesh.scales, mesh.opacities),
        f"photographs, {len(trained)}": Geometry(trained.means, trained.quats, trained.scales, field.solidity),
    }
    lamps, receivers = behind_surfaces(scene, corners, wish.lamps), scene.receivers(wish.receivers, 3)
    outside = ((lamps < corners.amin((0, 1))) | (lamps > corners.amax((0, 1)))).any(-1)
    views = []
    for index in range(len(receivers)):
        pose = receivers[index]
        directions = pose.to_world(grid.directions)
        hit = first_hit(pose.position, directions.reshape(-1, 3), corners).reshape(grid.shape)
        points = pose.position + torch.where(hit.isfinite(), hit, 0.0)[..., None] * directions
        views.append((pose, hit, points, hidden(pose, grid, hit, lamps)))
    counts = [sum(int(inner[..., some].sum()) for *_, inner in views) for some in (outside, ~outside)]
    print(
        f"{len(faces)} triangles, {len(receivers)} receivers, {int(outside.sum())} lamps behind walls with {counts[0]}"
    )
    print(f"{int((~outside).sum())} behind other things with {counts[1]}\n")
    print("| geometry | compositing | walls: below -50 dB | others | of these solid | RMSE, bias [dB] | CPU ms |")
    print("|---|---|---|---|---|---|---|")
    for name, geometry in subjects.items():
        lit, count = geometry.with_lamps(lamps), len(geometry.means)
        values = torch.full((len(lit.means), len(lamps)), DARK)
        values[count:] = torch.eye(len(lamps))
        radiance = smooth(geometry.means)
        for label, way in WAYS.items():
            walls, others, solid, errors = [], [], [], []
            for pose, hit, points, inner in views:
                shown = lit.draw(pose, grid, values, way).values
                weight = geometry.draw(pose, grid, radiance, WAYS["as they are"]).weight[..., None].expand_as(shown)
                walls.append(shown[inner & outside])
                others.append(shown[inner & ~outside])
                solid.append(shown[inner & ~outside & (weight > 0.5)])
                found = geometry.draw(pose, grid, radiance, way).values[..., 0]
                exact = smooth(points.reshape(-1, 3)).reshape(grid.shape)
                usable = hit.isfinite() & (found > 0)
                errors.append(10 * torch.log10(found[usable] / exact[usable]))
            error = torch.cat(errors)
            spent = milliseconds(lambda g=geometry, r=radiance, w=way: g.draw(views[0][0], grid, r, w))
            shares = " | ".join(share(torch.cat(part) < 1e-5) for part in (walls, others, solid))
            rmse = float(error.square().mean().sqrt())
            print(f"| {name} | {label} | {shares} | {rmse:.2f}, {float(error.mean()):.2f} | {spent:.1f} |")


if __name__ == "__main__":
    main()
