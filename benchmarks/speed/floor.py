"""The machine's floor: how long the work of a picture or a training step takes at least.

    python -m benchmarks.speed.floor [--seconds 2]

measures multiply-adds per second and memory bandwidth. A phase of the work takes at least max(vector operations / their
rate, bytes / bandwidth); the floor is the sum over the phases. The counts below are those of the algorithm, not of the
code; docs/performance.md derives each one. A vector operation handles sixteen floats: a multiply-add, addition,
comparison, selection or division counts one.
"""

import argparse
import os
import sys
from dataclasses import dataclass

from rf3dgs.core.native import native_core
from rf3dgs.core.threads import thread_count

LANES = 16
FLOAT = 4  # bytes

CULL = 16
PROJECT = 116
HARMONICS_BASIS = {1: 10, 4: 13, 9: 27, 16: 46}  # with the direction
SORT = 4
BIN = 20
LIST = 2
BLEND = {"pinhole": 23, "sphere": 31}  # and one per channel
LOSS = 168  # per float of the picture
BLEND_BACK = {"pinhole": 31, "sphere": 39}  # and two per channel
GEOMETRY_SUMS = {"pinhole": 5, "sphere": 9}
GEOMETRY_BACK = {"pinhole": 7, "sphere": 12}
LANE_SUM = 4
PROJECT_BACK = 250
ADAM = 11
GEOMETRY_FLOATS = 10  # mean, quaternion, scales; the opacity is apart


@dataclass(frozen=True)
class Machine:
    """What was measured, or is stated, of a machine: per second of `threads` at once, per CPU second for `vectors`."""

    vectors: float  # vector operations per CPU second of one thread
    read: float  # bytes/s, all threads together, beyond the caches
    changed: float  # bytes/s read and written back, both counted
    threads: int

    def cpu_seconds(self, vectors: float, read: float = 0.0, changed: float = 0.0) -> float:
        """CPU time [s] of all threads for a phase; `changed` bytes are read and written."""
        moving = self.threads * (read / self.read + 2 * changed / self.changed)
        return max(vectors / self.vectors, moving)


# The machine of the milliseconds: 260 GFLOP/s a core, 48 GB/s from two cores beyond the caches.
TWO_ZEN5_CORES = Machine(vectors=260e9 / (2 * LANES), read=48e9, changed=48e9, threads=2)


@dataclass(frozen=True)
class Work:
    """What a picture consists of."""

    gaussians: int
    visible: float
    entries: float  # (Gaussian, 16x16 tile)
    pairs: float  # (Gaussian, 4x4 block of pixels)
    pixels: int
    channels: int
    coefficients: int = 16
    kind: str = "pinhole"
    moment_bytes: int = 2


@dataclass(frozen=True)
class Phase:
    """Vector operations and bytes of one phase."""

    name: str
    vectors: float
    read: float = 0.0
    changed: float = 0.0


def render(work: Work) -> list[Phase]:
    """Phases of drawing one picture."""
    seen, channels = work.visible, work.channels
    shading = HARMONICS_BASIS[work.coefficients] + work.coefficients * channels
    return [
        Phase("cull", CULL * work.gaussians / LANES, read=3 * FLOAT * work.gaussians),
        Phase("project", PROJECT * seen / LANES, read=8 * FLOAT * seen),
        Phase("values", shading * seen / LANES, read=FLOAT * work.coefficients * channels * seen),
        Phase("sort", SORT * seen),
        Phase("bin", (BIN + LIST) * work.entries),
        Phase("blend", (BLEND[work.kind] + channels) * work.pairs),
        Phase("picture", (channels + 1) * work.pixels / LANES),
    ]


def step(work: Work, *, frozen: bool) -> list[Phase]:
    """Phases of one training step: render, L1 + SSIM with known target statistics, backward, Adam of what was seen."""
    seen, channels, values = work.visible, work.channels, work.pixels * work.channels
    sums = channels + 1 + (0 if frozen else GEOMETRY_SUMS[work.kind])
    per_pair = BLEND_BACK[work.kind] + 2 * channels + (0 if frozen else GEOMETRY_BACK[work.kind])
    trained = work.coefficients * channels + 1 + (0 if frozen else GEOMETRY_FLOATS)
    phases = [
        *render(work),
        Phase("loss", LOSS * values / LANES, read=3 * FLOAT * values),
        Phase("blend back", per_pair * work.pairs + LANE_SUM * sums * work.entries),
        Phase("gather", sums * work.entries / LANES),
    ]
    if not frozen:
        phases.append(Phase("project back", PROJECT_BACK * seen / LANES))
    changed = (FLOAT + 2 * work.moment_bytes) * trained * seen
    return [*phases, Phase("adam", ADAM * trained * seen / LANES, changed=changed)]


def floor_ms(phases: list[Phase], machine: Machine) -> float:
    """The least CPU time [ms] of all threads together."""
    return 1e3 * sum(machine.cpu_seconds(phase.vectors, phase.read, phase.changed) for phase in phases)


def measure(seconds: float = 2.0, threads: int | None = None, size: int | None = None) -> Machine:
    """This machine with the instruction set in use; `size` bytes are gone through, by default beyond the caches."""
    core = native_core()
    if core is None:
        raise SystemExit("the floor is measured by the native core, which is not built")
    threads = thread_count() if threads is None else threads
    size = beyond_caches() if size is None else size
    return Machine(
        vectors=core.multiply_add_rate(threads, 0.2 * seconds),
        read=core.bandwidth(False, threads, size, 0.4 * seconds),
        changed=core.bandwidth(True, threads, size, 0.4 * seconds),
        threads=threads,
    )


def last_cache() -> int:
    """Bytes of the largest cache, or 32 MiB where the system does not say."""
    try:
        return max(os.sysconf("SC_LEVEL3_CACHE_SIZE"), os.sysconf("SC_LEVEL2_CACHE_SIZE"), 1 << 20)
    except (ValueError, OSError):
        return 32 << 20


def beyond_caches() -> int:
    """A working set that no cache helps [byte]."""
    return min(max(256 << 20, 8 * last_cache()), 2 << 30)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=2.0)
    options = parser.parse_args()
    for threads in sorted({1, thread_count()}):
        machine = measure(options.seconds, threads)
        print(
            f"{threads} thread{'s' * (threads > 1)}: {machine.vectors / 1e9:.2f} G vector operations/s each "
            f"({2 * LANES * machine.vectors / 1e9:.0f} GFLOP/s), read {machine.read / 1e9:.1f} GB/s, "
            f"change {machine.changed / 1e9:.1f} GB/s"
        )
    return 0


if __name__ == "__main__":
    sys.exit(main())
