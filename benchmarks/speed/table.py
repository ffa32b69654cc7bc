"""The speed of the splatting core beside the machine's floor, measured in the same run.

    python -m benchmarks.speed.table [--json FILE] [--seconds 2] [--full]

CPU ms are of all threads together: the mean over the views of each view's least time, and the median of all calls.
`floor` is the model of benchmarks/speed/floor.py with the multiply-adds and the bandwidth of this machine, `ratio` the
least CPU time divided by it. Musts and goals are ratios to the floor; where milliseconds on another machine are asked
for, they are turned into ratios as docs/performance.md says. `--full` runs all 10,000 steps of the radio stage instead
of 1,000.
"""

import argparse
import json
import os
import platform
import subprocess
import sys
from dataclasses import asdict
from importlib.metadata import version
from pathlib import Path

import torch

from benchmarks.speed.floor import Machine, measure
from benchmarks.speed.reference import Against, against_reference
from benchmarks.speed.rows import RADIO_STEPS, ROWS, Result, time_row
from rf3dgs.core.files import write_whole
from rf3dgs.core.native import native_core
from rf3dgs.core.threads import thread_count
from rf3dgs.splats.rasterize import pick_backend

HEADER = f"{'300x200 unless said':27}{'CPU ms':>7}{'median':>8}{'clock':>7}{'floor':>7}{'ratio':>6}{'must/goal':>10}"
REFERENCE_MUST, REFERENCE_GOAL = 80.0, 200.0


def print_result(result: Result) -> None:
    timing = result.timing
    numbers = f"{timing.cpu_min:7.2f}{timing.cpu_median:8.2f}{timing.wall_min:7.2f}{result.floor_ms:7.2f}"
    wanted = f"{result.must:.1f}/{result.goal:.1f}"
    print(f"{result.label:27}{numbers}{result.ratio:6.1f}{wanted:>9} {result.verdict}", flush=True)


def print_reference(against: Against) -> None:
    met = "goal met" if against.measured >= REFERENCE_GOAL else "not met"
    met = "must met" if REFERENCE_MUST <= against.measured < REFERENCE_GOAL else met
    print(
        f"frozen step against the reference backend, {against.gaussians // 1000}k, same picture of 60x40:\n"
        f"  {against.reference_small_ms:.0f} / {against.native_small_ms:.1f} CPU ms = {against.measured:.0f}x "
        f"(must 80, goal 200): {met}\n"
        f"  300x200, the reference extrapolated from 36x24 and 60x40: {against.extrapolated:.0f}x"
    )


def circumstances() -> dict[str, object]:
    """Machine, versions and commit."""
    core = native_core()
    assert core is not None
    names = ("rf3dgs", "torch", "numpy")
    return {
        "cpu": cpu_model(),
        "instruction_set": core.info()["instruction_set"],
        "threads": thread_count(),
        "processors": os.cpu_count(),
        "system": platform.platform(),
        "python": platform.python_version(),
        "versions": {name: version(name) for name in names},
        "commit": commit(),
        "seed": 0,
    }


def cpu_model() -> str:
    """What the system calls its processor."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        lines = []
    named = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")]
    family = [line.split(":", 1)[1].strip() for line in lines if line.startswith(("cpu family", "model\t"))]
    return f"{named[0]} (family {family[0]}, model {family[1]})" if named and len(family) > 1 else platform.processor()


def commit() -> str:
    """The commit of the checkout, with a mark where files differ from it; empty outside of one."""

    def git(*words: str) -> str:
        done = subprocess.run(("git", *words), cwd=Path(__file__).parent, capture_output=True, text=True, check=False)
        return done.stdout.strip()

    return git("rev-parse", "HEAD") + ("+" if git("status", "--porcelain", "--untracked-files=no") else "")


def describe(machine: Machine) -> str:
    return (
        f"{32 * machine.vectors / 1e9:.0f} GFLOP/s a thread, {machine.read / 1e9:.0f} GB/s read, "
        f"{machine.changed / 1e9:.0f} GB/s read and written"
    )


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", type=Path, help="write the figures to this file")
    parser.add_argument("--seconds", type=float, default=2.0, help="for each row")
    parser.add_argument("--full", action="store_true", help="all steps of the radio stage")
    options = parser.parse_args()
    torch.set_num_threads(thread_count())
    name, reason = pick_backend()
    print(f"backend: {name} ({reason})\n{cpu_model()}")
    if name != "native":
        return 1
    load = os.getloadavg()[0]
    machine, alone = measure(), measure(threads=1)
    print(f"floor: {describe(machine)} ({machine.threads} threads)\n       {describe(alone)} (1 thread)")
    print(f"load average at the start {load:.2f}\n\n{HEADER}")
    results = []
    for row in ROWS:
        steps = RADIO_STEPS if options.full else RADIO_STEPS // 10
        results.append(time_row(row, machine, seconds=options.seconds, steps=steps))
        print_result(results[-1])
        if row.run:
            whole = 1e-3 * RADIO_STEPS * results[-1].timing.wall_median
            print(f"  {RADIO_STEPS} steps, 640 views: {whole:.0f} s of the clock, from {steps} steps")
    against = against_reference(seconds=options.seconds)
    print_reference(against)
    print(f"load average at the end {os.getloadavg()[0]:.2f}")
    if options.json is not None:
        content = {
            **circumstances(),
            "load": [load, os.getloadavg()[0]],
            "floor": {"all_threads": asdict(machine), "one_thread": asdict(alone)},
            "rows": [{**asdict(result), "ratio": result.ratio, "verdict": result.verdict} for result in results],
            "reference": {**asdict(against), "measured": against.measured, "extrapolated": against.extrapolated},
        }
        write_whole(options.json, (json.dumps(content, indent=2) + "\n").encode())
    return 0


if __name__ == "__main__":
    sys.exit(main())
