"""`rf3dgs spectra`: receiver by receiver, in flat memory, going on where it was killed; and the paper's protocol."""

import math
import os
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from rf3dgs.channel.arrays import planar_array
from rf3dgs.channel.io import PathsReader, PathsWriter
from rf3dgs.cli.main import main
from rf3dgs.core.frames import Pose
from rf3dgs.core.grids import equirect_grid, pinhole_grid
from rf3dgs.core.units import SPEED_OF_LIGHT
from rf3dgs.data.dataset import Dataset
from rf3dgs.spectra.config import ArrayProcessing, Loading
from rf3dgs.spectra.scan import spectrum_of

ROOM = ((0, 0, 1), (14, 15, 2))


@pytest.fixture
def write_paths(tmp_path, random_paths):
    """Paths to receivers scattered in a room, in a file."""

    def write(count: int, each: int = 30) -> Path:
        file = tmp_path / f"{count}-{each}.paths"
        rx = Pose.scatter(ROOM, count, seed=1)
        first = random_paths(each)
        with PathsWriter(file, first.frequency, first.tx) as writer:
            for number in range(count):
                paths = random_paths(each, seed=number, rx=rx[number])
                flight = float(torch.linalg.vector_norm(rx[number].position - first.tx.position)) / SPEED_OF_LIGHT
                writer.append(replace(paths, delay=paths.delay + flight))
        return file

    return write


MAKE_AND_READ = """
import resource, sys
from rf3dgs.cli.main import main
assert main(["spectra", *sys.argv[1:]]) == 0
from rf3dgs.data import Dataset
dataset = Dataset.load(sys.argv[3], unseal_test=True).split(seed=3)
print(sum(float(one.power.max()) > 0 for one in dataset.spectra))
assert main(["validate", sys.argv[3]]) == 0
print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024)
"""


def test_memory_does_not_grow_with_the_receivers(write_paths, tmp_path):
    peaks = []
    for count in (20, 180):
        out = str(tmp_path / f"site-{count}")
        command = [sys.executable, "-c", MAKE_AND_READ, str(write_paths(count)), "--out", out, "--size", "180", "90"]
        said = subprocess.run(command, capture_output=True, text=True, check=True).stdout.splitlines()
        assert said[1] == str(count), "making, opening, splitting, iterating and validating are in this process"
        peaks.append(float(said[-1]))
    held = 160 * 180 * 90 * 5 * 4 / 2**20
    assert held > 49, "what 160 spectra take in memory [MB]"
    assert peaks[1] - peaks[0] < 0.2 * held


def test_the_stream_is_what_each_receiver_alone_gives(write_paths, tmp_path):
    file = write_paths(12)
    assert main(["spectra", str(file), "--out", str(tmp_path / "site"), "--size", "48", "24"]) == 0
    stored = Dataset.load(tmp_path / "site", unseal_test=True).spectra
    with PathsReader(file) as reader:
        for number in range(12):
            alone = spectrum_of(reader[number], None, equirect_grid(48, 24))
            some = alone.power > 0
            assert torch.equal(stored[number].power > 0, some)
            assert float((stored[number].gain_db - alone.gain_db)[some].abs().max()) < 0.00251, "half a step"
            assert float((stored[number].delay - alone.delay)[some].abs().max()) < 5.1e-12
    assert sorted(item.name for item in tmp_path.iterdir()) == ["12-30.paths", "site"]


def started(file: Path, out: Path) -> subprocess.Popen[str]:
    command = [sys.executable, "-m", "rf3dgs", "spectra", str(file), "--out", str(out), "--size", "360", "180"]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def test_a_killed_run_goes_on_and_ends_byte_for_byte_as_one_that_was_not(write_paths, tmp_path):
    file = write_paths(40)
    process = started(file, tmp_path / "killed")
    folder = tmp_path / ".killed.spectra"
    deadline = time.monotonic() + 120
    while not list(folder.glob("part-*.h5")) and time.monotonic() < deadline and process.poll() is None:
        time.sleep(0.005)
    os.kill(process.pid, signal.SIGKILL)
    process.communicate()
    assert process.returncode == -signal.SIGKILL
    finished = len(list(folder.glob("part-*.h5")))
    assert finished > 0
    assert not (tmp_path / "killed").exists()
    assert main(["spectra", str(file), "--out", str(tmp_path / "calm"), "--size", "360", "180"]) == 0
    again = started(file, tmp_path / "killed")
    _, progress = again.communicate(timeout=120)
    assert again.returncode == 0, progress
    assert "spectra: 40/40" in progress
    for name in ("spectra.h5", "dataset.json"):
        assert (tmp_path / "killed" / name).read_bytes() == (tmp_path / "calm" / name).read_bytes()
    assert not folder.exists()


