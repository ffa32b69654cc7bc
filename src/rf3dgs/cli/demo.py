"""`demo`: the whole story on one site, from photographs and spectra to an evaluated field and its report."""

import resource
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from rf3dgs.cli.fit import Preset, checkpoints, chosen_radio, drop_checkpoints
from rf3dgs.cli.show import console, out
from rf3dgs.propagation.config import PhotoConfig, TraceConfig
from rf3dgs.training.config import RadioConfig, VisualConfig


@dataclass(frozen=True)
class Demo:
    """The whole story: photographs and spectra of a site to an evaluated radio radiance field and a report."""

    out: Path = Path("out/demo")
    """The folder to write: dataset (when traced), geometry.ply, site.field and report.html."""
    scene: str = "lobby"
    """The built-in lobby, a scene that ships with Sionna RT ("box", "simple_street_canyon"), or an XML file."""
    trace: bool = False
    """Trace and photograph the scene afresh instead of taking the prepared lobby; other scenes are always traced."""
    geometry: Literal["auto", "photos", "mesh"] = "auto"
    """Where the Gaussians come from; "auto" takes photographs in the lobby and the mesh elsewhere."""
    seed: int = 0
    """Of everything random."""
    receivers: int = 80
    """Receiver positions when tracing."""
    photos: int = 60
    """Photographs when rendering them."""
    grid: tuple[int, int] = (180, 90)
    """Width and height of the full-sphere spectra when tracing [pixel]."""
    mesh_count: int = 40_000
    """Gaussians on a mesh."""
    trace_config: TraceConfig = field(default_factory=TraceConfig)
    """How paths are traced."""
    photo_config: PhotoConfig = field(default_factory=PhotoConfig)
    """How photographs are rendered."""
    visual: VisualConfig = field(
        default_factory=lambda: VisualConfig(steps=3000, max_count=50_000, ssim_weight=0.05, degree=1)
    )
    """The visual stage."""
    preset: Preset | None = None
    """All settings of the radio stage at once, in place of --radio.* (the seed stays)."""
    radio: RadioConfig = field(default_factory=RadioConfig)
    """The radio stage."""

    def run(self) -> int:
        """Run every stage; a killed run goes on from its last checkpoint."""
        from dataclasses import replace

        from rf3dgs.cli.chain import evaluate_parts, geometry_of_mesh, make_dataset, report_inputs
        from rf3dgs.cli.facts import open_dataset, open_scene
        from rf3dgs.core.grids import equirect_grid
        from rf3dgs.evaluation.figures import footprint_of
        from rf3dgs.evaluation.report import write_report
        from rf3dgs.evaluation.table import format_table
        from rf3dgs.splats.ply import write_ply
        from rf3dgs.training.radio import fit_radio
        from rf3dgs.training.visual import fit_geometry

        radio = chosen_radio(self.preset, self.radio)
        fresh = self.trace or self.scene != "lobby"
        from_mesh = self.geometry == "mesh" or (self.geometry == "auto" and self.scene != "lobby")
        clock = Clock()
        progress = console()
        scene = open_scene(self.scene)
        self.out.mkdir(parents=True, exist_ok=True)
        if fresh:
            with clock.stage("trace and photograph"):
                dataset = make_dataset(
                    scene,
                    self.out / "dataset",
                    equirect_grid(*self.grid),
                    receivers=self.receivers,
                    photos=0 if from_mesh else self.photos,
                    trace=replace(self.trace_config, seed=self.trace_config.seed + self.seed),
                    photo=self.photo_config,
                    seed=self.seed,
                    progress=progress,
                )
        else:
            with clock.stage("load the prepared lobby"):
                dataset = open_dataset("lobby")
        out(f"{dataset}")
        field_path = self.out / "site.field"
        folder = checkpoints(field_path)
        with clock.stage("visual stage" if not from_mesh else "geometry from the mesh"):
            if from_mesh:
                geometry = geometry_of_mesh(scene, self.mesh_count, self.seed)
            else:
                config = replace(self.visual, seed=self.visual.seed + self.seed)
                geometry = fit_geometry(
                    dataset.train.photos, config, progress=progress, checkpoint_dir=folder / "visual"
                )
            write_ply(self.out / "geometry.ply", geometry)
        train = dataset.train.spectra
        assert train is not None
        with clock.stage("radio stage"):
            config = replace(radio, seed=radio.seed + self.seed, geometry="given" if from_mesh else radio.geometry)
            trained = fit_radio(geometry, train, config, progress=progress, checkpoint_dir=folder / "radio")
            trained.save(field_path)
        with clock.stage("evaluation"):
            parts = {role: dataset.open_test("rf3dgs demo", name) for role, name in HOLDOUTS.items()}
            evaluations = evaluate_parts(trained, train, parts, progress, self.seed)
        inputs = report_inputs(
            f"Radio radiance field of the {scene.name.replace('_', ' ')}",
            *(trained, dataset, parts, evaluations),
            geometry=None if from_mesh else geometry,
            footprint=footprint_of(*(part.numpy() for part in scene.mesh()[:2])),
            timings=clock.seconds,
            seed=self.seed,
            command=self.command(),
        )
        report = write_report(self.out / "report.html", inputs)
        drop_checkpoints(field_path)
        out(format_table(evaluations))
        spent = ", ".join(f"{name} {seconds:.0f} s" for name, seconds in clock.seconds.items())
        out(f"{spent}; peak memory {peak_memory() / 1e9:.1f} GB")
        out(f"field:  {field_path}")
        out(f"report: {report}")
        return 0

    def command(self) -> str:
        """The command line that repeats this run, apart from changed configurations."""
        words = ["rf3dgs demo"]
        words += [f"--scene {self.scene}"] * (self.scene != "lobby") + ["--trace"] * self.trace
        words += [f"--geometry {self.geometry}"] * (self.geometry != "auto")
        words += [f"--seed {self.seed}"] * (self.seed != 0)
        return " ".join(words)


HOLDOUTS = {"random": "test", "region": "region"}


class Clock:
    """Seconds per stage, for the report."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Time a block."""
        began = time.monotonic()
        yield
        self.seconds[name] = time.monotonic() - began


def peak_memory() -> float:
    """Largest resident memory of this process so far [byte]."""
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return float(peak) * (1 if sys.platform == "darwin" else 1024)
