import json
import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from rf3dgs.core.errors import InputError
from rf3dgs.core.frames import Pose
from rf3dgs.core.grids import pinhole_grid
from rf3dgs.evaluation import evaluate, format_table
from rf3dgs.evaluation.scores import SCORES
from rf3dgs.spectra.codec import DbWindow


@pytest.fixture(scope="module")
def scored(room):
    pose = room.receivers(20)
    train, test = room.spectra_at(pose[:14], noise_db=1.0), room.spectra_at(pose[14:], noise_db=1.0, seed=14)
    repeat = room.spectra_at(pose[14:], noise_db=1.0, seed=50)
    return evaluate(room.Oracle(noise_db=1.0), test, train=train, repeat=repeat)


def test_an_oracle_beats_lookup_and_the_ceiling_is_near_it(scored):
    assert scored.methods == ("field", "nearest", "inverse distance", "second solve")
    for key in ("peak_median", "beam_loss_peak", "beam_loss_eigen", "rmse_db", "delay", "departure"):
        assert scored.value("field", key) < min(scored.value(name, key) for name in scored.baselines)
        assert scored.value("second solve", key) < min(scored.value(name, key) for name in scored.baselines)
        assert scored.best(key) == ("field",)
    assert scored.value("field", "rmse_db") == pytest.approx(scored.value("second solve", "rmse_db"), rel=0.3)


def test_a_perfect_predictor_scores_perfectly(room):
    test = room.spectra_at(room.receivers(3))
    result = evaluate(room.Oracle(), test)
    expected = {"psnr": 100.0, "ssim": 1.0, "peak_within_1": 100.0, "distinct_within_1": 100.0}
    for score in SCORES:
        if score.key != "lpips":
            assert result.value("field", score.key) == pytest.approx(expected.get(score.key, 0.0), abs=1e-3), score.key
    assert "no baseline" in result.summary()


def test_a_gain_offset_is_caught_where_it_matters(room):
    pose = room.receivers(8)
    result = evaluate(room.Oracle(offset_db=4.0), room.spectra_at(pose[6:]), train=room.spectra_at(pose[:6]))
    assert result.value("field", "path_gain") == pytest.approx(4.0, abs=1e-3)
    assert result.value("field", "peak_median") < 0.01
    assert "path_gain" in {item.score.key for item in result.losses}
    sentence = next(item.sentence() for item in result.losses if item.score.key == "path_gain")
    assert sentence.startswith("Path gain: the field loses to nearest (4.00 against ")
    assert "loses on" in result.summary()
    assert "path gain" in result.summary()


def test_a_test_position_among_the_training_ones_is_refused(room):
    pose = room.receivers(5)
    train = room.spectra_at(pose)
    near = Pose(pose.position[2:3] + 5e-4)
    with pytest.raises(InputError, match=r"held-out position 0 is training position 2 .*split by position"):
        evaluate(room.Oracle(), room.spectra_at(near), train=train)


def test_the_second_solve_must_stand_at_held_out_positions(room):
    pose = room.receivers(4)
    with pytest.raises(InputError, match="repeated spectra must stand at held-out positions"):
        evaluate(room.Oracle(), room.spectra_at(pose[:2]), repeat=room.spectra_at(pose[2:]))


def test_a_second_solve_of_some_positions_is_put_where_it_belongs(room):
    test = room.spectra_at(room.receivers(3))
    result = evaluate(room.Oracle(), test, repeat=test[torch.tensor([2])])
    values = result.column("second solve", "rmse_db")
    assert np.isnan(values[:2]).all()
    assert values[2] == 0.0


def test_a_second_solve_finds_its_own_view_among_those_of_one_position(room):
    grid = pinhole_grid(24, 16, fov_deg=90)
    views = Pose.from_yaw((6.0, 6, 1.5), torch.arange(4) * (math.pi / 2))
    test = room.spectra_at(views, grid)
    result = evaluate(room.Oracle(), test, repeat=test[torch.tensor([3, 1])], window=DbWindow(-120.0, -60.0))
    values = result.column("second solve", "rmse_db")
    assert np.isnan(values[[0, 2]]).all()
    assert (values[[1, 3]] == 0.0).all()


