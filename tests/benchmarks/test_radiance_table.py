"""Laws of the table's machinery: what is there is not made again, the seal holds, and checks say what numbers say."""

import json
import math

import numpy as np
import pytest
import torch
from benchmarks.quality.methods import methods_of
from benchmarks.quality.methods.field import changed
from benchmarks.quality.methods.method import Task
from benchmarks.quality.protocol import cells, compare, data, study
from benchmarks.quality.protocol.results import Place, Results
from benchmarks.quality.radiance import __main__ as command
from benchmarks.quality.radiance import aging
from benchmarks.quality.radiance.checks import beats_baselines, reaches
from benchmarks.quality.radiance.tables import page_of, text_of

from rf3dgs.channel.io import PathsWriter
from rf3dgs.channel.paths import Paths
from rf3dgs.core.angles import angles_of
from rf3dgs.core.errors import InputError
from rf3dgs.core.frames import Pose
from rf3dgs.core.grids import equirect_grid
from rf3dgs.core.units import SPEED_OF_LIGHT
from rf3dgs.spectra.codec import DbWindow
from rf3dgs.spectra.spectrum import Instrument, Spectrum, stack_spectra
from rf3dgs.splats.ply import write_ply
from rf3dgs.splats.surface import sample_mesh
from rf3dgs.training.config import RadioConfig

TX = torch.tensor([0.6, 0.8, 2.6])
RECEIVERS = 60


def receivers() -> torch.Tensor:
    generator = torch.Generator().manual_seed(0)
    low, size = torch.tensor([0.5, 0.5, 1.0]), torch.tensor([13.0, 14.0, 1.0])
    return low + size * torch.rand(RECEIVERS, 3, generator=generator)


def write_paths(folder, place: torch.Tensor, *, noise: float = 0.0):
    """Paths to receivers in a hall: the line of sight, its images in two walls, and a haze of weak directions."""
    generator = torch.Generator().manual_seed(1)
    haze = torch.nn.functional.normalize(torch.randn(400, 3, generator=generator), dim=-1)
    images = torch.stack((TX, TX * torch.tensor([-1.0, 1.0, 1.0]), TX * torch.tensor([1.0, -1.0, 1.0])))
    with PathsWriter(folder, 60e9, Pose(TX)) as writer:
        for point in place:
            arrival = torch.cat((images - point, 3.0 * haze))
            length = arrival.norm(dim=-1)
            level = torch.cat((torch.tensor([1.0, 0.3, 0.2]), torch.full((400,), 0.01))) / length
            level = level * (1 + noise * torch.rand(len(level), generator=generator))
            zenith, azimuth = angles_of(arrival / length[:, None])
            writer.append(
                Paths(
                    coeff=(1e-3 * level).to(torch.complex64),
                    delay=torch.where(length > 3.001, length, length[0] + 3.0) / SPEED_OF_LIGHT,
                    aoa_zenith=zenith,
                    aoa_azimuth=azimuth,
                    aod_zenith=math.pi - zenith,
                    aod_azimuth=azimuth,
                    valid=torch.ones(len(level), dtype=torch.bool),
                    frequency=60e9,
                    tx=Pose(TX),
                    rx=Pose(point),
                )
            )
    return folder


@pytest.fixture
def words(tmp_path, monkeypatch):
    """The words of a small table of lookups, whose second solve needs no tracer."""
    monkeypatch.setattr(compare, "RESAMPLES", 200)
    monkeypatch.setattr(
        data, "paths_of", lambda *args: write_paths(tmp_path / "second.h5", args[2].position, noise=0.1)
    )
    first = write_paths(tmp_path / "first.h5", receivers())
    return [
        *("--preset", "diffuse", "--paths", f"diffuse={first}", "--out", str(tmp_path / "out"), "--receivers"),
        *(
            str(RECEIVERS),
            "--size",
            "36",
            "18",
            "--again",
            "4",
            "--held",
            "8",
            "8",
            "5",
            "5",
            "--positions",
            "10",
            "20",
            "--seeds",
            "0",
            "1",
        ),
        *("--models", "nearest", "idw4"),
    ]


def stored(folder) -> dict[str, str]:
    return {
        str(path.relative_to(folder)): path.read_text() for path in sorted((folder / "out").rglob("cells/**/*.json"))
    }


