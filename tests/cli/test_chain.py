"""The small whole chain through the command line, and `rf3dgs fit` killed with SIGKILL and started again."""

import json
import math
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from rf3dgs.cli.main import main
from rf3dgs.core.frames import Pose
from rf3dgs.core.grids import Camera, equirect_grid, pinhole_grid
from rf3dgs.core.units import SPEED_OF_LIGHT, power_from_db
from rf3dgs.data.dataset import Dataset
from rf3dgs.data.photo import Photo
from rf3dgs.spectra.spectrum import Instrument, Spectrum
from rf3dgs.splats.gaussians import Gaussians
from rf3dgs.training.photographs import render_photo

BOX_TX = (-3.5, -3.5, 4.0)
AT = (0.5, 1.0, 1.5)
OUTSIDE = (0.5, 1.0, 3.5)
TRACE = ("--trace.rays", "5000", "--trace.depth", "2")
PHOTO = ("--photo.width", "48", "--photo.height", "36", "--photo.samples", "4")


@pytest.fixture(scope="module")
def box(tmp_path_factory) -> Path:
    """The box that ships with Sionna RT: traced, photographed, and made into datasets of ideal and Capon spectra."""
    pytest.importorskip("sionna.rt")
    folder = tmp_path_factory.mktemp("box")
    ideal, capon, paths = folder / "ideal", folder / "capon", folder / "box.paths"
    assert main(["trace", "box", "--rx.count", "12", "--out", str(paths), *TRACE]) == 0
    assert main(["photos", "box", "--count", "9", "--out", str(ideal / "photos"), *PHOTO]) == 0
    assert main(["spectra", str(paths), "--out", str(ideal), "--size", "48", "24"]) == 0
    array = ("--method", "capon", "--array", "4x4", "--snr-db", "20", "--grid", "pinhole", "--size", "24", "16")
    assert main(["spectra", str(paths), "--out", str(capon), *array]) == 0
    fit = ("--mesh", "box", "--mesh-count", "800")
    for name in ("ideal", "capon"):
        assert main(["fit", str(folder / name), "--out", str(folder / f"{name}.field"), *fit]) == 0
    return folder


def test_the_chain_leaves_sound_files_and_nothing_else(box, capsys):
    names = ("box.paths", "capon", "capon.field", "ideal", "ideal.field")
    assert sorted(item.name for item in box.iterdir()) == sorted(names)
    for name in ("ideal", "capon"):
        assert main(["validate", str(box / name)]) == 0, capsys.readouterr().out
    for name in names:
        assert main(["info", str(box / name)]) == 0
    text = capsys.readouterr().out
    assert "12" in text
    assert "28 GHz" in text
    dataset = Dataset.load(box / "ideal")
    assert len(dataset.photos) == 9
    assert dataset.photos[0].load().shape == (36, 48, 3)


def test_the_line_of_sight_comes_out_of_the_field_as_it_was_traced(box, capsys):
    where = [str(value) for value in AT]
    for name in ("ideal", "capon"):
        capsys.readouterr()
        assert main(["csi", str(box / f"{name}.field"), "--at", *where, "--format", "json"]) == 0
        paths = json.loads(capsys.readouterr().out)
        first = max(paths, key=lambda path: path["gain_db"])
        distance = math.dist(AT, BOX_TX)
        azimuth = math.degrees(math.atan2(BOX_TX[1] - AT[1], BOX_TX[0] - AT[0]))
        assert first["aoa_azimuth_deg"] == pytest.approx(azimuth, abs=0.1)
        assert first["delay_ns"] == pytest.approx(distance / SPEED_OF_LIGHT * 1e9, abs=0.01)
        if name == "ideal":
            friis_db = 20 * math.log10(SPEED_OF_LIGHT / 28e9 / (4 * math.pi * distance))
            assert first["gain_db"] == pytest.approx(friis_db, abs=1.0)


def test_a_remark_does_not_spoil_what_a_program_reads(box, capsys):
    command = ["csi", str(box / "ideal.field"), "--at", *map(str, OUTSIDE), "--format", "json"]
    assert main(command) == 0
    said = capsys.readouterr()
    assert len(json.loads(said.out)) > 0
    assert "note: this receiver stands outside the volume" in said.err


def test_render_draws_what_csi_lists(box, tmp_path):
    command = ["render", str(box / "ideal.field"), "--at", *map(str, AT), "--grid", "sphere", "--size", "90", "45"]
    assert main([*command, "--out", str(tmp_path / "s.npz")]) == 0
    with np.load(tmp_path / "s.npz") as content:
        row, col = np.unravel_index(content["gain_db"].argmax(), content["gain_db"].shape)
        towards = content["directions"][row, col]
    truth = np.subtract(BOX_TX, AT) / math.dist(BOX_TX, AT)
    assert float(towards @ truth) > math.cos(math.radians(6.0))


