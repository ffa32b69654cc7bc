"""Crews of processes through dask.distributed: some on this machine, or those of a scheduler that runs already.

Workers send the bytes of a shard back, and the process that asked writes them: no shared folder is needed, one process
holds the lock, and one place decides what is finished. A worker that dies loses its shard, which another one makes.
Every worker must have the versions and the processor type of the others; one that has not is refused with its name.
"""

import json
import logging
import tempfile
import threading
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from typing import TYPE_CHECKING, NamedTuple

from rf3dgs.core.errors import InputError, MissingDependencyError, RfError
from rf3dgs.core.manifest import difference
from rf3dgs.propagation.jobs.job import Each, Made, Task

if TYPE_CHECKING:
    from distributed import Client, Future

RETRIES = 2
"""How often a connection, or a shard that failed by no fault of its arguments, is tried again; dask counts dead workers
(3)."""
PATIENCE = 60.0
"""Seconds without any worker, or without an answer of the scheduler, after which the run gives up."""
AHEAD = 2
"""Shards per worker that are handed out at a time: few results wait in memory."""

_ALONE = threading.Lock()
"""Held by the task at work: the tracer is not made for two threads, and a foreign worker may have more than one."""


class Refusal(NamedTuple):
    """A worker's answer when it is not like the others."""

    worker: str
    difference: str


class DaskCrew:
    """The workers of a connected dask client."""

    def __init__(self, client: "Client", *, patience: float = PATIENCE) -> None:
        self._client, self._patience = client, patience

    def made_by(self, task: Task) -> Mapping[str, object]:
        """What every worker answers; InputError naming two that differ, RfError when one cannot work."""
        asked = {
            address: self._client.submit(_made_by, task, workers=[address], pure=False) for address in self._workers()
        }
        first: tuple[str, dict] | None = None
        for address, future in asked.items():
            try:
                answer = future.result(timeout=2 * self._patience)
            except RfError:
                raise
            except Exception as error:  # whatever the worker's machine lacks
                raise RfError(
                    f"the worker {address} cannot work ({type(error).__name__}: {error}); install the same rf3dgs "
                    "there as here"
                ) from error
            if first is None:
                first = address, answer
            found = difference(first[1], answer)
            if found:
                raise _stranger(address, found, f"than {first[0]}")
        assert first is not None
        return first[1]

    def work(self, tasks: Iterator[tuple[int, Task]], made_by: Mapping[str, object], each: Each) -> Iterator[Made]:
        """Yield shards as they come back; a failed one is tried again, then one error names it."""
        pending: dict[Future, tuple[int, Task, int]] = {}

        def hand_out(shard: int, task: Task, tries: int) -> None:
            with self._there():
                future = self._client.submit(_work, task, dict(made_by), pure=False)
            pending[future] = shard, task, tries

        try:
            while True:
                while len(pending) < AHEAD * max(1, len(self._threads())) and (item := next(tasks, None)):
                    hand_out(*item, 0)
                if not pending:
                    return
                for future in self._done(list(pending)):
                    shard, task, tries = pending.pop(future)
                    try:
                        result = future.result()
                    except Exception as error:  # a task may fail in any way
                        self._check_scheduler()
                        _give_up(shard, error, tries)
                        hand_out(shard, task, tries + 1)
                        continue
                    finally:
                        future.release()
                    if isinstance(result, Refusal):
                        raise _stranger(result.worker, result.difference, "than the others")
                    yield shard, result
        finally:
            with suppress(OSError, TimeoutError):
                self._client.cancel(list(pending))

    def _workers(self) -> list[str]:
        try:
            self._client.wait_for_workers(1, timeout=self._patience)
        except TimeoutError as error:
            raise RfError(
                f"the scheduler {self._address} has had no workers for {self._patience:g} seconds; start some and run "
                "the same command again"
            ) from error
        return sorted(self._threads())

    def _threads(self) -> dict[str, int]:
        """The workers that are there now, and their threads."""
        with self._there():
            return dict(self._client.nthreads())  # type: ignore[arg-type]

    def _check_scheduler(self) -> None:
        if self._client.status not in ("running", "connecting"):
            raise self._gone()

    @contextmanager
    def _there(self) -> Iterator[None]:
        """Turn a scheduler that is no longer there into one sentence."""
        from distributed import CancelledError

        try:
            yield
        except (OSError, CancelledError) as error:
            raise self._gone() from error

    def _gone(self) -> RfError:
        return RfError(f"the scheduler {self._address} is gone; finished shards are kept: run the same command again")

    def _done(self, futures: "list[Future]") -> "list[Future]":
        """Those that ended, at least one; RfError when nobody has been there to work on them for a while."""
        from distributed import wait

        alone_since = None
        while True:
            with self._there(), suppress(TimeoutError):
                wait(futures, timeout=1.0, return_when="FIRST_COMPLETED")
            self._check_scheduler()
            # A future is "lost" for a moment when the worker that kept its result dies; dask makes it again.
            if any(future.cancelled() for future in futures):
                raise self._gone()
            ended = [future for future in futures if future.done()]
            if ended:
                return ended
            if self._client.status == "running" and self._threads():
                alone_since = None
                continue
            alone_since = time.monotonic() if alone_since is None else alone_since
            if time.monotonic() - alone_since > self._patience:
                raise RfError(
                    f"the scheduler {self._address} has had no workers for {self._patience:g} seconds; finished shards "
                    "are kept: start workers and run the same command again"
                )

    @property
    def _address(self) -> str:
        return str(self._client.scheduler.address) if self._client.scheduler is not None else "of this cluster"