def test_the_window_is_the_one_asked_for_else_the_predictors_own(room):
    test = room.spectra_at(room.receivers(2))
    oracle = room.Oracle()
    assert evaluate(oracle, test, window=DbWindow(-111.0, -70.0)).window == (-111.0, -70.0)
    oracle.window = DbWindow(-105.0, -60.0)
    assert evaluate(oracle, test).window == (-105.0, -60.0)


class Wrong:
    def __init__(self, room, change):
        self.room, self.change = room, change

    def render(self, pose, grid):
        spectrum = self.room.spectrum_at(pose, grid)
        return replace(spectrum, power=self.change(spectrum.power))


@pytest.mark.parametrize("change", [lambda power: -power, lambda power: power * math.nan, lambda power: power / 0.0])
def test_power_that_is_no_power_is_refused(room, change):
    with pytest.raises(InputError, match="field answered with power that is negative, NaN or infinite"):
        evaluate(Wrong(room, change), room.spectra_at(room.receivers(1)))


def test_a_dark_truth_and_an_empty_hold_out_are_refused(room):
    test = room.spectra_at(room.receivers(2))
    with pytest.raises(InputError, match="held-out spectrum 0 has no power at all"):
        evaluate(room.Oracle(), replace(test, power=torch.zeros_like(test.power)), window=DbWindow(-120, -60))
    with pytest.raises(InputError, match="no held-out spectra"):
        evaluate(room.Oracle(), test[:0])


def test_a_dark_predictor_loses_everywhere_without_failing(room):
    pose = room.receivers(8)
    test, train = room.spectra_at(pose[5:]), room.spectra_at(pose[:5])
    result = evaluate(Wrong(room, torch.zeros_like), test, train=train)
    assert result.value("field", "peak_median") == pytest.approx(180.0)
    assert not [item for item in result.wins if item.score.key in ("rmse_db", "beam_loss_eigen", "path_gain", "psnr")]


def test_intervals_hold_the_value_and_come_out_the_same_again(scored):
    for key in ("rmse_db", "delay", "peak_p90"):
        estimate = scored.estimate("nearest", key)
        assert estimate.low <= estimate.value <= estimate.high
        assert estimate == scored.estimate("nearest", key)


def test_a_difference_within_the_noise_is_not_called_clear(room):
    pose = room.receivers(10)
    train = room.spectra_at(pose[:5])

    class Copy:
        def render(self, pose, grid):
            from rf3dgs.evaluation import NearestNeighbour

            spectrum = NearestNeighbour(train).render(pose, grid)
            level = 1.0 + 0.01 * math.sin(100 * float(pose.position[0]))
            return replace(spectrum, power=spectrum.power * level)

    result = evaluate(Copy(), room.spectra_at(pose[5:]), train=train)
    gain = next(item for item in result.comparisons if item.score.key == "path_gain" and item.baseline == "nearest")
    assert not gain.clear
    peak = next(item for item in result.comparisons if item.score.key == "peak_median" and item.baseline == "nearest")
    assert peak.is_tie
    assert "equals nearest" in peak.sentence()


def test_the_terminal_table_fits_and_marks_the_best(scored):
    text = format_table({"random": scored, "region": replace(scored, holdout="region")})
    lines = text.split("\n")
    assert max(len(line) for line in lines) <= 80
    row = next(line for line in lines if line.startswith("RMSE in the window [dB]"))
    assert f"{scored.value('field', 'rmse_db'):.2f}*" in row
    assert f"{scored.value('nearest', 'rmse_db'):.2f}" in row
    assert any(line.startswith("LPIPS") and "n/a" in line for line in lines)
    assert str(scored) == format_table({"random": scored})


def test_an_evaluation_becomes_plain_json(scored):
    content = json.loads(json.dumps(scored.as_dict(), allow_nan=False))
    assert content["table"]["field"]["rmse_db"]["value"] == pytest.approx(scored.value("field", "rmse_db"))
    assert len(content["values"]["nearest"]["delay_ns"]) == len(scored) == 6
    assert content["table"]["field"]["lpips"]["value"] is None


def test_an_unknown_method_is_named(scored):
    with pytest.raises(InputError, match="there is no method 'nerf'"):
        scored.value("nerf", "rmse_db")
