"""Photographing a scene as a job in shards: JPEG files by number, which a killed run leaves sound."""

import secrets
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property
from io import BytesIO

import numpy as np
import torch
from numpy.typing import NDArray

from rf3dgs.core.frames import Pose
from rf3dgs.core.grids import Camera, Panorama, equirect_grid
from rf3dgs.core.manifest import Manifest
from rf3dgs.propagation.config import PhotoConfig
from rf3dgs.propagation.jobs.job import Each
from rf3dgs.propagation.jobs.toolchain import fingerprint, made_by, scene_of_run
from rf3dgs.propagation.sites.scene import Scene

SCHEMA = "rf3dgs.photos"
SHARD_SIZE = 10
"""Photographs in a shard unless said otherwise: some twenty seconds of work."""
FACES = 6
"""Seeds that an equirectangular photograph uses: one for each face of a cube."""


@dataclass(frozen=True, eq=False)
class Shot:
    """One photograph to take: by which camera, or all round, and how; `config.seed` is its own."""

    camera: Camera | Panorama
    config: PhotoConfig


def photo_name(number: int) -> str:
    """The file of photograph `number`."""
    return f"{number:05d}.jpg"


def shots_all_round(poses: Pose, width: int, config: PhotoConfig) -> list[Shot]:
    """One equirectangular photograph of `width` x `width / 2` at each pose `[n]`, as `render_panoramas` takes them."""
    grid = equirect_grid(width, width // 2)
    return [
        Shot(Panorama.of(poses[place], grid), replace(config, seed=config.seed + FACES * place))
        for place in range(len(poses))
    ]


def take(scene: Scene, shots: Sequence[Shot], each: Each) -> Iterator[tuple[int, bytes]]:
    """Yield (place in `shots`, JPEG bytes); shots of one configuration and successive seeds share a loaded scene."""
    from PIL import Image

    for places in _runs(shots):
        pictures = _pictures(scene, [shots[place] for place in places])
        for place, picture in zip(places, pictures, strict=True):
            content = BytesIO()
            Image.fromarray(picture).save(content, "JPEG", quality=95, subsampling=0)
            yield place, content.getvalue()
            each()


def _pictures(scene: Scene, shots: Sequence[Shot]) -> Iterator[NDArray[np.uint8]]:
    """The photographs of one run of `_runs`."""
    from rf3dgs.propagation.photographer import render_panoramas, render_photos

    first = shots[0]
    if isinstance(first.camera, Panorama):
        poses = [shot.camera.pose for shot in shots]
        stacked = Pose(*(torch.stack([getattr(p, part) for p in poses]) for part in ("position", "orientation")))
        return render_panoramas(scene, stacked, first.camera.width, first.config)
    return render_photos(scene, [shot.camera for shot in shots if isinstance(shot.camera, Camera)], first.config)


def _runs(shots: Sequence[Shot]) -> list[list[int]]:
    """The places of shots in groups that differ in nothing but seeds, which rise by as many as a photograph uses."""
    runs: dict[tuple[PhotoConfig, int], list[list[int]]] = {}
    for place, shot in enumerate(shots):
        width = shot.camera.width if isinstance(shot.camera, Panorama) else 0
        known = runs.setdefault((replace(shot.config, seed=0), width), [])
        if known and shots[known[-1][-1]].config.seed + (FACES if width else 1) == shot.config.seed:
            known[-1].append(place)
        else:
            known.append([place])
    return [run for known in runs.values() for run in known]


@dataclass(frozen=True, eq=False)
class PhotoTask:
    """The photographs `numbers` of a scene."""

    scene: str | Scene
    shots: Sequence[Shot]
    numbers: range
    run: str

    def made_by(self) -> Mapping[str, object]:
        """The versions, the processor, and the scene as this process builds it."""
        return made_by(self.scene, self.run)

    def make(self, each: Each) -> Mapping[str, bytes]:
        """JPEG files by name."""
        taken = take(scene_of_run(self.scene, self.run), self.shots, each)
        return {photo_name(self.numbers[place]): content for place, content in taken}


@dataclass(frozen=True, eq=False)
class PhotoJob:
    """Photographs of a scene, numbered in the order of `shots`.

    scene: a name or XML file that every worker can open, or a `Scene`, which is sent to them. rule: how the cameras
    were chosen, for the manifest.
    """

    scene: str | Scene
    shots: Sequence[Shot]
    rule: Mapping[str, object] = field(default_factory=dict)
    shard_size: int = SHARD_SIZE
    label: str = "photographs"
    run: str = field(default_factory=lambda: secrets.token_hex(8))

    @property
    def plan(self) -> Manifest:
        """The arguments as the manifest holds them; scene and cameras as their sha256."""
        return self._plan

    @cached_property
    def _plan(self) -> Manifest:
        scene = scene_of_run(self.scene, self.run)
        made_from = {
            "scene": {"name": scene.name, "sha256": fingerprint(scene)},
            "cameras": {**self.rule, "sha256": fingerprint([shot.camera for shot in self.shots])},
            "photo": asdict(self.shots[0].config) if self.shots else {},
            "shots": fingerprint([asdict(shot.config) for shot in self.shots]),
        }
        return Manifest(SCHEMA, len(self.shots), self.shard_size, made_from, {})

    def names(self, shard: int) -> tuple[str, ...]:
        """One JPEG file per photograph."""
        return tuple(photo_name(number) for number in self.plan.part(shard))

    def task(self, shard: int) -> PhotoTask:
        """The work of one shard."""
        part = self.plan.part(shard)
        return PhotoTask(self.scene, self.shots[part.start : part.stop], part, self.run)
