"""Speed of spectra: a million paths to the ideal sphere and to array pictures, scans against the BLAS floor.

    python -m benchmarks.speed.spectra [--json FILE] [--page docs/performance.md]

Paths are a million diffuse ones from all sides with delays of 20 to 100 ns, arrays 10x10 patches, pictures 300x200. The
floor of a scan is one complex128 matrix product [direction, element] x [element, element], measured in turn with the
scans; the floors of the others are not known. Musts: ratios to the floor in CPU time, or milliseconds of the clock on
two cores, judged by the CPU time of all threads, which the clock of a machine that does nothing else does not exceed.
"""

import argparse
import json
import math
import os
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path

import torch

from benchmarks.speed.page import between_marks
from benchmarks.speed.table import circumstances
from benchmarks.speed.timing import Timing, measure
from rf3dgs.channel.arrays import planar_array
from rf3dgs.channel.paths import Paths
from rf3dgs.channel.response import manifold
from rf3dgs.core.files import write_whole
from rf3dgs.core.frames import Pose
from rf3dgs.core.grids import equirect_grid, pinhole_grid
from rf3dgs.core.threads import thread_count
from rf3dgs.spectra.beamformers import bartlett, capon, music
from rf3dgs.spectra.config import ArrayProcessing
from rf3dgs.spectra.covariance import covariance_of
from rf3dgs.spectra.scan import spectrum_of
from rf3dgs.spectra.steering import PlanarSteering

FLOOR = "BLAS floor of a scan"
HEADER = (
    "| 1M paths, 10x10 patches | CPU ms | clock ms | floor CPU ms | ratio | must | |\n|---|---|---|---|---|---|---|"
)


@dataclass(frozen=True)
class Row:
    """What is timed: with a must in ms of the clock, or a must as a ratio to the floor in CPU time, or none."""

    label: str
    timing: Timing
    floor_ms: float | None = None
    clock_must: float | None = None
    ratio_must: float | None = None

    @property
    def ratio(self) -> float | None:
        return None if self.floor_ms is None else self.timing.cpu_min / self.floor_ms

    @property
    def verdict(self) -> str:
        if self.clock_must is not None:
            return "met" if self.timing.cpu_min <= self.clock_must else "not met"
        if self.ratio_must is not None and self.ratio is not None:
            return "met" if self.ratio <= self.ratio_must else "not met"
        return ""


def diffuse_paths(count: int, seed: int = 0) -> Paths:
    """Diffuse paths from all sides: nothing to merge, nothing in order."""
    generator = torch.Generator().manual_seed(seed)

    def uniform(low: float, high: float) -> torch.Tensor:
        return low + (high - low) * torch.rand(count, generator=generator)

    return Paths(
        coeff=torch.polar(uniform(1e-8, 1e-7), uniform(0.0, 2 * math.pi)),
        delay=uniform(2e-8, 1e-7),
        aoa_zenith=torch.acos(uniform(-1.0, 1.0)),
        aoa_azimuth=uniform(-math.pi, math.pi),
        aod_zenith=torch.acos(uniform(-1.0, 1.0)),
        aod_azimuth=uniform(-math.pi, math.pi),
        valid=torch.ones(count, dtype=torch.bool),
        frequency=60e9,
        tx=Pose([0.0, 0.0, 2.0]),
        rx=Pose([3.0, 4.0, 1.0]),
        kind=torch.full((count,), 2, dtype=torch.int8),
    )


def time_all(seconds: float, count: int) -> list[Row]:
    """All rows; the scans and their floor are timed one after the other in every round."""
    paths, array = diffuse_paths(count), planar_array(10, 10, "patch")
    sphere, grid = equirect_grid(360, 180), pinhole_grid(300, 200, 90)
    rows = [
        Row(
            "ideal gain, delay and departure, sphere 360x180",
            measure(lambda _: spectrum_of(paths, grid=sphere), 1, seconds),
            clock_must=300.0,
        )
    ]
    for label, snapshots, must in (("256 frequencies", 256, 2000.0), ("uncorrelated paths", None, None)):

        def picture(_: int, snapshots: int | None = snapshots) -> object:
            return spectrum_of(paths, array, grid, method="capon", processing=ArrayProcessing(snapshots=snapshots))

        rows.append(Row(f"Capon picture 300x200, {label}", measure(picture, 1, seconds), clock_must=must))
    R = covariance_of(paths, array, snr_db=20)
    A, steering = manifold(array, grid.directions.double()), PlanarSteering(array, grid.directions)
    flat = A.reshape(-1, array.count)
    scans: dict[str, tuple[Callable[[], object], float | None]] = {
        FLOOR: (lambda: flat @ R, None),
        "CBF scan, planar array": (lambda: bartlett(R, steering), 3.0),
        "Capon scan, planar array": (lambda: capon(R, steering), 3.0),
        "MUSIC scan, planar array": (lambda: music(R, steering, 25), None),
        "CBF scan, any manifold": (lambda: bartlett(R, A), 3.0),
        "Capon scan, any manifold": (lambda: capon(R, A), 3.0),
    }
    timings = in_turn({label: task for label, (task, _) in scans.items()}, seconds)
    floor = timings[FLOOR].cpu_min
    rows += [Row(label, timings[label], floor, ratio_must=must) for label, (_, must) in scans.items()]
    return rows


def in_turn(tasks: dict[str, Callable[[], object]], seconds: float, rounds: int = 5) -> dict[str, Timing]:
    """The best of several rounds in which every task has its turn, so that what disturbs one disturbs all."""
    found: dict[str, Timing] = {}
    for _ in range(rounds):
        for label, task in tasks.items():
            timing = measure(lambda _, task=task: task(), 1, seconds / rounds, rounds=1)
            if label not in found or timing.cpu_min < found[label].cpu_min:
                found[label] = timing
    return found


def line(row: Row) -> str:
    floor = "" if row.floor_ms is None else f"{row.floor_ms:.0f}"
    ratio = "" if row.ratio is None else f"{row.ratio:.2f}"
    must = "" if row.ratio_must is None else f"ratio {row.ratio_must:.0f}"
    must = must if row.clock_must is None else f"{row.clock_must:.0f} ms of the clock"
    timing = row.timing
    return (
        f"| {row.label} | {timing.cpu_min:.0f} | {timing.wall_min:.0f} | {floor} | {ratio} | {must} | {row.verdict} |"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", type=Path, help="write the figures to this file")
    parser.add_argument("--page", type=Path, help="put the table between the marks of this page")
    parser.add_argument("--seconds", type=float, default=3.0, help="for each row")
    parser.add_argument("--paths", type=int, default=1_000_000)
    options = parser.parse_args()
    torch.set_num_threads(thread_count())
    load = os.getloadavg()[0]
    rows = time_all(options.seconds, options.paths)
    about = circumstances()
    where = (
        f"{about['cpu']}, {about['instruction_set']}, {about['threads']} threads, commit {str(about['commit'])[:12]}, "
        f"load average {load:.1f} to {os.getloadavg()[0]:.1f}."
    )
    table = "\n".join([where, "", HEADER, *map(line, rows)])
    print(table)
    if options.json is not None:
        content = {
            **about,
            "paths": options.paths,
            "load": [load, os.getloadavg()[0]],
            "rows": [{**asdict(row), "ratio": row.ratio, "verdict": row.verdict} for row in rows],
        }
        write_whole(options.json, (json.dumps(content, indent=2) + "\n").encode())
    if options.page is not None:
        write_whole(options.page, between_marks(options.page.read_text(), "spectra", table).encode())


if __name__ == "__main__":
    torch.set_grad_enabled(False)
    main()
