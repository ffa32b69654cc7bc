"""Surfaces of the built-in lobby: planes, segments and normals found in Gaussians against the meshes they show.

    python -m benchmarks.quality.surfaces geometry.ply [mesh:40000 ...] [--planes] [--flatten] [--json FILE]

A source is a .ply or `mesh:COUNT`, Gaussians sampled on the meshes. True planes are coplanar faces (within 3 cm and 1
degree) that are free on their side, with 0.3 m^2 or more, but for round things (columns, pots, plants). A plane is
found where one of the search holds 30 % of it, within 10 cm and 5 degrees. One of the search is false where less than
half of its patch lies within 10 cm and 15 degrees of a surface of the meshes that is not round. Purity is the share of
Gaussians (opacity 0.3 or more) whose object is the commonest of their segment; "spots" counts windows, doors, lights
and the like as part of what they are set in. Normals are judged where the Gaussian is within 10 cm of a surface.
With --flatten each .ply is also measured after `flatten` with the shipped photographs, and PSNR [dB] of the held-out
photographs is printed before and after.
"""

import argparse
import json
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Tensor

from rf3dgs.cli.chain import geometry_of_mesh
from rf3dgs.cli.facts import open_dataset
from rf3dgs.core.files import write_whole
from rf3dgs.geometry import Surfaces, find_surfaces
from rf3dgs.geometry.flatten import flatten
from rf3dgs.geometry.patches import CELL
from rf3dgs.propagation.sites.lobby import lobby
from rf3dgs.propagation.sites.scene import Scene
from rf3dgs.splats.gaussians import Gaussians
from rf3dgs.splats.image_loss import psnr
from rf3dgs.splats.ply import read_ply
from rf3dgs.training.photographs import picture_of, render_photo

STEP = 0.03
ROUND = ("column-3", "column-4", "pot-", "plant-", "table-foot")
SET_IN = {
    "window-": "wall-west",
    "entrance": "wall-south",
    "door-": "wall-east",
    "lift-": "wall-north",
    "light-": "ceiling",
}
WALLS = ("floor", "ceiling", "wall-south", "wall-west", "wall-east", "wall-north")
LEAST_AREA = 0.3
OFFSET, TILT_DEG, HELD = 0.10, 5.0, 0.3


