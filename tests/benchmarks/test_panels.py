"""Laws of figures 1 and 6: the truth is perfect against itself, finer is finer, and nothing is made twice."""

import json
import math
import re

import numpy as np
import pytest
import torch
from benchmarks.quality import fig1, fig6, fig6_scores
from benchmarks.quality.methods.method import Method
from benchmarks.quality.panel_data import kept
from benchmarks.quality.protocol.figure import SIZES, parser_of, study_of
from benchmarks.quality.protocol.split import split_of

from rf3dgs.channel.io import PathsReader, PathsWriter
from rf3dgs.channel.paths import Paths
from rf3dgs.core.angles import angles_of
from rf3dgs.core.frames import Pose
from rf3dgs.core.grids import equirect_grid, pinhole_grid
from rf3dgs.core.units import SPEED_OF_LIGHT
from rf3dgs.evaluation.baselines.lookup import NearestNeighbour
from rf3dgs.spectra.codec import DbWindow
from rf3dgs.spectra.synthesis import default_lobe
from rf3dgs.splats.ply import write_ply
from rf3dgs.splats.surface import sample_mesh

TX = torch.tensor([0.5, 0.6, 2.0])
SIZE = torch.tensor([6.0, 5.0, 2.6])
RECEIVERS, HAZE = 40, 300
GRID = pinhole_grid(36, 24, 90)
WINDOW = DbWindow(-80.0, 0.0)


def room():
    """Vertices and faces of a closed box."""
    corner = torch.tensor([[x, y, z] for x in (0.0, 1.0) for y in (0.0, 1.0) for z in (0.0, 1.0)]) * SIZE
    sides = [(0, 1, 3, 2), (4, 5, 7, 6), (0, 1, 5, 4), (2, 3, 7, 6), (0, 2, 6, 4), (1, 3, 7, 5)]
    return corner, torch.tensor([face for a, b, c, d in sides for face in ((a, b, c), (a, c, d))])


def write_paths(folder, *, rays: int, seed: int):
    """Paths to receivers in the box: the line of sight, and one bounce off each of `rays` points of the walls."""
    generator = torch.Generator().manual_seed(0)
    place = 0.8 + (SIZE - 1.6) * torch.rand(RECEIVERS, 3, generator=generator)
    generator = torch.Generator().manual_seed(seed)
    point = torch.rand(rays, 3, generator=generator) * SIZE
    wall = torch.arange(rays) % 6
    point[torch.arange(rays), wall // 2] = (wall % 2) * SIZE[wall // 2]
    with PathsWriter(folder, 60e9, Pose(TX)) as writer:
        for receiver in place:
            last, first = torch.cat((TX[None], point)) - receiver, torch.cat((receiver[None], point)) - TX
            away = torch.cat((torch.zeros(1), last[1:].norm(dim=-1))) + first.norm(dim=-1)
            gain = torch.cat((torch.ones(1), torch.full((rays,), 3.0 / rays))) * (4e-4 / away) ** 2
            (zenith, azimuth), (out_zenith, out_azimuth) = angles_of(last), angles_of(first)
            writer.append(
                Paths(
                    coeff=gain.sqrt().to(torch.complex64),
                    delay=away / SPEED_OF_LIGHT,
                    aoa_zenith=zenith,
                    aoa_azimuth=azimuth,
                    aod_zenith=out_zenith,
                    aod_azimuth=out_azimuth,
                    valid=torch.ones(rays + 1, dtype=torch.bool),
                    frequency=60e9,
                    tx=Pose(TX),
                    rx=Pose(receiver),
                )
            )
    return folder


@pytest.fixture(scope="module")
def given(tmp_path_factory):
    """Paths, paths of a finer truth, and Gaussians on the box, as words of the command line."""
    folder = tmp_path_factory.mktemp("panels")
    vertices, faces = room()
    write_ply(folder / "box.ply", sample_mesh(vertices, faces, count=800, colours=torch.rand(len(faces), 3)))
    coarse = write_paths(folder / "coarse.h5", rays=HAZE, seed=1)
    words = ["--scale", "smoke", "--paths", str(coarse), "--geometry", str(folder / "box.ply"), "--training", "6"]
    return words, write_paths(folder / "fine.h5", rays=4 * HAZE, seed=2)


def split_at(paths):
    """The protocol's split of the receivers of a folder of paths."""
    with PathsReader(paths) as reader:
        return split_of(reader.rx.position, SIZES["smoke"].split)


def cells(table: str) -> list[list[str]]:
    lines = [line for line in table.splitlines() if line.startswith("|")]
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in lines[2:]]


