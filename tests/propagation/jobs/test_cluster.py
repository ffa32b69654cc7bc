"""Shards made by processes of dask.distributed: the same bytes, whoever dies on the way."""

import json
import os
import signal
import subprocess
import sys

import psutil
import pytest
from tests.propagation.jobs.fake_work import FakeJob, command, files_of, wait_for

from rf3dgs.core.errors import DataError, InputError, MissingDependencyError, RfError
from rf3dgs.core.progress import Silent
from rf3dgs.propagation.jobs import cluster
from rf3dgs.propagation.jobs.job import Here, run_job

dask = pytest.importorskip("dask")
distributed = pytest.importorskip("distributed")


class Borrowed:
    """A crew that a test enters and leaves without ending its processes."""

    def __init__(self, crew):
        self.crew = crew

    def __enter__(self):
        return self.crew

    def __exit__(self, *_):
        pass


@pytest.fixture(scope="module")
def crew():
    """Two processes; a shard may lose one worker, and is given up when it loses another."""
    with dask.config.set({"distributed.scheduler.allowed-failures": 1}), cluster.local_processes(2) as crew:
        yield crew


def make(job, folder, crew):
    return run_job(job, folder, crew=Borrowed(crew))


def test_two_processes_make_the_bytes_of_one(crew, tmp_path):
    run_job(FakeJob(20, 3), tmp_path / "here", crew=Borrowed(Here()))
    make(FakeJob(20, 3), tmp_path / "there", crew)
    assert files_of(tmp_path / "here") == files_of(tmp_path / "there")


def test_everyone_listens_on_this_machine_alone(crew):
    this = psutil.Process()
    heard = {
        connection.laddr.ip
        for process in (this, *this.children(recursive=True))
        for connection in process.net_connections(kind="inet")
        if connection.status == psutil.CONN_LISTEN
    }
    assert heard == {"127.0.0.1"}


def test_the_shard_of_a_worker_that_is_killed_is_made_by_another(crew, tmp_path):
    run_job(FakeJob(20, 3), tmp_path / "here")
    odd = {2: {"dies_once": str(tmp_path / "died")}}
    make(FakeJob(20, 3, seconds=0.02, special=odd), tmp_path / "there", crew)
    assert (tmp_path / "died").exists()
    assert files_of(tmp_path / "here") == files_of(tmp_path / "there")


def test_a_shard_that_kills_every_worker_is_named_and_the_others_are_kept(crew, tmp_path):
    with pytest.raises(RfError, match=r"shard 6: 2 workers died .* finished shards are kept"):
        make(FakeJob(20, 3, special={6: {"dies": True}}), tmp_path, crew)
    assert not (tmp_path / "18.bin").exists()
    assert (tmp_path / "0.bin").exists()
    make(FakeJob(20, 3), tmp_path, crew)
    assert (tmp_path / "18.bin").exists()


def test_an_error_of_ours_is_told_at_once_and_another_after_three_tries(crew, tmp_path):
    with pytest.raises(DataError, match="shard 1: receiver 7 is inside the sofa"):
        make(FakeJob(special={1: {"fault": "ours"}}), tmp_path / "ours", crew)
    with pytest.raises(RfError, match="shard 1 failed 3 times, last with ZeroDivisionError: by zero; finished shards"):
        make(FakeJob(special={1: {"fault": "theirs"}}), tmp_path / "theirs", crew)
    make(FakeJob(), tmp_path / "theirs", crew)
    assert len(files_of(tmp_path / "theirs")) == 11


def test_a_worker_of_another_version_is_refused_by_name(crew, tmp_path):
    crew._client.wait_for_workers(2, timeout=60)  # those killed in other tests come back
    job = FakeJob(common={"two_kinds": str(tmp_path / "kinds")})
    message = r'worker tcp://127.0.0.1:\d+ has another version .*"[12]".* than tcp://127.0.0.1:\d+, so its bytes would'
    with pytest.raises(InputError, match=message):
        make(job, tmp_path / "set", crew)
    assert not (tmp_path / "set" / "manifest.json").exists()


def test_a_worker_that_joins_late_is_asked_too(crew):
    tasks = iter([(0, FakeJob().task(0))])
    with pytest.raises(InputError, match=r'another version \(it had "0", the worker has "1"\) than the others'):
        list(crew.work(tasks, {"version": "0"}, lambda: None))


def test_an_existing_scheduler_is_used_and_left_running(crew, tmp_path):
    address = crew._client.scheduler.address
    run_job(FakeJob(), tmp_path, crew=cluster.existing_cluster(address))
    assert len(files_of(tmp_path)) == 11
    assert crew._client.submit(sum, [1, 2]).result() == 3


