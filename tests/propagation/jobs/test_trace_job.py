"""Real traces and photographs of the small box as jobs: the same bytes however they are cut, killed and shared out."""

import json
import os
import signal
import subprocess
import sys
from dataclasses import replace

import pytest
import torch
from tests.propagation.jobs.fake_work import files_of, wait_for

from rf3dgs.channel.binning import bin_diffuse
from rf3dgs.channel.io import PathsReader
from rf3dgs.core.errors import InputError
from rf3dgs.core.frames import Pose
from rf3dgs.core.grids import Camera, pinhole_grid
from rf3dgs.propagation.config import PhotoConfig, TraceConfig
from rf3dgs.propagation.jobs.job import run_job
from rf3dgs.propagation.jobs.photo_job import PhotoJob, Shot, take
from rf3dgs.propagation.jobs.toolchain import fingerprint, toolchain
from rf3dgs.propagation.jobs.trace_job import TraceJob
from rf3dgs.propagation.sites.presets import PRESETS
from rf3dgs.propagation.sites.scenes import scene_of

QUICK = TraceConfig(rays=3000, depth=2)


@pytest.fixture(scope="module")
def box(tracer):
    return scene_of("box")


def job_of(box, count=6, *, scene="box", shard_size=2, **options):
    options = {"config": QUICK, "rule": {"seed": 0}, "shard_size": shard_size} | options
    return TraceJob(scene, box.tx, box.receivers(6, 0)[:count], box.frequency, **options)


@pytest.fixture(scope="module")
def calm(box, tmp_path_factory):
    folder = tmp_path_factory.mktemp("calm") / "box.paths"
    run_job(job_of(box), folder)
    return folder


def test_a_set_holds_what_the_tracer_yields(box, calm, tracer):
    rows = list(tracer.trace_each(box, None, box.receivers(6, 0), QUICK))
    with PathsReader(calm) as reader:
        assert reader.traced is not None
        assert reader.traced.tolist() == [int(row.count) for row in rows]
        for stored, row in zip(reader, rows, strict=True):
            merged = bin_diffuse(row)[0]
            assert torch.equal(stored.coeff, merged.coeff)
            assert torch.equal(stored.delay, merged.delay)
            assert torch.equal(stored.rx.position, row.rx.position[0])


def test_a_shard_does_not_know_what_was_traced_before_it(box, calm, tmp_path):
    for shard in (2, 0, 1):
        made = job_of(box).task(shard).make(lambda: None)
        assert made == {f"{shard:05d}.h5": (calm / f"{shard:05d}.h5").read_bytes()}


def test_the_manifest_says_what_decides_the_bytes(box, calm):
    manifest = json.loads((calm / "manifest.json").read_text())
    assert manifest["made_from"]["scene"]["name"] == "box"
    assert manifest["made_from"]["trace"]["rays"] == 3000
    assert manifest["made_from"]["frequency"] == 28e9
    assert {"sionna-rt", "mitsuba", "drjit", "llvm", "processor", "scene"} <= set(manifest["made_by"])


def test_a_moved_receiver_or_a_changed_scene_is_another_set(box, calm):
    moved = replace(job_of(box), rx=Pose(job_of(box).rx.position + 0.01))
    with pytest.raises(InputError, match=r"another made_from.receivers.sha256"):
        run_job(moved, calm)
    rough = replace(box, objects=tuple(replace(item, scattering=0.3) for item in box.objects))
    with pytest.raises(InputError, match=r"another made_from.scene.sha256"):
        run_job(job_of(box, scene=rough), calm)


def test_a_receiver_with_too_few_paths_gets_more_passes_and_the_others_stay_as_they_are(box, calm, tmp_path):
    with PathsReader(calm) as reader:
        few = reader.traced
        plain = list(reader)
    assert few is not None
    wanted = int(few.min()) + 1
    run_job(job_of(box, min_paths=wanted), tmp_path)
    with PathsReader(tmp_path) as reader:
        enough = reader.traced
        rows = list(reader)
    assert enough is not None
    assert enough.min() >= wanted
    for before, after, row, other in zip(few, enough, rows, plain, strict=True):
        if before >= wanted:
            assert after == before
            assert torch.equal(row.coeff, other.coeff)
        else:
            # The second pass has 1009 rays more; the noise of counting two thousand paths is below 5 % (2 sigma).
            assert after == pytest.approx(before * (1 + 4009 / 3000), rel=0.05)
            assert float(row.path_gain.sum()) == pytest.approx(float(other.path_gain.sum()), rel=0.1)


def test_a_receiver_that_more_passes_do_not_help_is_named(box, tmp_path):
    with pytest.raises(InputError, match=r"receiver 0 has [\d,]+ paths after 16 passes of 3,000 rays, but at least"):
        run_job(job_of(box, min_paths=10**9), tmp_path)


