"""`trace` and `photos` as jobs, through the command line: what is refused, and that the same command again is quick."""

import json
from io import BytesIO

import numpy as np
import pytest
from PIL import Image

from rf3dgs.channel.io import PathsReader
from rf3dgs.cli.main import main
from rf3dgs.data.formats.detect import read_photos
from rf3dgs.propagation.config import PhotoConfig, ReceiverConfig
from rf3dgs.propagation.jobs.toolchain import fingerprint
from rf3dgs.propagation.photographer import render_panoramas
from rf3dgs.propagation.sites.lobby import lobby
from rf3dgs.propagation.sites.receivers import receivers_of
from rf3dgs.propagation.sites.scenes import scene_of

TRACE = ("--trace.rays", "2000", "--trace.depth", "1")
PHOTO = ("--photo.width", "24", "--photo.height", "16", "--photo.samples", "1")


@pytest.mark.parametrize(
    ("command", "words"),
    [
        (
            "trace box --preset paper --trace.rays 5",
            "the preset 'paper' is a whole set and says how paths are traced; leave out other settings",
        ),
        ("trace box --rx.count 0", "count from 1 to 1000000; got 0.35 and 0"),
        ("trace box --shard-size 0", "--shard-size must be at least 1; got 0"),
        ("trace box --workers 0", "--workers must be at least 1; got 0"),
        ("trace box --workers 2 --cluster tcp://127.0.0.1:9", "give one of them"),
        ("photos box --count 0", "--count must be at least 1; got 0"),
        ("photos box --workers 3 --cluster tcp://127.0.0.1:9", "give one of them"),
        ("panoramas box --width 33", "--width must be even and at least 8 pixels; got 33"),
        ("panoramas box --samples 0", "--samples must be at least 1; got 0"),
        ("panoramas box --workers 3 --cluster tcp://127.0.0.1:9", "give one of them"),
    ],
)
def test_wrong_options_are_one_sentence_and_write_nothing(tmp_path, capsys, command, words):
    assert main([*command.split(), "--out", str(tmp_path / "set")]) == 2
    assert words in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


def test_the_same_trace_again_makes_the_missing_shard_alone(tmp_path, capsys):
    pytest.importorskip("sionna.rt")
    out = tmp_path / "box.paths"
    command = ["trace", "box", "--rx.count", "5", "--shard-size", "2", "--out", str(out), *TRACE]
    assert main(command) == 0
    said = capsys.readouterr().out
    with PathsReader(out) as reader:
        assert reader.traced is not None
        assert f"5 receivers, at least {reader.traced.min():,} paths each" in said
    content = {item.name: item.read_bytes() for item in out.iterdir()}
    times = {item.name: item.stat().st_mtime_ns for item in out.iterdir()}
    (out / "00001.h5").unlink()
    assert main(["info", str(out)]) == 2
    assert "has 2 of 3 shards; run the same rf3dgs trace command again" in capsys.readouterr().err
    assert main(command) == 0
    assert {item.name: item.read_bytes() for item in out.iterdir()} == content
    assert {item.name for item in out.iterdir() if item.stat().st_mtime_ns != times[item.name]} == {"00001.h5"}
    assert main([*command, "--rx.seed", "1"]) == 2
    assert "another made_from.receivers.seed (it had 0, this run has 1)" in capsys.readouterr().err
    assert main(["info", str(out)]) == 0
    assert "propagation paths" in capsys.readouterr().out


def test_photographs_go_on_and_end_in_nerfstudios_layout(tmp_path, capsys):
    pytest.importorskip("mitsuba")
    out = tmp_path / "photos"
    command = ["photos", "box", "--count", "5", "--shard-size", "2", "--out", str(out), *PHOTO]
    assert main(command) == 0
    content = {item.name: item.read_bytes() for item in out.iterdir()}
    assert set(content) == {*(f"{number:05d}.jpg" for number in range(5)), "manifest.json", "transforms.json"}
    assert len(json.loads(content["transforms.json"])["frames"]) == 5
    assert len(read_photos(out)) == 5
    for name in ("00003.jpg", "transforms.json"):
        (out / name).unlink()
    assert main(command) == 0
    assert {item.name: item.read_bytes() for item in out.iterdir()} == content
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "holiday.jpg").write_bytes(b"precious")
    assert main(["photos", "box", "--out", str(tmp_path / "mine"), *PHOTO]) == 2
    assert "has no manifest.json but holds holiday.jpg; choose another name with --out" in capsys.readouterr().err
    assert [item.name for item in (tmp_path / "mine").iterdir()] == ["holiday.jpg"]


def test_panoramas_stand_where_trace_puts_receivers_and_go_on(tmp_path):
    pytest.importorskip("mitsuba")
    out = tmp_path / "panoramas"
    command = ["panoramas", "box", "--rx.count", "3", "--rx.seed", "4", "--width", "16", "--samples", "1"]
    command += ["--shard-size", "2", "--out", str(out)]
    assert main(command) == 0
    content = {item.name: item.read_bytes() for item in out.iterdir()}
    assert set(content) == {"00000.jpg", "00001.jpg", "00002.jpg", "manifest.json", "panoramas.json"}
    pictures = [np.asarray(Image.open(BytesIO(content[f"{number:05d}.jpg"]))).astype(int) for number in range(3)]
    assert pictures[0].shape == (8, 16, 3)
    about = json.loads(content["panoramas.json"])
    scene = scene_of("box")
    rx = receivers_of(scene, ReceiverConfig(count=3, seed=4))
    assert [item["position"] for item in about["panoramas"]] == rx.position.tolist()
    (third,) = render_panoramas(scene, rx[2:], 16, PhotoConfig(samples=1, seed=12))
    assert np.abs(pictures[2] - third).mean() < 4  # JPEG's loss
    assert np.abs(pictures[1] - third).mean() > 8
    for name in ("00001.jpg", "00002.jpg", "panoramas.json"):
        (out / name).unlink()
    assert main(command) == 0
    assert {item.name: item.read_bytes() for item in out.iterdir()} == content


def test_people_of_the_command_line_are_those_of_python(tmp_path, capsys):
    pytest.importorskip("mitsuba")
    out = tmp_path / "photos"
    assert main(["photos", "lobby-full", "--people", "2", "--count", "1", "--out", str(out), *PHOTO]) == 0
    made_from = json.loads((out / "manifest.json").read_text())["made_from"]
    assert made_from["scene"]["sha256"] == fingerprint(lobby("full", people=2))
    for scene, people, words in (
        ("box", "1", "--people stand in lobby and lobby-full only; got the scene 'box'"),
        ("lobby", "9", "people must be between 0 and 8; got 9"),
    ):
        for command in ("photos", "trace", "panoramas"):
            assert main([command, scene, "--people", people, "--out", str(tmp_path / "other")]) == 2
            assert words in capsys.readouterr().err
            assert not (tmp_path / "other").exists()
