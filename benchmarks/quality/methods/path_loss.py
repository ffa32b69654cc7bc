"""Path loss by formula: a level at every position, the same in all directions."""

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from benchmarks.quality.methods.method import Method, Task
from rf3dgs.channel import path_loss
from rf3dgs.evaluation.baselines.path_loss import PathLossPredictor, log_distance_of

Formula = Callable[[Tensor, Tensor, float], Tensor]


def _distance(tx: Tensor, rx: Tensor) -> Tensor:
    return torch.linalg.vector_norm(rx - tx, dim=-1)


def _friis(tx: Tensor, rx: Tensor, frequency: float) -> Tensor:
    return path_loss.free_space_loss(_distance(tx, rx), frequency)


def _itu(tx: Tensor, rx: Tensor, frequency: float) -> Tensor:
    return path_loss.itu_indoor_loss(_distance(tx, rx), frequency)


def _hata(formula: Callable[..., Tensor]) -> Formula:
    """Heights are the positions' z, the mean one of the receivers."""

    def loss(tx: Tensor, rx: Tensor, frequency: float) -> Tensor:
        return formula(_distance(tx, rx), frequency, base_height=float(tx[2]), mobile_height=float(rx[:, 2].mean()))

    return loss


def _of(name: str, formula: Formula, **settings: Any) -> Method:
    def fit(task: Task) -> PathLossPredictor:
        frequency = task.spectra.frequency
        return PathLossPredictor(task.spectra, lambda tx, rx: formula(tx, rx, frequency), name=name)

    return Method(name, fit, settings=lambda task: settings)


def _log_distance(task: Task) -> PathLossPredictor:
    line = log_distance_of(task.spectra)
    return PathLossPredictor(task.spectra, lambda tx, rx: line.loss(_distance(tx, rx)), name="log-distance")


METHODS = (
    _of("friis", _friis),
    Method("log-distance", _log_distance),
    _of("itu-indoor", _itu, recommendation="P.1238-11", environment="office", line_of_sight=True),
    _of("okumura-hata", _hata(path_loss.okumura_hata_loss), area="city"),
    _of("cost231-hata", _hata(path_loss.cost231_hata_loss), area="city"),
)
