"""Laws of the table of the published recipe: what it compares, what it scores, what it writes."""

import json
import math

import numpy as np
import pytest
import torch
from benchmarks.quality.recipe import MODELS, main, values_of
from benchmarks.quality.recipe_table import differences

from rf3dgs.core.frames import Pose
from rf3dgs.core.grids import pinhole_grid
from rf3dgs.spectra.codec import DbWindow
from rf3dgs.spectra.spectrum import Instrument, Spectrum


@pytest.fixture
def words(room_paths, room_geometry, tmp_path):
    words = ["--scale", "smoke", "--paths", str(room_paths), "--geometry", str(room_geometry)]
    return [*words, "--steps", "2", "--out", str(tmp_path / "out")]


def test_the_command_writes_one_table_of_all_models(words, tmp_path):
    page, out = tmp_path / "page.md", tmp_path / "out"
    page.write_text("before\n<!-- recipe -->\nold\n<!-- end of recipe -->\nafter\n", encoding="utf-8")
    assert main([*words, "--positions", "3", "4", "--page", str(page)]) == 0
    run = json.loads((out / "recipe-smoke.json").read_text(encoding="utf-8"))
    assert [(row["positions"], row["model"]) for row in run["rows"]] == [(n, m) for n in (3, 4) for m in MODELS]
    assert all(len(row["values"]["psnr_grey"]) == 4 * 4 for row in run["rows"])
    text = page.read_text(encoding="utf-8")
    assert text.startswith("before\n<!-- recipe -->\n\n4 validation positions, 4 pictures of 24x16 each;")
    assert text.endswith("<!-- end of recipe -->\nafter\n")
    assert "python -m benchmarks.quality.recipe --scale smoke --paths room.h5" in text
    assert str(tmp_path) not in text
    assert text.count("| jet colours, 8 bits (published) |") == 2
    assert text.count("over jet colours, 8 bits (published) |") == 2
    assert (out / "recipe-smoke.md").read_text(encoding="utf-8").strip() in text


def test_sealed_positions_are_read_with_their_flag_alone(words, tmp_path, capsys):
    few = [*words, "--models", "nearest"]
    assert main(few) == 0
    assert capsys.readouterr().out.startswith("4 validation positions")
    assert not list(tmp_path.rglob("test_reads.log"))
    assert main([*few, "--read-test"]) == 0
    assert capsys.readouterr().out.startswith("6 test positions")
    (log,) = tmp_path.rglob("test_reads.log")
    assert "benchmarks.quality.recipe" in log.read_text(encoding="utf-8")


def test_more_training_positions_than_the_pool_are_refused(words, capsys):
    assert main([*words, "--models", "nearest", "--positions", "39"]) == 2
    assert "recipe: 39 training positions were asked for" in capsys.readouterr().err


def test_a_page_without_marks_is_one_sentence_and_stays(words, tmp_path, capsys):
    page = tmp_path / "page.md"
    page.write_text("nothing\n", encoding="utf-8")
    assert main([*words, "--models", "nearest", "--page", str(page)]) == 2
    assert "has no marks <!-- recipe --> and <!-- end of recipe -->; add them" in capsys.readouterr().err
    assert page.read_text(encoding="utf-8") == "nothing\n"


def test_a_perfect_predictor_has_the_best_scores():
    grid, window = pinhole_grid(16, 12, fov_deg=90), DbWindow(-120.0, -80.0)
    power = 10 ** (-12 + 4 * torch.rand(3, *grid.shape, generator=torch.Generator().manual_seed(0)))
    truth = Spectrum(power, grid, Pose(torch.rand(3, 3)), 60e9, Instrument.gaussian(math.radians(6)))

    class Known:
        def render(self, pose, grid):
            place = int((truth.pose.position - pose.position).norm(dim=-1).argmin())
            return truth[place]

    values = values_of(Known(), truth, window)
    assert np.isnan(values.pop("psnr_own")).all()
    best = {"psnr_rgb": 100.0, "psnr_grey": 100.0, "ssim_rgb": 1.0, "ssim_grey": 1.0}
    for name, value in values.items():
        assert value == pytest.approx(best.get(name, 0.0), abs=1e-4), name


def test_differences_are_paired_by_picture():
    def row(model: str, values: list[float]) -> dict:
        return {"model": model, "values": {"psnr_grey": values}}

    base = [10.0, 20, 30, 40, 11, 21, 31, 41]
    text = differences([row("rf3dgs-jet", base), row("rf3dgs-db", [value + 0.5 for value in base])], 4)
    assert text.splitlines()[-1].endswith("| +0.50 ± 0.00 | +0.50 | +0.6 |")
    assert differences([row("rf3dgs-jet", base)], 4) == ""
