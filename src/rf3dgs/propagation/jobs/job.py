"""Long jobs in shards: a folder that a killed run leaves sound and the same command finishes.

A `Job` says how its items are cut into shards and what decides them; a `Task` makes the files of one shard, here or in
another process. `run_job` makes the missing shards, writes each file under a temporary name, brings it to the disk and
renames it: a file under its own name is whole, and is never written again. It knows nothing about what is made.

Who works is a `Crew`: `Here`, or the processes of `propagation.cluster`. Only this process writes to the folder.
"""

import contextlib
import json
import signal
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import replace
from pathlib import Path
from typing import Protocol

from rf3dgs.core import manifest as manifests
from rf3dgs.core.errors import DataError, InputError, RfError
from rf3dgs.core.files import remove_partials, write_whole
from rf3dgs.core.lock import LOCK, locked
from rf3dgs.core.manifest import Manifest, difference, load_manifest
from rf3dgs.core.progress import Progress, Silent

Made = tuple[int, Mapping[str, bytes]]
"""A shard and its files by name."""
Each = Callable[[], None]
"""Called after every item, so that progress is seen within a shard."""


class Task(Protocol):
    """The work of one shard; can be pickled, small, and free of what only this process has."""

    def made_by(self) -> Mapping[str, object]:
        """What decides the bytes besides the job's arguments, asked where the work is done."""
        ...

    def make(self, each: Each) -> Mapping[str, bytes]:
        """The files of the shard by name; the same bytes on every run."""
        ...


class Job(Protocol):
    """Items in shards; `plan` is the manifest without `made_by`, `label` what the items are called."""

    @property
    def plan(self) -> Manifest: ...

    @property
    def label(self) -> str: ...

    def names(self, shard: int) -> Sequence[str]:
        """The files of one shard."""
        ...

    def task(self, shard: int) -> Task:
        """The work of one shard."""
        ...


class Crew(Protocol):
    """Those who work on tasks."""

    def made_by(self, task: Task) -> Mapping[str, object]:
        """What all of them answer to `Task.made_by`; InputError when they differ."""
        ...

    def work(self, tasks: Iterator[tuple[int, Task]], made_by: Mapping[str, object], each: Each) -> Iterator[Made]:
        """Yield the shards as they are made, in any order, a few at a time; `each` is for who can call it."""
        ...


class Here:
    """This process does the work, one shard after the other."""

    def made_by(self, task: Task) -> Mapping[str, object]:
        return task.made_by()

    def work(self, tasks: Iterator[tuple[int, Task]], made_by: Mapping[str, object], each: Each) -> Iterator[Made]:
        for shard, task in tasks:
            yield shard, task.make(each)


def run_job(
    job: Job,
    folder: str | Path,
    *,
    crew: AbstractContextManager[Crew] | None = None,
    progress: Progress | None = None,
) -> Manifest:
    """Make what `folder` lacks of the job; finished shards are kept whatever happens. Returns the manifest.

    crew: entered only when something is missing; this process when absent. Raises InputError when the folder holds
    another job (naming the first difference) or something else, DataError when another run uses it or the disk is full.
    """
    folder = Path(folder)
    progress = Silent() if progress is None else progress
    _check_folder(folder, job.plan.schema)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise DataError(f"cannot make the folder {folder}: {error.strerror}; choose another one") from error
    with _ended_by_sigterm(), locked(folder):
        remove_partials(folder, older_than=0.0)
        old = load_manifest(folder) if (folder / manifests.NAME).exists() else None
        if old is not None:
            _refuse_another(folder, old, replace(_plain(job.plan), made_by=old.made_by))
        missing = [shard for shard in range(job.plan.shards) if not _finished(folder, job, shard)]
        if old is not None and not missing:
            return old
        with contextlib.nullcontext(Here()) if crew is None else crew as workers:
            made_by = workers.made_by(job.task(0))
            plan = _plain(replace(job.plan, made_by=made_by))
            if old is None:
                plan.save(folder)
            else:
                _refuse_another(folder, old, plan)
            try:
                _make(job, folder, missing, workers, made_by, progress)
            except RfError:
                if not any(_finished(folder, job, shard) for shard in range(plan.shards)):
                    (folder / manifests.NAME).unlink()  # what was asked for cannot be made: nothing was begun
                raise
        return plan


@contextlib.contextmanager
def _ended_by_sigterm() -> Iterator[None]:
    """Let SIGTERM, which batch systems send before SIGKILL, end the run so that its lock and its workers go too."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    def end(number: int, _: object) -> None:
        raise SystemExit(128 + number)

    before = signal.signal(signal.SIGTERM, end)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


def _make(
    job: Job, folder: Path, missing: list[int], crew: Crew, made_by: Mapping[str, object], progress: Progress
) -> None:
    """Make the missing shards and store each as soon as it comes."""
    counted = Counted(progress, job.plan.count - sum(len(job.plan.part(shard)) for shard in missing))
    progress.start(job.label, job.plan.count, counted.finished)
    tasks = ((shard, job.task(shard)) for shard in missing)
    for shard, files in crew.work(tasks, made_by, counted.each):
        if sorted(files) != sorted(job.names(shard)):
            raise InputError(f"shard {shard} must be the files {list(job.names(shard))}; got {list(files)}")
        for name, content in files.items():
            if not (folder / name).exists():
                write_whole(folder / name, content)
        counted.shard(len(job.plan.part(shard)))
    progress.finish()


class Counted:
    """Counts finished items for the progress: whole shards, and items of the shard that is being made here."""

    def __init__(self, progress: Progress, finished: int) -> None:
        self.finished, self._begun, self._progress = finished, 0, progress

    def each(self) -> None:
        self._begun += 1
        self._progress.update(self.finished + self._begun)

    def shard(self, items: int) -> None:
        self.finished, self._begun = self.finished + items, 0
        self._progress.update(self.finished)


def _plain(manifest: Manifest) -> Manifest:
    """The manifest as it comes back from JSON: lists for tuples."""
    made_from, made_by = (json.loads(json.dumps(dict(part))) for part in (manifest.made_from, manifest.made_by))
    return replace(manifest, made_from=made_from, made_by=made_by)


def _finished(folder: Path, job: Job, shard: int) -> bool:
    return all((folder / name).exists() for name in job.names(shard))


def _refuse_another(folder: Path, old: Manifest, new: Manifest) -> None:
    found = difference(vars(old), vars(new))
    if found:
        raise InputError(
            f"{folder} was begun with another {found}; give the run another folder, go back to what the folder was "
            "begun with, or delete it"
        )


def _check_folder(folder: Path, schema: str) -> None:
    """Refuse a file, and a folder that holds anything before its manifest but what a killed run leaves."""
    if folder.exists() and not folder.is_dir():
        raise DataError(f"{folder} is a file, but a folder is to be written there; remove it or choose another name")
    if not folder.is_dir() or (folder / manifests.NAME).exists():
        return
    others = sorted(item.name for item in folder.iterdir() if not (item.name == LOCK or ".partial" in item.name))
    if others:
        raise InputError(
            f"{folder} is no folder of {schema}: it has no {manifests.NAME} but holds {others[0]}; choose another name "
            "with --out"
        )
