"""`trace` and `photos`: from a scene to its paths and its photographs."""

from contextlib import AbstractContextManager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import tyro

from rf3dgs.cli.show import console, out
from rf3dgs.core.errors import InputError
from rf3dgs.propagation.config import PhotoConfig, TraceConfig

if TYPE_CHECKING:
    from rf3dgs.propagation.jobs import Crew

RX_COUNT = 72
"""Receivers that `trace` places unless a number or a preset is given."""


@dataclass(frozen=True)
class Trace:
    """Trace the paths from the transmitter to many receivers with Sionna RT; a killed run goes on where it stopped."""

    scene: tyro.conf.Positional[str]
    """"lobby", a scene that ships with Sionna RT ("box", "simple_street_canyon"), or a Sionna/Mitsuba XML file."""
    rx_count: int | None = None
    """Receivers, drawn in the free space of the scene; the preset's number, or 72."""
    rx_seed: int = 0
    """Decides where the receivers stand."""
    out: Path = Path("lobby.paths")
    """The folder to write: a manifest and shards in HDF5; the same command again makes what is missing."""
    preset: Literal["paper"] | None = None
    """"paper": 800 receivers, depth 3, at least 300,000 paths each; instead of --trace.*"""
    trace: TraceConfig = field(default_factory=TraceConfig)
    """How paths are traced."""
    shard_size: int = 25
    """Receivers in one shard, which is what a killed run may have to do again."""
    workers: int = 1
    """Processes on this machine; more than one needs the extra "cluster"."""
    cluster: str | None = None
    """The address of a dask scheduler, such as tcp://10.0.0.5:8786, whose workers do the tracing."""

    def run(self) -> int:
        """Trace what the folder lacks, and say how large it is."""
        from rf3dgs.channel.io import PathsReader
        from rf3dgs.cli.facts import open_scene
        from rf3dgs.propagation.jobs import run_job
        from rf3dgs.propagation.trace_job import TraceJob
        from rf3dgs.propagation.trace_presets import TRACE_PRESETS

        preset = TRACE_PRESETS[self.preset] if self.preset else None
        config = _chosen_trace(self.preset, preset.trace, self.trace) if preset else self.trace
        count = self.rx_count if self.rx_count is not None else preset.rx_count if preset else RX_COUNT
        _at_least_one(("--rx-count", count), ("--shard-size", self.shard_size), ("--workers", self.workers))
        crew = _crew(self.workers, self.cluster)
        scene = open_scene(self.scene)
        job = TraceJob(
            scene=self.scene,
            tx=scene.tx,
            rx=scene.receivers(count, self.rx_seed),
            frequency=config.frequency or scene.frequency,
            config=config,
            rule={"how": "drawn in free space", "seed": self.rx_seed},
            min_paths=preset.min_paths if preset else 0,
            shard_size=self.shard_size,
        )
        run_job(job, self.out, crew=crew, progress=console())
        with PathsReader(self.out) as reader:
            traced = reader.traced
        size = sum(item.stat().st_size for item in self.out.iterdir())
        least = "" if traced is None else f", at least {int(traced.min()):,} paths each before diffuse ones are merged"
        out(f"{self.out}: {count} receivers{least}, {size / 1e6:.1f} MB")
        return 0


@dataclass(frozen=True)
class MakePhotos:
    """Render posed photographs of a scene with Mitsuba, in nerfstudio's layout; a killed run goes on."""

    scene: tyro.conf.Positional[str]
    """"lobby", a scene that ships with Sionna RT, or a Sionna/Mitsuba XML file."""
    count: int = 60
    """Photographs."""
    tour_seed: int = 0
    """Decides where the cameras stand."""
    out: Path = Path("lobby/photos")
    """The folder to write: pictures, a manifest, and transforms.json at the end."""
    photo: PhotoConfig = field(default_factory=PhotoConfig)
    """How photographs are rendered."""
    shard_size: int = 10
    """Photographs in one shard, which is what a killed run may have to do again."""
    workers: int = 1
    """Processes on this machine; more than one needs the extra "cluster"."""
    cluster: str | None = None
    """The address of a dask scheduler, such as tcp://10.0.0.5:8786, whose workers do the rendering."""

    def run(self) -> int:
        """Render what the folder lacks, then write the cameras."""
        from rf3dgs.cli.chain import photos_of, shots_of_tour
        from rf3dgs.cli.facts import open_scene
        from rf3dgs.data.formats.nerfstudio import write_nerfstudio
        from rf3dgs.propagation.jobs import run_job
        from rf3dgs.propagation.photo_job import PhotoJob

        _at_least_one(("--count", self.count), ("--shard-size", self.shard_size), ("--workers", self.workers))
        crew = _crew(self.workers, self.cluster)
        shots = shots_of_tour(open_scene(self.scene), self.count, self.tour_seed, self.photo)
        rule = {"how": "a walk", "seed": self.tour_seed}
        job = PhotoJob(self.scene, shots, rule, self.shard_size)
        run_job(job, self.out, crew=crew, progress=console())
        write_nerfstudio(self.out, photos_of(shots, self.out))
        out(f"{self.out}: {self.count} photographs of {self.photo.width}x{self.photo.height}")
        return 0


def _at_least_one(*options: tuple[str, int]) -> None:
    for name, value in options:
        if value < 1:
            raise InputError(f"{name} must be at least 1; got {value}")


def _chosen_trace(name: str | None, preset: TraceConfig, given: TraceConfig) -> TraceConfig:
    """The preset with the seed and the frequency given; InputError where both say something else."""
    chosen = {"seed": given.seed, "frequency": given.frequency}
    if given != TraceConfig(**chosen):
        raise InputError(f"--preset {name} sets how paths are traced; give it or --trace.*, not both")
    return replace(preset, **chosen)


def _crew(workers: int, cluster: str | None) -> "AbstractContextManager[Crew] | None":
    """Who does the work: this process (None), processes on this machine, or a dask cluster."""
    if cluster is None and workers == 1:
        return None
    from rf3dgs.propagation.cluster import existing_cluster, local_processes

    if cluster is None:
        return local_processes(workers)
    if workers != 1:
        raise InputError("--workers starts processes here, --cluster uses those of a scheduler; give one of them")
    return existing_cluster(cluster)
