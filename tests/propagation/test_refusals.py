"""What tracing must refuse in one sentence, through the doors that people use."""

import os
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from rf3dgs.cli.main import main
from rf3dgs.core.errors import DataError, InputError, MissingDependencyError, RfError
from rf3dgs.core.frames import Pose
from rf3dgs.propagation import llvm, sionna
from rf3dgs.propagation.config import TraceConfig
from rf3dgs.propagation.room import shoebox

RX = Pose([[3.0, 3.0, 1.5]])
CONFIG = TraceConfig(rays=100, depth=2)


def said(capsys, *arguments) -> str:
    """The one line of a command that ends with status 2."""
    capsys.readouterr()
    assert main([str(argument) for argument in arguments]) == 2
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 1
    assert lines[0].startswith("rf3dgs: ")
    return lines[0]


# A material that is not defined at the frequency


def test_a_material_without_values_at_the_frequency_names_its_object(site, capsys, tmp_path):
    with pytest.raises(InputError, match=r"object 'floor.*' has the material 'floorboard', .* at 10 GHz; use one of"):
        sionna.trace_each(site, None, RX, CONFIG, frequency=10e9)
    told = said(capsys, "trace", "lobby", "--rx.count", 1, "--trace.frequency", 10e9, "--out", tmp_path / "a.paths")
    assert "which ITU-R P.2040 does not define at 10 GHz" in told
    assert not list(tmp_path.iterdir())
    with pytest.raises(InputError, match=r"wall 'z low' has the material 'floorboard', .* at 10 GHz"):
        shoebox((5, 5, 3), Pose((1.0, 1.0, 1.0)), RX, 10e9, 1, [*["concrete"] * 4, "floorboard", "metal"])


# A receiver where none can be


@pytest.mark.parametrize(
    ("position", "message"),
    [
        ((4.5, 4.6, 1.5), "is inside the object 'column-1'"),
        ((-3.0, 3.0, 1.5), "is outside the scene 'lobby'"),
        ((3.0, 3.0, 4.0), "is outside the scene 'lobby'"),
    ],
)
def test_a_receiver_that_cannot_be_is_refused_before_anything_is_traced(site, monkeypatch, position, message):
    monkeypatch.setattr(sionna, "Tracer", None)
    rx = Pose([[3.0, 3.0, 1.5], list(position)])
    with pytest.raises(InputError, match=rf"receiver 1 at .* {message}"):
        sionna.trace_each(site, None, rx, CONFIG)


# LLVM that is missing, or that aborts the process


def test_an_llvm_that_aborts_ends_its_own_process_only(monkeypatch):
    monkeypatch.setattr(llvm, "_PROBE", "import os; os.abort()")
    fault = llvm.probe(Path("/usr/lib/libLLVM-16.so"))
    assert fault.startswith("/usr/lib/libLLVM-16.so: exit -6")


def test_an_llvm_that_hangs_is_given_up(monkeypatch):
    def run(*_, timeout, **__):
        raise subprocess.TimeoutExpired("python", timeout)

    monkeypatch.setattr(subprocess, "run", run)
    assert "timed out after 60 seconds" in llvm.probe(Path("/usr/lib/libLLVM-19.so"))


def test_the_next_library_is_tried_and_all_faults_are_told(monkeypatch):
    paths = [Path("/a/libLLVM-19.so"), Path("/b/libLLVM-18.so")]
    monkeypatch.setattr(llvm, "candidates", lambda: paths)
    monkeypatch.setattr(llvm, "probe", lambda path: "" if path == paths[1] else f"{path}: exit -6: abort")
    assert llvm.find_llvm.__wrapped__() == llvm.Llvm(paths[1], "LLVM works: /b/libLLVM-18.so")
    monkeypatch.setattr(llvm, "probe", lambda path: f"{path}: exit -6: abort")
    assert llvm.find_llvm.__wrapped__().reason == "/a/libLLVM-19.so: exit -6: abort; /b/libLLVM-18.so: exit -6: abort"


def test_tracing_without_llvm_is_one_error(site, monkeypatch):
    monkeypatch.setattr(llvm, "find_llvm", lambda: llvm.Llvm(None, "/a/libLLVM-15.so: exit -6: abort"))
    with pytest.raises(MissingDependencyError, match=r"needs LLVM 17 to 20 \(/a/libLLVM-15.so: exit -6: abort\); inst"):
        list(sionna.trace_each(site, None, RX, CONFIG))


OLD = [path for path in sorted(Path("/usr/lib/x86_64-linux-gnu").glob("libLLVM-14.so")) if path.exists()]


@pytest.mark.parametrize("library", [*OLD, Path("/nonexistent/libLLVM.so")], ids=lambda path: path.name)
def test_the_command_line_survives_a_chosen_llvm_that_does_not_work(library, tmp_path):
    """The command says so and leaves nothing; an old library counts where this machine has one."""
    command = [sys.executable, "-m", "rf3dgs", "trace", "lobby", "--rx.count", "1", "--out", str(tmp_path / "a.paths")]
    environment = {**os.environ, llvm.VARIABLE: str(library)}
    run = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    assert run.returncode == 2
    (line,) = run.stderr.splitlines()
    assert line.startswith("rf3dgs: the ray tracer needs LLVM 17 to 20 (")
    assert str(library) in line
    assert "install libllvm19" in line
    assert not list(tmp_path.iterdir())


# Room for paths that is full


class FullSolver:
    """Answers with as many valid paths as it was given room for."""

    def __init__(self):
        self.asked = {}

    def __call__(self, scene, **asked):
        self.asked = asked
        return SimpleNamespace(valid=np.ones((1, 1, asked["max_num_paths_per_src"]), dtype=bool))


@pytest.mark.parametrize(("rays", "depth"), [(1, 0), (1000, 1), (500, 4)])
def test_a_full_room_for_paths_is_an_error_and_there_is_room_for_every_candidate(rays, depth):
    tracer = object.__new__(sionna.Tracer)
    tracer._scene, tracer._solver = None, FullSolver()
    with pytest.raises(RfError, match=r"room for \d+ paths is full, so paths may be missing; use fewer rays"):
        tracer._solve(TraceConfig(rays=rays, depth=depth), 0, 0)
    assert tracer._solver.asked["max_num_paths_per_src"] > rays * depth + 1


# A scene file that reads other files


@pytest.mark.parametrize(
    ("inner", "message"),
    [
        ('<include filename="../other.xml"/>', "has a <include> element, which is refused"),
        (
            '<shape type="ply"><string name="filename" value="../../secret.ply"/></shape>',
            "names the file '../../secret.ply'; only files in the scene's own folder may be read",
        ),
    ],
)
def test_a_scene_file_that_reads_others_is_refused_at_every_door(tmp_path, capsys, monkeypatch, inner, message):
    monkeypatch.setattr(sionna, "import_sionna", None)  # refused before a parser of scenes sees it
    file = tmp_path / "scene.xml"
    file.write_text(f'<scene version="2.1.0">{inner}</scene>')
    with pytest.raises(DataError, match=message):
        sionna.trace(file, rx=RX, config=CONFIG)
    for command in (("trace", file, "--out", tmp_path / "a.paths"), ("photos", file, "--out", tmp_path / "photos")):
        told = said(capsys, *command)
        assert message in told
        assert str(file) in told
    assert list(tmp_path.iterdir()) == [file]
