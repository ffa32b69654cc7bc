"""The lock that keeps two runs out of one folder."""

import contextlib
import json
import os
import socket
import time
from collections.abc import Iterator
from pathlib import Path

from rf3dgs.core.errors import DataError, RfError

LOCK = "lock.json"


@contextlib.contextmanager
def locked(folder: str | Path, *, error: type[RfError] = DataError, called: str = "folder") -> Iterator[None]:
    """Hold `folder` for this process: a file `lock.json` with pid and host.

    The lock of a process that is gone is taken over; that of a living one (or one on another host, which cannot be
    asked) raises `error`, whose message calls the folder what `called` says.
    """
    path = Path(folder) / LOCK
    mine = {"pid": os.getpid(), "host": socket.gethostname(), "began": _birth(os.getpid()), "at": time.time_ns()}
    _take(path, mine, error, called)
    try:
        yield
    finally:
        if _holder(path) == mine:
            path.unlink(missing_ok=True)


def _take(path: Path, mine: dict, error: type[RfError], called: str) -> None:
    """Create the lock, after putting aside one whose owner is gone."""
    for _ in range(8):
        try:
            with os.fdopen(os.open(path, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o644), "w") as file:
                json.dump(mine, file)
                return
        except FileExistsError:
            holder = _holder(path)
            if _alive(holder, path):
                raise error(
                    f"{path.parent} is in use by process {holder.get('pid')} on {holder.get('host')}; wait for it, "
                    f"use another {called}, or delete {path} if that run is gone"
                ) from None
            aside = path.with_name(f"lock.{mine['pid']}.{mine['at']}.stale")
            with contextlib.suppress(FileNotFoundError):
                path.rename(aside)
                if _holder(aside) != holder:
                    aside.rename(path)
                aside.unlink(missing_ok=True)
    raise error(f"cannot take the lock {path}: other runs keep taking it; use another {called}")


def _holder(path: Path) -> dict:
    """What the lock file says; an empty mapping when it is missing or unreadable."""
    try:
        holder = json.loads(path.read_bytes())
        return holder if isinstance(holder, dict) else {}
    except (OSError, ValueError):
        return {}


def _alive(holder: dict, path: Path) -> bool:
    """Whether the lock's owner may still run. An unreadable lock counts as alive while it is being written."""
    pid = holder.get("pid")
    if not isinstance(pid, int) or pid < 1:
        with contextlib.suppress(OSError):
            return time.time() - path.stat().st_mtime < 2.0
        return False
    if holder.get("host") != socket.gethostname():
        return True
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        pass
    return holder.get("began") == _birth(pid)


def _birth(pid: int) -> str:
    """The process's start time in kernel ticks, which tells a reused pid from the old one; empty where unknown."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[19]
    except (OSError, IndexError):
        return ""
