"""Photographing a scene as a job in shards: JPEG files by number, which a killed run leaves sound."""

import secrets
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property
from io import BytesIO

from rf3dgs.core.grids import Camera
from rf3dgs.core.manifest import Manifest
from rf3dgs.propagation.config import PhotoConfig
from rf3dgs.propagation.jobs import Each
from rf3dgs.propagation.scene import Scene
from rf3dgs.propagation.toolchain import fingerprint, made_by, scene_of_run

SCHEMA = "rf3dgs.photos"
SHARD_SIZE = 10
"""Photographs in a shard unless said otherwise: some twenty seconds of work."""


@dataclass(frozen=True, eq=False)
class Shot:
    """One photograph to take: by which camera, and how; `config.seed` is its own."""

    camera: Camera
    config: PhotoConfig


def photo_name(number: int) -> str:
    """The file of photograph `number`."""
    return f"{number:05d}.jpg"


def take(scene: Scene, shots: Sequence[Shot], each: Each) -> Iterator[tuple[int, bytes]]:
    """Yield (place in `shots`, JPEG bytes); shots of one configuration and successive seeds share a loaded scene."""
    from PIL import Image

    from rf3dgs.propagation.photographer import render_photos

    for places in _runs(shots):
        first = shots[places[0]].config
        pictures = render_photos(scene, [shots[place].camera for place in places], first)
        for place, picture in zip(places, pictures, strict=True):
            content = BytesIO()
            Image.fromarray(picture).save(content, "JPEG", quality=95, subsampling=0)
            yield place, content.getvalue()
            each()


def _runs(shots: Sequence[Shot]) -> list[list[int]]:
    """The places of shots in groups that differ in nothing but seeds, which rise by one."""
    runs: dict[PhotoConfig, list[list[int]]] = {}
    for place, shot in enumerate(shots):
        known = runs.setdefault(replace(shot.config, seed=0), [])
        if known and shots[known[-1][-1]].config.seed + 1 == shot.config.seed:
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
