"""Triangles: distances to them, what they enclose, their colours, and the files they are kept in."""

import math
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

if TYPE_CHECKING:
    from rf3dgs.propagation.sites.scene import SceneObject

_CHUNK = 2_000_000  # point-triangle pairs worked on at once


def near_box(points: Tensor, corners: Tensor, margin: float) -> Tensor:
    """True where points `[n, 3]` lie in the box around triangles `[F, 3, 3]`, widened by `margin` [m]."""
    low, high = corners.amin((0, 1)) - margin, corners.amax((0, 1)) + margin
    return ((points >= low) & (points <= high)).all(-1)


def distance(points: Tensor, corners: Tensor) -> Tensor:
    """Distance [m] `[n]` from points `[n, 3]` to the nearest of triangles `[F, 3, 3]`."""
    step = max(_CHUNK // max(len(corners), 1), 1)
    return torch.cat([_distance(part, corners) for part in points.split(step)])


def _distance(points: Tensor, corners: Tensor) -> Tensor:
    a, b, c = corners.unbind(1)
    normal = torch.linalg.cross(b - a, c - a)
    length = normal.norm(dim=-1).clamp_min(1e-20)
    height = ((points[:, None] - a) * (normal / length[:, None])).sum(-1)
    foot = points[:, None] - height[..., None] * (normal / length[:, None])
    above = torch.ones_like(height, dtype=torch.bool)
    nearest = torch.full_like(height, math.inf)
    for start, end in ((a, b), (b, c), (c, a)):
        edge = end - start
        above &= (torch.linalg.cross(edge.expand_as(foot), foot - start) * normal).sum(-1) >= 0
        share = ((points[:, None] - start) * edge).sum(-1) / (edge * edge).sum(-1).clamp_min(1e-20)
        on_edge = start + share.clamp(0, 1)[..., None] * edge
        nearest = torch.minimum(nearest, (points[:, None] - on_edge).norm(dim=-1))
    return torch.where(above, height.abs(), nearest).amin(-1)


def inside(points: Tensor, corners: Tensor) -> Tensor:
    """True `[n]` where points `[n, 3]` are enclosed by closed triangles `[F, 3, 3]`: winding number above one half.

    The solid angle of a triangle is that of van Oosterom and Strackee (1983), eq. 8.
    """
    step = max(_CHUNK // max(len(corners), 1), 1)
    return torch.cat([_winding(part, corners).abs() > 0.5 for part in points.split(step)])


def _winding(points: Tensor, corners: Tensor) -> Tensor:
    a, b, c = ((corner - points[:, None]).double() for corner in corners.unbind(1))
    la, lb, lc = a.norm(dim=-1), b.norm(dim=-1), c.norm(dim=-1)
    triple = (a * torch.linalg.cross(b, c)).sum(-1)
    below = la * lb * lc + (a * b).sum(-1) * lc + (b * c).sum(-1) * la + (c * a).sum(-1) * lb
    return torch.atan2(triple, below).sum(-1) / (2 * math.pi)


def is_shell(item: "SceneObject", low: Tensor, high: Tensor) -> bool:
    """True for the object that reaches over the whole site: a room's walls or the ground."""
    size = (high - low)[:2]
    return bool((item.vertices.amax(0) - item.vertices.amin(0))[:2].ge(0.98 * size).all())


def is_closed(item: "SceneObject") -> bool:
    """True when every edge belongs to two triangles, corners at the same place counting as one."""
    _, corner = torch.unique((item.vertices * 1e4).round(), dim=0, return_inverse=True)
    faces = corner[item.faces]
    edges = torch.cat((faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]])).sort(-1).values
    _, count = torch.unique(edges, dim=0, return_counts=True)
    return bool((count == 2).all())


def facing_outwards(item: "SceneObject") -> "SceneObject":
    """A closed object with its faces turned round when they enclose a negative volume."""
    a, b, c = item.vertices[item.faces].double().unbind(1)
    inside_out = float((a * torch.linalg.cross(b, c)).sum()) < 0
    return replace(item, faces=item.faces.flip(1)) if inside_out else item


def coloured(item: "SceneObject", longest_edge: float | None) -> tuple[Tensor, Tensor, Tensor]:
    """Vertices `[V, 3]`, faces `[F, 3]` and their sRGB colours `[F, 3]`, cut until no edge exceeds `longest_edge`."""
    uv = torch.zeros(len(item.vertices), 2) if item.uv is None else item.uv
    points = torch.cat((item.vertices, uv), -1)
    triangles = points[item.faces]
    finished = []
    while longest_edge is not None and len(triangles):
        sides = (triangles - triangles.roll(-1, 1))[..., :3].norm(dim=-1)
        long = sides.amax(1) > longest_edge
        finished.append(triangles[~long])
        triangles, first = triangles[long], sides[long].argmax(1)
        corner = torch.arange(3)[None] + first[:, None]
        a, b, c = triangles.gather(1, (corner % 3)[..., None].expand(-1, -1, 5)).unbind(1)
        middle = (a + b) / 2
        triangles = torch.cat((torch.stack((a, middle, c), 1), torch.stack((middle, b, c), 1)))
    if longest_edge is None:
        vertices, faces = item.vertices, item.faces
    else:
        triangles = torch.cat(finished)
        vertices, faces = triangles.reshape(-1, 5)[:, :3], torch.arange(3 * len(triangles)).reshape(-1, 3)
    if item.texture is None:
        return vertices, faces, torch.tensor(item.colour).expand(len(faces), 3)
    centre = triangles[..., 3:].mean(1) % 1.0
    height, width = item.texture.shape[:2]
    row = (centre[:, 1] * height).long().clamp(0, height - 1)
    col = (centre[:, 0] * width).long().clamp(0, width - 1)
    return vertices, faces, torch.from_numpy(item.texture.copy())[row, col].float() / 255.0


def welded(item: "SceneObject") -> "SceneObject":
    """The object with one vertex for all corners within 0.1 mm, without its texture and triangles that vanish."""
    _, corner, count = torch.unique((item.vertices * 1e4).round(), dim=0, return_inverse=True, return_counts=True)
    first = corner.argsort(stable=True)[count.cumsum(0) - count]
    faces = corner[item.faces]
    distinct = (faces != faces.roll(1, 1)).all(1)
    return replace(item, vertices=item.vertices[first], faces=faces[distinct], texture=None, uv=None)


def write_mesh(path: Path, vertices: Tensor, faces: Tensor, uv: Tensor | None) -> None:
    """Write a binary little-endian PLY: vertices `[V, 3]` [m], faces `[F, 3]`, and `uv` `[V, 2]` when given."""
    columns = vertices if uv is None else torch.cat((vertices, uv), -1)
    names = ("x", "y", "z", "u", "v")[: columns.shape[-1]]
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(vertices)}"]
    header += [f"property float {name}" for name in names]
    header += [f"element face {len(faces)}", "property list uchar int vertex_indices", "end_header\n"]
    table = np.empty(len(faces), dtype=[("count", "u1"), ("index", "<i4", 3)])
    table["count"] = 3
    table["index"] = faces.numpy()
    body = columns.contiguous().numpy().astype("<f4").tobytes() + table.tobytes()
    path.write_bytes("\n".join(header).encode() + body)
