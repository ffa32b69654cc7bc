"""The command line as a person meets it: help, errors in one sentence, answers from the shipped field."""

import json
import os
import resource
import subprocess
import sys
from pathlib import Path

import pytest

from rf3dgs.cli.main import main
from rf3dgs.cli.show import table

COMMANDS = (
    *("demo", "trace", "photos", "panoramas", "spectra", "import", "export", "fit", "fit-geometry"),
    *("fit-radio", "render", "csi", "eval", "view", "info", "validate", "doctor"),
)
AT = ("lobby", "--at", "7", "5", "1.5")


def run(*arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run([sys.executable, "-m", "rf3dgs", *arguments], capture_output=True, text=True, check=False)


def test_help_is_instant_because_torch_is_not_imported() -> None:
    code = "import sys; from rf3dgs.cli.main import main\ntry: main(['--help'])\nfinally: print('torch' in sys.modules)"
    seconds = []
    for _ in range(3):
        before = resource.getrusage(resource.RUSAGE_CHILDREN)
        result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
        after = resource.getrusage(resource.RUSAGE_CHILDREN)
        seconds.append(after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime)
    assert result.stdout.rstrip().endswith("False")
    assert min(seconds) < 1.0, "twice the half second of processor time that it should take"
    assert all(f" {command} " in result.stdout for command in COMMANDS)


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_explains_itself_in_eighty_columns(command: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stop:
        main([command, "--help"])
    text = capsys.readouterr().out
    assert stop.value.code == 0
    assert "usage: rf3dgs" in text


def test_version() -> None:
    assert run("--version").stdout.startswith("rf3dgs 0.")


def test_an_error_is_one_sentence_and_status_two(tmp_path: Path) -> None:
    result = run("render", str(tmp_path / "nothing.field"), "--at", "1", "2", "1")
    assert result.returncode == 2
    assert "Traceback" not in result.stderr
    assert result.stderr.count("\n") == 1
    assert "there is no field" in result.stderr
    assert "rf3dgs fit" in result.stderr


def test_csi_of_the_shipped_field_lists_the_line_of_sight_first(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["csi", *AT, "--strongest", "3", "--format", "json"]) == 0
    rows = json.loads(capsys.readouterr().out)
    assert len(rows) == 3
    assert [row["gain_db"] for row in rows] == sorted((row["gain_db"] for row in rows), reverse=True)
    assert set(rows[0]) == {
        *("gain_db", "delay_ns"),
        *("aoa_zenith_deg", "aoa_azimuth_deg", "aod_zenith_deg", "aod_azimuth_deg"),
    }


@pytest.mark.parametrize(("form", "start"), [("text", "path"), ("csv", "gain_db,delay_ns"), ("json", "[")])
def test_csi_formats_agree(form: str, start: str, tmp_path: Path) -> None:
    file = tmp_path / "paths.txt"
    assert main(["csi", *AT, "--strongest", "2", "--format", form, "--out", str(file)]) == 0
    assert file.read_text().lstrip().startswith(start)


def test_csi_writes_matlab(tmp_path: Path) -> None:
    from scipy.io import loadmat

    file = tmp_path / "paths.mat"
    assert main(["csi", *AT, "--strongest", "2", "--format", "mat", "--out", str(file)]) == 0
    assert loadmat(file)["delay_ns"].size == 2


def test_render_writes_a_picture_and_numbers(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    import numpy as np
    from PIL import Image

    picture, numbers = tmp_path / "spectrum.png", tmp_path / "spectrum.npz"
    assert main(["render", *AT, "--out", str(picture), "--size", "60", "40"]) == 0
    with Image.open(picture) as opened:
        assert opened.width > 60
    assert "peak -" in capsys.readouterr().out
    assert (
        main(
            [
                "render",
                "lobby",
                "--at",
                "7",
                "5",
                "1.5",
                "--out",
                str(numbers),
                "--grid",
                "sphere",
                "--size",
                "60",
                "30",
            ]
        )
        == 0
    )
    with np.load(numbers) as content:
        assert content["gain_db"].shape == (30, 60)
        assert content["aod"].shape == (30, 60, 3)
        assert float(content["delay"].max()) < 1e-6


def test_a_receiver_outside_the_trained_volume_is_marked(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = str(tmp_path / "far.png")
    assert main(["render", "lobby", "--at", "60", "5", "1.5", "--out", out, "--size", "30", "20"]) == 0
    assert "outside the volume" in capsys.readouterr().err


def test_info_and_validate_of_the_shipped_dataset(capsys: pytest.CaptureFixture[str]) -> None:
    from rf3dgs.cli.facts import ASSETS

    assert main(["info", str(ASSETS / "lobby")]) == 0
    assert main(["info", str(ASSETS / "lobby.field")]) == 0
    text = capsys.readouterr().out
    assert "60 GHz" in text
    assert "photographs" in text
    assert "(0.60, 0.80, 2.60) m, given" in text
    assert main(["validate", str(ASSETS / "lobby")]) == 0
    assert "good" in capsys.readouterr().out


def test_the_shipped_assets_are_small() -> None:
    from rf3dgs.cli.facts import ASSETS

    def megabytes(folder: Path) -> float:
        return sum(file.stat().st_size for file in folder.rglob("*") if file.is_file()) / 1e6

    assert 0.1 < megabytes(ASSETS / "lobby") < 12.0
    assert 0.1 < megabytes(ASSETS / "lobby.field") < 6.0


def test_doctor_finds_the_core_and_the_tracer(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["doctor", "--format", "json"]) == 0
    checks = {check["what"]: check for check in json.loads(capsys.readouterr().out)}
    assert checks["native core"]["works"]
    assert checks["ray tracer"]["works"]


def test_tables_stay_within_their_width() -> None:
    text = table([("name", "value " * 40), ("longer name", "x")], width=60)
    assert all(len(line) <= 60 for line in text.splitlines())
    assert text.splitlines()[-1].split() == ["longer", "name", "x"]


def test_photos_never_replace_a_folder_of_something_else(tmp_path, capsys):
    folder = tmp_path / "holiday"
    folder.mkdir()
    (folder / "00000.jpg").touch()
    (folder / "diary.txt").write_text("dear diary")
    assert main(["photos", "lobby", "--out", str(folder)]) == 2
    assert "has no manifest.json but holds 00000.jpg; choose another name" in capsys.readouterr().err
    assert (folder / "diary.txt").read_text() == "dear diary"


def test_an_unknown_log_level_is_one_sentence(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("RF3DGS_LOG", "chatty")
    assert main(["doctor"]) == 2
    assert capsys.readouterr().err == "rf3dgs: RF3DGS_LOG must be DEBUG, INFO, WARNING or ERROR; got 'CHATTY'\n"


def test_the_shipped_field_is_scored_on_validation_positions(tmp_path, capsys) -> None:
    report = tmp_path / "report.html"
    assert main(["eval", "lobby", "lobby", "--out", str(report), "--json-out", str(tmp_path / "scores.json")]) == 0
    table_of_scores = capsys.readouterr().out
    assert "Hold-out: validation (8 positions)" in table_of_scores
    assert "2nd solve" not in table_of_scores, "the validation positions were solved once"
    assert set(json.loads((tmp_path / "scores.json").read_text())) == {"validation"}
    assert "Hold-out: validation" in report.read_text()


def test_a_preset_and_settings_of_the_radio_stage_do_not_mix(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = ("--out", str(tmp_path / "field"))
    assert main(["fit-radio", "nowhere.ply", "lobby", *out, "--preset", "fast", "--radio.steps", "3"]) == 2
    assert "--preset fast sets all of the radio stage; give it or --radio.*, not both" in capsys.readouterr().err


def test_help_into_a_closed_pipe_ends_quietly():
    reading, writing = os.pipe()
    os.close(reading)
    with os.fdopen(writing, "w") as closed:
        run = subprocess.run([sys.executable, "-m", "rf3dgs", "trace", "--help"], stdout=closed, stderr=-1, check=False)
    assert run.returncode == 0
    assert run.stderr == b""
