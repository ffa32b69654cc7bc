"""Laws of Figure 9: harms do what they say, and a score that orders by the loss itself is never wrong."""

import json

import numpy as np
import pytest
import torch
from benchmarks.quality import fig9
from benchmarks.quality.fig9 import HARMS, misorders
from benchmarks.quality.protocol.results import Place, Results

from rf3dgs.evaluation.scores import SCORE


def level() -> np.ndarray:
    """A picture with a beam on a rough floor [dB]."""
    rows, cols = np.mgrid[:20, :30]
    rough = np.random.default_rng(0).normal(-90.0, 3.0, (20, 30))
    return np.maximum(rough, -50.0 - (rows - 6) ** 2 - (cols - 8) ** 2)


def test_harms_change_what_they_say_and_nothing_else():
    before, random = level(), np.random.default_rng(0)
    after = {name: harm(before, random) for name, (_, harm) in HARMS.items()}
    peak = np.unravel_index(before.argmax(), before.shape)
    assert np.unravel_index(after["turned"].argmax(), before.shape) == (peak[0], peak[1] + 3)
    assert np.allclose(after["3 dB more"] - before, 3.0)
    assert after["no strong beam"].max() == before.max() - 20.0
    assert np.array_equal(after["no strong beam"] == before, before <= before.max() - 20.0)
    assert np.unravel_index(after["ghost beam"].argmax(), before.shape) == (peak[0], peak[1] + 15)
    assert after["ghost beam"][peak] == before[peak]
    assert (after["peaks clipped"] == after["peaks clipped"].max()).sum() > 10
    assert abs(np.std(after["noise of 4 dB"] - before) - 4.0) < 0.3
    assert after["blurred"].max() < before.max()
    assert all(np.array_equal(level(), before) for _ in after)  # nothing works in place


def planted(columns: dict[str, dict[str, np.ndarray]]) -> Results:
    results = Results(list(columns), "validation", "photos", [0])
    results.values[Place("lobby", "diffuse", "random", 8)] = {name: {0: values} for name, values in columns.items()}
    return results


def test_a_score_that_knows_the_loss_orders_rightly_and_a_blind_one_is_a_coin():
    loss = np.random.default_rng(1).gamma(2.0, 2.0, (2, 4000))
    blind = np.random.default_rng(2).normal(20.0, 2.0, (2, 4000))
    columns = {
        name: {"beam_loss_eigen_db": loss[k], "psnr_db": 30.0 - loss[k], "ssim": blind[k], "rmse_db": -loss[k]}
        for k, name in enumerate(("one", "other"))
    }
    results = planted(columns)
    share, pairs = misorders(results, "random", SCORE["psnr"], 0)
    assert share == 0.0
    assert 1000 < pairs < 4000  # those that differ by 1 dB
    assert misorders(results, "random", SCORE["rmse_db"], 0)[0] == 100.0
    # 3,000 coins: a standard deviation of 0.9 percent points.
    assert misorders(results, "random", SCORE["ssim"], 0)[0] == pytest.approx(50.0, abs=4.0)


def test_the_figure_is_made_and_its_numbers_are_those_of_the_harms(room_paths, room_geometry, tmp_path, capsys):
    words = ["--scale", "smoke", "--paths", str(room_paths), "--geometry", str(room_geometry), "--out", str(tmp_path)]
    assert fig9.main([*words, "--methods", "nearest", "constant"]) == 0
    text = capsys.readouterr().out
    assert "**Pairs of methods at one view**" in text
    found = json.loads((tmp_path / "fig9-smoke.json").read_text())
    harmed = {
        name: {column: np.array(v, dtype=float) for column, v in row.items()} for name, row in found["harmed"].items()
    }
    assert np.nanmax(harmed["3 dB more"]["peak_deg"]) < 1e-3
    assert np.nanmean(harmed["3 dB more"]["path_gain_db"]) == pytest.approx(3.0, abs=0.01)
    beamless = harmed["no strong beam"]
    assert np.nanmean(beamless["beam_loss_eigen_db"]) > np.nanmean(harmed["3 dB more"]["beam_loss_eigen_db"])
    assert (tmp_path / "fig9-smoke.png").stat().st_size > 10_000
    assert torch.is_grad_enabled()
