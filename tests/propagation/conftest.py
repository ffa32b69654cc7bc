import importlib.util

import pytest

from rf3dgs.propagation import sionna
from rf3dgs.propagation.llvm import find_llvm
from rf3dgs.propagation.sites.lobby import lobby


@pytest.fixture(scope="session")
def site():
    return lobby()


@pytest.fixture(scope="session")
def tracer():
    """The ray tracer's module; skips where sionna-rt or LLVM is missing."""
    if importlib.util.find_spec("sionna") is None:
        pytest.skip("sionna-rt is not installed")
    if find_llvm().path is None:
        pytest.skip(f"no LLVM for the ray tracer: {find_llvm().reason}")
    return sionna
