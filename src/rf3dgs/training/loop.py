"""The one training loop of both stages: steps, progress, checkpoints, resume, and what to do when something breaks.

A run that is killed and started again ends bitwise where an uninterrupted one ends (on the CPU), because everything
random is a pure function of (seed, iteration) and everything else is in the stage's state.
"""

import contextlib
import hashlib
import math
import signal
import threading
import time
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Protocol

import torch

from rf3dgs.core.errors import TrainingError
from rf3dgs.core.progress import Progress, Silent
from rf3dgs.training.checkpoint import CheckpointFolder, State, locked

GUARD_EVERY = 100


class Stage(Protocol):
    """What the loop drives: the visual or the radio stage."""

    def step(self, iteration: int) -> float:
        """Do iteration 0, 1, ... (one view, one update) and return its loss."""
        ...

    def state(self) -> State:
        """Everything needed to go on after the last step."""
        ...

    def restore(self, state: State) -> None:
        """Continue from a state."""
        ...


class TrainingStopped(TrainingError):
    """A signal stopped the run after its checkpoint had been written; starting it again goes on from there."""


def train(
    stage: Stage,
    steps: int,
    *,
    label: str,
    identity: Mapping[str, object],
    progress: Progress | None = None,
    checkpoint_dir: str | Path | None = None,
    every_steps: int = 1_000,
    every_seconds: float = 30.0,
) -> None:
    """Run `stage` for `steps` iterations; with a `checkpoint_dir`, go on from its newest whole checkpoint.

    `identity` (stage, configuration, data fingerprint; JSON-able) is what a checkpoint must share with this run. A
    checkpoint is written every `every_steps` iterations, or `every_seconds` seconds, and at the end. Raises
    `TrainingError` when the loss or a tensor is no longer finite (the last good checkpoint stays), when another process
    uses the folder, and as `TrainingStopped` after SIGINT or SIGTERM; `InputError` for a checkpoint of another run.
    """
    progress = Silent() if progress is None else progress
    with contextlib.ExitStack() as stack:
        folder, done = None, 0
        if checkpoint_dir is not None:
            folder = CheckpointFolder(checkpoint_dir, identity)
            stack.enter_context(locked(folder.folder))
            folder.sweep()
            found = folder.load_newest()
            if found is not None:
                done, state = found
                stage.restore(state)
        signals = stack.enter_context(caught_signals()) if folder is not None else []
        saved, saved_at, loss = done, time.monotonic(), math.nan
        progress.start(label, steps, done)
        while done < steps:
            loss = stage.step(done)
            done += 1
            due = done == steps or done - saved >= every_steps or time.monotonic() - saved_at >= every_seconds
            due = folder is not None and (due or bool(signals))
            if due or not math.isfinite(loss) or done % GUARD_EVERY == 0 or done == steps:
                state = stage.state()
                _guard(state, loss, label, done, folder)
                if folder is not None and due:
                    folder.save(done, state)
                    saved, saved_at = done, time.monotonic()
            progress.update(done, f"loss {loss:.4f}")
            if signals and done < steps:
                progress.finish(f"stopped by {signals[0]}")
                raise TrainingStopped(
                    f"{label} stopped by {signals[0]} at iteration {done} of {steps}; run it again to go on"
                )
        progress.finish(f"loss {loss:.4f}" if math.isfinite(loss) else "already finished")


def _guard(state: State, loss: float, label: str, done: int, folder: CheckpointFolder | None) -> None:
    """Raise `TrainingError`, naming the culprits, when the loss or a tensor is not finite."""
    broken = [name for name, tensor in state.tensors.items() if not bool(torch.isfinite(tensor).all())]
    if math.isfinite(loss) and not broken:
        return
    what = "values that are not finite in " + ", ".join(broken[:3]) if broken else f"a loss of {loss}"
    kept = "" if folder is None else f" The last good checkpoint stays in {folder.folder}."
    raise TrainingError(f"{label} met {what} at iteration {done}; check the data or lower the learning rates.{kept}")


@contextlib.contextmanager
def caught_signals() -> Iterator[list[str]]:
    """The names of SIGINT and SIGTERM received so far; a second signal acts as usual. Idle off the main thread."""
    received: list[str] = []
    if threading.current_thread() is not threading.main_thread():
        yield received
        return
    before = {int(number): signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}

    def note(number: int, _frame: object) -> None:
        received.append(signal.Signals(number).name)
        signal.signal(number, before[number])

    for number in before:
        signal.signal(number, note)
    try:
        yield received
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def random_at(seed: int, iteration: int, purpose: str) -> torch.Generator:
    """A generator that depends on seed, iteration and purpose alone, so that a resumed run draws the same numbers."""
    digest = hashlib.sha256(f"{seed}/{iteration}/{purpose}".encode()).digest()
    return torch.Generator().manual_seed(int.from_bytes(digest[:7], "little"))


def view_at(seed: int, iteration: int, count: int) -> int:
    """The view of an iteration: each of `count` views once per round, in a new random order every round."""
    order = torch.randperm(count, generator=random_at(seed, iteration // count, "views"))
    return int(order[iteration % count])