def test_a_receiver_in_the_wrong_place_is_named_by_its_own_number(box, tmp_path):
    rx = box.receivers(6, 0)
    rx.position[5, 2] = 40.0
    with pytest.raises(InputError, match=r"receiver 5 at .* is outside the scene 'box'"):
        run_job(replace(job_of(box), rx=rx), tmp_path)
    assert sorted(item.name for item in tmp_path.glob("*.h5")) == ["00000.h5", "00001.h5"]


def test_the_papers_preset_is_its_set():
    paper, config = PRESETS["paper"], PRESETS["paper"].applied(scene_of("lobby"))[1]
    assert (paper.rx_count, config.depth, paper.min_paths, config.frequency) == (800, 3, 300_000, 60e9)


def test_the_toolchain_names_versions_llvm_and_processor(tracer):
    found = toolchain()
    assert all(part.isdigit() for part in found["llvm"].split("."))
    assert found["sionna-rt"][0].isdigit()
    assert "instructions" in found["processor"]


def test_a_fingerprint_sees_every_part_of_a_scene(box):
    prints = {fingerprint(box), fingerprint(replace(box, frequency=1e9)), fingerprint(replace(box, tx=Pose([0, 0, 1])))}
    item = replace(box.objects[0], scattering=0.1)
    prints.add(fingerprint(replace(box, objects=(item, *box.objects[1:]))))
    assert len(prints) == 4
    assert fingerprint(scene_of("box")) == fingerprint(box)
    with pytest.raises(TypeError, match="a set has no fingerprint"):
        fingerprint({1, 2})


@pytest.fixture(scope="module")
def shots():
    how = PhotoConfig(width=24, height=16, samples=4)
    camera = [Camera.of(Pose.look_at((x, 0.0, 1.5), (0.0, 0.0, 1.5)), pinhole_grid(24, 16, 85.0)) for x in (1, 2, 3, 4)]
    seeds = (0, 9, 1, 2)
    return [Shot(at, replace(how, seed=seed)) for at, seed in zip(camera, seeds, strict=True)]


def test_photographs_do_not_depend_on_how_they_are_cut(box, shots, tmp_path):
    single = [next(take(box, [shot], lambda: None))[1] for shot in shots]
    for size in (1, 3):
        run_job(PhotoJob("box", shots, shard_size=size), tmp_path / str(size))
        assert [(tmp_path / str(size) / f"{number:05d}.jpg").read_bytes() for number in range(4)] == single
    assert len(set(single)) == 4


def test_other_cameras_or_samples_are_another_set(shots, tmp_path, tracer):
    run_job(PhotoJob("box", shots), tmp_path)
    with pytest.raises(InputError, match=r"another made_from\.cameras.sha256"):
        run_job(PhotoJob("box", shots[::-1]), tmp_path)
    finer = [replace(shot, config=replace(shot.config, samples=9)) for shot in shots]
    with pytest.raises(InputError, match=r"another made_from.photo.samples \(it had 4, this run has 9\)"):
        run_job(PhotoJob("box", finer), tmp_path)


def trace_command(out, *options):
    return [sys.executable, "-m", "rf3dgs", "trace", "box", "--out", str(out), *map(str, options)]


@pytest.mark.slow
@pytest.mark.parametrize(
    "what",
    [
        ("trace", "box", "--rx.count", "120", "--shard-size", "2", "--trace.rays", "30000"),
        ("photos", "box", "--count", "120", "--shard-size", "2", "--photo.width", "160", "--photo.height", "120"),
    ],
)
def test_a_job_killed_twenty_times_ends_with_the_bytes_of_a_calm_one(tracer, tmp_path, what):
    script = [sys.executable, "-m", "benchmarks.scale.kill_and_resume", str(tmp_path / "killed")]
    options = ["--calm", str(tmp_path / "calm"), "--seconds", "1.0", "--", *what]
    run = subprocess.run([*script, *options], stdout=subprocess.PIPE, text=True, check=False)
    result = json.loads(run.stdout.splitlines()[-1])
    assert result["differing"] == []
    assert result["kills"] == 20
    assert run.returncode == 0


@pytest.mark.slow
def test_two_workers_one_of_them_killed_make_the_bytes_of_one_process(tracer, tmp_path):
    psutil = pytest.importorskip("psutil")
    pytest.importorskip("distributed")
    what = ("--rx.count", 200, "--shard-size", 5, "--trace.rays", 5_000)
    subprocess.run(trace_command(tmp_path / "calm", *what), check=True)
    process = subprocess.Popen(trace_command(tmp_path / "shared", *what, "--workers", 2))
    wait_for(lambda: (tmp_path / "shared" / "00004.h5").exists(), 600)
    busy = [child for child in psutil.Process(process.pid).children() if "spawn_main" in " ".join(child.cmdline())]
    os.kill(busy[0].pid, signal.SIGKILL)
    assert process.wait(timeout=1200) == 0
    assert files_of(tmp_path / "shared") == files_of(tmp_path / "calm")
