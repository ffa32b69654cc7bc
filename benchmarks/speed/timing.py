"""CPU time of something that is done for one view after the other."""

import random
import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass
from itertools import chain

Task = Callable[[int], object]  # does its work for the view of this number


@dataclass(frozen=True)
class Timing:
    """Milliseconds of one call: the mean over the views of each view's least, and the median of all calls.

    CPU time is that of all threads of the process; `calls` were timed.
    """

    cpu_min: float
    cpu_median: float
    wall_min: float
    wall_median: float
    calls: int


def measure(task: Task, views: int, seconds: float = 2.0, *, rounds: int = 3) -> Timing:
    """Calls `task` for every view in turn, one round unmeasured, then at least `rounds` and about `seconds`."""
    for view in range(views):
        task(view)
    cpu: list[list[float]] = [[] for _ in range(views)]
    wall: list[list[float]] = [[] for _ in range(views)]
    begin, done = time.perf_counter(), 0
    while done < rounds or time.perf_counter() - begin < seconds:
        for view in range(views):
            started, started_cpu = time.perf_counter(), time.process_time()
            task(view)
            cpu[view].append(1e3 * (time.process_time() - started_cpu))
            wall[view].append(1e3 * (time.perf_counter() - started))
        done += 1
    return Timing(
        cpu_min=statistics.fmean(map(min, cpu)),
        cpu_median=statistics.median(chain.from_iterable(cpu)),
        wall_min=statistics.fmean(map(min, wall)),
        wall_median=statistics.median(chain.from_iterable(wall)),
        calls=views * done,
    )


def measure_run(task: Task, views: int, steps: int) -> Timing:
    """One run of `steps` calls that takes the views in a shuffled order, as training does: the mean of a call."""
    order = [view for turn in range(-(-steps // views)) for view in random.Random(turn).sample(range(views), views)]
    for view in order[: min(views, 16)]:
        task(view)
    started, started_cpu = time.perf_counter(), time.process_time()
    for view in order[:steps]:
        task(view)
    wall, cpu = 1e3 * (time.perf_counter() - started) / steps, 1e3 * (time.process_time() - started_cpu) / steps
    return Timing(cpu_min=cpu, cpu_median=cpu, wall_min=wall, wall_median=wall, calls=steps)
