"""A study: one scene under one preset, split and pictured one way, and the cells that methods get there.

Data, geometry and cells are kept in a folder; what is there and was made from the same is not made again, so a study
that was killed goes on.
"""

import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import torch

from benchmarks.quality.methods.method import Method, Scale, Task
from benchmarks.quality.protocol.cells import (
    SECOND,
    Extra,
    Key,
    Truth,
    lpips_of_user,
    make_cells,
    make_second,
    read_cell,
)
from benchmarks.quality.protocol.data import (
    FIRST,
    Data,
    data_of,
    geometry_digest,
    geometry_of,
    second_solve,
    spectra_at,
)
from benchmarks.quality.protocol.pictures import SPHERE, Pictures
from benchmarks.quality.protocol.results import Results
from benchmarks.quality.protocol.scenes import Setting
from benchmarks.quality.protocol.split import HOLDOUTS, Draw, SplitConfig
from rf3dgs.core.errors import InputError, RfError
from rf3dgs.propagation.sites.presets import preset_of
from rf3dgs.propagation.sites.scene import Scene
from rf3dgs.splats.gaussians import Gaussians


def say(text: str) -> None:
    print(text, file=sys.stderr, flush=True)


@dataclass(frozen=True)
class StudyConfig:
    """What decides a study."""

    scene: str
    preset: str
    out: Path
    trained: str | None = None
    """Scene of the training spectra, where things have moved since; None: the same."""
    judge: str = "validation"
    """"test" reads the sealed positions."""
    holdouts: tuple[str, ...] = HOLDOUTS
    judged: int | None = None
    """Of each hold-out the first so many positions; None: all."""
    split: SplitConfig | Literal["paper"] | None = None
    """None: what suits the scene. "paper": a fifth at random is the test, nothing is kept for validation."""
    receivers: int | None = None
    """The first so many; None: what suits the scene."""
    rays: int | None = None
    """Of traced paths; None: as `rf3dgs trace`."""
    pictures: Pictures = SPHERE
    geometry: str = "photos"
    """"photos", of which every seed has its own Gaussians, "mesh", or a .ply file."""
    geometry_folder: Path | None = None
    """Where made geometry is kept; None: in `out`."""
    mesh_count: int = 100_000
    scale: Scale = "laptop"
    paths: Mapping[str, Path] = field(default_factory=dict)
    """Folders of traced paths by preset, for the scene itself."""
    reason: Callable[[], str] = lambda: "a study"
    """Why the sealed positions are read, for the log."""
    only_read: bool = False
    """Make no cell."""
    extra: Extra | None = None
    """More scores of every picture; cells that have them are in a folder of that name."""
    keep: int = 0
    """Of the first so many pictures of a hold-out, what every method draws is kept beside its cell."""

    @property
    def cells(self) -> Path:
        """The folder of the cells."""
        return self.out if self.extra is None else self.out / self.extra.name


