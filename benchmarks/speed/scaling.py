"""How the cost grows: with Gaussians, pixels, channels and threads, in memory, and beside another process.

    python -m benchmarks.speed.scaling [--json FILE] [--figures FOLDER] [--seconds 0.5]

Straight lines are fitted to the CPU time of pictures and of frozen training steps against Gaussians, pixels and
channels; `worst` is the largest relative distance of a point from its line. Memory is what processes of two sizes
differ by. The busy neighbour is a process that computes without end on one processor.
"""

import argparse
import json
import os
import subprocess
import sys
from collections.abc import Callable
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from benchmarks.speed.figures import draw_scaling
from benchmarks.speed.floor import Machine, floor_ms
from benchmarks.speed.floor import measure as measure_floor
from benchmarks.speed.scenes import room
from benchmarks.speed.subjects import Subject, rendering, training
from benchmarks.speed.timing import measure
from rf3dgs.core.files import write_whole
from rf3dgs.core.threads import thread_count


@dataclass(frozen=True)
class Setting:
    """One point of a sweep; what is not varied is as here."""

    gaussians: int = 100_000
    channels: int = 3
    width: int = 300
    height: int = 200


SWEEPS = {
    "gaussians": {count: Setting(gaussians=count) for count in (25_000, 50_000, 100_000, 200_000, 400_000)},
    "pixels": {
        width * height: Setting(width=width, height=height)
        for width, height in ((150, 100), (300, 200), (450, 300), (600, 400), (900, 600))
    },
    "channels": {channels: Setting(channels=channels) for channels in (1, 2, 3, 4, 8)},
}
KINDS: dict[str, Callable[..., Subject]] = {"render": rendering, "frozen step": training}
BOUND_BESIDE = 2.5

_MEMORY = """
import os, sys, resource, torch
from benchmarks.speed.scenes import cameras_of, room
from benchmarks.speed.subjects import RATES, trainer_of
from rf3dgs.splats.target import Target
torch.set_num_threads(1)
count, views = int(sys.argv[1]), int(sys.argv[2])
trainer = trainer_of(room(count, channels=1), frozen=True, backend="native")
cameras = cameras_of(views)
targets = [Target(torch.rand(200, 300, 1)) for _ in cameras]
for camera, target in zip(cameras, targets):
    trainer.step(camera, target, RATES)
pages = int(open("/proc/self/statm").read().split()[1])
print(pages * resource.getpagesize())
"""


def point(kind: str, at: int, setting: Setting, machine: Machine, seconds: float) -> dict[str, float]:
    """CPU time, time of the clock and floor [ms] of one setting."""
    scene = room(setting.gaussians, channels=setting.channels)
    subject = KINDS[kind](scene, width=setting.width, height=setting.height)
    timing, floor = measure(subject.task, subject.views, seconds), floor_ms(subject.phases, machine)
    return {"at": at, "cpu_ms": timing.cpu_min, "wall_ms": timing.wall_min, "floor_ms": floor}


def line(points: list[dict[str, float]]) -> dict[str, float]:
    """The straight line through cpu_ms against `at` with least relative distances, and how far the worst point lies."""
    at, cost = (np.array([point[name] for point in points]) for name in ("at", "cpu_ms"))
    slope, start = np.polyfit(at, cost, 1, w=1 / cost)
    away = np.abs(start + slope * at - cost) / cost
    doubling = np.polyfit(np.log(at), np.log(cost), 1)[0]
    return {"start_ms": float(start), "slope_ms": float(slope), "worst": float(away.max()), "exponent": float(doubling)}


def memory() -> dict[str, float]:
    """Bytes that a Gaussian and a view add to a process that trains one channel with frozen geometry at 300x200."""

    def resident(count: int, views: int) -> int:
        words = (sys.executable, "-c", _MEMORY, str(count), str(views))
        done = subprocess.run(words, capture_output=True, text=True, check=True, env=os.environ)
        return int(done.stdout)

    small = resident(100_000, 4)
    return {
        "per_gaussian": (resident(500_000, 4) - small) / 400_000,
        "per_view": (resident(100_000, 104) - small) / 100,
    }


@contextmanager
def busy_neighbour():
    """A process that computes without end."""
    neighbour = subprocess.Popen((sys.executable, "-c", "while True: pass"))
    try:
        yield
    finally:
        neighbour.kill()
        neighbour.wait()


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", type=Path, help="write the figures to this file")
    parser.add_argument("--figures", type=Path, help="draw them as PNG and SVG into this folder")
    parser.add_argument("--seconds", type=float, default=0.5, help="for each point")
    options = parser.parse_args()
    threads, seconds = thread_count(), options.seconds
    torch.set_num_threads(threads)
    machine = measure_floor()
    result: dict[str, dict[str, dict]] = {name: {} for name in (*SWEEPS, "threads")}
    for kind in KINDS:
        print(f"{kind}, CPU ms at 300x200 RGB, 100k unless varied")
        for name, settings in SWEEPS.items():
            points = [point(kind, at, setting, machine, seconds) for at, setting in settings.items()]
            fit = line(points)
            result[name][kind] = {"points": points, **fit}
            print(f"  {name}: " + ", ".join(f"{at['at']}: {at['cpu_ms']:.2f}" for at in points))
            print(f"    exponent {fit['exponent']:.2f}, worst off a line {100 * fit['worst']:.0f} %", flush=True)
        points = []
        for number in range(1, threads + 1):
            torch.set_num_threads(number)
            points.append(point(kind, number, Setting(), machine, seconds))
        result["threads"][kind] = {"points": points}
        print("  threads, ms of the clock: " + ", ".join(f"{at['at']}: {at['wall_ms']:.2f}" for at in points))
    subject = training(room(100_000))
    alone = measure(subject.task, subject.views, 2 * seconds)
    with busy_neighbour():
        beside = measure(subject.task, subject.views, 2 * seconds)
    ratio = beside.wall_median / alone.wall_median
    met = "met" if ratio <= BOUND_BESIDE else "not met"
    print(f"beside a busy process: {ratio:.2f} times as long by the clock (at most {BOUND_BESIDE}): {met}")
    used = memory()
    each = f"{used['per_gaussian']:.0f} bytes a Gaussian, {used['per_view'] / 1e6:.2f} MB a view"
    print(f"memory, one channel, frozen geometry, 300x200: {each}")
    content = {**result, "busy_neighbour": ratio, "memory": used, "load": os.getloadavg()[0], "threads_used": threads}
    if options.json is not None:
        write_whole(options.json, (json.dumps(content, indent=2) + "\n").encode())
    if options.figures is not None:
        draw_scaling(result, options.figures)
    return 0


if __name__ == "__main__":
    sys.exit(main())