def test_parts_of_other_settings_are_not_taken_over(write_paths, tmp_path, capsys):
    file = write_paths(10)
    folder = tmp_path / ".site.spectra"
    folder.mkdir()
    (folder / "mine.txt").write_text("mine")
    assert main(["spectra", str(file), "--out", str(tmp_path / "site")]) == 2
    assert "holds something else; remove it" in capsys.readouterr().err
    assert (folder / "mine.txt").read_text() == "mine"
    (folder / "mine.txt").unlink()
    (folder / "run.json").write_text('{"settings": {"size": [9, 9]}, "paths": "other"}')
    (folder / "part-0000000.h5").write_bytes(b"of another run")
    assert main(["spectra", str(file), "--out", str(tmp_path / "site"), "--size", "48", "24"]) == 0
    assert Dataset.load(tmp_path / "site").grid.shape == (24, 48)


def test_the_papers_preset_gives_four_pictures_of_each_position_on_one_side(write_paths, tmp_path, capsys):
    out = tmp_path / "site"
    assert main(["spectra", str(write_paths(5, 100)), "--out", str(out), "--preset", "paper"]) == 0
    assert "20 spectra of 300x200 at 5 positions" in capsys.readouterr().out
    dataset = Dataset.load(out, unseal_test=True)
    assert dataset.grid.kind == "pinhole"
    assert dataset.grid.K is not None
    assert float(dataset.grid.K[0, 0]) == pytest.approx(150.0)
    assert dataset.places.tolist() == [number // 4 for number in range(20)]
    forward = dataset.pose.world_from_device[:4, :, 0]
    expected = torch.tensor([[1.0, 0, 0], [0, 1, 0], [-1, 0, 0], [0, -1, 0]])
    torch.testing.assert_close(forward, expected, atol=1e-6, rtol=0)
    roles = [set(dataset.roles[start : start + 4]) for start in range(0, 20, 4)]
    assert all(len(each) == 1 for each in roles)
    assert sum(each == {"test"} for each in roles) == 1
    assert dataset.roles.count("train") == 16
    assert main(["validate", str(out)]) == 0
    capsys.readouterr()
    assert main(["info", str(out)]) == 0
    told = [line.split() for line in capsys.readouterr().out.splitlines()]
    assert ["positions", "5"] in told
    assert ["pictures", "16", "train,", "4", "test"] in told or ["pictures", "4", "test,", "16", "train"] in told


def test_the_sphere_preset_and_a_region(write_paths, tmp_path, capsys):
    command = ["spectra", str(write_paths(10)), "--out", str(tmp_path / "site"), "--preset", "sphere"]
    assert main([*command, "--split", "region"]) == 0
    dataset = Dataset.load(tmp_path / "site")
    assert dataset.grid.kind == "equirect"
    assert dataset.grid.shape == (180, 360)
    assert dataset.roles.count("region") == 2
    assert "test" not in dataset.roles
    fit = ["fit", str(tmp_path / "site"), "--mesh", "lobby", "--out", str(tmp_path / "site.field")]
    assert main([*fit, "--fraction", "1.5"]) == 2
    assert (
        "fraction must lie in (0, 1], the share of the training places to keep, such as 0.2" in capsys.readouterr().err
    )


def test_a_preset_and_what_it_sets_are_not_both_given(write_paths, tmp_path, capsys):
    command = ["spectra", str(write_paths(10)), "--out", str(tmp_path / "site"), "--preset", "paper"]
    assert main([*command, "--fov-deg", "60"]) == 2
    assert "--preset paper sets --fov-deg as well; give one of the two" in capsys.readouterr().err
    assert not (tmp_path / "site").exists()


@pytest.mark.parametrize(
    ("options", "how"),
    [
        (
            "--method mvdr --snapshots 40 --bandwidth 1e9 --taps 0 1e-8 --snr-db 15 --averaging forward-backward "
            "--subarray 3 2 --loading.amount 25 --loading.rule snr",
            ArrayProcessing(40, 1e9, (0.0, 1e-8), 15.0, "forward-backward", (3, 2), Loading(25.0, "snr")),
        ),
        ("--method music --snr-db 20 --sources 3", ArrayProcessing(snr_db=20.0, sources=3)),
        ("--method music --snr-db 20 --sources aic", ArrayProcessing(snr_db=20.0, sources="aic")),
        ("--method cbf --snapshots None", ArrayProcessing(snapshots=None)),
    ],
)
def test_the_options_of_arrays_are_the_fields_of_their_processing(write_paths, tmp_path, options, how):
    file, out = write_paths(10), tmp_path / "site"
    view = ["--array", "4x4", "--pattern", "isotropic", "--grid", "pinhole", "--size", "24", "16", "--seed", "5"]
    assert main(["spectra", str(file), "--out", str(out), *view, *options.split()]) == 0
    stored = Dataset.load(out, unseal_test=True).spectra
    method = options.split()[1]
    with PathsReader(file) as reader:
        alone = spectrum_of(
            reader[7],
            planar_array(4, 4, "isotropic"),
            pinhole_grid(24, 16, 90),
            method=method,
            processing=how,
            seed=12,
        )
    assert float((stored[7].gain_db - alone.gain_db).abs().max()) < 0.00251, "half a step"
    assert stored.instrument.name == alone.instrument.name
    assert main(["validate", str(out)]) == 0


def test_fields_are_not_made_of_spectra_without_level(write_paths, tmp_path, capsys):
    out = tmp_path / "site"
    options = ["--method", "music", "--array", "4x4", "--sources", "3", "--snr-db", "20", "--size", "24", "12"]
    assert main(["spectra", str(write_paths(10)), "--out", str(out), *options]) == 0
    assert main(["fit", str(out), "--mesh", "lobby", "--out", str(tmp_path / "site.field")]) == 2
    assert "have no level to learn; make spectra of power" in capsys.readouterr().err


def test_the_ideal_lobe_is_as_wide_as_asked(write_paths, tmp_path):
    out = tmp_path / "site"
    assert main(["spectra", str(write_paths(10)), "--out", str(out), "--size", "24", "12", "--lobe-deg", "40"]) == 0
    lobe = Dataset.load(out, unseal_test=True).spectra.instrument.lobe
    assert lobe == pytest.approx(math.radians(40), rel=1e-6)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ("--snr-db 20", "an ideal spectrum has no array to process"),
        ("--method cbf --lobe-deg 3", 'lobe belongs to method "ideal"'),
        ("--method cbf --loading.amount 0.1", 'loading belongs to method "capon"'),
        ("--method mvdr --sources 2", 'sources belong to method "music"'),
        ("--method music --snapshots 64", "more snapshots than the 64 elements; got 64"),
        ("--method mvdr --subarray 9 2", "1 to 8 rows and 1 to 8 columns of the 8x8 patch array; got 9x2"),
    ],
)
def test_options_that_cannot_be_are_told_before_the_paths_are_read(write_paths, tmp_path, capsys, options, message):
    out = tmp_path / "site"
    assert main(["spectra", str(write_paths(10)), "--out", str(out), *options.split()]) == 2
    told = capsys.readouterr().err
    assert message in told
    assert "reading paths" not in told
    assert [item.name for item in tmp_path.iterdir()] == ["10-30.paths"]


def test_values_that_no_field_can_have_are_told_with_the_usage(write_paths, tmp_path, capsys):
    command = ["spectra", str(write_paths(10)), "--out", str(tmp_path / "site"), "--method", "mvdr"]
    with pytest.raises(SystemExit, match="2"):
        main([*command, "--loading.amount", "-1"])
    told = " ".join(capsys.readouterr().err.split())
    assert "a relative loading must be finite and, as a power, not negative; got -1.0" in told
    assert not (tmp_path / "site").exists()