def test_a_greeting_that_comes_with_other_news_is_asked_for_again(crew, tmp_path, monkeypatch):
    real, asked = distributed.Client, []

    def interrupted(*arguments, **options):
        asked.append(arguments)
        if len(asked) <= failures:
            raise AssertionError  # what a client does when its first batch holds more than the greeting
        return real(*arguments, **options)

    address = crew._client.scheduler.address
    monkeypatch.setattr(distributed, "Client", interrupted)
    failures = 2
    run_job(FakeJob(), tmp_path / "first", crew=cluster.existing_cluster(address))
    assert len(asked) == 3
    assert len(files_of(tmp_path / "first")) == 11
    failures = 6
    with pytest.raises(InputError, match=r"no dask scheduler answers at .*\(AssertionError\)"):
        run_job(FakeJob(), tmp_path / "second", crew=cluster.existing_cluster(address))
    assert len(asked) == 6


def test_a_worker_with_many_threads_makes_one_shard_at_a_time(tmp_path):
    with (
        distributed.LocalCluster(
            n_workers=1, threads_per_worker=4, host="127.0.0.1", dashboard_address="127.0.0.1:0"
        ) as threads,
        distributed.Client(threads) as client,
    ):
        job = FakeJob(20, 2, seconds=0.02, common={"alone": str(tmp_path / "alone")})
        make(job, tmp_path / "set", cluster.DaskCrew(client))
    assert len(files_of(tmp_path / "set")) == 21


def test_a_scheduler_that_is_not_there_is_one_sentence(monkeypatch, tmp_path):
    monkeypatch.setattr(cluster, "PATIENCE", 1.0)
    with pytest.raises(InputError, match=r"no dask scheduler answers at tcp://127.0.0.1:9 .*; start one"):
        run_job(FakeJob(), tmp_path, crew=cluster.existing_cluster("tcp://127.0.0.1:9"))
    for address in ("10.0.0.5:8786", "tcp://here", "http://here:8786"):
        with pytest.raises(InputError, match=r"given as tcp://host:port or tls://host:port; got"):
            run_job(FakeJob(), tmp_path, crew=cluster.existing_cluster(address))


def test_a_scheduler_without_workers_is_given_up_after_a_while(crew, tmp_path):
    with (
        distributed.LocalCluster(n_workers=0, host="127.0.0.1", dashboard_address="127.0.0.1:0") as empty,
        distributed.Client(empty) as client,
        pytest.raises(RfError, match=r"scheduler tcp://127.0.0.1:\d+ has had no workers for 0.5 seconds; start some"),
    ):
        make(FakeJob(), tmp_path, cluster.DaskCrew(client, patience=0.5))


def test_a_scheduler_that_goes_away_is_one_sentence_and_finished_shards_are_kept(tmp_path):
    script = (
        "import distributed, time\n"
        "if __name__ == '__main__':\n"
        "    it = distributed.LocalCluster(n_workers=1, host='127.0.0.1', dashboard_address='127.0.0.1:0')\n"
        "    print(it.scheduler_address, flush=True)\n"
        "    time.sleep(60)\n"
    )
    (tmp_path / "scheduler.py").write_text(script)
    started = [sys.executable, str(tmp_path / "scheduler.py")]
    process = subprocess.Popen(started, stdout=subprocess.PIPE, text=True, env=os.environ | {"PYTHONPATH": "."})
    assert process.stdout is not None
    address = process.stdout.readline().strip()

    class KillingProgress(Silent):
        def update(self, done, note=""):
            process.kill()

    crew = cluster.existing_cluster(address)
    with dask.config.set({"distributed.comm.timeouts.connect": "1s"}), process.stdout:
        with pytest.raises(RfError, match=r"the scheduler .* is gone; finished shards are kept: run the same command"):
            run_job(FakeJob(20, 2, seconds=0.5), tmp_path / "set", crew=crew, progress=KillingProgress())
        process.wait()
    assert (tmp_path / "set" / "0.bin").exists()


def test_workers_without_dask_are_a_missing_dependency(monkeypatch, tmp_path):
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(
        MissingDependencyError, match=r"workers need dask.distributed .*pip install 'rf3dgs\[cluster\]'"
    ):
        run_job(FakeJob(), tmp_path, crew=cluster.local_processes(2))


def test_workers_end_with_a_killed_run_and_the_next_one_finishes(tmp_path):
    run_job(FakeJob(40, 2), tmp_path / "calm")
    out = tmp_path / "killed"
    process = subprocess.Popen(command(out, "--count", 40, "--seconds", 0.1, "--workers", 2))
    wait_for(lambda: (out / "3.bin").exists(), 60)
    children = psutil.Process(process.pid).children(recursive=True)
    os.kill(process.pid, signal.SIGKILL)
    process.wait()
    assert children
    assert json.loads((out / "lock.json").read_text())["pid"] == process.pid
    wait_for(lambda: not any(child.is_running() and child.status() != "zombie" for child in children), 30)
    subprocess.run(command(out, "--count", 40, "--workers", 2), check=True)
    assert files_of(out) == files_of(tmp_path / "calm")
