"""# A method of your own

One file is all that a method needs: a `fit` that learns from a task, a predictor with `render`, and the list `METHODS`.
This one copies the two nearest training positions and lets the stronger picture win.

    python examples/07_adding_a_method.py
"""

import sys
from dataclasses import dataclass, replace
from pathlib import Path

import torch

from rf3dgs.core.frames import Pose
from rf3dgs.core.grids import DirectionGrid
from rf3dgs.evaluation.baselines import NearestNeighbour
from rf3dgs.spectra.spectrum import Spectrum

sys.path.append(str(Path(__file__).resolve().parents[1]))  # the checkout, where the benchmarks are
from benchmarks.quality.methods.method import Method, Task


@dataclass(frozen=True, eq=False)
class StrongerOfTwo:
    """The picture with more power of those at the two nearest training positions."""

    train: Spectrum

    def render(self, pose: Pose, grid: DirectionGrid) -> Spectrum:
        distance = torch.linalg.vector_norm(self.train.pose.position - pose.position, dim=-1)
        nearest = distance < distance.min() + 1e-3  # all pictures of that position
        sides = [side for side in (nearest, ~nearest) if bool(side.any())]
        copies = [NearestNeighbour(self.train[side]).render(pose, grid) for side in sides]
        return replace(max(copies, key=lambda copy: float(copy.path_gain)), method="stronger of two")


def fit(task: Task) -> StrongerOfTwo:
    """Nothing to learn: the training pictures are all it needs."""
    return StrongerOfTwo(task.spectra)


METHODS = (Method("stronger-of-two", fit),)

if __name__ == "__main__":
    from rf3dgs.cli.facts import open_dataset
    from rf3dgs.evaluation import evaluate
    from rf3dgs.spectra.codec import window_of

    dataset = open_dataset("lobby")
    train, held = dataset.train.spectra, dataset.validation.spectra
    assert train is not None
    assert held is not None
    for method in METHODS:
        predictor = method.made(Task(train, window_of(train)))
        print(f"{method.name} is called field in this table:")
        print(evaluate(predictor, held, train=train, holdout="validation"))
