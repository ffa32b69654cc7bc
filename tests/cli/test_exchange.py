"""`rf3dgs import` and `rf3dgs export`: round trips through every format, and one sentence for what cannot be."""

import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.io import loadmat

from rf3dgs.channel.io import PathsReader, load_paths, save_paths
from rf3dgs.cli.main import main
from rf3dgs.core.frames import Pose
from rf3dgs.propagation.exchange.deepmimo import read_deepmimo
from rf3dgs.propagation.room import shoebox

SIZE, TX, FREQUENCY = (8.0, 6.0, 3.0), Pose((1.0, 1.5, 2.3)), 28e9
RX = Pose([[4.0, 3.2, 1.2], [2.0, 4.0, 0.7], [6.5, 2.5, 1.9]])


@pytest.fixture
def source(tmp_path) -> Path:
    file = tmp_path / "room.paths"
    save_paths(shoebox(SIZE, TX, RX, FREQUENCY, 3, "concrete"), file, meta={"scene": "room"})
    return file


def refused(capsys, *arguments) -> str:
    """The one sentence with which a command ends, status 2."""
    capsys.readouterr()
    assert main([str(argument) for argument in arguments]) == 2
    said = capsys.readouterr().err.splitlines()
    ours = [line for line in said if line.startswith("rf3dgs: ")]
    assert len(ours) == 1
    assert said[-1] == ours[0]
    return ours[0]


def run(*arguments) -> None:
    assert main([str(argument) for argument in arguments]) == 0


def test_paths_go_to_deepmimo_and_back(source, tmp_path, capsys):
    run("export", source, "--to", "deepmimo", "--out", tmp_path / "scenario")
    assert "3 receivers, up to 25 paths each" in capsys.readouterr().out
    run("import", tmp_path / "scenario", "--out", tmp_path / "back.paths")
    sent, back = load_paths(source).strongest(25), load_paths(tmp_path / "back.paths")
    assert torch.equal(back.delay, sent.delay)
    assert torch.allclose(back.coeff, sent.coeff, rtol=5e-6, atol=1e-12)
    assert torch.equal(back.order, sent.order)
    with PathsReader(tmp_path / "back.paths") as reader:
        assert reader.meta == {"imported": "deepmimo", "from": "scenario"}


def test_paths_go_to_hdf5_and_back_bit_for_bit(source, tmp_path):
    run("export", source, "--to", "hdf5", "--out", tmp_path / "matlab" / "room.h5")
    assert sorted(item.name for item in (tmp_path / "matlab").iterdir()) == ["read_paths.m", "room.h5"]
    run("import", tmp_path / "matlab" / "room.h5", "--out", tmp_path / "back.paths")
    sent, back = load_paths(source), load_paths(tmp_path / "back.paths")
    for name in ("coeff", "delay", "aoa_zenith", "aod_azimuth", "order", "kind"):
        assert torch.equal(getattr(back, name), getattr(sent, name)), name
    with PathsReader(tmp_path / "back.paths") as reader:
        assert reader.meta == {"scene": "room", "imported": "paths", "from": "room.h5"}


def test_a_reader_of_ones_own_is_not_replaced(source, tmp_path):
    (tmp_path / "read_paths.m").write_text("% mine")
    run("export", source, "--to", "hdf5", "--out", tmp_path / "room.h5")
    assert (tmp_path / "read_paths.m").read_text() == "% mine"


def test_paths_go_to_matlab(source, tmp_path):
    run("export", source, "--to", "matlab", "--out", tmp_path / "room_rays.m", "--strongest", "4")
    text = (tmp_path / "room_rays.m").read_text()
    assert text.startswith("function [rays, txPosition, rxPosition] = room_rays()")
    assert text.count("\npaths{") == 3
    run("export", source, "--to", "mat", "--out", tmp_path / "room.mat")
    back = loadmat(tmp_path / "room.mat")
    assert back["coeff"].shape == (3, 63)
    assert np.array_equal(back["delay"], load_paths(source).delay.numpy())


def test_only_the_strongest_are_kept_when_asked(source, tmp_path):
    run("export", source, "--to", "hdf5", "--out", tmp_path / "few.paths", "--strongest", "2")
    assert load_paths(tmp_path / "few.paths").count.tolist() == [2, 2, 2]
    run("export", source, "--to", "deepmimo", "--out", tmp_path / "few", "--strongest", "40")
    assert read_deepmimo(tmp_path / "few").coeff.shape == (3, 40)


def test_a_pair_of_a_scenario_is_chosen(source, tmp_path, capsys):
    folder = tmp_path / "scenario"
    run("export", source, "--to", "deepmimo", "--out", folder)
    for file in list(folder.glob("*_t000_tx000_r001.npz")):
        shutil.copy(file, folder / file.name.replace("tx000", "tx001"))
    told = refused(capsys, "import", folder, "--out", tmp_path / "back.paths")
    assert "several pairs of transmitter and receivers; choose one of t000_tx000_r001 (3 receivers)" in told
    run("import", folder, "--pair", "t000_tx001_r001", "--out", tmp_path / "back.paths")
    assert len(load_paths(tmp_path / "back.paths").rx) == 3


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--to", "mat", "--out", "room.txt"), "--out must end in .mat for --to mat"),
        (("--to", "matlab", "--out", "2room.m"), "is named like my_rays.m"),
        (("--to", "hdf5", "--out", "room.paths"), "is the source itself"),
        (("--to", "mat", "--out", "room.mat", "--strongest", "0"), "--strongest must be at least 1"),
        (("--to", "deepmimo", "--out", "photos"), "holds something else than a DeepMIMO scenario, such as a.jpg"),
    ],
)
def test_exports_that_cannot_be_leave_nothing(source, tmp_path, capsys, monkeypatch, arguments, message):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "photos").mkdir()
    (tmp_path / "photos" / "a.jpg").touch()
    before = sorted(tmp_path.rglob("*"))
    assert message in refused(capsys, "export", source, *arguments)
    assert sorted(tmp_path.rglob("*")) == before


