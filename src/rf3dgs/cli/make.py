"""`trace`, `photos` and `panoramas`: from a scene to its paths and its photographs."""

import json
from contextlib import AbstractContextManager
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import tyro

from rf3dgs.cli.show import console, out
from rf3dgs.core.errors import InputError
from rf3dgs.propagation.config import PhotoConfig, ReceiverConfig, TraceConfig

if TYPE_CHECKING:
    from rf3dgs.propagation.jobs.job import Crew

Preset = Literal["paper", "diffuse", "realistic", "28ghz", "10ghz", "2.4ghz", "transparent"]


@dataclass(frozen=True)
class Trace:
    """Trace the paths from the transmitter to many receivers with Sionna RT; a killed run goes on where it stopped."""

    scene: tyro.conf.Positional[str]
    """"lobby", "lobby-full" (more furniture), a scene that ships with Sionna RT ("box", "simple_street_canyon"), a
    Sionna/Mitsuba XML file, or a folder of meshes."""
    people: int = 0
    """How many persons stand and walk in lobby or lobby-full, up to eight."""
    out: Path = Path("lobby.paths")
    """The folder to write: a manifest and shards in HDF5; the same command again makes what is missing."""
    preset: Preset | None = None
    """Frequency, scattering and what rays do, by name; the scene's own without. "paper" is "diffuse" for 800 receivers
    with, by as many passes as it takes, at least 300,000 paths each."""
    rx: ReceiverConfig = field(default_factory=ReceiverConfig)
    """Where receivers stand."""
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
        from rf3dgs.propagation.jobs.job import run_job
        from rf3dgs.propagation.jobs.trace_job import TraceJob
        from rf3dgs.propagation.sites.presets import preset_of
        from rf3dgs.propagation.sites.receivers import receivers_of
        from rf3dgs.propagation.sites.scene import without_looks

        _at_least_one(("--shard-size", self.shard_size), ("--workers", self.workers))
        crew = _crew(self.workers, self.cluster)
        scene, config, preset = open_scene(self.scene, self.people), self.trace, None
        where = self.rx
        if self.preset is not None:
            preset = preset_of(self.preset)
            scene, config = preset.applied(scene, config)
            where = replace(where, count=where.count or preset.rx_count)
        rx = receivers_of(scene, where)
        job = TraceJob(
            scene=self.scene if preset is None and not self.people else without_looks(scene),
            tx=scene.tx,
            rx=rx,
            frequency=config.frequency or scene.frequency,
            config=config,
            rule=asdict(where),
            min_paths=preset.min_paths if preset else 0,
            shard_size=self.shard_size,
        )
        run_job(job, self.out, crew=crew, progress=console())
        with PathsReader(self.out) as reader:
            traced = reader.traced
        size = sum(item.stat().st_size for item in self.out.iterdir())
        least = "" if traced is None else f", at least {int(traced.min()):,} paths each before diffuse ones are merged"
        out(f"{self.out}: {len(rx)} receivers{least}, {size / 1e6:.1f} MB")
        return 0


@dataclass(frozen=True)
class MakePhotos:
    """Render posed photographs of a scene with Mitsuba, in nerfstudio's layout; a killed run goes on."""

    scene: tyro.conf.Positional[str]
    """"lobby", "lobby-full", a scene that ships with Sionna RT, a Sionna/Mitsuba XML file, or a folder of meshes."""
    preset: Preset | None = None
    """As of trace: some presets change what stands in the scene, and how it looks."""
    people: int = 0
    """How many persons stand and walk in lobby or lobby-full, up to eight."""
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
        from rf3dgs.propagation.jobs.job import run_job
        from rf3dgs.propagation.jobs.photo_job import PhotoJob
        from rf3dgs.propagation.sites.presets import preset_of

        _at_least_one(("--count", self.count), ("--shard-size", self.shard_size), ("--workers", self.workers))
        crew = _crew(self.workers, self.cluster)
        scene = open_scene(self.scene, self.people)
        if self.preset is not None:
            scene, _ = preset_of(self.preset).applied(scene)
        shots = shots_of_tour(scene, self.count, self.tour_seed, self.photo)
        rule = {"how": "a walk", "seed": self.tour_seed}
        job = PhotoJob(scene if self.preset or self.people else self.scene, shots, rule, self.shard_size)
        run_job(job, self.out, crew=crew, progress=console())
        write_nerfstudio(self.out, photos_of(shots, self.out))
        out(f"{self.out}: {self.count} photographs of {self.photo.width}x{self.photo.height}")
        return 0