def test_a_second_run_makes_nothing_and_says_the_same(words, tmp_path, capsys, monkeypatch):
    assert command.main(words) == 0
    said, before = capsys.readouterr().out, stored(tmp_path)
    assert (
        len(before) == 2 * 2 * 2 * 2 + 2
    )  # hold-outs, positions, seeds, models; and the second solve of each hold-out
    monkeypatch.setattr(study, "make_cells", lambda *args: pytest.fail("a cell was made again"))
    assert command.main(words) == 0
    assert capsys.readouterr().out == said
    assert stored(tmp_path) == before


def test_a_run_that_was_stopped_goes_on_and_ends_alike(words, tmp_path, monkeypatch):
    made, honest = [], cells.make_cells

    def stopping(keys, *rest):
        made.extend(keys)
        if len(made) > 8:
            raise KeyboardInterrupt
        honest(keys, *rest)

    monkeypatch.setattr(study, "make_cells", stopping)
    with pytest.raises(KeyboardInterrupt):
        command.main(words)
    first = stored(tmp_path)
    assert 0 < len(first) < 18
    monkeypatch.setattr(study, "make_cells", honest)
    assert command.main(words) == 0
    after = stored(tmp_path)
    assert len(after) == 18
    assert all(after[name] == text for name, text in first.items())
    values = {name: json.loads(text)["values"] for name, text in after.items()}
    assert command.main([*words, "--again-models", "nearest", "idw4"]) == 0
    assert {name: json.loads(text)["values"] for name, text in stored(tmp_path).items()} == values


def test_a_cell_of_other_data_is_made_again(words, tmp_path):
    assert command.main(words) == 0
    name = next(name for name in stored(tmp_path) if "nearest" in name)
    cell = json.loads((tmp_path / name).read_text())
    cell["identity"]["data"][0] = "other"
    cell["values"]["rmse_db"] = [0.0] * len(cell["values"]["rmse_db"])
    (tmp_path / name).write_text(json.dumps(cell))
    assert command.main(words) == 0
    assert max(json.loads((tmp_path / name).read_text())["values"]["rmse_db"]) > 0.0


def test_validation_never_opens_the_seal_and_the_test_is_logged_once(words, tmp_path):
    log = tmp_path / "out" / "data" / "lobby-diffuse" / "dataset" / "test_reads.log"
    assert command.main(words) == 0
    assert not log.exists()
    assert command.main([*words, "--judge", "test"]) == 0
    lines = log.read_text().splitlines()
    assert len(lines) == 2
    assert {line.split()[1] for line in lines} == {"test", "region"}
    assert all("nearest, idw4" in line and " at " in line for line in lines)
    assert command.main([*words, "--judge", "test"]) == 0
    assert log.read_text().splitlines() == lines


def test_a_field_is_judged_like_a_lookup_and_its_cost_is_kept(words, tmp_path):
    corner = torch.tensor([[0.0, 0, 0], [14, 0, 0], [14, 15, 0], [0, 15, 0]])
    faces = torch.tensor([[0, 1, 2], [0, 2, 3]])
    write_ply(tmp_path / "floor.ply", sample_mesh(corner, faces, count=400))
    extra = ["--positions", "10", "--seeds", "0", "--variants", "quick=paper,steps=0", "--geometry"]
    assert command.main([*words, *extra, str(tmp_path / "floor.ply")]) == 0
    name = next(name for name in stored(tmp_path) if name.endswith("random-010-0-floor-quick.json"))
    cell = json.loads((tmp_path / name).read_text())
    assert len(cell["values"]["rmse_db"]) == 5
    assert cell["fit"]["cpu_seconds"] > 0
    assert cell["gaussians"] > 0
    assert cell["identity"]["settings"]["steps"] == 0
    page = (tmp_path / "out" / "lobby-floor-validation.md").read_text()
    assert "quick minus" in page
    assert "second solve" in page
    assert "--paths diffuse=first.h5" in page
    report = (tmp_path / "out" / "lobby-floor-validation.json").read_text()
    assert not [text for text in (json.dumps(cell), page, report) if str(tmp_path) in text]


def test_a_model_that_fails_leaves_its_cells_empty_and_is_a_failed_check(words, capsys):
    short = [*words, "--models", "nearest", "--variants", "bad=paper,steps=-1", "--geometry", "mesh"]
    short += ["--mesh-count", "200", "--positions", "10", "--seeds", "0", "--holdout", "random"]
    assert command.main(short) == 0
    captured = capsys.readouterr()
    assert "bad failed" in captured.err
    assert "FAIL 1 diffuse random 10" in captured.out
    assert "no cell for seed 0" in captured.out