def numbers_of(table: str) -> list[float]:
    return [float(text) for row in cells(table) for text in re.findall(r"-?\d+\.\d+|nan|inf", " ".join(row[1:]))]


def test_figure_1_has_a_row_for_each_method_in_each_group_and_is_made_once(given, tmp_path, monkeypatch):
    page = tmp_path / "page.md"
    page.write_text("<!-- fig1 -->\n<!-- end of fig1 -->\n")
    words = [*given[0], "--photo", "gaussians", "--out", str(tmp_path), "--page", str(page)]
    assert fig1.main(words) == 0
    picture, table = (tmp_path / "fig1-smoke.png").read_bytes(), (tmp_path / "fig1-smoke.md").read_text()
    assert table.rstrip() in page.read_text()
    assert "python -m benchmarks.quality.fig1 --scale smoke --paths coarse.h5" in table
    assert picture.startswith(b"\x89PNG")
    assert [row[:2] for row in cells(table)] == [
        [group, method.name] for group in fig1.GROUPS.values() for method in fig1.COLUMNS
    ]
    assert all(math.isfinite(number) for number in numbers_of(table))
    facts = json.loads((tmp_path / "fig1-smoke.json").read_text())
    split = split_at(given[0][3])
    assert facts["view"] == split.part("validation", "random")[0]
    assert facts["training"] == split.training(6, 0).tolist()
    assert not list(tmp_path.rglob("test_reads.log"))

    monkeypatch.setattr(fig1, "fit_radio", lambda *_: pytest.fail("a field was trained again"))
    assert fig1.main(words) == 0
    assert (tmp_path / "fig1-smoke.png").read_bytes() == picture


def test_any_method_may_be_a_column_of_figure_1(given, tmp_path, monkeypatch):
    fitted = []

    def fit(task):
        fitted.append(task.spectra.method)
        return NearestNeighbour(task.spectra)

    monkeypatch.setattr(fig1, "COLUMNS", (Method("mine", fit),))
    assert fig1.main([*given[0], "--photo", "gaussians", "--out", str(tmp_path)]) == 0
    assert [row[1] for row in cells((tmp_path / "fig1-smoke.md").read_text())] == ["mine", "mine"]
    assert fitted == ["ideal", "capon"]


def test_figure_6_says_of_each_candidate_whether_it_is_nearer(given, tmp_path, monkeypatch):
    words = [*given[0], "--truth", str(given[1]), "--out", str(tmp_path)]
    assert fig6.main(words) == 0
    picture, table = (tmp_path / "fig6-smoke.png").read_bytes(), (tmp_path / "fig6-smoke.md").read_text()
    rows = {row[0]: row[1:] for row in cells(table)}
    assert list(rows) == [
        fig6.COARSE,
        *(
            name
            for method in fig1.SPLATS_AND_COPY
            for name in (method.name, *([fig6.SHARP] if method is fig1.OURS else []))
        ),
    ]
    assert all(math.isfinite(number) for number in numbers_of(table))
    assert all("(" not in cell for cell in rows.pop(fig6.COARSE))
    assert all(re.search(r"\((nearer|farther|same)\)$", cell) for row in rows.values() for cell in row[:-1])
    facts = json.loads((tmp_path / "fig6-smoke.json").read_text())
    split = split_at(given[0][3])
    assert facts["judged"] == split.part("validation", "random")[:2].tolist()
    assert facts["training"] == split.training(6, 0).tolist()
    assert not list(tmp_path.rglob("test_reads.log"))

    monkeypatch.setattr(fig1, "fit_radio", lambda *_: pytest.fail("a field was trained again"))
    assert fig6.main(words) == 0
    assert (tmp_path / "fig6-smoke.png").read_bytes() == picture


