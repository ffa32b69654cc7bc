import errno
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from rf3dgs.core.errors import DataError
from rf3dgs.core.files import atomic_file, atomic_folder, remove_partials


def names(folder: Path) -> list[str]:
    return sorted(item.name for item in folder.iterdir())


def test_a_file_appears_whole_and_replaces_the_old_one(tmp_path: Path) -> None:
    path = tmp_path / "made" / "field.bin"
    for content in (b"old", b"new"):
        with atomic_file(path) as temporary:
            assert temporary.parent == path.parent
            assert temporary.suffix == ".bin"
            temporary.write_bytes(content)
        assert path.read_bytes() == content
    assert names(path.parent) == ["field.bin"]


def test_a_failed_writer_leaves_the_old_file_and_nothing_else(tmp_path: Path) -> None:
    path = tmp_path / "field.bin"
    path.write_bytes(b"old")

    def fail() -> None:
        with atomic_file(path) as temporary:
            temporary.write_bytes(b"half")
            raise RuntimeError("stopped")

    with pytest.raises(RuntimeError, match="stopped"):
        fail()
    assert path.read_bytes() == b"old"
    assert names(tmp_path) == ["field.bin"]


def test_a_full_disk_is_one_sentence_that_names_the_file(tmp_path: Path) -> None:
    def fail() -> None:
        with atomic_file(tmp_path / "field.bin"):
            raise OSError(errno.ENOSPC, "No space left on device")

    with pytest.raises(DataError, match=r"cannot write .*field\.bin: No space left on device; free space"):
        fail()
    assert names(tmp_path) == []


def test_other_errors_of_the_block_stay_what_they_are(tmp_path: Path) -> None:
    def fail() -> None:
        with atomic_file(tmp_path / "field.bin"):
            (tmp_path / "missing").read_bytes()

    with pytest.raises(FileNotFoundError):
        fail()


def test_a_folder_appears_whole_and_replaces_the_old_one(tmp_path: Path) -> None:
    path = tmp_path / "lobby.field"
    for content in ("old", "new"):
        with atomic_folder(path) as temporary:
            (temporary / "sub").mkdir()
            (temporary / "sub" / f"{content}.txt").write_text(content)
        assert names(path / "sub") == [f"{content}.txt"]
    assert names(tmp_path) == ["lobby.field"]


def test_a_failed_folder_leaves_the_old_one(tmp_path: Path) -> None:
    path = tmp_path / "lobby.field"
    with atomic_folder(path) as temporary:
        (temporary / "a.txt").write_text("old")

    def fail() -> None:
        with atomic_folder(path) as temporary:
            (temporary / "b.txt").write_text("half")
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        fail()
    assert names(path) == ["a.txt"]
    assert names(tmp_path) == ["lobby.field"]


def test_a_file_in_the_folders_place_is_refused(tmp_path: Path) -> None:
    (tmp_path / "lobby").write_text("a file")

    def fail() -> None:
        with atomic_folder(tmp_path / "lobby"):
            pass

    with pytest.raises(DataError, match="lobby is a file, but a folder is to be written there"):
        fail()


def test_a_killed_writer_leaves_the_old_file_and_a_partial_that_can_be_swept(tmp_path: Path) -> None:
    path = tmp_path / "state.bin"
    path.write_bytes(b"old")
    code = (
        "import sys, time; from rf3dgs.core.files import atomic_file\n"
        "with atomic_file(sys.argv[1]) as temporary:\n"
        "    temporary.write_bytes(b'half'); print('ready', flush=True); time.sleep(60)\n"
    )
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}
    with subprocess.Popen(
        [sys.executable, "-c", code, str(path)], stdout=subprocess.PIPE, text=True, env=environment
    ) as writer:
        assert writer.stdout is not None
        assert writer.stdout.readline() == "ready\n"
        writer.send_signal(signal.SIGKILL)
    assert path.read_bytes() == b"old"
    assert len(names(tmp_path)) == 2
    assert remove_partials(tmp_path) == []
    for item in tmp_path.glob(".*.partial*"):
        os.utime(item, (time.time() - 7200, time.time() - 7200))
    assert len(remove_partials(tmp_path)) == 1
    assert names(tmp_path) == ["state.bin"]
