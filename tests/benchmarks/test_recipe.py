"""Laws of the table of the published recipe: which positions it takes, what it scores, what it writes."""

import json
import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from benchmarks.quality.protocol.split import split_of
from benchmarks.quality.recipe import MODELS, main, put_into, values_of
from benchmarks.quality.recipe_data import pictures_of
from benchmarks.quality.recipe_table import differences

from rf3dgs.channel.io import PathsWriter
from rf3dgs.core.errors import InputError
from rf3dgs.core.frames import Pose
from rf3dgs.core.grids import pinhole_grid
from rf3dgs.core.progress import Silent
from rf3dgs.spectra.codec import DbWindow
from rf3dgs.spectra.spectrum import Instrument, Spectrum
from rf3dgs.splats.ply import write_ply
from rf3dgs.splats.surface import sample_mesh

RECEIVERS = 330  # of which 280 are held out, and those in the buffers serve nothing


@pytest.fixture(scope="module")
def places() -> Pose:
    return Pose.scatter(((0.5, 0.5, 1.0), (30.0, 30.0, 2.0)), RECEIVERS, 0)


@pytest.fixture
def paths(places, random_paths, tmp_path):
    file = tmp_path / "some.paths"
    rows = [random_paths(300, seed=number, rx=places[number]) for number in range(RECEIVERS)]
    with PathsWriter(file, rows[0].frequency, rows[0].tx) as writer:
        for row in rows:
            writer.append(replace(row, delay=row.delay + 1.5e-7))  # light needs so long through the whole hall
    return file


@pytest.fixture
def geometry(tmp_path):
    corners = torch.tensor([[0.0, 0, 0], [31.0, 0, 0], [31.0, 31, 0], [0.0, 31, 0]])
    write_ply(tmp_path / "floor.ply", sample_mesh(corners, torch.tensor([[0, 1, 2], [0, 2, 3]]), count=300))
    return tmp_path / "floor.ply"


def test_the_command_writes_one_table_of_all_models(paths, geometry, tmp_path, capsys):
    page = tmp_path / "page.md"
    page.write_text("before\n<!-- recipe -->\nold\n<!-- end of recipe -->\nafter\n", encoding="utf-8")
    out = tmp_path / "out"
    words = ["--paths", str(paths), "--geometry", str(geometry), "--scale", "smoke", "--positions", "3", "4"]
    words += ["--held", "2", "--steps", "2", "--out", str(out), "--page", str(page)]
    assert main(words) == 0
    run = json.loads((out / "recipe.json").read_text(encoding="utf-8"))
    assert [(row["positions"], row["model"]) for row in run["rows"]] == [(n, m) for n in (3, 4) for m in MODELS]
    assert all(len(row["values"]["psnr_grey"]) == 2 * 4 for row in run["rows"])
    text = page.read_text(encoding="utf-8")
    assert text.startswith("before\n<!-- recipe -->\n\n`python -m benchmarks.quality.recipe --paths some.paths")
    assert text.endswith("<!-- end of recipe -->\nafter\n")
    assert "old" not in text
    assert text.count("jet colours, 8 bits (published) |") == 2 * 2
    assert (out / "recipe.md").read_text(encoding="utf-8").strip() in text
    capsys.readouterr()
    assert main([*words[:-2], "--held", "3"]) == 2
    assert "holds pictures made with other settings; remove it" in capsys.readouterr().err


def test_sealed_positions_are_not_read(paths, places, tmp_path):
    train, held = pictures_of(paths, tmp_path / "made", positions=4, held=3, size=(12, 8), progress=Silent())
    assert (len(train), len(held)) == (16, 12)
    split = split_of(places.position)
    for spectra, name in ((train, "pool"), (held, "validation")):
        own = places.position[torch.from_numpy(split.where(name))]
        apart = torch.cdist(spectra.pose.position.double(), own.double()).amin(1)
        assert float(apart.max()) < 1e-6
    with pytest.raises(InputError, match="41 positions are to be judged and the validation part has 40"):
        pictures_of(paths, tmp_path / "more", positions=4, held=41, size=(12, 8), progress=Silent())


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
    text = differences([row("rf3dgs-jet", base), row("rf3dgs-db", [value + 0.5 for value in base])])
    assert text.splitlines()[-1].endswith("| +0.50 ± 0.00 | +0.50 | +0.6 |")
    assert differences([row("rf3dgs-jet", base)]) == ""


def test_a_page_without_marks_is_refused(tmp_path):
    page = tmp_path / "page.md"
    page.write_text("nothing\n", encoding="utf-8")
    with pytest.raises(InputError, match="has no marks <!-- recipe --> and <!-- end of recipe -->; add them"):
        put_into(page, "text")
