"""`Scene`: one list of objects that is both the radio scene and the visual scene."""

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from numpy.typing import NDArray
from torch import Tensor

from rf3dgs.core.errors import InputError
from rf3dgs.core.frames import Pose
from rf3dgs.propagation.sites import meshes
from rf3dgs.propagation.sites.materials import permittivity

Bounds = tuple[Sequence[float], Sequence[float]]
MAX_ALPHA_R = 100


@dataclass(frozen=True, eq=False)
class SceneObject:
    """One object: a triangle mesh with a radio material and a look.

    vertices `[V, 3]` [m], faces `[F, 3]` with normals towards free space; uv `[V, 2]` texture coordinates, v downwards
        from the picture's top row, repeated outside [0, 1].
    material: a name of `materials.ITU`; scattering: amplitude S in [0, 1], so that S^2 of the reflected power is
        diffuse; thickness [m]. alpha_r: the diffuse power leaves in a lobe round the mirror direction, the narrower the
        larger this whole number (directive model of Degli-Esposti et al., 2007); None scatters by Lambert's law.
    electric: (relative permittivity, conductivity [S/m]) at every frequency in place of the material's.
    transparency: share of the light that passes straight through; photographs only.
    texture `[row, col, 3]` sRGB bytes, or None for the plain sRGB `colour`. glow: emitted light relative to white.
    solid: closed, and nobody can stand inside.
    """

    name: str
    vertices: Tensor
    faces: Tensor
    material: str
    scattering: float
    thickness: float = 0.1
    colour: tuple[float, float, float] = (0.6, 0.6, 0.6)
    texture: NDArray | None = None
    uv: Tensor | None = None
    glow: float = 0.0
    solid: bool = False
    alpha_r: int | None = None
    electric: tuple[float, float] | None = None
    transparency: float = 0.0

    def __post_init__(self) -> None:
        if not re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9_.-]{0,99}", self.name):
            raise InputError(f"an object's name must be letters, digits, '-', '_' and '.'; got {self.name!r}")
        if self.vertices.dim() != 2 or self.vertices.shape[-1] != 3 or self.faces.shape[-1:] != (3,):
            raise InputError(
                f"{self.name}: vertices must be [V, 3] and faces [F, 3]; "
                f"got {list(self.vertices.shape)} and {list(self.faces.shape)}"
            )
        if not bool(torch.isfinite(self.vertices).all()):
            raise InputError(f"{self.name}: vertices have NaN or infinite values; mend the mesh")
        if self.faces.numel() and not 0 <= int(self.faces.min()) <= int(self.faces.max()) < len(self.vertices):
            raise InputError(f"{self.name}: faces name vertices that do not exist ({len(self.vertices)} vertices)")
        if not 0.0 <= self.scattering <= 1.0:
            raise InputError(f"{self.name}: scattering is an amplitude S between 0 and 1; got {self.scattering}")
        if self.alpha_r is not None and not (isinstance(self.alpha_r, int) and 1 <= self.alpha_r <= MAX_ALPHA_R):
            raise InputError(f"{self.name}: alpha_r must be a whole number from 1 to {MAX_ALPHA_R}; got {self.alpha_r}")
        if self.electric is not None and not (self.electric[0] >= 1.0 and 0.0 <= self.electric[1] < math.inf):
            raise InputError(
                f"{self.name}: electric must be a relative permittivity of at least 1 and a conductivity [S/m] of at "
                f"least 0; got {self.electric}"
            )
        if not (0.0 <= self.transparency < 1.0 and 0.0 < self.thickness < math.inf):
            raise InputError(
                f"{self.name}: transparency must be from 0 to below 1 and thickness [m] positive; "
                f"got {self.transparency} and {self.thickness}"
            )
        if self.texture is not None and (self.uv is None or self.uv.shape != (len(self.vertices), 2)):
            raise InputError(f"{self.name}: a texture needs uv coordinates [V, 2], one per vertex")

    def permittivity(self, frequency: float) -> tuple[float, float]:
        """Relative permittivity and conductivity [S/m] at `frequency` [Hz]; InputError when they are not defined."""
        if self.electric is not None:
            return self.electric
        return permittivity(self.material, frequency, owner=f"object {self.name!r}")


