"""How many threads there are, and work that gives the same bits on any number of them.

The native core sums in one order on any number of threads. torch cuts its sums by the number of its threads: it works
on one where a rounding error would be carried on by thousands of steps, and independent pieces share the threads.
"""

import os
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from contextvars import ContextVar, copy_context
from typing import TypeVar

import torch

from rf3dgs.core.errors import InputError

Item = TypeVar("Item")
Result = TypeVar("Result")

_given: ContextVar[int | None] = ContextVar("threads that torch had before it was kept to one", default=None)
_shared: ContextVar[bool] = ContextVar("whether the threads are at work on pieces of which this is one", default=False)


def thread_count() -> int:
    """Threads the core uses: RF3DGS_THREADS if set, else torch's number, never more than this process may run on.

    One in a piece of work that `on_threads` shares out.
    """
    wish = os.environ.get("RF3DGS_THREADS")
    if wish is not None and not (wish.isdecimal() and int(wish) > 0):
        raise InputError(f"RF3DGS_THREADS must be a positive whole number; got {wish!r}")
    if _shared.get():
        return 1
    available = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    of_torch = _given.get() or torch.get_num_threads()
    return max(1, min(available, of_torch if wish is None else int(wish)))


@contextmanager
def one_torch_thread() -> Iterator[None]:
    """torch works on one thread, and `thread_count` stays what it is."""
    before = torch.get_num_threads()
    token = _given.set(_given.get() or before)
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)
        _given.reset(token)


def on_threads(work: Callable[[Item], Result], items: Iterable[Item]) -> list[Result]:
    """What `work` makes of each of the items, in their order; they share the threads, and each has one.

    No item's work may read what another's writes.
    """
    every, threads = list(items), thread_count()
    if threads == 1 or len(every) < 2:
        with one_torch_thread():
            return [work(item) for item in every]
    with one_torch_thread(), ThreadPoolExecutor(threads) as pool:
        shared = copy_context()
        shared.run(_shared.set, True)
        return [done.result() for done in [pool.submit(shared.copy().run, work, item) for item in every]]
