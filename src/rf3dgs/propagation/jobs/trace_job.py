"""Tracing many receivers as a job in shards: a folder of paths that a killed run leaves sound."""

import gc
import math
import secrets
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property, lru_cache
from io import BytesIO

from rf3dgs.channel.binning import bin_diffuse
from rf3dgs.channel.io import PathsWriter, shard_name
from rf3dgs.channel.paths_file import SCHEMA
from rf3dgs.core.errors import InputError
from rf3dgs.core.frames import Pose
from rf3dgs.core.manifest import Manifest
from rf3dgs.propagation.config import TraceConfig
from rf3dgs.propagation.jobs.job import Each
from rf3dgs.propagation.jobs.toolchain import fingerprint, made_by, scene_of_run
from rf3dgs.propagation.sites.scene import Scene

SHARD_SIZE = 25
"""Receivers in a shard unless said otherwise: half a minute of work, and some hundred megabytes."""

MOST_PASSES = 16
"""A receiver with too few paths is traced again with 2, 4, 8 and at last this many times the passes."""


@dataclass(frozen=True, eq=False)
class TraceTask:
    """The receivers `numbers` of a scene; `files` are what the job's folder calls their shard."""

    scene: str | Scene
    tx: Pose
    rx: Pose
    numbers: range
    frequency: float
    config: TraceConfig
    min_paths: int
    file: str
    meta: Mapping[str, object]
    run: str
    """Says which run asks, so that a process that serves several loads the scene of each anew."""

    def made_by(self) -> Mapping[str, object]:
        """The versions, the processor, and the scene as this process builds it."""
        return made_by(self.scene, self.run)

    def make(self, each: Each) -> Mapping[str, bytes]:
        """The bytes of an HDF5 file of paths, diffuse ones merged."""
        from rf3dgs.propagation.sionna import trace_each

        tracer = _tracer(self.scene, self.frequency, self.config.diffraction, self.run)
        scene, config = scene_of_run(self.scene, self.run), self.config
        cell = math.radians(config.cell_deg)
        content = BytesIO()
        with PathsWriter(content, self.frequency, self.tx, self.meta) as writer:
            traced = trace_each(
                scene, self.tx, self.rx, config, frequency=self.frequency, indices=self.numbers, tracer=tracer
            )
            for place, (number, paths) in enumerate(zip(self.numbers, traced, strict=True)):
                passes = config.passes
                while paths.count < self.min_paths and passes < MOST_PASSES * config.passes:
                    passes *= 2
                    rx, finer = self.rx[place : place + 1], replace(config, passes=passes)
                    paths = tracer.paths(self.tx, rx, finer, config.seed + number)
                count = int(paths.count)
                if count < self.min_paths:
                    raise InputError(
                        f"receiver {number} has {count:,} paths after {passes} passes of {config.rays:,} rays, but at "
                        f"least {self.min_paths:,} are asked for; trace with more rays"
                    )
                writer.append(bin_diffuse(paths, cell=cell, delay_step=config.delay_step), traced=count)
                each()
        gc.collect()  # a tracer leaves cycles behind, which the command line's thresholds would keep for hours
        return {self.file: content.getvalue()}


@dataclass(frozen=True, eq=False)
class TraceJob:
    """The paths from `tx` to the poses `rx` `[rx]`, in the folder that `PathsReader` reads.

    scene: a name or XML file that every worker can open, or a `Scene`, which is sent to them. rule: how the poses were
    chosen, for the manifest. min_paths: a receiver with fewer paths, before diffuse ones are merged, is traced
    again with twice the passes, up to `MOST_PASSES` times as many, then refused.
    """

    scene: str | Scene
    tx: Pose
    rx: Pose
    frequency: float
    config: TraceConfig = field(default_factory=TraceConfig)
    rule: Mapping[str, object] = field(default_factory=dict)
    min_paths: int = 0
    shard_size: int = SHARD_SIZE
    label: str = "tracing"
    run: str = field(default_factory=lambda: secrets.token_hex(8))

    @property
    def plan(self) -> Manifest:
        """The arguments as the manifest holds them; scene and poses as their sha256, since each shard has its poses."""
        return self._plan

    @cached_property
    def _plan(self) -> Manifest:
        scene = scene_of_run(self.scene, self.run)
        place = {"position": self.tx.position.tolist(), "orientation": self.tx.orientation.tolist()}
        config = {name: value for name, value in asdict(self.config).items() if name != "frequency"}
        made_from = {
            "scene": {"name": scene.name, "sha256": fingerprint(scene)},
            "tx": place,
            "frequency": self.frequency,
            "receivers": {**self.rule, "sha256": fingerprint(self.rx)},
            "trace": config,
            "min_paths": self.min_paths,
        }
        return Manifest(SCHEMA, len(self.rx), self.shard_size, made_from, {})

    def names(self, shard: int) -> tuple[str, ...]:
        """One HDF5 file per shard."""
        return (shard_name(shard),)

    def task(self, shard: int) -> TraceTask:
        """The work of one shard, with the poses of its own receivers alone."""
        plan = self.plan
        part = plan.part(shard)
        meta = {"set": plan.digest, "first": part.start}
        return TraceTask(
            self.scene,
            self.tx,
            self.rx[part.start : part.stop],
            part,
            self.frequency,
            self.config,
            self.min_paths,
            shard_name(shard),
            meta,
            self.run,
        )


@lru_cache(maxsize=1)
def _tracer(scene: str | Scene, frequency: float, diffraction: bool, run: str):
    from rf3dgs.propagation.sionna import Tracer

    return Tracer(scene_of_run(scene, run), frequency, diffraction=diffraction)