@dataclass(frozen=True)
class MakePanoramas:
    """Render equirectangular photographs at receiver positions, to lie over their spectra; a killed run goes on."""

    scene: tyro.conf.Positional[str]
    """As of photos."""
    preset: Preset | None = None
    """As of trace, which stands receivers at the same places for the same --preset and --rx."""
    people: int = 0
    """How many persons stand and walk in lobby or lobby-full, up to eight."""
    rx: ReceiverConfig = field(default_factory=ReceiverConfig)
    """Where receivers stand."""
    out: Path = Path("lobby/panoramas")
    """The folder to write: pictures, a manifest, and panoramas.json with their poses at the end."""
    width: int = 720
    """Pixels in a row; half as many rows."""
    samples: int = 64
    """Light paths per pixel of the six pictures on a cube that a panorama is put together from."""
    bounces: int = 6
    """Largest number of segments of a light path."""
    exposure: float = 1.0
    """Factor on the linear light, on top of the scene's own exposure."""
    seed: int = 0
    """Panorama number i is rendered with the seeds from `seed + 6 i` on."""
    shard_size: int = 5
    """Panoramas in one shard, which is what a killed run may have to do again."""
    workers: int = 1
    """Processes on this machine; more than one needs the extra "cluster"."""
    cluster: str | None = None
    """The address of a dask scheduler, such as tcp://10.0.0.5:8786, whose workers do the rendering."""

    def run(self) -> int:
        """Render what the folder lacks, then write the poses."""
        from rf3dgs.cli.facts import open_scene
        from rf3dgs.core.files import write_whole
        from rf3dgs.propagation.jobs.job import run_job
        from rf3dgs.propagation.jobs.photo_job import PhotoJob, photo_name, shots_all_round
        from rf3dgs.propagation.sites.presets import preset_of
        from rf3dgs.propagation.sites.receivers import receivers_of

        _at_least_one(("--shard-size", self.shard_size), ("--workers", self.workers), ("--samples", self.samples))
        if self.width < 8 or self.width % 2:
            raise InputError(f"--width must be even and at least 8 pixels; got {self.width}")
        crew = _crew(self.workers, self.cluster)
        scene, where = open_scene(self.scene, self.people), self.rx
        if self.preset is not None:
            preset = preset_of(self.preset)
            scene, _ = preset.applied(scene)
            where = replace(where, count=where.count or preset.rx_count)
        rx = receivers_of(scene, where)
        config = PhotoConfig(
            self.width,
            self.width // 2,
            samples=self.samples,
            bounces=self.bounces,
            exposure=self.exposure,
            seed=self.seed,
        )
        job = PhotoJob(
            scene=scene if self.preset or self.people else self.scene,
            shots=shots_all_round(rx, self.width, config),
            rule={"how": "receivers", **asdict(where)},
            shard_size=self.shard_size,
            label="panoramas",
        )
        run_job(job, self.out, crew=crew, progress=console())
        poses = [
            {"file": photo_name(number), "position": position, "orientation_wxyz": orientation}
            for number, (position, orientation) in enumerate(
                zip(rx.position.tolist(), rx.orientation.tolist(), strict=True)
            )
        ]
        about = {"projection": "equirectangular", "width": self.width, "height": self.width // 2, "panoramas": poses}
        write_whole(self.out / "panoramas.json", (json.dumps(about, indent=2) + "\n").encode())
        out(f"{self.out}: {len(rx)} panoramas of {self.width}x{self.width // 2}")
        return 0


def _at_least_one(*options: tuple[str, int]) -> None:
    for name, value in options:
        if value < 1:
            raise InputError(f"{name} must be at least 1; got {value}")


def _crew(workers: int, cluster: str | None) -> "AbstractContextManager[Crew] | None":
    """Who does the work: this process (None), processes on this machine, or a dask cluster."""
    if cluster is None and workers == 1:
        return None
    from rf3dgs.propagation.jobs.cluster import existing_cluster, local_processes

    if cluster is None:
        return local_processes(workers)
    if workers != 1:
        raise InputError("--workers starts processes here, --cluster uses those of a scheduler; give one of them")
    return existing_cluster(cluster)
