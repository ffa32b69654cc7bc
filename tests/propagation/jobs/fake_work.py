"""Cheap work for the job runner, in a module that worker processes can import; also a command that tests can kill."""

import argparse
import hashlib
import os
import resource
import signal
import sys
import time
from dataclasses import dataclass, field
from pathlib import Path

from rf3dgs.core.errors import DataError
from rf3dgs.core.manifest import Manifest
from rf3dgs.propagation.jobs.job import run_job


def content(item: int, size: int = 200) -> bytes:
    return (hashlib.sha256(str(item).encode()).digest() * (size // 32 + 1))[:size]


def first_time(marker: str) -> bool:
    """True for whoever asks first, in whatever process."""
    try:
        os.close(os.open(marker, os.O_CREAT | os.O_EXCL))
    except FileExistsError:
        return False
    return True


@dataclass(frozen=True)
class FakeTask:
    numbers: range
    seconds: float = 0.0
    size: int = 200
    dies_once: str = ""  # a marker file: the process that makes this shard first is killed
    dies: bool = False
    fault: str = ""
    alone: str = ""  # a marker file that exists while a shard is made: two at a time fail
    two_kinds: str = ""  # a marker file: the process that answers first has another version than the rest

    def made_by(self):
        if not self.two_kinds:
            return {"version": "1"}
        if first_time(self.two_kinds):
            Path(self.two_kinds).write_text(str(os.getpid()))
        return {"version": "1" if Path(self.two_kinds).read_text() == str(os.getpid()) else "2"}

    def make(self, each):
        if self.dies or (self.dies_once and first_time(self.dies_once)):
            os.kill(os.getpid(), signal.SIGKILL)
        if self.fault == "ours":
            raise DataError("receiver 7 is inside the sofa")
        if self.fault == "theirs":
            raise ZeroDivisionError("by zero")
        if self.alone and not first_time(self.alone):
            raise DataError("two tasks at a time in one process")
        files = {}
        for item in self.numbers:
            time.sleep(self.seconds)
            files[f"{item}.bin"] = content(item, self.size)
            each()
        if self.alone:
            Path(self.alone).unlink()
        return files


@dataclass(frozen=True)
class FakeJob:
    """Items 0 to count - 1, one file each; `special` maps a shard to what is odd about its task."""

    count: int = 10
    shard_size: int = 3
    seconds: float = 0.0
    colour: str = "red"
    label: str = "work"
    common: dict = field(default_factory=dict)
    special: dict = field(default_factory=dict)
    asked: list = field(default_factory=list)

    @property
    def plan(self):
        return Manifest("test.work", self.count, self.shard_size, {"paint": {"colour": self.colour}}, {})

    def names(self, shard):
        return [f"{item}.bin" for item in self.plan.part(shard)]

    def task(self, shard):
        self.asked.append(shard)
        return FakeTask(self.plan.part(shard), self.seconds, **(self.common | self.special.get(shard, {})))


def files_of(folder):
    return {item.name: item.read_bytes() for item in sorted(folder.iterdir())}


def command(out, *options):
    return [sys.executable, "-m", "tests.propagation.jobs.fake_work", str(out), *map(str, options)]


def text_of(path):
    try:
        return path.read_text()
    except OSError:
        return ""


def wait_for(condition, seconds=20.0):
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline, "it never happened"
        time.sleep(0.01)


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("out")
    parser.add_argument("--count", type=int, default=12)
    parser.add_argument("--seconds", type=float, default=0.0)
    parser.add_argument("--limit", type=int, default=0, help="largest file this process may write")
    parser.add_argument("--large", type=int, default=-1, help="a shard whose files are large")
    parser.add_argument("--workers", type=int, default=1)
    options = parser.parse_args()
    if options.limit:
        resource.setrlimit(resource.RLIMIT_FSIZE, (options.limit, options.limit))
    special = {options.large: {"size": 100_000}} if options.large >= 0 else {}
    crew = None
    if options.workers > 1:
        from rf3dgs.propagation.jobs.cluster import local_processes

        crew = local_processes(options.workers)
    run_job(FakeJob(options.count, 2, options.seconds, special=special), options.out, crew=crew)


if __name__ == "__main__":
    main()