@contextmanager
def local_processes(count: int) -> Iterator[DaskCrew]:
    """`count` processes on this machine, which listen on 127.0.0.1 alone and end with the block."""
    if count < 1:
        raise InputError(f"the number of workers must be at least 1; got {count}")
    _need_distributed()
    from distributed import Client, LocalCluster

    with (
        _quiet(),
        tempfile.TemporaryDirectory(prefix="rf3dgs-", ignore_cleanup_errors=True) as scratch,
        LocalCluster(
            n_workers=count,
            threads_per_worker=1,
            processes=True,
            host="127.0.0.1",
            dashboard_address="127.0.0.1:0",
            memory_limit=0,
            local_directory=scratch,
            silence_logs=logging.CRITICAL,
        ) as cluster,
        Client(cluster, direct_to_workers=True) as client,
    ):
        yield DaskCrew(client)


@contextmanager
def existing_cluster(address: str) -> Iterator[DaskCrew]:
    """The workers of the dask scheduler at `address` (tcp://host:port or tls://host:port), which goes on after it."""
    if not address.startswith(("tcp://", "tls://")) or address.count(":") < 2:
        raise InputError(f"a cluster is given as tcp://host:port or tls://host:port; got {address!r}")
    _need_distributed()
    with _quiet(), _connected(address) as client:
        yield DaskCrew(client)


def _connected(address: str, tries: int = 1 + RETRIES) -> "Client":
    """A client of the scheduler at `address`; InputError when none answers.

    A client asserts that the first batch it reads holds the greeting alone, but a scheduler that has news for all of
    its clients in those two milliseconds sends both in one batch: connecting again is all there is to do.
    """
    from distributed import Client

    try:
        return Client(address, timeout=PATIENCE / 2)
    except (OSError, TimeoutError, ValueError, AssertionError) as error:
        if isinstance(error, AssertionError) and tries > 1:
            return _connected(address, tries - 1)
        raise InputError(
            f"no dask scheduler answers at {address} ({type(error).__name__}); start one with dask scheduler, or look "
            "at the address and the firewall"
        ) from error


@contextmanager
def _quiet() -> Iterator[None]:
    """Keep dask's diary out of the terminal: what matters to the user is an error of ours."""
    logger = logging.getLogger("distributed")
    before = logger.level
    logger.setLevel(logging.CRITICAL)
    try:
        yield
    finally:
        logger.setLevel(before)


def _need_distributed() -> None:
    try:
        import distributed  # noqa: F401
    except ImportError as error:
        raise MissingDependencyError(
            f"workers need dask.distributed ({error}): pip install 'rf3dgs[cluster]'"
        ) from error


def _made_by(task: Task) -> dict:
    """What a worker answers, as it comes back from JSON."""
    return json.loads(json.dumps(dict(task.made_by())))


def _work(task: Task, made_by: dict) -> Mapping[str, bytes] | Refusal:
    """On the worker: the files of the shard, unless this worker, which may have come late, is not like the others."""
    from distributed import get_worker

    with _ALONE:
        found = difference(made_by, _made_by(task))
        return Refusal(get_worker().address, found) if found else task.make(lambda: None)


def _stranger(worker: str, found: str, than: str) -> InputError:
    """The error about a worker that would make other bytes."""
    return InputError(
        f"the worker {worker} has another {found.replace('this run has', 'the worker has')} {than}, so its bytes would "
        "differ; use workers of one installation and one processor type"
    )


def _give_up(shard: int, error: Exception, tries: int) -> None:
    """Raise when trying again is of no use or was of none."""
    from distributed import KilledWorker

    kept = "finished shards are kept"
    if isinstance(error, KilledWorker):
        raise RfError(
            f"shard {shard}: {error.allowed_failures + 1} workers died while they worked on it, perhaps for lack of "
            f"memory; {kept}: look at the workers' logs and run the same command again"
        ) from error
    if isinstance(error, RfError):
        raise type(error)(f"shard {shard}: {error}") from error
    if tries >= RETRIES:
        raise RfError(
            f"shard {shard} failed {tries + 1} times, last with {type(error).__name__}: {error}; {kept}: mend that and "
            "run the same command again"
        ) from error
