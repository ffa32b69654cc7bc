"""Seconds, memory and megabytes per receiver of a traced set.

    python -m benchmarks.scale.receivers --scene lobby --count 50 --rays 300000

Prints a line of JSON: wall and processor seconds per receiver after the first (which compiles), resident and peak
memory after every tenth of the receivers, and the size of the set. The folder is temporary.
"""

import argparse
import json
import os
import resource
import tempfile
import time
from pathlib import Path

from rf3dgs.propagation.config import TraceConfig
from rf3dgs.propagation.jobs.job import run_job
from rf3dgs.propagation.jobs.trace_job import SHARD_SIZE, TraceJob
from rf3dgs.propagation.sites.scenes import scene_of

PAGE = os.sysconf("SC_PAGE_SIZE") / 1e6


class Notes:
    """A progress that notes times and memory after each receiver."""

    def __init__(self) -> None:
        self.rows: list[tuple[int, float, float, float, float]] = []

    def start(self, label: str, total: int, done: int = 0) -> None: ...

    def update(self, done: int, note: str = "") -> None:
        if self.rows and self.rows[-1][0] == done:
            return
        resident = int(Path("/proc/self/statm").read_text().split()[1]) * PAGE
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3
        self.rows.append((done, time.monotonic(), time.process_time(), resident, peak))

    def finish(self, note: str = "") -> None: ...


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scene", default="lobby")
    parser.add_argument("--count", type=int, default=50)
    parser.add_argument("--rays", type=int, default=300_000)
    parser.add_argument("--depth", type=int, default=3)
    parser.add_argument("--shard-size", type=int, default=SHARD_SIZE)
    options = parser.parse_args()
    scene, notes = scene_of(options.scene), Notes()
    config = TraceConfig(rays=options.rays, depth=options.depth)
    rx = scene.receivers(options.count, 0)
    with tempfile.TemporaryDirectory() as folder:
        job = TraceJob(options.scene, scene.tx, rx, scene.frequency, config, shard_size=options.shard_size)
        run_job(job, Path(folder) / "set", progress=notes)
        size = sum(item.stat().st_size for item in (Path(folder) / "set").glob("*.h5"))
    first, last = notes.rows[0], notes.rows[-1]
    steps = last[0] - first[0]
    every = max(1, options.count // 10)
    result = {
        "receivers": options.count,
        "wall_s_per_receiver": (last[1] - first[1]) / max(steps, 1),
        "cpu_s_per_receiver": (last[2] - first[2]) / max(steps, 1),
        "mb_per_receiver": size / options.count / 1e6,
        "memory_mb": [
            {"after": row[0], "resident": round(row[3]), "peak": round(row[4])}
            for row in notes.rows
            if row[0] in (1, 5) or row[0] % every == 0
        ],
        "load": os.getloadavg()[0],
    }
    print(json.dumps(result, indent=1))


if __name__ == "__main__":
    main()
