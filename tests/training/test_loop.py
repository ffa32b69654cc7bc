import os
import signal
import threading

import pytest
import torch

from rf3dgs.core.errors import InputError, TrainingError
from rf3dgs.training.checkpoint import CheckpointFolder, State
from rf3dgs.training.loop import TrainingStopped, random_at, train, view_at

IDENTITY = {"stage": "walk", "configuration": {"seed": 0}}


class Walk:
    """A stage whose every step depends on all steps before it; `trouble` is called with the iteration."""

    def __init__(self, trouble=lambda walk, iteration: None):
        self.place, self.steps_made, self.trouble = torch.zeros(3), 0, trouble

    def step(self, iteration):
        self.place = 0.9 * self.place + torch.randn(3, generator=random_at(0, iteration, "walk"))
        self.steps_made += 1
        self.trouble(self, iteration)
        return float(self.place.norm())

    def state(self):
        return State({"place": self.place}, {})

    def restore(self, state):
        self.place = state.tensors["place"]


class Recorder:
    def __init__(self):
        self.events = []

    def start(self, label, total, done=0):
        self.events.append(("start", label, total, done))

    def update(self, done, note=""):
        self.events.append(("update", done, note))

    def finish(self, note=""):
        self.events.append(("finish", note))


def walk(steps, folder=None, trouble=lambda walk, iteration: None, **options):
    stage = Walk(trouble)
    train(stage, steps, label="walk", identity=IDENTITY, checkpoint_dir=folder, every_steps=10, **options)
    return stage


def test_a_resumed_run_ends_where_an_uninterrupted_one_does(tmp_path):
    def fail(stage, iteration):
        if iteration == 47:
            raise RuntimeError("power cut")

    with pytest.raises(RuntimeError, match="power cut"):
        walk(80, tmp_path, fail)
    resumed = walk(80, tmp_path)
    assert resumed.steps_made == 40
    assert torch.equal(resumed.place, walk(80).place)


def test_a_finished_run_starts_no_step_again(tmp_path):
    first = walk(30, tmp_path)
    again = walk(30, tmp_path)
    assert again.steps_made == 0
    assert torch.equal(first.place, again.place)


def test_time_alone_also_brings_a_checkpoint(tmp_path):
    walk(3, tmp_path / "always", every_seconds=0.0)
    assert sorted(path.name for path in (tmp_path / "always").glob("*.json")) == [
        "step-00000002.json",
        "step-00000003.json",
    ]


def test_progress_counts_from_where_a_resumed_run_begins(tmp_path):
    walk(20, tmp_path)
    recorder = Recorder()
    walk(25, tmp_path, progress=recorder)
    assert recorder.events[0] == ("start", "walk", 25, 20)
    assert [event[1] for event in recorder.events[1:-1]] == [21, 22, 23, 24, 25]
    assert recorder.events[-1][0] == "finish"


def test_another_configuration_is_refused(tmp_path):
    walk(10, tmp_path)
    with pytest.raises(InputError, match=r"another configuration.seed \(it had 0, this run has 1\)"):
        train(
            Walk(), 10, label="walk", identity={"stage": "walk", "configuration": {"seed": 1}}, checkpoint_dir=tmp_path
        )


def test_a_tensor_that_is_not_finite_stops_the_run_and_is_named(tmp_path):
    def break_down(stage, iteration):
        if iteration == 33:
            stage.place = torch.tensor([1.0, float("nan"), 0.0])

    with pytest.raises(TrainingError, match=r"not finite in place at iteration 34.*last good checkpoint stays in"):
        walk(80, tmp_path, break_down)
    iteration, state = CheckpointFolder(tmp_path, IDENTITY).load_newest()
    assert iteration == 30
    assert bool(torch.isfinite(state.tensors["place"]).all())


def test_a_hidden_nan_never_reaches_a_checkpoint(tmp_path):
    class Hidden(Walk):
        def step(self, iteration):
            super().step(iteration)
            if iteration == 15:
                self.place[1] = float("inf")
            return 0.5

    with pytest.raises(TrainingError, match="not finite in place at iteration 20"):
        train(Hidden(), 80, label="walk", identity=IDENTITY, checkpoint_dir=tmp_path, every_steps=10)
    assert CheckpointFolder(tmp_path, IDENTITY).load_newest()[0] == 10


def test_a_loss_that_is_not_finite_is_named():
    class Bad(Walk):
        def step(self, iteration):
            return float("inf")

    with pytest.raises(TrainingError, match="walk met a loss of inf at iteration 1; check the data"):
        train(Bad(), 5, label="walk", identity=IDENTITY)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_leaves_a_checkpoint_and_stops(tmp_path, number):
    def interrupt(stage, iteration):
        if iteration == 25:
            os.kill(os.getpid(), number)

    before = signal.getsignal(number)
    with pytest.raises(TrainingStopped, match=f"stopped by {number.name} at iteration 26 of 80; run it again to go on"):
        walk(80, tmp_path, interrupt)
    assert signal.getsignal(number) == before
    assert not (tmp_path / "lock.json").exists()
    resumed = walk(80, tmp_path)
    assert resumed.steps_made == 54
    assert torch.equal(resumed.place, walk(80).place)


def test_training_works_off_the_main_thread(tmp_path):
    places = []
    thread = threading.Thread(target=lambda: places.append(walk(30, tmp_path).place))
    thread.start()
    thread.join()
    assert torch.equal(places[0], walk(30).place)


def test_two_runs_in_one_folder_are_refused(tmp_path):
    def second(stage, iteration):
        if iteration == 5:
            walk(10, tmp_path)

    with pytest.raises(TrainingError, match="in use by process"):
        walk(10, tmp_path, second)


def test_random_numbers_depend_on_seed_iteration_and_purpose_alone():
    def draw(seed, iteration, purpose):
        return tuple(torch.rand(4, generator=random_at(seed, iteration, purpose)).tolist())

    assert draw(1, 2, "split") == draw(1, 2, "split")
    assert len({draw(1, 2, "split"), draw(2, 2, "split"), draw(1, 3, "split"), draw(1, 2, "views")}) == 4


def test_every_view_comes_once_a_round_in_another_order():
    rounds = [[view_at(7, 5 * turn + index, 5) for index in range(5)] for turn in range(6)]
    assert all(sorted(order) == [0, 1, 2, 3, 4] for order in rounds)
    assert len({tuple(order) for order in rounds}) > 1
