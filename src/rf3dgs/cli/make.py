"""`trace`, `photos` and `spectra`: from a scene to a dataset folder."""

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
    """"paper": 800 receivers, depth 3, 300,000 rays and, with passes, as many paths at least; instead of --trace.*"""
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


@dataclass(frozen=True)
class MakeSpectra:
    """Make spectra of traced paths and put them, with the photographs beside, into a dataset folder."""

    paths: tyro.conf.Positional[Path]
    """A file written by rf3dgs trace."""
    out: Path = Path("lobby")
    """The dataset folder; photographs already in its photos/ folder are kept."""
    method: Literal["ideal", "bartlett", "tapered", "capon", "cbf", "tcbf", "mvdr"] = "ideal"
    """Ideal narrow lobe, or an array's Bartlett (CBF), Hann-tapered (TCBF) or Capon (MVDR) spectrum."""
    array: str = "8x8"
    """Rows x columns of the receiving array, at half a wavelength; ideal spectra need none."""
    pattern: Literal["isotropic", "dipole", "patch", "tr38901"] = "patch"
    """The array's element."""
    grid: Literal["sphere", "pinhole"] = "sphere"
    """The whole sphere, or a pinhole picture that looks along the receiver's forward axis."""
    size: tuple[int, int] | None = None
    """Width and height [pixel]: 180 90 for a sphere, 300 200 for a pinhole unless given."""
    fov_deg: float = 90.0
    """Horizontal field of view of a pinhole [deg]."""
    snr_db: float | None = None
    """Signal-to-noise ratio at the elements [dB]; no noise unless given. Array methods only."""
    seed: int = 0
    """Of the noise and of the split."""

    def run(self) -> int:
        """Read, synthesise, split and write."""
        from rf3dgs.channel.arrays import planar_array
        from rf3dgs.channel.io import PathsReader
        from rf3dgs.core.grids import equirect_grid, pinhole_grid
        from rf3dgs.core.progress import track
        from rf3dgs.data.dataset import Dataset
        from rf3dgs.data.formats.detect import read_photos
        from rf3dgs.spectra.scan import spectrum_of
        from rf3dgs.spectra.spectrum import stack_spectra

        rows, cols = _size_of(self.array)
        array = None if self.method == "ideal" else planar_array(rows, cols, pattern=self.pattern)
        if self.grid == "sphere":
            grid = equirect_grid(*(self.size or (180, 90)))
        else:
            grid = pinhole_grid(*(self.size or (300, 200)), fov_deg=self.fov_deg)
        with PathsReader(self.paths) as reader:
            spectra = [
                spectrum_of(paths, array, grid, method=self.method, snr_db=self.snr_db, seed=self.seed + index)
                for index, paths in enumerate(track(reader, "spectra", len(reader), console()))
            ]
        photos = read_photos(self.out / "photos").photos if (self.out / "photos").is_dir() else ()
        meta = {"generator": f"rf3dgs spectra, method {self.method}", "seed": self.seed}
        Dataset(photos, stack_spectra(spectra), meta=meta).split(seed=self.seed).save(self.out)
        out(f"{self.out}: {len(spectra)} spectra of {grid.width}x{grid.height}, {len(photos)} photographs")
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


def _size_of(array: str) -> tuple[int, int]:
    rows, _, cols = array.partition("x")
    if not (rows.isdigit() and cols.isdigit() and int(rows) and int(cols)):
        raise InputError(f'--array must be rows x columns such as "8x8"; got {array!r}')
    return int(rows), int(cols)
