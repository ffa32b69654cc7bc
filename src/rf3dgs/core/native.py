"""Finds the native core and says how many threads it may use."""

import importlib
import os
from functools import cache
from types import ModuleType

import torch

from rf3dgs.core.errors import InputError


@cache
def _load() -> tuple[ModuleType | None, str]:
    try:
        return importlib.import_module("rf3dgs._native"), ""
    except ImportError as error:
        return None, str(error)


def native_core() -> ModuleType | None:
    """The compiled module, or None where it was not built or cannot be loaded."""
    return _load()[0]


def native_failure() -> str:
    """Why the compiled module cannot be loaded; empty when it can."""
    return _load()[1]


def thread_count() -> int:
    """Threads the core uses: RF3DGS_THREADS if set, else torch's number, never more than this process may run on."""
    wish = os.environ.get("RF3DGS_THREADS")
    if wish is not None and not (wish.isdecimal() and int(wish) > 0):
        raise InputError(f"RF3DGS_THREADS must be a positive whole number; got {wish!r}")
    available = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return max(1, min(available, torch.get_num_threads() if wish is None else int(wish)))
