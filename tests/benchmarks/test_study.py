"""Laws of a study: positions are split and never pictures, nothing leaks, and only what saw the same is compared."""

import numpy as np
import pytest
import torch
from benchmarks.quality.methods import known, methods_in, methods_of
from benchmarks.quality.methods.method import Method, Task
from benchmarks.quality.protocol import compare
from benchmarks.quality.protocol.cells import Key, read_cell
from benchmarks.quality.protocol.compare import difference, estimate
from benchmarks.quality.protocol.pictures import pinholes
from benchmarks.quality.protocol.results import Results
from benchmarks.quality.protocol.split import SplitConfig, paper_split, split_of
from benchmarks.quality.protocol.study import Study, StudyConfig

from rf3dgs.core.errors import DataError, InputError, SealedError
from rf3dgs.evaluation.scores import SCORE
from rf3dgs.spectra.codec import DbWindow

RECEIVERS = 40


def config(paths, out, **changes) -> StudyConfig:
    values = {"judge": "validation", "split": SplitConfig(6, 6, 4, 4, buffer=0.2), "holdouts": ("random",)}
    values |= {"receivers": RECEIVERS, "pictures": pinholes(12, 8), "paths": {"diffuse": paths}, "scale": "smoke"}
    return StudyConfig("lobby", "diffuse", out, **(values | changes))


def test_all_pictures_of_a_position_are_on_one_side(room_paths, tmp_path):
    study = Study(config(room_paths, tmp_path))
    roles = np.array(study.data.dataset.roles).reshape(RECEIVERS, 4)
    assert bool((roles == roles[:, :1]).all())
    train = study.task(5, 0, geometry=False).spectra
    assert len(train) == 4 * 5
    assert len(torch.unique(train.pose.position, dim=0)) == 5
    apart = torch.cdist(train.pose.position, study.truth("random").spectra.pose.position)
    assert float(apart.min()) > 1e-3


def test_the_paper_split_tests_a_fifth_and_trains_on_the_rest(room_places):
    split = paper_split(room_places)
    assert len(split.where("test")) == RECEIVERS // 5
    assert len(split.where("pool")) == RECEIVERS - RECEIVERS // 5
    few, more = (set(split.training(count, 1).tolist()) for count in (8, 16))
    assert few < more


def test_clustered_positions_lie_closer_together_than_uniform_ones_and_are_nested(room_places):
    split, ground = paper_split(room_places), room_places[:, :2].double().numpy()

    def alone(which: np.ndarray) -> float:
        """How far the farthest position of the room is from a training position [m]."""
        return float(np.linalg.norm(ground[:, None] - ground[which], axis=-1).min(1).max())

    uniform, clustered = (split.training(16, 0, draw, ground) for draw in ("uniform", "clustered"))
    assert alone(clustered) > alone(uniform)
    assert set(split.training(8, 0, "clustered", ground)) < set(clustered)


def test_a_region_keeps_its_buffer(room_places):
    split = split_of(room_places, SplitConfig(6, 6, 4, 4, buffer=0.4))
    ground = room_places[:, :2]
    for part in ("region", "validation region"):
        inside = ground[torch.from_numpy(split.where(part))]
        pool = ground[torch.from_numpy(split.where("pool"))]
        assert float(torch.cdist(inside, pool).min()) > 0.4


def test_two_receivers_at_one_place_are_refused(room_places):
    twice = room_places.clone()
    twice[7] = twice[3]
    with pytest.raises(InputError, match="two receivers stand at one place"):
        split_of(twice, SplitConfig(6, 6, 4, 4))


def test_a_held_out_position_among_the_training_ones_is_refused(room_paths, tmp_path):
    study = Study(config(room_paths, tmp_path))
    leak = study.truth("random").spectra[:4]

    class Leaky(Study):
        def task(self, *args, **options) -> Task:
            task = super().task(*args, **options)
            return Task(torch_stack(task.spectra, leak), task.window)

    def torch_stack(one, other):
        from rf3dgs.spectra.spectrum import stack_spectra

        return stack_spectra([part[index] for part in (one, other) for index in range(len(part))])

    results = Results(["nearest"], "validation", "photos", [0])
    Leaky(config(room_paths, tmp_path)).add(results, methods_of(["nearest"]), 5, 0)
    assert not results.places  # its cells stay empty


