"""`info`, `validate` and `doctor`: what a file holds, what is wrong with a folder, what works on this machine."""

import json
import os
import platform
import shutil
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import tyro

from rf3dgs import __version__
from rf3dgs.cli.show import out, table


@dataclass(frozen=True)
class Info:
    """Say what a field, a dataset, a file of paths or a .ply holds."""

    path: tyro.conf.Positional[Path]
    """A .field folder, a dataset folder, a file or folder of paths, or a .ply file."""

    def run(self) -> int:
        """Print the facts as lines of name and value."""
        from rf3dgs.cli.facts import facts_of

        out(table([(name, value) for name, value in facts_of(self.path).items()]))
        return 0


@dataclass(frozen=True)
class Validate:
    """Look for faults in a dataset folder, ours or a foreign one; each is named with its file and the remedy."""

    folder: tyro.conf.Positional[Path]
    """The dataset folder."""

    def run(self) -> int:
        """Print the faults; exit status 1 when there are any."""
        from rf3dgs.data.validate import validate

        faults = validate(self.folder)
        for fault in faults:
            out(f"{fault.file}: {fault.what}\n    {fault.remedy}")
        out(f"{self.folder}: {len(faults)} fault{'s' * (len(faults) != 1)} found" if faults else f"{self.folder}: good")
        return 1 if faults else 0


@dataclass(frozen=True)
class Doctor:
    """Say what works on this machine: native core, ray tracer, GPU, browser."""

    format: Literal["text", "json"] = "text"
    """How the answer is written."""

    def run(self) -> int:
        """Print each check; exit status 1 only if the package's own core cannot work."""
        checks = [_python(), _native(), _tracer(), _cuda(), _sfm(), _browser(), _lpips()]
        if self.format == "json":
            out(json.dumps([dict(zip(("what", "works", "detail"), check, strict=True)) for check in checks], indent=1))
        else:
            out(table([(what, "yes" if works else "no", detail) for what, works, detail in checks]))
        return 0 if checks[1][1] else 1


Check = tuple[str, bool, str]


def _python() -> Check:
    import torch

    threads = torch.get_num_threads()
    return (
        "rf3dgs",
        True,
        f"{__version__}, Python {platform.python_version()}, torch {torch.__version__}, {threads} threads",
    )


def _native() -> Check:
    from rf3dgs.splats.rasterize import pick_backend

    name, reason = pick_backend()
    return "native core", name == "native", reason


def _tracer() -> Check:
    from rf3dgs.propagation.llvm import find_llvm

    try:
        import importlib.util

        if importlib.util.find_spec("sionna") is None:
            return "ray tracer", False, 'sionna-rt is not installed: pip install "rf3dgs[trace]"'
        library, reason = find_llvm()
    except ImportError as error:
        return "ray tracer", False, str(error)
    return "ray tracer", library is not None, f"LLVM {library}" if library else reason


def _cuda() -> Check:
    import torch

    if not torch.cuda.is_available():
        return "CUDA", False, "no CUDA device, or a CPU build of torch; the CPU does everything"
    import importlib.util

    device = torch.cuda.get_device_name(0)
    if importlib.util.find_spec("gsplat") is None:
        return "CUDA", False, f'{device}, but gsplat is not installed: pip install "rf3dgs[cuda]"'
    return "CUDA", True, device


def _sfm() -> Check:
    import importlib.util

    works = importlib.util.find_spec("pycolmap") is not None
    return "poses from photos", works, "pycolmap" if works else 'pip install "rf3dgs[sfm]"'


def _browser() -> Check:
    found = next(
        (path for name in ("chromium", "chromium-browser", "google-chrome") if (path := shutil.which(name))), None
    )
    return "browser", found is not None, found or "none found; any browser on another machine shows reports as well"


def _lpips() -> Check:
    file = os.environ.get("RF3DGS_LPIPS", "")
    works = bool(file) and Path(file).exists()
    return "LPIPS weights", works, file if works else "not available; set RF3DGS_LPIPS to your own weights"