def test_the_transmitter_of_a_mirror_field_moves(box, tmp_path, capsys):
    name, tx = str(tmp_path / "mirror.field"), (-2.0, 3.0, 3.0)
    fit = ("--mesh", "box", "--mesh-count", "800")
    assert main(["fit", str(box / "ideal"), "--out", name, *fit]) == 0
    capsys.readouterr()
    ask = [name, "--at", *map(str, AT), "--tx", *map(str, tx)]
    assert main(["csi", *ask, "--format", "json"]) == 0
    first = max(json.loads(capsys.readouterr().out), key=lambda path: path["gain_db"])
    distance = math.dist(AT, tx)
    assert first["delay_ns"] == pytest.approx(distance / SPEED_OF_LIGHT * 1e9, abs=0.01)
    assert first["aoa_azimuth_deg"] == pytest.approx(math.degrees(math.atan2(tx[1] - AT[1], tx[0] - AT[0])), abs=0.01)
    assert main(["render", *ask, "--grid", "sphere", "--size", "90", "45", "--out", str(tmp_path / "s.npz")]) == 0
    with np.load(tmp_path / "s.npz") as content:
        towards = content["directions"][np.unravel_index(content["gain_db"].argmax(), content["gain_db"].shape)]
    assert float(towards @ np.subtract(tx, AT)) > distance * math.cos(math.radians(4.0))


@pytest.mark.parametrize("name", ["ideal", "capon"])
def test_eval_scores_the_held_out_positions_and_writes_its_report(box, tmp_path, capsys, name):
    report, numbers = tmp_path / "report.html", tmp_path / "report.json"
    command = ["eval", str(box / f"{name}.field"), str(box / name), "--read-test"]
    assert main([*command, "--out", str(report), "--json-out", str(numbers)]) == 0
    assert "Main peak" in capsys.readouterr().out
    scores = json.loads(numbers.read_text())
    assert set(scores) == {"random", "region"}
    assert report.read_text().lstrip().lower().startswith("<!doctype html>")
    assert "rf3dgs eval" in (box / name / "test_reads.log").read_text()


@pytest.fixture(scope="module")
def site(tmp_path_factory) -> Path:
    """A dataset of rendered blobs and of spectra around them, small enough to be fitted in seconds."""
    folder = tmp_path_factory.mktemp("kill")
    truth = Gaussians.random(30, (-1, -1, -1), (1, 1, 1), degree=0, seed=3)
    grid = pinhole_grid(32, 24, 60)
    photos = []
    for index in range(6):
        turn = index * math.pi / 3
        camera = Camera.of(Pose.look_at((3 * math.cos(turn), 3 * math.sin(turn), 0.5), (0.0, 0.0, 0.0)), grid)
        picture = (render_photo(truth, camera).clamp(0, 1) * 255).round().byte().numpy()
        Image.fromarray(picture).save(folder / f"{index}.png")
        photos.append(Photo(f"{index}.png", camera, folder / f"{index}.png"))
    random = torch.Generator().manual_seed(5)
    shape = (10, 12, 24)
    pose = Pose(2 * torch.rand(10, 3, generator=random) - 1)
    tx = Pose((1.5, 1.5, 1.8))
    power = power_from_db(-120 + 40 * torch.rand(shape, generator=random))
    delay = 2e-8 * (1 + torch.rand(shape, generator=random))
    aod = torch.nn.functional.normalize(torch.randn(*shape, 3, generator=random), dim=-1)
    instrument = Instrument.gaussian(0.4)
    spectra = Spectrum(power, equirect_grid(24, 12), pose, 60e9, instrument, "ideal", delay, aod, tx)
    Dataset(photos, spectra).split(seed=0).save(folder / "site")
    return folder / "site"


def started(site: Path, out: Path) -> subprocess.Popen[str]:
    """`rf3dgs fit` as a person starts it, with checkpoints every few iterations."""
    command = [sys.executable, "-m", "rf3dgs", "fit", str(site), "--out", str(out)]
    command += ["--visual.steps", "300", "--visual.start", "random", "--visual.start-count", "60"]
    command += ["--visual.max-count", "120", "--visual.checkpoint-every", "5", "--visual.degree", "1"]
    command += ["--radio.model", "paper", "--radio.steps", "300", "--radio.checkpoint-every", "5"]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def kill_in(stage: str, process: subprocess.Popen[str], out: Path, beyond: int) -> None:
    """SIGKILL as soon as the stage has a checkpoint later than iteration `beyond`."""
    folder = out.parent / f".{out.name}.checkpoints" / stage
    deadline = time.monotonic() + 120
    while time.monotonic() < deadline and process.poll() is None:
        newest = max((int(path.stem.removeprefix("step-")) for path in folder.glob("step-*.json")), default=0)
        if newest > beyond:
            os.kill(process.pid, signal.SIGKILL)
            process.communicate()
            assert process.returncode == -signal.SIGKILL
            return
        time.sleep(0.002)
    process.kill()
    said = process.communicate()
    raise AssertionError(f"the {stage} stage ended before it could be killed: {said}")


def test_a_fit_killed_in_either_stage_ends_byte_for_byte_as_one_that_was_not(site, tmp_path):
    calm = started(site, tmp_path / "calm.field")
    said = calm.communicate(timeout=300)
    assert calm.returncode == 0, said
    killed = tmp_path / "killed.field"
    kill_in("visual", started(site, killed), killed, 40)
    assert not killed.exists()
    kill_in("radio", started(site, killed), killed, 40)
    assert not killed.exists()
    last = started(site, killed)
    said = last.communicate(timeout=300)
    assert last.returncode == 0, said
    files = sorted(item.name for item in killed.iterdir())
    assert files == sorted(item.name for item in (tmp_path / "calm.field").iterdir())
    for name in files:
        assert (killed / name).read_bytes() == (tmp_path / "calm.field" / name).read_bytes(), name
    assert sorted(item.name for item in tmp_path.iterdir()) == ["calm.field", "killed.field"]
