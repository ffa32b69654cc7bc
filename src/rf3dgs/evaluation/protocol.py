"""The protocol: one predictor and the copying baselines on held-out spectra, position by position."""

import math
from typing import Protocol

import numpy as np
import torch
from torch import Tensor

from rf3dgs.channel.arrays import PlanarArray, planar_array
from rf3dgs.core.errors import InputError
from rf3dgs.core.frames import Pose
from rf3dgs.core.grids import DirectionGrid
from rf3dgs.core.progress import Progress, Silent
from rf3dgs.evaluation import beams, metrics
from rf3dgs.evaluation.baselines.lookup import InverseDistance, NearestNeighbour
from rf3dgs.evaluation.lpips import LEAST_SIDE, Lpips
from rf3dgs.evaluation.perceptual import flip
from rf3dgs.evaluation.table import CEILING, FIELD, Evaluation
from rf3dgs.evaluation.transport import angular_wasserstein
from rf3dgs.spectra.codec import DbWindow, window_of
from rf3dgs.spectra.spectrum import Spectrum, stack_spectra

LEAK_DISTANCE = 1e-3  # [m]


class Predictor(Protocol):
    """Anything that answers with a spectrum at a pose: a field, a baseline, a tracer."""

    def render(self, pose: Pose, grid: DirectionGrid) -> Spectrum:
        """The spectrum `[row, col]` at one pose."""
        ...


def evaluate(
    predictor: Predictor,
    spectra: Spectrum,
    *,
    train: Spectrum | None = None,
    repeat: Spectrum | None = None,
    holdout: str = "random",
    window: DbWindow | None = None,
    array: PlanarArray | None = None,
    lpips: Lpips | None = None,
    seed: int = 0,
    progress: Progress | None = None,
) -> Evaluation:
    """Score `predictor` on held-out `spectra` `[n, row, col]`, beside the baselines and the ceiling.

    train: the training spectra; gives nearest neighbour and inverse distance. Refused when one of its positions is a
    held-out one. repeat: a second solve of the same truth (all or some of the positions) with another seed and number
    of rays; it gives the ceiling. holdout: name of the held-out set. window: the dB window of all pictures and clipped
    errors; default the predictor's own, else that of `train`, else that of `spectra`. array: for the beam losses,
    default 8x8 patches. lpips: default what RF3DGS_LPIPS names, else not available. seed: of the confidence intervals.
    """
    spectra = _with_axis(spectra)
    progress = Silent() if progress is None else progress
    _check_truth(spectra)
    if window is None:
        own = getattr(predictor, "window", None)
        window = own if isinstance(own, DbWindow) else window_of(spectra if train is None else train)
    array = planar_array(8, 8, pattern="patch") if array is None else array
    lpips = Lpips.from_environment() if lpips is None else lpips
    methods: dict[str, Predictor] = {FIELD: predictor}
    if train is not None:
        train = _with_axis(train)
        refuse_leak(train.pose.position, spectra.pose.position)
        methods |= {"nearest": NearestNeighbour(train), "inverse distance": InverseDistance(train)}
    steps = len(methods) * len(spectra)
    progress.start(f"evaluate ({holdout})", steps)
    truth_covariance = beams.panel_covariance(spectra, array)
    values: dict[str, dict[str, np.ndarray]] = {}
    for number, (name, method) in enumerate(methods.items()):
        predicted = []
        for index in range(len(spectra)):
            predicted.append(_checked(method.render(spectra.pose[index], spectra.grid), spectra[index], name))
            progress.update(number * len(spectra) + index + 1)
        values[name] = score(spectra, stack_spectra(predicted), truth_covariance, window, array, lpips)
    if repeat is not None and len(repeat):
        values[CEILING] = _ceiling(spectra, _with_axis(repeat), truth_covariance, window, array, lpips)
    progress.finish()
    position = spectra.pose.position.numpy().copy()
    return Evaluation(holdout, values, position, (window.floor_db, window.ceil_db), seed)


