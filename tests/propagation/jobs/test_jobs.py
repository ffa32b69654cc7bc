"""The job runner with cheap work: killed, refused, out of disk, and always the same bytes in the end."""

import json
import random
import signal
import subprocess
import time
from dataclasses import replace

import pytest
from tests.propagation.jobs.fake_work import FakeJob, command, content, files_of, text_of, wait_for

from rf3dgs.core.errors import DataError, InputError
from rf3dgs.propagation.jobs.job import run_job


class Recorder:
    """A progress that remembers."""

    def __init__(self):
        self.said = []

    def start(self, label, total, done=0):
        self.said.append((label, total, done))

    def update(self, done, note=""):
        self.said.append(done)

    def finish(self, note=""):
        self.said.append("finish")


def test_a_job_makes_every_file_and_the_same_run_again_makes_none(tmp_path):
    job = FakeJob()
    manifest = run_job(job, tmp_path / "set")
    made = files_of(tmp_path / "set")
    assert set(made) == {"manifest.json", *(f"{item}.bin" for item in range(10))}
    assert all(made[f"{item}.bin"] == content(item) for item in range(10))
    assert manifest.made_by == {"version": "1"}
    times = {item.name: item.stat().st_mtime_ns for item in (tmp_path / "set").iterdir()}
    again = FakeJob()
    assert run_job(again, tmp_path / "set") == manifest
    assert again.asked == []
    assert {item.name: item.stat().st_mtime_ns for item in (tmp_path / "set").iterdir()} == times


def test_only_missing_shards_are_made_and_files_that_are_there_stay(tmp_path):
    run_job(FakeJob(), tmp_path)
    (tmp_path / "4.bin").unlink()
    (tmp_path / "5.bin").write_bytes(b"as it was")
    job, progress = FakeJob(), Recorder()
    run_job(job, tmp_path, progress=progress)
    assert job.asked == [0, 1]  # 0 is asked who makes it, 1 is made
    assert (tmp_path / "4.bin").read_bytes() == content(4)
    assert (tmp_path / "5.bin").read_bytes() == b"as it was"
    assert progress.said == [("work", 10, 7), 8, 9, 10, 10, "finish"]


def test_twenty_kills_at_random_moments_leave_the_bytes_of_a_calm_run(tmp_path):
    run_job(FakeJob(400, 2), tmp_path / "calm")
    out, generator = tmp_path / "killed", random.Random(3)
    for _ in range(20):
        process = subprocess.Popen(command(out, "--count", 400, "--seconds", 0.01))
        wait_for(lambda pid=process.pid: f'"pid": {pid},' in text_of(out / "lock.json"))
        time.sleep(generator.uniform(0.0, 0.15))
        process.send_signal(signal.SIGKILL)
        assert process.wait() == -signal.SIGKILL
        whole = [item for item in out.glob("*.bin") if not item.name.startswith(".")]
        assert all(item.read_bytes() == content(int(item.stem)) for item in whole)
    assert len(whole) > 10
    subprocess.run(command(out, "--count", 400), check=True)
    assert files_of(out) == files_of(tmp_path / "calm")


def test_sigterm_ends_a_run_and_frees_its_folder(tmp_path):
    process = subprocess.Popen(command(tmp_path / "set", "--seconds", 0.2))
    wait_for(lambda: (tmp_path / "set" / "1.bin").exists())
    process.send_signal(signal.SIGTERM)
    assert process.wait(timeout=10) == 128 + signal.SIGTERM
    assert not (tmp_path / "set" / "lock.json").exists()


def test_other_arguments_are_refused_and_the_first_difference_is_named(tmp_path):
    run_job(FakeJob(), tmp_path)
    before = files_of(tmp_path)
    for other, words in (
        (FakeJob(colour="blue"), r'made_from\.paint\.colour \(it had "red", this run has "blue"\)'),
        (FakeJob(count=11), r"count \(it had 10, this run has 11\)"),
        (FakeJob(shard_size=5), r"shard_size \(it had 3, this run has 5\)"),
    ):
        with pytest.raises(InputError, match=rf"was begun with another {words}; give the run another folder"):
            run_job(other, tmp_path)
    assert files_of(tmp_path) == before


