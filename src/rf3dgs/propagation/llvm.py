"""Finds an LLVM that the ray tracer's compiler accepts, without risking this process.

Dr.Jit loads LLVM at its first computation. It refuses version 14; with 15 and 16 it computes small things, then aborts
the whole process when a scene is traced. So each candidate is tried, and asked for its version, in a process of its
own.
"""

import os
import re
import subprocess
import sys
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from types import ModuleType
from typing import NamedTuple

from rf3dgs.core.errors import MissingDependencyError

VERSIONS = (19, 20, 18, 17)
FOLDERS = (
    "/usr/lib/*-linux-gnu",
    "/usr/lib64",
    "/usr/lib",
    "/usr/lib/llvm-*/lib",
    "/usr/lib64/llvm*/lib",
    "/usr/local/lib",
    "/opt/homebrew/opt/llvm*/lib",
    "/usr/local/opt/llvm*/lib",
)
VARIABLE = "DRJIT_LIBLLVM_PATH"
INSTALL = "install libllvm19 (Debian: apt-get install libllvm19) or set DRJIT_LIBLLVM_PATH to a libLLVM 17 to 20"

_PROBE = """
import drjit as dr
from drjit.llvm import Float
x = dr.arange(Float, 8)
assert dr.sum(x * x)[0] == 140.0
version = dr.detail.llvm_version()
assert version[0] >= 17, "this is LLVM %d.%d.%d" % version
"""


class Llvm(NamedTuple):
    """`path` of a working library, or None; `reason` says in words what was found."""

    path: Path | None
    reason: str


def candidates() -> list[Path]:
    """The LLVM libraries of this machine in the order in which they are tried; the environment's own choice first."""
    chosen = os.environ.get(VARIABLE)
    if chosen:
        return [Path(chosen)]
    found: dict[Path, int] = {}
    for folder in FOLDERS:
        root = Path("/")
        for path in sorted(root.glob(folder.lstrip("/") + "/libLLVM*")):
            version = re.search(r"libLLVM[-.](?:so\.)?(\d+)", path.name)
            if version and int(version[1]) in VERSIONS and path.exists():
                found.setdefault(path.resolve(), int(version[1]))
    return sorted(found, key=lambda path: VERSIONS.index(found[path]))


def probe(path: Path) -> str:
    """Empty when Dr.Jit computes with this library in a process of its own, else the reason why it does not."""
    environment = {**os.environ, VARIABLE: str(path)}
    command = [sys.executable, "-c", _PROBE]
    try:
        run = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=60, check=False)
    except (OSError, subprocess.TimeoutExpired) as error:
        return f"{path}: {error}"
    if run.returncode == 0:
        return ""
    last = (run.stderr.strip().splitlines() or ["no message"])[-1]
    return f"{path}: exit {run.returncode}: {last}"


@cache
def find_llvm() -> Llvm:
    """The first LLVM library that works with Dr.Jit here; asked once per process."""
    faults = []
    for path in candidates():
        fault = probe(path)
        if not fault:
            return Llvm(path, f"LLVM works: {path}")
        faults.append(fault)
    return Llvm(None, "; ".join(faults) if faults else "no libLLVM 17 to 20 found")


def prepare() -> Path:
    """Point Dr.Jit to a working LLVM; call before anything is traced. Raises MissingDependencyError without one."""
    found = find_llvm()
    if found.path is None:
        raise MissingDependencyError(f"the ray tracer needs LLVM 17 to 20 ({found.reason}); {INSTALL}")
    os.environ[VARIABLE] = str(found.path)
    return found.path


@contextmanager
def mitsuba_variant(name: str) -> Iterator[None]:
    """Mitsuba computes with the variant `name` inside the block; the one before, if any, comes back after it."""
    import mitsuba

    before = mitsuba.variant()
    if before != name:
        _switch(mitsuba, name)
    try:
        yield
    finally:
        if before is not None and before != name:
            _switch(mitsuba, before)


def _switch(mitsuba: ModuleType, name: str) -> None:
    """Change the variant; Sionna then compiles one of its modules anew, and Dr.Jit warns when that adds up."""
    with warnings.catch_warnings():
        warnings.filterwarnings(
            "ignore", message="The AST-transforming decorator @drjit.syntax", category=RuntimeWarning
        )
        mitsuba.set_variant(name)
