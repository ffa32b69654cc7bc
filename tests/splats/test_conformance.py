"""Every backend against the float64 reference: pictures, and gradients of every parameter."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
from tests.splats.conformance import CASES, check, check_resampled

from rf3dgs.core.native import native_core

ROOT = Path(__file__).parents[2]
ACROSS = [
    "pinhole, 3 channels",
    "pinhole, 11 channels",
    "pinhole, background",
    "pinhole, all, dense",
    "pinhole, fuzzed 1",
]


@pytest.mark.parametrize("name", CASES)
def test_the_reference_in_float32_agrees_with_itself_in_float64(name: str):
    check(CASES[name], "reference")


@pytest.mark.skipif(native_core() is None, reason="the native core was not built")
@pytest.mark.parametrize("name", CASES)
def test_the_native_core_agrees_with_the_reference(name: str):
    check(CASES[name], "native")


@pytest.mark.skipif(native_core() is None, reason="the native core was not built")
@pytest.mark.parametrize("instruction_set", ["avx2", "portable"])
def test_every_instruction_set_agrees_with_the_reference(instruction_set: str):
    done = subprocess.run(
        [sys.executable, "-m", "tests.splats.conformance", *ACROSS],
        cwd=ROOT,
        env={**os.environ, "RF3DGS_ISA": instruction_set},
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.strip() in (instruction_set, "portable")


@pytest.mark.gpu
@pytest.mark.parametrize("name", [name for name, case in CASES.items() if case.compositing.depth_gate is None])
def test_gsplat_agrees_with_the_reference(name: str):
    case = CASES[name]
    if case.view == "pinhole":
        check(case, "gsplat", device="cuda", tolerance=1e-3)
    else:
        check_resampled(case, "gsplat", device="cuda")
