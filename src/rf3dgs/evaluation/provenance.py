"""What a result was made with: versions and the kind of machine, without names or paths."""

import os
import platform
from importlib import metadata
from pathlib import Path

import torch

PACKAGES = ("rf3dgs", "torch", "numpy", "sionna-rt", "mitsuba", "gsplat", "matplotlib")


def versions() -> dict[str, str]:
    """Python's version and those of the installed packages that matter."""
    found = {"Python": platform.python_version()}
    for name in PACKAGES:
        try:
            found[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            continue
    return found


def machine() -> dict[str, str]:
    """Processor model, threads, system and GPU; neither host name nor user nor path."""
    about = {
        "Processor": processor(),
        "Threads": f"{torch.get_num_threads()} of {os.cpu_count()}",
        "System": f"{platform.system()} {platform.machine()}",
    }
    if torch.cuda.is_available():
        about["GPU"] = torch.cuda.get_device_name()
    return about


def processor() -> str:
    """The processor's model name, or its architecture where the system does not tell."""
    info = Path("/proc/cpuinfo")
    if info.is_file():
        for line in info.read_text(errors="replace").splitlines():
            if line.startswith("model name") and ":" in line:
                return line.split(":", 1)[1].strip()
    return platform.processor() or platform.machine()
