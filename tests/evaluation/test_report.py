import re
from html.parser import HTMLParser

import numpy as np
import pytest
import torch

from rf3dgs.core.errors import InputError
from rf3dgs.core.files import write_whole
from rf3dgs.evaluation import (
    PhotoPair,
    ReportInputs,
    SpectrumExample,
    evaluate,
    save_spectrum_figure,
    spectrum_picture,
    write_report,
)
from rf3dgs.evaluation.figures import footprint_of
from rf3dgs.evaluation.panels import even_ticks
from rf3dgs.evaluation.pictures import LEVEL_COLOURS, coloured, difference_picture, hues
from rf3dgs.evaluation.scores import SCORES
from rf3dgs.spectra.codec import DbWindow

WINDOW = DbWindow(-120.0, -80.0)


class Loads(HTMLParser):
    """Collects everything that a browser would fetch, and that the tags are balanced."""

    def __init__(self):
        super().__init__()
        self.addresses, self.open, self.text = [], [], []

    def handle_starttag(self, tag, attrs):
        self.addresses += [value for name, value in attrs if name in ("src", "href", "srcset", "data", "xlink:href")]
        assert tag not in ("script", "iframe", "link", "object")
        if tag not in ("meta", "img", "image", "path", "rect", "circle"):
            self.open.append(tag)

    def handle_startendtag(self, tag, attrs):
        self.addresses += [value for name, value in attrs if name in ("src", "href", "xlink:href")]

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        self.text.append(data)


@pytest.fixture(scope="module")
def report(room, tmp_path_factory):
    pose = room.receivers(10)
    train, test, region = (room.spectra_at(pose[part]) for part in (slice(0, 6), slice(6, 8), slice(8, 10)))
    oracle = room.Oracle(offset_db=6.0)
    evaluations = {
        "random": evaluate(oracle, test, train=train, repeat=test),
        "region": evaluate(oracle, region, train=train, holdout="region"),
    }
    grey = np.full((24, 32, 3), 0.5)
    inputs = ReportInputs(
        title="Lobby <twin>",
        evaluations=evaluations,
        facts={"Frequency": "60 GHz"},
        photos=[PhotoPair("view 7", torch.from_numpy(grey), grey + 0.1)],
        examples=[SpectrumExample.of("position 0", oracle, test[0], train)],
        positions=pose.position,
        roles=["train"] * 6 + ["test"] * 2 + ["region"] * 2,
        tx=room.tx,
        footprint=footprint_of(np.eye(3) * 3, np.array([[0, 1, 2]])),
        timings={"radio stage": 12.3},
        seed=5,
        command="rf3dgs demo --seed 5",
    )
    path = tmp_path_factory.mktemp("report") / "deep" / "report.html"
    assert write_report(path, inputs) == path
    return path, inputs


def test_the_report_loads_nothing(report):
    html = report[0].read_text()
    page = Loads()
    page.feed(html)
    assert page.open == []
    assert len(page.addresses) > 10
    assert all(address.startswith("data:image/") for address in page.addresses)
    assert not re.search(r"https?://|file:|@import|url\(", re.sub(r"base64,[A-Za-z0-9+/=]+", "", html))


def test_the_report_holds_every_number_of_the_table(report):
    path, inputs = report
    html = path.read_text()
    rows = re.findall(r"<tr><th>(.*?)</tr>", html)
    for evaluation in inputs.evaluations.values():
        for score in SCORES:
            shown = [score.text(evaluation.value(method, score.key)) for method in evaluation.methods]
            shown = ["not available" if text == "n/a" else text for text in shown]
            assert any(row.startswith(score.label) and all(text in row for text in shown) for row in rows), score.key


def test_the_report_says_where_the_field_loses_and_what_is_not_available(report):
    path, inputs = report
    html = path.read_text()
    assert "Where the field loses:" in html
    losses = inputs.evaluations["random"].losses
    assert losses
    assert all(item.sentence() in html for item in losses)
    assert re.search(r"<th>LPIPS</th>.*?not available", html)