def test_the_sealed_positions_raise_without_their_flag(room_paths, tmp_path):
    study = Study(config(room_paths, tmp_path))
    for read in (lambda: study.data.dataset.test, lambda: study.data.dataset.spectra):
        with pytest.raises(SealedError):
            read()
    assert not (tmp_path / "data" / "lobby-diffuse" / "dataset" / "test_reads.log").exists()


def test_cells_say_what_was_seen_and_a_cell_that_saw_other_views_is_refused(room_paths, tmp_path):
    results, study = Results(["nearest", "idw4"], "validation", "photos", [0]), Study(config(room_paths, tmp_path))
    study.add(results, methods_of(["nearest", "idw4"]), 5, 0)
    assert results.positions(results.places[0]) == 4
    assert results.estimate(results.places[0], "nearest", SCORE["psnr"]) is not None
    assert [fact["rendering"]["pictures"] for fact in results.facts] == [16, 16]
    assert all("cores" in fact["made"]["machine"] for fact in results.facts)
    key = Key("lobby", "diffuse", "none", "validation", "random", 5, 0, "other", "lobby")
    cell = {**results.facts[0], "values": {"rmse_db": [0.0] * 16}, "saw": {"trained": "x", "judged": "y"}}
    with pytest.raises(DataError, match="saw other views"):
        results.add(key, cell)


def test_a_study_of_another_scale_makes_its_own_cells(room_paths, tmp_path):
    results = Results(["nearest"], "validation", "photos", [0])
    Study(config(room_paths, tmp_path)).add(results, methods_of(["nearest"]), 5, 0)
    file = next((tmp_path / "cells").rglob("*.json"))
    study = Study(config(room_paths, tmp_path, scale="paper"))
    assert read_cell(file, study.base | {"model": "nearest"}) is None


def test_pictures_of_one_position_are_resampled_together(monkeypatch):
    monkeypatch.setattr(compare, "RESAMPLES", 400)
    random = np.random.default_rng(0)
    once = random.normal(0.0, 1.0, (1, 60))
    four = np.repeat(once, 4, axis=1)
    for key in ("rmse_db", "peak_median"):
        alone, together = estimate(once, SCORE[key]), estimate(four, SCORE[key], views=4)
        apart = estimate(four, SCORE[key])
        width = alone.high - alone.low
        assert together.high - together.low == pytest.approx(width, rel=0.25)
        assert apart.high - apart.low < 0.75 * width
    assert difference(four, four - 0.2, SCORE["rmse_db"], views=4).positions == 60


def test_a_picture_without_a_value_leaves_its_position_in():
    values = np.random.default_rng(0).normal(0.0, 1.0, (2, 40))
    values[0, 3] = np.nan
    found = estimate(values, SCORE["peak_median"], views=4)
    assert found.low < found.value < found.high


def test_every_method_has_a_name_of_its_own_and_says_what_it_needs():
    methods = known()
    assert {"nearest", "idw4", "paper", "mirror"} <= set(methods)
    bare = Task(None, DbWindow(-100.0, -50.0))  # pyright: ignore[reportArgumentType]
    with pytest.raises(InputError, match="'mirror' needs a task with geometry"):
        methods["mirror"].made(bare)


def test_a_method_may_be_a_file_anywhere(tmp_path):
    file = tmp_path / "mine.py"
    file.write_text(
        "from benchmarks.quality.methods.method import Method\nMETHODS = (Method('mine', lambda task: task),)\n"
    )
    assert [method.name for method in methods_in(file)] == ["mine"]
    assert isinstance(methods_of([str(file), "nearest"])[0], Method)
    with pytest.raises(InputError, match="no such file"):
        methods_in(tmp_path / "other.py")
    file.write_text("METHODS = 3\n")
    with pytest.raises(InputError, match="must list its methods"):
        methods_of([str(file)])
