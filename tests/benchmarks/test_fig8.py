"""Laws of Figure 8: every method of a place saw the same views, and a second run says the same without working."""

import json

import pytest
from benchmarks.quality import fig8
from benchmarks.quality.protocol import compare, study

FIELD = "laws=mirror,joint=0"


@pytest.fixture
def words(room_paths, room_geometry, tmp_path, monkeypatch):
    monkeypatch.setattr(compare, "RESAMPLES", 50)
    return [
        *("--scale", "smoke", "--paths", str(room_paths), "--geometry", str(room_geometry), "--read-test"),
        *("--methods", "nearest", "constant", FIELD, "--out", str(tmp_path / "out"), "--again", "0"),
    ]


def test_the_figure_is_made_once_and_says_what_made_it(words, tmp_path, capsys, monkeypatch):
    page = tmp_path / "page.md"
    page.write_text("before\n<!-- fig8 -->\n<!-- end of fig8 -->\nafter\n")
    assert fig8.main([*words, "--page", str(page)]) == 0
    text = capsys.readouterr().out
    assert "region hold-out, 8 training positions (clustered), 6 judged" in text
    assert "random hold-out, 32 training positions, 8 judged" in text
    assert "python -m benchmarks.quality.fig8 --scale smoke --paths room.h5" in text
    assert str(tmp_path) not in text
    assert page.read_text() == f"before\n<!-- fig8 -->\n\n{text.rstrip()}\n\n<!-- end of fig8 -->\nafter\n"
    out = tmp_path / "out"
    assert (out / "fig8-smoke.png").stat().st_size > 10_000
    html = (out / "fig8-smoke.html").read_text()
    assert "<th>constant</th>" in html
    assert "resampling positions and seeds" in html
    facts = json.loads((out / "fig8-smoke.json").read_text())["own"]["facts"]
    by_place: dict = {}
    for fact in facts:
        key = fact["key"]
        place = (key["holdout"], key["count"], key["draw"], key["seed"])
        by_place.setdefault(place, set()).add(json.dumps(fact["saw"], sort_keys=True))
    assert all(len(seen) == 1 for seen in by_place.values())
    assert len(by_place) == 2 * 2 + 2
    monkeypatch.setattr(study, "make_cells", lambda *args: pytest.fail("a cell was made again"))
    assert fig8.main(words) == 0
    logs = list(out.rglob("test_reads.log"))
    assert len(logs) == 2
    assert all("benchmarks.quality.fig8" in log.read_text() for log in logs)


def test_without_its_flag_the_sealed_positions_stay_sealed(words, tmp_path, capsys):
    few = [word for word in words if word not in ("--read-test", FIELD)]
    assert fig8.main(few) == 0
    assert "4 judged" in capsys.readouterr().out
    assert not list((tmp_path / "out").rglob("test_reads.log"))


def test_a_page_without_marks_is_one_sentence_and_stays(words, tmp_path, capsys):
    page = tmp_path / "page.md"
    page.write_text("nothing\n")
    few = [word for word in words if word != FIELD]
    assert fig8.main([*few, "--page", str(page)]) == 2
    assert "has no marks <!-- fig8 -->" in capsys.readouterr().err
    assert page.read_text() == "nothing\n"
