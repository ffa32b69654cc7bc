"""The rows of the table: what each times and what is asked of it."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache

from benchmarks.speed.floor import TWO_ZEN5_CORES, Machine, floor_ms
from benchmarks.speed.scenes import merged_room, room
from benchmarks.speed.subjects import Subject, rendering, training
from benchmarks.speed.timing import Timing, measure, measure_run

# The milliseconds that are asked for hold for two Zen 5 cores, on which a frozen RGB step of 100,000 Gaussians takes at
# least 1.9 ms of the clock.
ASKED_FLOOR_MS = 1.9
RADIO_VIEWS = 640
RADIO_STEPS = 10_000


@dataclass(frozen=True)
class Row:
    """What is timed, with must and goal as ratios to the floor or else in ms of the clock on two Zen 5 cores."""

    label: str
    subject: Callable[[], Subject]
    ratios: tuple[float, float] | None = None
    zen5_ms: tuple[float, float] | None = None
    run: bool = False  # timed as one run in the order of training, not as the least of many calls


ROWS = (
    Row("render RGB, 50k", lambda: rendering(room(50_000)), ratios=(2.5, 1.6)),
    Row("render RGB, 100k", lambda: rendering(room(100_000)), ratios=(2.5, 1.6)),
    Row("render RGB, 200k", lambda: rendering(room(200_000)), ratios=(2.5, 1.6)),
    Row("frozen step RGB, 100k", lambda: training(room(100_000)), ratios=(2.1, 1.3)),
    Row("frozen step 1 ch, 100k", lambda: training(room(100_000, channels=1)), ratios=(2.1, 1.3)),
    Row("radio stage step RGB, 100k", lambda: training(room(100_000), views=RADIO_VIEWS), zen5_ms=(4.0, 2.5), run=True),
    Row("full step RGB, 100k", lambda: training(room(100_000), frozen=False), zen5_ms=(11.0, 5.0)),
    Row("sphere 360x180 1 ch, 100k", lambda: rendering(room(100_000, channels=1), sphere=True), zen5_ms=(5.0, 3.0)),
    Row("1M merged: render 1 ch", lambda: rendering(merged_room()), zen5_ms=(8.0, 5.0)),
    Row("1M merged: frozen step 1 ch", lambda: training(merged_room()), zen5_ms=(20.0, 10.0)),
)


@dataclass(frozen=True)
class Result:
    """A timed row, its floor [CPU ms of all threads], and what is asked for as ratios to the floor."""

    label: str
    timing: Timing
    floor_ms: float
    must: float
    goal: float

    @property
    def ratio(self) -> float:
        return self.timing.cpu_min / self.floor_ms

    @property
    def verdict(self) -> str:
        return "goal met" if self.ratio <= self.goal else "must met" if self.ratio <= self.must else "not met"


def time_row(row: Row, machine: Machine, *, seconds: float, steps: int) -> Result:
    """Times a row for about `seconds`, or one run of `steps`."""
    subject = row.subject()
    timing = (
        measure_run(subject.task, subject.views, steps) if row.run else measure(subject.task, subject.views, seconds)
    )
    must, goal = row.ratios or asked_ratios(row, subject)
    return Result(row.label, timing, floor_ms(subject.phases, machine), must, goal)


def asked_ratios(row: Row, subject: Subject) -> tuple[float, float]:
    """Must and goal of a row that is asked for in milliseconds, as ratios to the floor on the machine they hold for.

    That floor is the model's, scaled so that the frozen RGB step takes `ASKED_FLOOR_MS`.
    """
    assert row.zen5_ms is not None
    floor = _zen5_ms(subject) * ASKED_FLOOR_MS / _frozen_step_on_zen5()
    return row.zen5_ms[0] / floor, row.zen5_ms[1] / floor


@cache
def _frozen_step_on_zen5() -> float:
    return _zen5_ms(training(room(100_000)))


def _zen5_ms(subject: Subject) -> float:
    return floor_ms(subject.phases, TWO_ZEN5_CORES) / TWO_ZEN5_CORES.threads