def random_power(seed: int) -> torch.Tensor:
    return 10 ** (-4 + 2 * torch.rand(3, *GRID.shape, generator=torch.Generator().manual_seed(seed)))


def scored(truth, answer, *, noise: float = 0.0):
    """Scores against two solves of `truth` with that much independent noise [dB]."""
    generator = torch.Generator().manual_seed(9)
    solves = [truth * 10 ** (noise / 10 * torch.randn(truth.shape, generator=generator)) for _ in range(2)]
    return fig6_scores.scores((solves[0], solves[1]), answer, GRID, WINDOW, math.radians(7.5))


def test_the_truth_is_perfect_against_itself():
    truth = random_power(0)
    found = scored(truth, truth)
    perfect = {"psnr_db": 100.0, "ssim": 1.0, "rmse_db": 0.0, "coarse_db": 0.0, "detail_db": 0.0}
    for name, value in perfect.items():
        # SSIM is float32, the others double: rounding is below 1e-6.
        assert found[name] == pytest.approx(np.full(3, value), abs=1e-6), name
    assert fig6_scores.statistic("detail_match", found["detail_match"]) == pytest.approx(1.0, abs=1e-6)


def test_noise_of_the_truth_is_taken_off():
    truth, answer = random_power(0), random_power(1)
    still, noisy = scored(truth, answer), scored(truth, answer, noise=3.0)
    # 2592 pixels, of which a square of some 70 dB^2 is known to 70 * sqrt(2 / 2592) = 2 dB^2 and its root to 0.12 dB,
    # the noise adding about as much; three of that. Not taken off, 4.5 dB^2 would be 0.27 dB.
    for name in ("rmse_db", "detail_db"):
        assert noisy[name].mean() == pytest.approx(still[name].mean(), abs=0.15), name
    same = scored(truth, truth, noise=3.0)
    assert same["rmse_db"].mean() < 0.7  # 3 / sqrt(2) = 2.1 dB if it were not
    assert fig6_scores.statistic("detail_match", same["detail_match"]) == pytest.approx(1.0, abs=0.05)


def test_what_the_truth_has_is_told_from_its_noise():
    truth = random_power(0)
    generator = torch.Generator().manual_seed(9)
    solves = [truth * 10 ** (0.3 * torch.randn(truth.shape, generator=generator)) for _ in range(2)]
    lobe = math.radians(7.5)
    still, noisy = (fig6_scores.truth_of((a, b), GRID, WINDOW, lobe) for a, b in ((truth, truth), solves))
    assert still["noise"] == 0.0
    # The mean of two solves with 3 dB each has 3 / sqrt(2); 2592 pixels know it, and the others, to 2 or 3 %.
    assert noisy["noise"] == pytest.approx(3.0 / math.sqrt(2.0), rel=0.06)
    for name in ("detail", "sharpness"):
        assert noisy[name] == pytest.approx(still[name], rel=0.06), name


def test_another_truth_has_no_detail_in_common():
    found = scored(random_power(0), random_power(1))
    # Independent pictures of 3 x 864 pixels: the correlation scatters by 1 / sqrt(2592) = 0.02; four of that.
    assert abs(fig6_scores.statistic("detail_match", found["detail_match"])) < 0.08


