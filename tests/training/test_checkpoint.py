import json
import os
import socket
import subprocess
import sys
from pathlib import Path

import pytest
import torch

from rf3dgs.core.errors import InputError, TrainingError
from rf3dgs.training.checkpoint import CheckpointFolder, State, fingerprint, locked

IDENTITY = {"stage": "test", "configuration": {"steps": 10, "rate": 0.1}}


def state_at(iteration: int) -> State:
    values = torch.arange(6.0).reshape(2, 3) * iteration / 7
    return State({"values": values, "ids": torch.arange(3)}, {"iteration": iteration, "extent": 0.1 * iteration})


def filled(folder: Path) -> CheckpointFolder:
    checkpoints = CheckpointFolder(folder, IDENTITY)
    for iteration in (10, 20, 30):
        checkpoints.save(iteration, state_at(iteration))
    return checkpoints


def flip_byte(path: Path, at: int) -> None:
    data = bytearray(path.read_bytes())
    data[at] ^= 0x10
    path.write_bytes(bytes(data))


def test_a_checkpoint_comes_back_bit_by_bit(tmp_path):
    iteration, state = filled(tmp_path).load_newest()
    assert iteration == 30
    assert torch.equal(state.tensors["values"], state_at(30).tensors["values"])
    assert torch.equal(state.tensors["ids"], torch.arange(3))
    assert state.numbers == state_at(30).numbers


def test_the_two_newest_checkpoints_are_kept(tmp_path):
    filled(tmp_path)
    assert sorted(path.stem for path in tmp_path.glob("*.json")) == ["step-00000020", "step-00000030"]
    assert len(list(tmp_path.iterdir())) == 4


@pytest.mark.parametrize("suffix", [".safetensors", ".json"])
@pytest.mark.parametrize("at", [0, 40, -2])
def test_a_flipped_bit_in_the_newest_falls_back_to_the_one_before(tmp_path, suffix, at):
    checkpoints = filled(tmp_path)
    flip_byte(tmp_path / f"step-00000030{suffix}", at)
    iteration, state = checkpoints.load_newest()
    assert iteration == 20
    assert torch.equal(state.tensors["values"], state_at(20).tensors["values"])


@pytest.mark.parametrize("damage", ["truncated", "missing", "empty json", "nested json"])
def test_other_damage_falls_back_too(tmp_path, damage):
    checkpoints = filled(tmp_path)
    tensors, record = tmp_path / "step-00000030.safetensors", tmp_path / "step-00000030.json"
    if damage == "truncated":
        tensors.write_bytes(tensors.read_bytes()[:-5])
    elif damage == "missing":
        tensors.unlink()
    else:
        record.write_text("" if damage == "empty json" else "[" * 200_000)
    found = checkpoints.load_newest()
    assert found is not None
    assert found[0] == 20


def test_no_whole_checkpoint_means_starting_afresh(tmp_path):
    checkpoints = filled(tmp_path)
    for path in tmp_path.glob("*.safetensors"):
        flip_byte(path, -1)
    assert checkpoints.load_newest() is None


def test_saving_after_a_fallback_removes_the_damaged_future(tmp_path):
    checkpoints = filled(tmp_path)
    flip_byte(tmp_path / "step-00000030.safetensors", -1)
    checkpoints.save(25, state_at(25))
    assert sorted(path.stem for path in tmp_path.glob("*.json")) == ["step-00000020", "step-00000025"]


def test_another_configuration_is_refused_and_named(tmp_path):
    filled(tmp_path)
    other = CheckpointFolder(tmp_path, {"stage": "test", "configuration": {"steps": 10, "rate": 0.2}})
    with pytest.raises(InputError, match=r"another configuration.rate \(it had 0.1, this run has 0.2\); give the run"):
        other.load_newest()


def test_sweeping_removes_what_killed_writers_left(tmp_path):
    checkpoints = filled(tmp_path)
    (tmp_path / ".step-00000040.json.0123456789ab.partial.json").write_text("half")
    (tmp_path / "step-00000040.safetensors").write_bytes(b"no record")
    checkpoints.sweep()
    assert sorted(path.stem for path in tmp_path.iterdir()) == ["step-00000020"] * 2 + ["step-00000030"] * 2


def test_a_fingerprint_sees_every_bit_and_the_shape():
    tensor = torch.arange(6.0)
    changed = tensor.clone()
    changed[3] += 1e-6
    prints = {fingerprint([tensor]), fingerprint([changed]), fingerprint([tensor.reshape(2, 3)])}
    assert len(prints) == 3
    assert fingerprint([tensor]) == fingerprint([tensor.clone()])


def test_a_living_lock_is_refused(tmp_path):
    with locked(tmp_path):
        holder = json.loads((tmp_path / "lock.json").read_text())
        assert (holder["pid"], holder["host"]) == (os.getpid(), socket.gethostname())
        with (
            pytest.raises(TrainingError, match=f"in use by process {os.getpid()} on .*; wait for it"),
            locked(tmp_path),
        ):
            pass
    assert not (tmp_path / "lock.json").exists()


def test_a_lock_of_a_dead_process_is_taken_over(tmp_path):
    script = f"from rf3dgs.training.checkpoint import locked; import os\nwith locked({str(tmp_path)!r}): os._exit(0)"
    subprocess.run([sys.executable, "-c", script], check=True)
    assert (tmp_path / "lock.json").exists()
    with locked(tmp_path):
        assert json.loads((tmp_path / "lock.json").read_text())["pid"] == os.getpid()
    assert list(tmp_path.iterdir()) == []


def test_a_lock_whose_pid_now_belongs_to_another_process_is_taken_over(tmp_path):
    stale = {"pid": os.getpid(), "host": socket.gethostname(), "began": "1", "at": 0}
    (tmp_path / "lock.json").write_text(json.dumps(stale))
    with locked(tmp_path):
        assert json.loads((tmp_path / "lock.json").read_text())["began"] != "1"


def test_a_lock_of_another_host_is_refused(tmp_path):
    (tmp_path / "lock.json").write_text(json.dumps({"pid": 1, "host": "elsewhere.example", "began": "1"}))
    with pytest.raises(TrainingError, match=r"process 1 on elsewhere.example; .* delete .*lock.json"), locked(tmp_path):
        pass