@dataclass(frozen=True)
class Truth:
    """Points on the free sides of a scene's faces, with their normals, objects, true planes and roundness."""

    points: np.ndarray
    normals: np.ndarray
    objects: np.ndarray
    planes: np.ndarray
    round: np.ndarray
    names: tuple[str, ...]
    tree: cKDTree

    @classmethod
    def of(cls, scene: Scene) -> "Truth":
        rng = np.random.default_rng(0)
        points, normals, objects = [], [], []
        for number, item in enumerate(scene.objects):
            corners = item.vertices[item.faces].double().numpy()
            cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
            length = np.linalg.norm(cross, axis=1)
            face = np.repeat(np.arange(len(length)), np.ceil(0.5 * length / STEP**2).astype(int))
            share = rng.random((len(face), 2))
            share = np.where(share.sum(1, keepdims=True) > 1, 1 - share, share)
            sides = corners[face, 1:] - corners[face, :1]
            points.append(corners[face, 0] + (share[..., None] * sides).sum(1))
            normals.append(cross[face] / length[face, None])
            objects.append(np.full(len(face), number))
        points, normals, objects = np.concatenate(points), np.concatenate(normals), np.concatenate(objects)
        free = scene.free(torch.from_numpy(points + 0.01 * normals).float()).numpy()
        points, normals, objects = points[free], normals[free], objects[free]
        names = tuple(item.name for item in scene.objects)
        curved = np.array([name.startswith(ROUND) for name in names])[objects]
        return cls(points, normals, objects, _coplanar(points, normals, curved), curved, names, cKDTree(points))

    def nearest(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Distance [m] and row of the nearest true point."""
        return self.tree.query(points, workers=2)


def _coplanar(points: np.ndarray, normals: np.ndarray, curved: np.ndarray) -> np.ndarray:
    """The true plane of each point, the largest first; -1 on round things and on planes that are too small."""
    plane = np.full(len(points), -1)
    rest, number = ~curved, 0
    while rest.any():
        keys = np.round(np.c_[normals, (points * normals).sum(1)][rest], 2)
        rows, count = np.unique(keys, axis=0, return_counts=True)
        best = rows[count.argmax()]
        lies = rest & (normals @ best[:3] > np.cos(np.radians(1))) & (np.abs(points @ best[:3] - best[3]) < 0.03)
        if lies.sum() * STEP**2 < LEAST_AREA:
            break
        plane[lies], number = number, number + 1
        rest &= ~lies
    return plane


def measure(gaussians: Gaussians, surfaces: Surfaces, truth: Truth) -> tuple[dict[str, float], list[str]]:
    """The figures of the table, and a line for each true and each false plane."""
    figures, lines = _planes(surfaces, truth)
    opaque = gaussians.opacities.numpy() >= 0.3
    away, row = truth.nearest(gaussians.means.numpy())
    cosine = (surfaces.normals.numpy() * truth.normals[row]).sum(1)
    judged = opaque & (away < 0.10)
    angle = np.degrees(np.arccos(np.clip(np.abs(cosine[judged]), 0, 1)))
    figures |= {"normal_median_deg": float(np.median(angle)), "normal_p90_deg": float(np.quantile(angle, 0.9))}
    figures |= {
        "turned_wrong": float((cosine[judged] < -0.5).mean()),
        "within_10cm": float((away < 0.10)[opaque].mean()),
    }
    objects = truth.objects[row]
    places = np.arange(len(truth.names))
    for number, name in enumerate(truth.names):
        places[number] = next((truth.names.index(wall) for key, wall in SET_IN.items() if name.startswith(key)), number)
    segment = surfaces.segment_of.numpy()
    figures["purity"] = _purity(segment[judged], objects[judged])
    figures["purity_spots"] = _purity(segment[judged], places[objects][judged])
    figures["segments"] = surfaces.segments
    figures["segments_of_50"] = int((np.bincount(segment) >= 50).sum())
    figures["on_planes"] = float((surfaces.plane_of.numpy() >= 0)[opaque].mean())
    return figures, lines


def _planes(surfaces: Surfaces, truth: Truth) -> tuple[dict[str, float], list[str]]:
    normals = surfaces.planes.normals.double().numpy()
    offsets = surfaces.planes.offsets.double().numpy()
    matched: set[int] = set()
    lines, errors = [], {}
    for number in range(int(truth.planes.max()) + 1):
        mine = np.flatnonzero(truth.planes == number)
        own = truth.normals[mine[0]]
        points = truth.points[mine[:: max(1, len(mine) // 2000)]]
        names = [truth.names[index] for index in np.bincount(truth.objects[mine]).argsort()[::-1][:1]]
        best = (0.0, -1, np.inf, np.inf, -np.inf)
        for plane in range(len(normals)):
            tilt = float(np.degrees(np.arccos(min(1.0, abs(normals[plane] @ own)))))
            if tilt > 15 or not len(points):
                continue
            away = points @ normals[plane] - offsets[plane]
            held = surfaces.patches.holds(torch.from_numpy(points).float(), torch.full((len(points),), plane)).numpy()
            held &= np.abs(away) < 0.5
            if not held.any():
                continue
            off = float(np.abs(away[held]).mean())
            score = min(float(held.mean()), HELD) - off
            if score > best[4]:
                best = (float(held.mean()), plane, off, tilt, score)
        held, plane, away, tilt, _ = best
        good = held >= HELD and away < OFFSET and tilt < TILT_DEG
        if good:
            matched.add(plane)
        errors[number] = (good, away, tilt)
        what = f"held {held:4.0%} offset {100 * away:5.1f} cm tilt {tilt:4.1f} deg by {plane}" if plane >= 0 else "none"
        lines.append(f"{'found ' if good else 'MISSED'} {names[0]:12s} {len(mine) * STEP**2:6.1f} m^2 {what}")
    false_area, false = 0.0, 0
    for plane in range(len(normals)):
        centres = _centres(surfaces, plane)
        away, row = truth.nearest(centres)
        alike = np.abs(truth.normals[row] @ normals[plane]) > np.cos(np.radians(15))
        true = (away < 0.10) & alike & ~truth.round[row]
        if true.mean() < 0.5:
            false, false_area = false + 1, false_area + len(centres) * CELL**2
            what = truth.names[np.bincount(truth.objects[row]).argmax()]
            lines.append(f"FALSE  {plane:3d} {len(centres) * CELL**2:6.1f} m^2 true {true.mean():4.0%} near {what}")
    wall_numbers = {truth.planes[np.flatnonzero(truth.objects == truth.names.index(name))[0]] for name in WALLS}
    walls = [errors[number] for number in sorted(wall_numbers)]
    others = [value for number, value in errors.items() if number not in wall_numbers]
    good = [value for value in errors.values() if value[0]]
    figures = {
        "planes": len(normals),
        "walls_found": sum(value[0] for value in walls),
        "wall_offset_cm": 100 * max(value[1] for value in walls),
        "wall_tilt_deg": max(value[2] for value in walls),
        "others_found": sum(value[0] for value in others),
        "others": len(others),
        "offset_cm": 100 * float(np.median([value[1] for value in good])) if good else float("nan"),
        "tilt_deg": float(np.median([value[2] for value in good])) if good else float("nan"),
        "false": false,
        "false_area_m2": false_area,
        "twice": len(normals) - false - len(matched),
    }
    return figures, lines


def _centres(surfaces: Surfaces, plane: int) -> np.ndarray:
    """World points [cell, 3] of a plane's occupied cells."""
    cell = surfaces.patches.grid(plane).nonzero()
    local = surfaces.patches.low[plane] + (cell + 0.5) * CELL
    normal = surfaces.planes.normals[plane]
    return (local @ surfaces.patches.axes[plane] + surfaces.planes.offsets[plane] * normal).numpy()


def _purity(segment: np.ndarray, label: np.ndarray) -> float:
    pairs, count = np.unique(np.c_[segment, label], axis=0, return_counts=True)
    best = np.zeros(segment.max() + 1)
    np.maximum.at(best, pairs[:, 0], count)
    return float(best.sum() / len(segment))


def eyes() -> Tensor:
    """Where the shipped lobby's training photographs were taken."""
    return torch.stack([photo.camera.position for photo in open_dataset("lobby").train.photos])


def held_out(gaussians: Gaussians) -> float:
    """Mean PSNR [dB] of the shipped lobby's held-out photographs."""
    dataset = open_dataset("lobby")
    photos = [photo for photo, role in zip(dataset.photos, dataset.photo_roles, strict=True) if role == "test"]
    return sum(float(psnr(render_photo(gaussians, photo.camera), photo.load())) for photo in photos) / len(photos)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("sources", nargs="+", help="a .ply, or mesh:COUNT")
    parser.add_argument("--planes", action="store_true", help="a line for each plane")
    parser.add_argument("--flatten", action="store_true", help="also measure each .ply flattened")
    parser.add_argument("--json", type=Path, help="write the figures to this file")
    options = parser.parse_args()
    scene, viewpoints = lobby(), eyes()
    truth, table = Truth.of(scene), {}
    sources: list[tuple[str, Gaussians]] = []
    for source in options.sources:
        kind, _, count = source.partition(":")
        sources.append((source, geometry_of_mesh(scene, int(count), 0) if kind == "mesh" else read_ply(Path(source))))
        if options.flatten and kind != "mesh":
            photos = list(open_dataset("lobby").train.photos)
            cameras, pictures = [photo.camera for photo in photos], [picture_of(photo) for photo in photos]
            flat = flatten(sources[-1][1], viewpoints, cameras, pictures)
            print(f"PSNR {held_out(sources[-1][1]):.2f} dB, flat {held_out(flat):.2f} dB")
            sources.append((f"{source}, flat", flat))
    for source, geometry in sources:
        wall, cpu = time.perf_counter(), time.process_time()
        surfaces = find_surfaces(geometry, viewpoints)
        wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
        figures, lines = measure(geometry, surfaces, truth)
        table[source] = figures | {"gaussians": len(geometry), "cpu_s": cpu, "wall_s": wall}
        print("\n".join([source, *(lines if options.planes else ())]))
        print("  ".join(f"{name} {value:.3g}" for name, value in table[source].items()), flush=True)
    if options.json is not None:
        write_whole(options.json, (json.dumps(table, indent=2) + "\n").encode())


if __name__ == "__main__":
    main()
