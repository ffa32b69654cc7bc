"""Writing files and folders so that a reader never meets half of one.

Everything is built under a hidden `.NAME.HEX.partial` name in the same folder, brought to the disk, and renamed into
place. A process that is killed leaves only such a partial name behind, which `remove_partials` sweeps away.
"""

import errno
import os
import secrets
import shutil
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from rf3dgs.core.errors import DataError

_DISK_ERRORS = {errno.ENOSPC, errno.EDQUOT, errno.EROFS, errno.EACCES, errno.EPERM, errno.EFBIG, errno.ENAMETOOLONG}
_DISK_ERRORS |= {errno.ENOTDIR, errno.EEXIST, errno.EISDIR}  # a file where a folder should be, or the other way round


@contextmanager
def atomic_file(path: str | Path) -> Iterator[Path]:
    """Yield a temporary path with the suffix of `path`; when the block ends well it becomes `path`, else it is removed.

    The parent folder is made if need be. Raises DataError naming `path` when the disk is full, read-only or forbidden;
    an older file of that name stays untouched then.
    """
    path = Path(path)
    temporary = _partial(path, keep_suffix=True)
    with _disk_errors(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        temporary.touch(exist_ok=False)
        try:
            yield temporary
            _sync(temporary)
            temporary.replace(path)
        except BaseException:
            temporary.unlink(missing_ok=True)
            raise
        _sync(path.parent)


def write_whole(path: str | Path, content: bytes) -> None:
    """Write `content` as the file `path`, at once or not at all; DataError as of `atomic_file`."""
    with atomic_file(path) as temporary:
        temporary.write_bytes(content)


@contextmanager
def atomic_folder(path: str | Path) -> Iterator[Path]:
    """Yield an empty temporary folder; when the block ends well it becomes `path`, else it is removed.

    An older folder of that name is moved aside, replaced and then deleted. Raises DataError naming `path` as
    `atomic_file` does, also where `path` is a file.
    """
    path = Path(path)
    temporary, old = _partial(path), _partial(path)
    with _disk_errors(path):
        if path.exists() and not path.is_dir():
            raise DataError(f"{path} is a file, but a folder is to be written there; remove it or choose another name")
        path.parent.mkdir(parents=True, exist_ok=True)
        temporary.mkdir()
        try:
            yield temporary
            for item in sorted(temporary.rglob("*")):
                _sync(item)
            _sync(temporary)
            if path.exists():
                path.rename(old)
            try:
                temporary.rename(path)
            except BaseException:
                if old.exists():
                    old.rename(path)
                raise
        except BaseException:
            shutil.rmtree(temporary, ignore_errors=True)
            raise
        _sync(path.parent)
        shutil.rmtree(old, ignore_errors=True)


def remove_partials(folder: str | Path, *, older_than: float = 3600.0) -> list[Path]:
    """Delete what killed writers left in `folder` at least `older_than` seconds ago; returns the names deleted."""
    removed = []
    for item in sorted(Path(folder).glob(".*.partial*")):
        if time.time() - item.lstat().st_mtime < older_than:
            continue
        if item.is_dir() and not item.is_symlink():
            shutil.rmtree(item, ignore_errors=True)
        else:
            item.unlink(missing_ok=True)
        removed.append(item)
    return removed


def _partial(path: Path, *, keep_suffix: bool = False) -> Path:
    """An unguessable name beside `path`; writers that choose a format by suffix see the right one."""
    return path.with_name(f".{path.name}.{secrets.token_hex(6)}.partial{path.suffix if keep_suffix else ''}")


def _sync(path: Path) -> None:
    """Bring a file or a folder's list of names to the disk; systems that cannot sync a folder are left in peace."""
    if path.is_symlink():
        return
    try:
        handle = os.open(path, os.O_RDONLY)
    except PermissionError:
        if path.is_dir():
            return
        raise
    try:
        os.fsync(handle)
    except OSError as error:
        if not (path.is_dir() and error.errno in {errno.EINVAL, errno.EBADF, errno.ENOTSUP}):
            raise
    finally:
        os.close(handle)


@contextmanager
def _disk_errors(path: Path) -> Iterator[None]:
    """Turn the operating system's refusal to write into one sentence that names `path`."""
    try:
        yield
    except OSError as error:
        if error.errno not in _DISK_ERRORS:
            raise
        raise DataError(f"cannot write {path}: {error.strerror}; free space or choose another folder") from error
