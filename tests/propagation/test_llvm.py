import os
from pathlib import Path

import pytest

from rf3dgs.core.errors import MissingDependencyError
from rf3dgs.propagation import llvm


def test_a_library_that_is_no_llvm_is_refused_without_harm():
    fault = llvm.probe(Path("/nonexistent/libLLVM.so"))
    assert "/nonexistent/libLLVM.so" in fault


def test_without_llvm_the_error_says_what_to_install(monkeypatch):
    monkeypatch.setattr(llvm, "find_llvm", lambda: llvm.Llvm(None, "no libLLVM 17 to 20 found"))
    with pytest.raises(MissingDependencyError, match=r"no libLLVM 17 to 20 found.*install libllvm19"):
        llvm.prepare()


def test_the_environments_own_choice_comes_first(monkeypatch):
    monkeypatch.setenv(llvm.VARIABLE, "/opt/llvm/libLLVM.so")
    assert llvm.candidates() == [Path("/opt/llvm/libLLVM.so")]


def test_found_libraries_have_the_accepted_versions_preferred_first(monkeypatch):
    monkeypatch.delenv(llvm.VARIABLE, raising=False)
    for path in llvm.candidates():
        assert any(str(version) in path.name for version in llvm.VERSIONS)


def test_prepare_points_drjit_to_the_library(tracer):
    assert llvm.prepare() == llvm.find_llvm().path
    assert os.environ[llvm.VARIABLE] == str(llvm.find_llvm().path)
