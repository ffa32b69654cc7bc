"""`trace` and `photos` as jobs, through the command line: what is refused, and that the same command again is quick."""

import json

import pytest

from rf3dgs.channel.io import PathsReader
from rf3dgs.cli.main import main
from rf3dgs.data.formats.detect import read_photos

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