def test_the_report_tells_how_it_was_made_without_naming_the_machine(report):
    import platform
    from pathlib import Path

    html = report[0].read_text()
    for text in (
        "rf3dgs demo --seed 5",
        "Seed",
        "torch",
        "Processor",
        "12.3 s",
        "60 GHz",
        "Lobby &lt;twin&gt;",
        "PSNR 20.2 dB",
    ):
        assert text in html
    assert str(Path.home()) + "/" not in html
    assert platform.node() == "" or f">{platform.node()}<" not in html


def test_sections_without_content_are_left_out(tmp_path):
    html = write_report(tmp_path / "bare.html", ReportInputs("Bare", {})).read_text()
    assert "Photographs" not in html
    assert "How to get this again" in html


def test_a_failed_write_leaves_the_old_file_and_no_other(tmp_path, monkeypatch):
    path = tmp_path / "report.html"
    write_whole(path, b"old")
    monkeypatch.setattr("os.fsync", lambda handle: (_ for _ in ()).throw(OSError("disk full")))
    with pytest.raises(OSError, match="disk full"):
        write_whole(path, b"new")
    assert path.read_bytes() == b"old"
    assert list(tmp_path.iterdir()) == [path]


def test_the_strongest_direction_is_the_brightest_and_up_is_up(room):
    spectrum = room.spectrum_at(room.receivers(1)[0])
    picture = spectrum_picture(spectrum, WINDOW)
    assert picture.shape == (*spectrum.grid.shape, 3)
    assert picture.dtype == np.uint8
    row, col = divmod(int(spectrum.power.argmax()), spectrum.grid.width)
    brightness = picture.astype(int).sum(-1)
    assert brightness[row, col] == brightness.max()


def test_colours_run_from_floor_to_ceiling_and_clip():
    ends = coloured(np.array([-1.0, 0.0, 1.0, 2.0]))
    assert (ends[:2] == LEVEL_COLOURS[0]).all()
    assert (ends[2:] == LEVEL_COLOURS[-1]).all()
    assert (np.diff(coloured(np.linspace(0, 1, 50)).astype(int) @ [0.2126, 0.7152, 0.0722]) > 0).all()
    assert (hues(np.array([-0.5])) == hues(np.array([0.5]))).all()


def test_a_prediction_that_is_too_strong_is_red(room):
    truth = room.spectrum_at(room.receivers(1)[0])
    louder = room.Oracle(offset_db=8.0).render(truth.pose, truth.grid)
    picture = difference_picture(truth, louder, DbWindow(-160.0, -40.0)).astype(int)
    assert (picture[..., 0] > picture[..., 2] + 50).all()
    assert (difference_picture(truth, truth, WINDOW) == 247).all()


def test_figures_of_spheres_and_of_pictures_are_written(room, tmp_path):
    from PIL import Image

    from rf3dgs.core.grids import pinhole_grid

    pose = room.receivers(1)[0]
    for name, grid in (("sphere", room.grid), ("picture", pinhole_grid(30, 20, fov_deg=90))):
        path = tmp_path / f"{name}.png"
        save_spectrum_figure(room.spectrum_at(pose, grid), path, title=name)
        with Image.open(path) as picture:
            assert picture.width > 800
    with pytest.raises(InputError, match="a picture shows one pose"):
        spectrum_picture(room.spectra_at(room.receivers(2)))


def test_ticks_are_round_numbers():
    assert [text for _, text in even_ticks(-145, -104)] == ["-140", "-130", "-120", "-110"]
    assert even_ticks(0.0, 10.0)[-1] == (1.0, "10")


def test_the_footprint_keeps_walls_and_furniture_and_drops_floor_and_ceiling():
    corners = np.array(
        [[0, 0, 0], [4, 0, 0], [0, 3, 0], [0, 0, 3], [4, 0, 3], [0, 3, 3], [1, 1, 1], [2, 1, 1], [1, 2, 1]]
    )
    floor, ceiling, wall, table = (0, 1, 2), (3, 4, 5), (0, 1, 3), (6, 7, 8)
    outlines = footprint_of(corners, np.array([floor, ceiling, wall, table]))
    assert [len(outline) for outline in outlines] == [2, 3]
    assert np.abs(np.diff(outlines[0], axis=0)).sum() == 4.0