def test_another_version_may_not_finish_a_set(tmp_path):
    run_job(FakeJob(), tmp_path)
    (tmp_path / "0.bin").unlink()
    manifest = json.loads((tmp_path / "manifest.json").read_text())
    manifest["made_by"]["version"] = "0"
    (tmp_path / "manifest.json").write_text(json.dumps(manifest))
    with pytest.raises(InputError, match=r'another made_by.version \(it had "0", this run has "1"\)'):
        run_job(FakeJob(), tmp_path)
    assert not (tmp_path / "0.bin").exists()


def test_a_folder_of_other_things_and_a_file_are_refused(tmp_path):
    (tmp_path / "thesis.tex").write_text("important")
    with pytest.raises(InputError, match=r"is no folder of test.work: .* holds thesis.tex; choose another name"):
        run_job(FakeJob(), tmp_path)
    with pytest.raises(DataError, match=r"thesis.tex is a file, but a folder is to be written there"):
        run_job(FakeJob(), tmp_path / "thesis.tex")
    assert [item.name for item in tmp_path.iterdir()] == ["thesis.tex"]


def test_a_damaged_manifest_is_one_sentence(tmp_path):
    run_job(FakeJob(), tmp_path)
    (tmp_path / "manifest.json").write_text("{")
    with pytest.raises(DataError, match=r"manifest.json is not a readable manifest .*; delete the folder"):
        run_job(FakeJob(), tmp_path)


def test_two_runs_do_not_share_a_folder(tmp_path):
    process = subprocess.Popen(command(tmp_path / "set", "--seconds", 0.5))
    wait_for(lambda: (tmp_path / "set" / "manifest.json").exists())
    with pytest.raises(DataError, match=rf"set is in use by process {process.pid} on .*; wait for it"):
        run_job(FakeJob(12, 2), tmp_path / "set")
    process.kill()
    process.wait()
    assert (tmp_path / "set" / "lock.json").exists()
    run_job(FakeJob(12, 2), tmp_path / "set")  # the lock of the dead is taken over
    assert not (tmp_path / "set" / "lock.json").exists()
    assert len(files_of(tmp_path / "set")) == 13


def test_a_full_disk_is_one_sentence_and_finished_shards_are_kept(tmp_path):
    out = tmp_path / "set"
    full = subprocess.run(command(out, "--large", 4, "--limit", 50_000), stderr=subprocess.PIPE, text=True, check=False)
    assert full.returncode != 0
    assert f"DataError: cannot write {out / '8.bin'}: File too large; free space" in full.stderr
    assert sorted(files_of(out)) == sorted(["manifest.json", *(f"{item}.bin" for item in range(8))])
    subprocess.run(command(out, "--large", 4), check=True)
    assert len((out / "8.bin").read_bytes()) == 100_000
    assert len(files_of(out)) == 13


def test_a_task_that_makes_other_files_than_announced_is_refused(tmp_path):
    class Wrong(FakeJob):
        def names(self, shard):
            return ["0.txt"]

    with pytest.raises(InputError, match=r"shard 0 must be the files \['0.txt'\]; got \['0.bin'"):
        run_job(Wrong(), tmp_path)


def test_a_folder_that_cannot_be_made_is_one_sentence(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(DataError, match=r"cannot make the folder .*: Not a directory; choose another one"):
        run_job(FakeJob(), tmp_path / "file" / "set")
    assert [item.name for item in tmp_path.iterdir()] == ["file"]


def test_what_killed_writers_left_is_swept_away(tmp_path):
    run_job(FakeJob(), tmp_path)
    (tmp_path / ".3.bin.0123456789ab.partial.bin").write_bytes(b"half")
    run_job(replace(FakeJob()), tmp_path)
    assert not list(tmp_path.glob(".*"))