def test_a_gain_of_all_levels_is_coarse_and_leaves_the_detail():
    truth = random_power(0)
    found = scored(truth, 2 * truth)
    assert found["coarse_db"] == pytest.approx(np.full(3, 10 * math.log10(2)), rel=1e-5)
    assert found["detail_db"] == pytest.approx(np.zeros(3), abs=1e-4)  # float32 levels of some 40 dB
    assert fig6_scores.statistic("detail_match", found["detail_match"]) == pytest.approx(1.0, abs=1e-6)


def test_blurring_takes_sharpness_away():
    truth = random_power(0)
    smooth, _ = fig6_scores.detail_of(10 * torch.log10(truth), 2.0)
    blurred, sharp = (scored(truth, power)["sharpness"] for power in ((10 ** (smooth / 10)).float(), truth))
    assert (blurred < 0.5 * sharp).all()


def test_the_narrower_lobe_has_the_larger_peak(given):
    with PathsReader(given[1]) as reader:
        wide, narrow = (fig6.turned(reader[3], 0.0, pinhole_grid(72, 48, 90), lobe) for lobe in (0.13, 0.04))
    density = [one.power / one.instrument.beam_solid_angle for one in (wide, narrow)]
    assert density[1].max() > 2 * density[0].max()


def test_points_drawn_finer_keep_their_power(given, tmp_path):
    study = study_of(parser_of("", "fig6").parse_args([*given[0][:-2], "--out", str(tmp_path)]), "fig6")
    field = fig1.OURS.made(study.task(6, 0))
    pose, lobe = study.data.dataset.validation.spectra.pose[0], default_lobe(study.config.pictures.grid)
    grid = equirect_grid(180, 90)
    plain = field.render(pose, grid, csi=False)
    finer = fig6.Sharper(field, lobe / 2).render(pose, grid)
    area = grid.solid_angle
    # Levels are those of one and the same beam, so the sums agree; a lobe of under two pixels sums to a few per cent.
    assert float((finer.power * area).sum()) == pytest.approx(float((plain.power * area).sum()), rel=0.05)
    assert finer.power.max() > 2 * plain.power.max()


def test_an_interval_holds_the_mean_and_a_verdict_needs_a_clear_difference():
    values = np.random.default_rng(0).normal(size=40)
    mean, low, high = fig6_scores.interval("rmse_db", values)
    assert low < mean < high
    assert fig6_scores.verdict("rmse_db", values, values + 1.0) == "nearer"
    assert fig6_scores.verdict("psnr_db", values, values + 1.0) == "farther"
    assert fig6_scores.verdict("rmse_db", values, np.roll(values, 1)) == "same"


def test_what_was_made_from_something_else_is_made_again(tmp_path):
    first = kept(tmp_path, "answer", {"seed": 0}, lambda: torch.zeros(2))
    assert torch.equal(kept(tmp_path, "answer", {"seed": 0}, lambda: pytest.fail("it is there")), first)
    assert torch.equal(kept(tmp_path, "answer", {"seed": 1}, lambda: torch.ones(2)), torch.ones(2))


def test_a_finer_truth_that_stands_elsewhere_is_refused(given, tmp_path, capsys):
    other = tmp_path / "other.h5"
    with PathsReader(given[1]) as reader, PathsWriter(other, 60e9, Pose(TX)) as writer:
        writer.append(reader[int(split_at(given[0][3]).where("pool")[0])])
    assert fig6.main([*given[0], "--truth", str(other), "--out", str(tmp_path / "out")]) == 2
    said = capsys.readouterr().err
    assert re.search(r"fig6: .*no receiver where number \d+ of the other paths stands; trace it", said)


def test_too_few_receivers_are_refused(tmp_path, given, capsys):
    few = tmp_path / "few.h5"
    with PathsReader(given[1]) as reader, PathsWriter(few, 60e9, Pose(TX)) as writer:
        for number in range(4):
            writer.append(reader[number])
    words = [*given[0][:3], str(few), *given[0][4:], "--out", str(tmp_path / "out")]
    assert fig1.main(words) == 2
    assert "fig1: 40 receivers were asked for and the paths have 4; trace more" in capsys.readouterr().err