@dataclass(frozen=True, eq=False)
class Scene:
    """A site: objects, the transmitter's pose, and where receivers and cameras may stand ((low), (high) corners) [m].

    frequency [Hz]; exposure scales photographs; sky is the light of the open sky relative to white (0 indoors).
    source: the Sionna XML file this scene was read from, which is traced instead of the meshes, or None.
    """

    name: str
    objects: tuple[SceneObject, ...]
    tx: Pose
    bounds: Bounds
    rx_bounds: Bounds
    camera_bounds: Bounds
    frequency: float
    exposure: float = 1.0
    sky: float = 0.0
    source: Path | None = None

    def __post_init__(self) -> None:
        names = [item.name for item in self.objects]
        twice = sorted({name for name in names if names.count(name) > 1})
        if twice:
            raise InputError(f"every object of a scene needs a name of its own; used twice: {', '.join(twice)}")

    def __getitem__(self, name: str) -> SceneObject:
        """The object of that name."""
        for item in self.objects:
            if item.name == name:
                return item
        raise InputError(f"scene {self.name!r} has no object {name!r}; it has {[item.name for item in self.objects]}")

    def mesh(self, longest_edge: float | None = None) -> tuple[Tensor, Tensor, Tensor]:
        """All objects as one mesh: vertices `[V, 3]` [m], faces `[F, 3]`, sRGB colour `[F, 3]` in [0, 1].

        With `longest_edge` [m] triangles are halved until no edge is longer, so that colours follow the textures.
        """
        parts = [meshes.coloured(item, longest_edge) for item in self.objects]
        start, faces = 0, []
        for vertices, triangles, _ in parts:
            faces.append(triangles + start)
            start += len(vertices)
        return torch.cat([part[0] for part in parts]), torch.cat(faces), torch.cat([part[2] for part in parts])

    def free(self, points: Tensor, clearance: float = 0.0) -> Tensor:
        """True where points `[*batch, 3]` lie inside the bounds, outside solids, `clearance` [m] from every surface."""
        flat = torch.as_tensor(points, dtype=torch.float32).reshape(-1, 3)
        low, high = (torch.tensor(corner, dtype=torch.float32) for corner in self.bounds)
        good = ((flat > low) & (flat < high)).all(-1)
        for item in self.objects:
            if bool(good.any()):
                corners = item.vertices[item.faces]
                near = meshes.near_box(flat, corners, clearance) & good
                if bool(near.any()):
                    good[near] &= meshes.distance(flat[near], corners) >= clearance
                    if item.solid:
                        good[near] &= ~meshes.inside(flat[near], corners)
        return good.reshape(points.shape[:-1])

    def occupant(self, point: Tensor) -> str | None:
        """What keeps a receiver from standing at `point` `[3]`: a solid object's name, "outside", or None when free."""
        low, high = (torch.tensor(corner, dtype=torch.float32) for corner in self.bounds)
        if not bool(((point > low) & (point < high)).all()):
            return "outside"
        for item in self.objects:
            if not item.solid:
                continue
            corners = item.vertices[item.faces]
            if bool(meshes.near_box(point[None], corners, 0.0)) and bool(meshes.inside(point[None], corners)):
                return item.name
        return None

    def nearest(self, point: Tensor) -> tuple[str, float]:
        """The object whose surface is nearest to `point` `[3]`, and its distance [m]."""
        found = {item.name: float(meshes.distance(point[None], item.vertices[item.faces])) for item in self.objects}
        name = min(found, key=lambda name: found[name])
        return name, found[name]

    def receivers(self, count: int, seed: int, *, clearance: float = 0.35) -> Pose:
        """`count` level poses drawn uniformly in the free part of `rx_bounds`, `clearance` [m] from every surface."""
        return Pose(self.free_points(self.rx_bounds, count, seed, clearance=clearance))

    def free_points(self, bounds: Bounds, count: int, seed: int, *, clearance: float) -> Tensor:
        """`count` points `[count, 3]` drawn uniformly in the free part of a box, also 1 m from the transmitter."""
        low, high = (torch.tensor(corner, dtype=torch.float32) for corner in bounds)
        generator = torch.Generator().manual_seed(seed)
        found = torch.empty(0, 3)
        for _ in range(200):
            points = low + (high - low) * torch.rand(max(2 * count, 32), 3, generator=generator)
            points = points[(points - self.tx.position).norm(dim=-1) > 1.0]
            found = torch.cat((found, points[self.free(points, clearance)]))
            if len(found) >= count:
                return found[:count]
        raise InputError(
            f"scene {self.name!r} has no room for {count} positions with {clearance} m clearance; ask for less"
        )

    def check_radio(self, frequency: float) -> None:
        """Raise InputError when an object's material is unknown or not defined at `frequency` [Hz]."""
        for item in self.objects:
            item.permittivity(frequency)

    @property
    def size(self) -> float:
        """The diagonal of the bounds [m]."""
        return math.dist(*self.bounds)


def without_looks(scene: Scene) -> Scene:
    """The scene as radio sees it: objects without textures, which are most of its bytes."""
    return replace(scene, objects=tuple(replace(item, texture=None, uv=None) for item in scene.objects))