class Study:
    """Data, truths and geometry of a study, each made when first needed."""

    def __init__(self, config: StudyConfig) -> None:
        self.config = config
        self.setting = Setting(config.scene, config.preset)
        self._truths: dict[str, Truth] = {}
        self._geometry: dict[int, Gaussians] = {}

    @cached_property
    def data(self) -> Data:
        """What is judged by."""
        return self._data_of(self.setting)

    @cached_property
    def before(self) -> Data:
        """What is trained on: the same, unless things have moved."""
        trained = self.config.trained
        before = self.data if trained is None else self._data_of(Setting(trained, self.config.preset))
        if before.split != self.data.split or not torch.equal(before.positions, self.data.positions):
            raise InputError(f"{trained!r} and {self.config.scene!r} have other receivers; nothing can be compared")
        return before

    @cached_property
    def scene(self) -> Scene:
        """The scene with its preset's materials."""
        return preset_of(self.config.preset).applied(self.setting.scene())[0]

    @property
    def traced(self) -> Path:
        """The folder of paths that the data are made from, receiver by receiver."""
        return self.config.paths.get(self.config.preset) or self._folder(self.setting) / FIRST

    def geometry(self, seed: int) -> Gaussians:
        """The Gaussians that methods build on whose training positions are drawn by `seed`."""
        config, setting = self.config, self.setting
        if seed not in self._geometry:
            site = "lobby" if setting.photographs else setting.name
            folder = config.geometry_folder or config.out / "geometry"
            made = geometry_of(config.geometry, setting, folder / site, count=config.mesh_count, seed=seed)
            self._geometry[seed] = made
        return self._geometry[seed]

    @cached_property
    def base(self) -> dict[str, Any]:
        """What identifies every cell of the study."""
        window = self.before.window()
        levels = [window.floor_db, window.ceil_db]
        found = {"data": [self.before.digest, self.data.digest], "window_db": levels, "judged": self.config.judged}
        lpips = lpips_of_user()
        found |= {"keep": self.config.keep} if self.config.keep else {}
        return found | ({} if lpips is None else {"lpips": lpips.network})

    def truth(self, holdout: str) -> Truth:
        """What a hold-out is judged by."""
        if holdout not in self._truths:
            config = self.config
            spectra = self.data.judged(config.judge, holdout, config.reason(), config.judged)
            window, views = self.before.window(), self.data.views
            self._truths[holdout] = Truth.of(spectra, window, views, extra=config.extra, keep=config.keep)
        return self._truths[holdout]

    def task(self, count: int, seed: int, draw: Draw = "uniform", *, geometry: bool = True) -> Task:
        """What methods are trained on: `count` positions drawn by `seed`."""
        config, before = self.config, self.before
        train = before.training(count, seed, draw)
        gaussians = self.geometry(seed) if geometry else None
        return Task(train, before.window(), seed, config.scale, gaussians, self.scene)

    def add(
        self,
        results: Results,
        methods: Sequence[Method],
        count: int,
        seed: int,
        draw: Draw = "uniform",
        *,
        again: Sequence[str] = (),
        also: Mapping[str, Truth] | None = None,
    ) -> None:
        """Make the missing cells of methods trained on the same positions, and those named `again`; add all to
        `results`. A method that fails leaves its cells out and is reported.

        also: more truths, by a name that stands for the hold-out; one fit is judged by all.
        """
        task = self.task(count, seed, draw, geometry=any("geometry" in method.needs for method in methods))
        for method in methods:
            for key, cell in self._cells(method, count, task, draw, also or {}, again=method.name in again):
                results.add(key, cell)

    def add_second(self, results: Results, count: int) -> None:
        """Add the second solve of `count` positions of each hold-out, made where it is missing."""
        for holdout in self.config.holdouts:
            config = self.config
            key = self._key(holdout, 0, 0, SECOND, "none", config.scene)
            identity = self.base | {"receivers": count}
            if read_cell(key.path(config.cells), identity) is None and not config.only_read:
                folder = self._folder(self.setting)
                solved = second_solve(
                    self.data, folder, config.judge, count, pictures=config.pictures, rays=config.rays
                )
                judged = self.truth(holdout)
                wanted = judged.spectra.pose.position
                repeat = spectra_at(solved, config.judge, holdout, config.reason(), wanted)
                if repeat is not None:
                    make_second(key, judged, repeat, identity, config.cells)
            found = read_cell(key.path(config.cells), identity)
            if found is not None:
                results.add_second(key, found)

    def _cells(
        self, method: Method, count: int, task: Task, draw: Draw, also: Mapping[str, Truth], *, again: bool
    ) -> Iterator[tuple[Key, dict[str, Any]]]:
        config, bare = self.config, "geometry" not in method.needs
        kind = "none" if bare else Path(config.geometry).stem
        trained = self.before.setting.name
        keys = [
            replace(self._key(holdout, count, task.seed, method.name, kind, trained), draw=draw)
            for holdout in (*config.holdouts, *also)
        ]
        identity = self.base | {
            "model": method.name,
            "settings": dict(method.settings(task)),
            "scale": config.scale,
            "geometry": None if bare or task.geometry is None else geometry_digest(task.geometry),
        }
        if also:
            identity |= {"also": {name: truth.digest for name, truth in also.items()}}
        missing = [key for key in keys if again or not read_cell(key.path(config.cells), identity)]
        if missing and not config.only_read:
            say(f"{config.preset} {config.judge} {count} positions, {draw}, seed {task.seed}: {method.name}")
            truths = {key.holdout: also.get(key.holdout) or self.truth(key.holdout) for key in missing}
            try:
                make_cells(missing, method, task, truths, identity, config.cells)
            except RfError as error:
                say(f"{method.name} failed, its cells stay empty: {error}")
        for key in keys:
            found = read_cell(key.path(config.cells), identity)
            if found is not None:
                yield key, found

    def _key(self, holdout: str, count: int, seed: int, model: str, geometry: str, trained: str) -> Key:
        config = self.config
        return Key(config.scene, config.preset, geometry, config.judge, holdout, count, seed, model, trained)

    def _data_of(self, setting: Setting) -> Data:
        config, site = self.config, setting.site
        split = SplitConfig(*site.held, buffer=site.buffer) if config.split is None else config.split
        return data_of(
            setting,
            self._folder(setting),
            None if split == "paper" else split,
            receivers=config.receivers or site.receivers,
            paths=config.paths.get(config.preset) if setting.name == config.scene else None,
            pictures=config.pictures,
            rays=config.rays,
        )

    def _folder(self, setting: Setting) -> Path:
        return self.config.out / "data" / f"{setting.name}-{setting.preset}"
