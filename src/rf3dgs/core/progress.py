"""Progress through an object that the caller gives; libraries never print."""

import sys
import time
from collections.abc import Iterable, Iterator
from typing import Protocol, TextIO, TypeVar

Item = TypeVar("Item")


class Progress(Protocol):
    """Receives the state of a long run."""

    def start(self, label: str, total: int, done: int = 0) -> None:
        """A run of `total` steps begins, `done` of them already finished (a resumed run)."""
        ...

    def update(self, done: int, note: str = "") -> None:
        """`done` steps are finished; `note` is a short text such as the current loss."""
        ...

    def finish(self, note: str = "") -> None:
        """The run has ended."""
        ...


class Silent:
    """The default: says nothing."""

    def start(self, label: str, total: int, done: int = 0) -> None: ...

    def update(self, done: int, note: str = "") -> None: ...

    def finish(self, note: str = "") -> None: ...


class Console:
    """A line with bar, rate and time left on a terminal; plain lines every few seconds elsewhere."""

    def __init__(self, stream: TextIO | None = None, *, plain_every: float = 5.0) -> None:
        self.stream = sys.stderr if stream is None else stream
        self.plain_every = plain_every
        self._label, self._total, self._first, self._done = "", 1, 0, 0
        self._began = self._shown = 0.0

    def start(self, label: str, total: int, done: int = 0) -> None:
        self._label, self._total, self._first, self._done = label, max(total, 1), done, done
        self._began = time.monotonic()
        self._shown = self._began - (0.0 if not self.stream.isatty() else self.plain_every)

    def update(self, done: int, note: str = "") -> None:
        self._done = done
        now = time.monotonic()
        if now - self._shown >= (0.1 if self.stream.isatty() else self.plain_every):
            self._shown = now
            self._write(self._line(now, note), last=False)

    def finish(self, note: str = "") -> None:
        seconds = time.monotonic() - self._began
        self._write(f"{self._label}: {self._done}/{self._total} in {seconds:.1f} s  {note}".rstrip(), last=True)

    def _line(self, now: float, note: str) -> str:
        steps = self._done - self._first
        rate = steps / max(now - self._began, 1e-9)
        left = (self._total - self._done) / rate if rate > 0 else float("inf")
        filled = round(20 * self._done / self._total)
        bar = "#" * filled + "-" * (20 - filled) if self.stream.isatty() else ""
        eta = "estimating" if left == float("inf") else f"{duration(left)} left"
        return " ".join(f"{self._label} {bar} {self._done}/{self._total} {rate:.1f}/s {eta} {note}".split())[:79]

    def _write(self, text: str, *, last: bool) -> None:
        if self.stream.isatty():
            self.stream.write(f"\r{text:<79}" + ("\n" if last else ""))
        else:
            self.stream.write(text + "\n")
        self.stream.flush()


def duration(seconds: float) -> str:
    """A time in words: "42 s", "3 min 20 s", "14 h 5 min"."""
    whole = round(seconds)
    if whole < 60:
        return f"{whole} s"
    minutes, rest = divmod(whole, 60)
    return f"{minutes} min {rest} s" if minutes < 60 else f"{minutes // 60} h {minutes % 60} min"


def track(items: Iterable[Item], label: str, total: int, progress: Progress) -> Iterator[Item]:
    """Yield `items` while reporting each to `progress`."""
    progress.start(label, total)
    for done, item in enumerate(items, start=1):
        yield item
        progress.update(done)
    progress.finish()