def test_imports_that_cannot_be_leave_nothing(source, tmp_path, capsys):
    target = tmp_path / "new.paths"
    (tmp_path / "empty").mkdir()
    (tmp_path / "notes.txt").write_text("hello")
    (tmp_path / "broken.paths").write_bytes(source.read_bytes()[:2000])
    (tmp_path / "broken.h5").write_bytes(b"no HDF5")
    before = sorted(tmp_path.rglob("*"))
    cases = {
        "nowhere": "there is no such file or folder",
        "empty": "expected a DeepMIMO v4 folder (params.json) or a folder of paths (manifest.json)",
        "notes.txt": "expected a folder, or a file ending in .paths, .h5, .hdf5, .mat, .csv",
        "broken.paths": "expected an HDF5 file; it is damaged",
        "broken.h5": "expected an HDF5 file; it is damaged",
    }
    for name, message in cases.items():
        told = refused(capsys, "import", tmp_path / name, "--out", target)
        assert message in told
        assert name in told
    assert "is the source itself" in refused(capsys, "import", source, "--out", source)
    assert "--pair is for DeepMIMO folders" in refused(capsys, "import", source, "--out", target, "--pair", "x")
    assert "--count is for measured soundings" in refused(capsys, "import", source, "--out", target, "--count", "3")
    assert "--untold is for measured soundings" in refused(
        capsys, "import", source, "--out", target, "--untold", "ahead"
    )
    assert sorted(tmp_path.rglob("*")) == before


def test_an_older_file_stays_when_an_import_fails(source, tmp_path, capsys):
    folder = tmp_path / "scenario"
    run("export", source, "--to", "deepmimo", "--out", folder)
    target = tmp_path / "old.paths"
    target.write_bytes(source.read_bytes())
    (folder / "delay_t000_tx000_r001.npz").unlink()
    assert "delay_t000_tx000_r001.npz: there is no such file" in refused(capsys, "import", folder, "--out", target)
    assert target.read_bytes() == source.read_bytes()


@pytest.mark.parametrize("suffix", [".h5", ".mat", ".csv"])
def test_a_measurement_becomes_paths_through_sage(tmp_path, suffix):
    """A noise-free comb of one line of sight: its delay to a hundredth of the resolution, its gain to 0.1 dB."""
    from rf3dgs.channel.arrays import planar_array
    from rf3dgs.channel.response import cfr
    from rf3dgs.channel.sounding import Sounding
    from rf3dgs.propagation.exchange.measured import write_sounding

    array = planar_array(3, 3, "isotropic")
    rx = Pose.look_at(RX.position[:1], TX.position)
    tx = Pose.look_at(TX.position, RX.position[0])
    paths = shoebox(SIZE, tx, rx, FREQUENCY, 0)
    offsets = (torch.arange(32, dtype=torch.float64) - 16) * 10e6
    response = cfr(paths, array, array, offsets).to(torch.complex128)
    sounding = Sounding(response, offsets, FREQUENCY, tx, rx, array_rx=array, array_tx=array)
    write_sounding(tmp_path / f"measured{suffix}", sounding)
    run("import", tmp_path / f"measured{suffix}", "--out", tmp_path / "found.paths", "--count", "1")
    found = load_paths(tmp_path / "found.paths")
    assert found.count.tolist() == [1]
    assert float(found.delay[0, 0] - paths.delay[0, 0]) == pytest.approx(0, abs=0.01 / 320e6)
    assert float(found.total_gain[0] / paths.total_gain[0]) == pytest.approx(1, abs=0.02)


def test_a_row_of_elements_is_refused_until_what_it_cannot_tell_is_taken_as_ahead(tmp_path, capsys):
    from rf3dgs.channel.arrays import planar_array
    from rf3dgs.channel.response import cfr
    from rf3dgs.channel.sounding import Sounding
    from rf3dgs.propagation.exchange.measured import write_sounding

    row = planar_array(1, 6, "isotropic")
    rx = Pose.look_at([[4.0, 3.2, TX.position[2]]], TX.position)
    paths = shoebox(SIZE, TX, rx, FREQUENCY, 0)
    offsets = (torch.arange(16, dtype=torch.float64) - 8) * 20e6
    response = cfr(paths, row, None, offsets).to(torch.complex128)
    write_sounding(tmp_path / "row.h5", Sounding(response, offsets, FREQUENCY, TX, rx, array_rx=row))
    target = tmp_path / "found.paths"
    assert "zenith" in refused(capsys, "import", tmp_path / "row.h5", "--count", "1", "--out", target)
    assert not target.exists()
    run("import", tmp_path / "row.h5", "--count", "1", "--untold", "ahead", "--out", target)
    found = load_paths(target)
    assert float(found.aoa_zenith[0, 0]) == pytest.approx(np.pi / 2, abs=1e-6)
    assert float(found.aoa_azimuth[0, 0] - paths.aoa_azimuth[0, 0]) == pytest.approx(0, abs=1e-3)