def test_a_model_may_be_trained_on_what_was_before_things_moved(words, tmp_path, monkeypatch):
    def traced(setting, folder, rx, config, progress):
        return write_paths(tmp_path / f"{setting.name}.h5", rx.position, noise=9.0 * (setting.name == "lobby-moved"))

    monkeypatch.setattr(data, "paths_of", traced)

    def drawn(setting, count):
        return Pose(receivers().flip(0) if setting.name == "lobby" else receivers())

    monkeypatch.setattr(data.Setting, "receivers", drawn)
    moved = [*words[4:], "--scene", "lobby-moved", "--again", "0", "--positions", "20", "--seeds", "0"]
    assert command.main(moved) == 0
    assert command.main([*moved, "--trained", "lobby-before"]) == 0
    cell = {name.rsplit("/", 1)[1]: json.loads(text)["values"]["rmse_db"] for name, text in stored(tmp_path).items()}
    fresh, stale = (cell[f"random-020-0-none-nearest{end}.json"] for end in ("", "-after-lobby-before"))
    assert np.mean(stale) != np.mean(fresh)
    assert (tmp_path / "out" / "lobby-moved-photos-validation-after-lobby-before.md").exists()
    assert command.main([*moved, "--trained", "lobby"]) == 2  # whose receivers are others


def test_the_table_of_aging_shows_what_is_lost_and_what_new_spectra_bring(words, tmp_path, monkeypatch, capsys):
    def traced(setting, folder, rx, config, progress):
        return write_paths(tmp_path / f"{setting.name}.h5", rx.position, noise=9.0 * (setting.name == "lobby-moved"))

    monkeypatch.setattr(data, "paths_of", traced)
    monkeypatch.setattr(data.Setting, "receivers", lambda setting, count: Pose(receivers()))
    corner = torch.tensor([[-1.0, -1, 0], [15, -1, 0], [15, 16, 0], [-1, 16, 0]])
    write_ply(tmp_path / "floor.ply", sample_mesh(corner, torch.tensor([[0, 1, 2], [0, 2, 3]]), count=400))
    own = ["--positions", "20", "--new", "10", "--geometry", str(tmp_path / "floor.ply")]
    places = [word for word in words[4:] if word not in ("--positions", "10", "20")]
    places = places[: places.index("--seeds")]
    assert aging.main([*own, *places]) == 0
    lines = capsys.readouterr().out.splitlines()
    rmse = {line[:42].rstrip(): float(line.split(" / ")[2]) for line in lines[1:12]}
    assert len(rmse) == 11
    assert rmse[f"{'nearest of before':34}     now"] > rmse[f"{'nearest of before':34}  before"]
    assert rmse[f"{'mirror refined by 10 new':34}     now"] < rmse[f"{'mirror of before':34}     now"]
    assert rmse[f"{'nearest of before and 10 new':34}     now"] < rmse[f"{'nearest of before':34}     now"]
    assert aging.main([*own, *places, "--model", "castle"]) == 2


def test_other_settings_for_data_that_are_there_are_refused(words, capsys):
    assert command.main(words) == 0
    assert command.main([*words, "--buffer", "0.5"]) == 2
    assert "made with other settings" in capsys.readouterr().err


def test_tables_fit_80_columns(words, capsys):
    assert command.main(words) == 0
    out = capsys.readouterr().out
    assert max(len(line) for line in out.splitlines() if not line.startswith("/")) <= 80
    assert "region hold-out, 20 training positions, 5 validation" in out


def spectrum() -> Spectrum:
    grid = equirect_grid(12, 6)
    return Spectrum(torch.ones(grid.shape), grid, Pose(TX), 60e9, Instrument.gaussian(0.1), "test")


PLACE = Place("lobby", "realistic", "random", 40)
COLUMNS = {
    "peak_deg": 5.0,
    "distinct_deg": 5.0,
    "beam_loss_peak_db": 3.0,
    "beam_loss_eigen_db": 3.0,
    "path_gain_db": 2.0,
    "rmse_db": 5.0,
    "mae_db": 4.0,
    "delay_ns": 6.0,
    "departure_deg": 20.0,
    "delay_spread_ns": 2.0,
}


def planted(factor: float, seeds=(0, 1, 2), **others: float) -> Results:
    """A lookup, and a model whose errors are `factor` times as large, or `others` for some columns."""
    results = Results(["nearest", "mirror"], "validation", "photos", [0, 1, 2])
    for seed in seeds:
        random = np.random.default_rng(seed)
        lookup = {name: scale * random.gamma(4.0, 0.25, 100) for name, scale in COLUMNS.items()}
        model = {name: others.get(name, factor) * value for name, value in lookup.items()}
        results.values.setdefault(PLACE, {}).setdefault("nearest", {})[seed] = lookup
        results.values[PLACE].setdefault("mirror", {})[seed] = model
    results.seconds["lobby", "realistic", "random"] = {name: np.full(100, 0.45 * v) for name, v in COLUMNS.items()}
    return results


