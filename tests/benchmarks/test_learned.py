"""Laws of the page that shows whether a learned baseline learns."""

import json

import pytest
import torch
from benchmarks.quality.learned import Constant, asked, data, main, method_of, pictures, room_paths, scores
from benchmarks.quality.methods.method import Task
from benchmarks.quality.methods.nerf2 import METHODS
from benchmarks.quality.protocol.figure import SIZES
from benchmarks.quality.protocol.pictures import YAWS_DEG
from benchmarks.quality.protocol.split import split_of

from rf3dgs.core.errors import InputError
from rf3dgs.core.frames import Pose
from rf3dgs.core.grids import equirect_grid
from rf3dgs.spectra.codec import window_of


def room_pictures(count, seed):
    return pictures(room_paths(count, seed), "smoke")


def test_four_pictures_stand_at_each_place_and_a_seed_draws_the_places():
    spectra = room_pictures(3, 0)
    assert len(spectra) == 3 * len(YAWS_DEG)
    places = spectra.pose.position.reshape(3, len(YAWS_DEG), 3)
    torch.testing.assert_close(places, places[:, :1].expand_as(places), rtol=0, atol=0)
    torch.testing.assert_close(room_pictures(3, 0).power, spectra.power, rtol=0, atol=0)
    assert not torch.equal(room_pictures(3, 1).pose.position, spectra.pose.position)


def test_traced_places_are_those_of_the_figures_and_the_sealed_ones_stay_sealed(room_paths, room_places, tmp_path):
    words = ["--method", "nerf2", "--scale", "smoke", "--paths", str(room_paths), "--out", str(tmp_path)]
    task, judge = data(asked([*words, "--positions", "5", "--held", "3"]))
    split = split_of(room_places, SIZES["smoke"].split)
    expected = split.training(5, 0), split.part("validation", "random")[:3]
    for spectra, places in zip((task.spectra, judge), expected, strict=True):
        assert len(spectra) == len(places) * len(YAWS_DEG)
        torch.testing.assert_close(
            spectra.pose.position[:: len(YAWS_DEG)], room_places[torch.from_numpy(places)], rtol=0, atol=1e-5
        )
    assert not list(tmp_path.rglob("test_reads.log"))
    with pytest.raises(InputError, match="4 places are held out and 5 are asked; lower --held"):
        data(asked([*words, "--held", "5"]))


def test_the_truth_scores_perfectly_and_the_constant_does_not():
    spectra = room_pictures(2, 0)
    window = window_of(spectra)

    class Oracle:
        def render(self, pose, grid):
            number = (spectra.pose.world_from_device == pose.world_from_device).all(-1).all(-1)
            number &= (spectra.pose.position == pose.position).all(-1)
            return spectra[int(number.nonzero()[0])]

    perfect = scores(Oracle(), spectra, window)
    assert perfect == {"psnr_db": 100.0, "psnr_linear_db": 100.0, "rmse_db": 0.0}
    constant = scores(Constant(spectra, window), spectra, window)
    assert constant["psnr_db"] < 30
    assert constant["rmse_db"] > 1


def test_both_configurations_are_methods_whose_settings_are_json():
    spectra = room_pictures(1, 0)
    task = Task(spectra, window_of(spectra), scale="smoke")
    assert [method.name for method in METHODS] == ["nerf2", "nerf2-db"]
    assert [method.settings(task)["target"] for method in METHODS] == ["linear", "db"]
    for method in METHODS:
        assert json.loads(json.dumps(method.settings(task))) == dict(method.settings(task))
        assert method_of(method.name)[0] is method


def test_what_was_learned_from_pinholes_answers_on_a_sphere():
    train = room_pictures(1, 0)
    model = METHODS[1].made(Task(train, window_of(train), scale="smoke"))
    answer = model.render(Pose([2.0, 2.0, 1.5]), equirect_grid(8, 4))
    assert answer.power.shape == (4, 8)
    assert bool((answer.power > 0).all())


def test_the_page_shows_what_was_learned_and_calls_an_extrapolation_one(tmp_path, capsys):
    asked = ["--method", "nerf2-db", "--scale", "smoke", "--positions", "6", "--held", "2", "--out", str(tmp_path)]
    assert main(asked) == 0
    figures = json.loads((tmp_path / "nerf2-db.json").read_text())
    assert set(figures["held_out"]) == {"nerf2-db", "constant", "nearest"}
    assert figures["history"]["positions"][-1][0] == figures["settings"]["steps"]
    assert figures["history"]["positions"][-1][2] < 0.5 * figures["history"]["positions"][0][2]
    cost = figures["published_cost"]
    assert cost["fit_seconds"] == pytest.approx(cost["seconds_per_point_of_fit"] * 30_000 * 8192 * 64)
    assert (tmp_path / "nerf2-db.png").read_bytes().startswith(b"\x89PNG")
    printed = capsys.readouterr().out
    assert "published size, an extrapolation" in printed
    assert "one view by heart" in printed


def test_no_places_are_refused_in_one_sentence(tmp_path, capsys):
    assert main(["--method", "nerf2", "--scale", "smoke", "--held", "0", "--out", str(tmp_path)]) == 2
    assert "--positions and --held must be at least 1; got 40 and 0" in capsys.readouterr().err
