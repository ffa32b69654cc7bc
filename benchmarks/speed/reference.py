"""The native step against that of the reference backend: the same Gaussians, view and target in one run.

The reference evaluates every visible Gaussian at every pixel and keeps all of it for the backward pass: at 100,000
Gaussians and 300x200 pixels more memory than a machine has. Both therefore draw the same view with few pixels, which
favours the reference: its time grows with the pixels, the native step's mostly does not. What the reference would take
for 300x200 is extrapolated along the line through two sizes, and said to be so.
"""

import gc
import time
from dataclasses import dataclass

from benchmarks.speed.scenes import room
from benchmarks.speed.subjects import training
from benchmarks.speed.timing import measure

SIZES = ((36, 24), (60, 40))
FULL = (300, 200)


@dataclass(frozen=True)
class Against:
    """CPU ms of a frozen step: of both at the larger of `SIZES`, of both at 300x200 (the reference extrapolated)."""

    gaussians: int
    native_small_ms: float
    reference_small_ms: float
    native_full_ms: float
    reference_full_ms: float

    @property
    def measured(self) -> float:
        return self.reference_small_ms / self.native_small_ms

    @property
    def extrapolated(self) -> float:
        return self.reference_full_ms / self.native_full_ms


def against_reference(gaussians: int = 100_000, *, seconds: float = 2.0) -> Against:
    """Times both; the reference is called once for each of two sizes after a call that warms it up."""
    slow = []
    for width, height in SIZES:
        subject = training(room(gaussians), width=width, height=height, views=1, backend="reference")
        subject.task(0)
        started = time.process_time()
        subject.task(0)
        slow.append(1e3 * (time.process_time() - started))
        del subject
        gc.collect()
    small, large = (width * height for width, height in SIZES)
    slope = (slow[1] - slow[0]) / (large - small)
    quick = []
    for width, height in (SIZES[1], FULL):
        subject = training(room(gaussians), width=width, height=height, views=1)
        quick.append(measure(subject.task, 1, seconds))
    return Against(
        gaussians, quick[0].cpu_min, slow[1], quick[1].cpu_min, slow[1] + slope * (FULL[0] * FULL[1] - large)
    )