def test_a_model_that_is_better_everywhere_passes_and_one_that_loses_a_score_fails():
    assert all(check.passed for check in beats_baselines(planted(0.05), PLACE, "mirror"))
    found = list(beats_baselines(planted(0.05, path_gain_db=1.0, delay_ns=1.3), PLACE, "mirror"))
    failed = [check.text for check in found if not check.passed]
    assert failed == ["Path gain: not better than nearest (same)", "Delay: not safe from nearest (worse)"]


def test_a_variant_can_be_what_others_are_judged_against():
    results = planted(0.05)
    results.against = ["nearest", "mirror"]
    assert results.baselines("paper") == ["nearest", "mirror"]
    assert results.baselines("mirror") == ["nearest"]


def test_a_baseline_that_is_not_in_the_table_is_refused(words, capsys):
    assert command.main([*words, "--against", "nearest", "spam"]) == 2
    assert "spam is to be judged against, but is no model of this table" in capsys.readouterr().err


def test_a_seed_that_is_missing_is_a_failed_check():
    found = list(beats_baselines(planted(0.05, seeds=(0, 2)), PLACE, "mirror"))
    assert [check.text for check in found if not check.passed] == ["mirror: no cell for seed 1"]


def test_targets_are_looser_in_a_region_and_the_noise_of_two_solves_counts():
    # RMSE 5 dB x 0.6 = 3.0 dB against 1.35 x 2.25 dB = 3.04 dB passes; the peak's median, 3 degrees, does not.
    lines = {check.text.split(":")[0]: check for check in reaches(planted(0.6), PLACE, "mirror")}
    assert len(lines) == 7
    assert lines["RMSE in the window"].passed
    assert not lines["Main peak (median)"].passed
    assert lines["Angle of departure"].passed  # 12 <= 14
    region = Place("lobby", "realistic", "region", 40)
    results = planted(0.9)
    results.values[region] = results.values.pop(PLACE)
    results.seconds["lobby", "realistic", "region"] = results.seconds["lobby", "realistic", "random"]
    lines = {check.text.split(":")[0]: check for check in reaches(results, region, "mirror")}
    assert lines["Angle of departure"].passed  # 18 <= 20
    assert "<= 20 deg" in lines["Angle of departure"].text
    assert lines["RMSE in the window"].passed  # 4.5 <= 1.35 x 1.5 x 2.25 = 4.56
    assert "<= 6 ns" in lines["Delay"].text


def test_without_a_second_solve_the_noise_check_fails():
    results = planted(0.1)
    results.seconds.clear()
    lines = [check for check in reaches(results, PLACE, "mirror") if "second solve" in check.text]
    assert [check.passed for check in lines] == [False]


def test_pages_of_planted_results_show_verdicts():
    results = planted(0.05)
    assert "mirror against" in text_of(results)
    assert "better" in text_of(results)
    results.facts = []
    assert "| Beam loss (eigenbeam) [dB] |" in page_of(results, "command")


def test_a_variant_changes_the_settings_it_names():
    words = ["bare=paper,line_of_sight=surface,steps=7,train_opacity=false", "best=paper,preset=best"]
    task = Task(stack_spectra([spectrum()]), DbWindow(-150.0, -50.0), seed=3)
    bare, best, laws = (one.settings(task) for one in methods_of([*words, "laws=mirror,without=lit+residual"]))
    assert (bare["line_of_sight"], bare["steps"], bare["train_opacity"]) == ("surface", 7, False)
    assert (bare["seed"], bare["floor_db"]) == (3, -150.0)
    assert best["steps"] == RadioConfig.best().steps
    assert laws["without"] == ["lit", "residual"]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("nonsense", "a model is one of"),
        ("a b=paper", "letters, digits and hyphens"),
        ("paper=paper,steps=1", "a name of its own"),
        ("x=nearest,steps=1", "a base that has settings"),
        ("x=paper,steps", "setting=value"),
    ],
)
def test_a_variant_that_means_nothing_is_refused(text, message):
    with pytest.raises(InputError, match=message):
        methods_of([text])


def test_a_setting_that_does_not_exist_is_refused():
    with pytest.raises(InputError, match="has no setting 'spam'"):
        methods_of(["x=paper,spam=1"])
    with pytest.raises(InputError, match=r"has no setting 'steps.deep'"):
        changed(RadioConfig(), {"steps.deep": 1})
