"""What decides the bits of a traced path besides the arguments: versions, LLVM, processor, and the scene itself."""

import ctypes
import hashlib
import platform
from dataclasses import fields, is_dataclass
from functools import cache, lru_cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

import numpy as np
import torch

from rf3dgs.propagation.llvm import find_llvm
from rf3dgs.propagation.sites.scene import Scene

PACKAGES = ("rf3dgs", "sionna-rt", "mitsuba", "drjit", "torch", "numpy", "h5py", "pillow")


@cache
def toolchain() -> dict[str, str]:
    """Versions of the packages, of LLVM, and the processor that LLVM compiles for; asked once per process.

    Two machines with the same answer compute the same bits. Without an LLVM that works, "llvm" is "none".
    """
    found = {name: _version(name) for name in PACKAGES}
    library = find_llvm().path
    if library is None:
        return found | {"llvm": "none", "processor": f"{platform.machine()} {platform.processor()}".strip()}
    llvm = ctypes.CDLL(str(library))
    numbers = [ctypes.c_uint() for _ in range(3)]
    llvm.LLVMGetVersion(*(ctypes.byref(number) for number in numbers))
    llvm.LLVMGetHostCPUName.restype = llvm.LLVMGetHostCPUFeatures.restype = ctypes.c_char_p
    name, features = llvm.LLVMGetHostCPUName().decode(), llvm.LLVMGetHostCPUFeatures()
    # A virtual machine may hide instructions of its processor: the name alone does not say what LLVM will use.
    used = hashlib.sha256(b",".join(sorted(features.split(b",")))).hexdigest()[:8]
    return found | {
        "llvm": ".".join(str(number.value) for number in numbers),
        "processor": f"{platform.machine()} {name}, instructions {used}",
    }


@lru_cache(maxsize=2)
def scene_of_run(scene: str | Scene, run: str) -> Scene:
    """The scene `scene_of` builds, once per process and run: a process that serves several runs builds it anew."""
    from rf3dgs.propagation.sites.scenes import scene_of

    return scene_of(scene)


def made_by(scene: str | Scene, run: str) -> dict[str, str]:
    """The toolchain, and the fingerprint of the scene as this process builds it."""
    return {**toolchain(), "scene": fingerprint(scene_of_run(scene, run))}


def fingerprint(value: object) -> str:
    """The sha256 of a value made of dataclasses, tensors, arrays, sequences, mappings, numbers and texts.

    A path stands for the content of its file, wherever that lies.
    """
    digest = hashlib.sha256()
    _feed(digest, value)
    return digest.hexdigest()


def _feed(digest, value: object) -> None:
    if isinstance(value, torch.Tensor):
        value = value.detach().cpu().numpy()
    if isinstance(value, np.ndarray):
        digest.update(f"{value.dtype}{list(value.shape)}".encode())
        digest.update(np.ascontiguousarray(value).tobytes())
    elif isinstance(value, Path):
        digest.update(hashlib.sha256(value.read_bytes()).digest())
    elif is_dataclass(value) and not isinstance(value, type):
        digest.update(f"<{type(value).__name__}".encode())
        for item in fields(value):
            digest.update(f".{item.name}=".encode())
            _feed(digest, getattr(value, item.name))
    elif isinstance(value, dict):
        digest.update(b"{")
        for key in sorted(value):
            digest.update(f"{key!r}:".encode())
            _feed(digest, value[key])
    elif isinstance(value, list | tuple):
        digest.update(f"[{len(value)}".encode())
        for item in value:
            _feed(digest, item)
    elif value is None or isinstance(value, str | int | float | bool):
        digest.update(f"{type(value).__name__}:{value!r};".encode())
    else:
        raise TypeError(f"a {type(value).__name__} has no fingerprint")


def _version(package: str) -> str:
    try:
        return version(package)
    except PackageNotFoundError:
        return "none"