def score(
    truth: Spectrum,
    prediction: Spectrum,
    truth_covariance: Tensor,
    window: DbWindow,
    array: PlanarArray,
    lpips: Lpips | None = None,
) -> dict[str, np.ndarray]:
    """All per-position values `[n]` of predictions at the truth's poses and grid; NaN where one does not apply.

    LPIPS does not apply without its weights, and to pictures too small for its networks.
    """
    weight = metrics.pixel_weight(truth.grid)
    true_picture = window.encode(truth.power)
    picture = window.encode(prediction.power)
    peak = torch.rad2deg(metrics.peak_error(truth, prediction))
    nothing = torch.full_like(peak, math.nan)
    covariance = beams.panel_covariance(prediction, array)
    values = {
        "peak_deg": peak,
        "distinct_deg": torch.where(metrics.is_distinct(truth), peak, nothing),
        "beam_loss_peak_db": beams.beam_loss_peak(truth, prediction, truth_covariance, array),
        "beam_loss_eigen_db": beams.beam_loss_eigen(truth_covariance, covariance),
        "rmse_db": metrics.rmse_db(truth.power, prediction.power, window, weight),
        "mae_db": metrics.mae_db(truth.power, prediction.power, window, weight),
        "path_gain_db": metrics.path_gain_error(truth, prediction),
        "delay_ns": 1e9 * metrics.delay_error(truth, prediction, window),
        "departure_deg": torch.rad2deg(metrics.departure_error(truth, prediction, window)),
        "delay_spread_ns": 1e9 * metrics.delay_spread_error(truth, prediction),
        "wasserstein_deg": torch.rad2deg(angular_wasserstein(truth, prediction)),
        "psnr_db": metrics.psnr(true_picture, picture, weight),
        "ssim": metrics.ssim(true_picture, picture, truth.grid),
        "flip": flip(true_picture, picture, truth.grid),
        "lpips": nothing if lpips is None or min(truth.grid.shape) < LEAST_SIDE else lpips(true_picture, picture),
    }
    return {name: value.double().numpy() for name, value in values.items()}


def refuse_leak(train: Tensor, test: Tensor) -> None:
    """Raise unless every test position `[m, 3]` is more than 1 mm away from every training position `[n, 3]`."""
    distance = torch.cdist(test.double(), train.double())
    close = (distance <= LEAK_DISTANCE).nonzero()
    if len(close):
        index, twin = (int(value) for value in close[0])
        raise InputError(
            f"held-out position {index} is training position {twin} ({1e3 * float(distance[index, twin]):.2f} mm off) "
            f"and {len(close) - 1} more pairs are like it; split by position before training"
        )


def _with_axis(spectra: Spectrum) -> Spectrum:
    return spectra if spectra.pose.batch_shape else stack_spectra([spectra])


def _check_truth(spectra: Spectrum) -> None:
    if len(spectra) == 0:
        raise InputError("there are no held-out spectra to evaluate on; split the dataset with a test share above 0")
    dark = ~(spectra.power.amax((-2, -1)) > 0)
    if bool(dark.any()):
        raise InputError(f"held-out spectrum {int(dark.nonzero()[0])} has no power at all; remove that position")


def _checked(prediction: Spectrum, truth: Spectrum, name: str) -> Spectrum:
    if prediction.power.shape != truth.power.shape:
        raise InputError(
            f"{name} answered with power {list(prediction.power.shape)}; expected {list(truth.power.shape)}, "
            "one pose on the asked grid"
        )
    if not bool(torch.isfinite(prediction.power).all()) or bool((prediction.power < 0).any()):
        raise InputError(
            f"{name} answered with power that is negative, NaN or infinite; power must be linear and finite"
        )
    return prediction


def _ceiling(
    spectra: Spectrum,
    repeat: Spectrum,
    covariance: Tensor,
    window: DbWindow,
    array: PlanarArray,
    lpips: Lpips | None,
) -> dict[str, np.ndarray]:
    """Values of the second solve, put where its poses stand among the held-out ones; NaN at the others."""
    distance = torch.cdist(_pose_numbers(repeat.pose), _pose_numbers(spectra.pose))
    nearest, index = distance.min(1)
    if bool((nearest > LEAK_DISTANCE).any()) or len(index.unique()) < len(index):
        raise InputError(
            "repeated spectra must stand at held-out positions, each once; pass the second solve of this hold-out only"
        )
    values = score(spectra[index], repeat, covariance[index], window, array, lpips)
    return {name: _scatter(value, index.numpy(), len(spectra)) for name, value in values.items()}


def _pose_numbers(pose: Pose) -> Tensor:
    """Position [m] and rotation matrix of each pose as one row `[n, 12]`, so that equal poses are equal rows."""
    return torch.cat((pose.position, pose.world_from_device.reshape(-1, 9)), -1).double()


def _scatter(value: np.ndarray, index: np.ndarray, count: int) -> np.ndarray:
    full = np.full(count, math.nan)
    full[index] = value
    return full
