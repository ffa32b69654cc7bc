"""Delay and angle of departure as pictures: the paper's own, and errors in nanoseconds and degrees."""

import math

import torch
from torch import Tensor

from benchmarks.quality.protocol.cells import lpips_of_user
from rf3dgs.core.angles import angle_between, angles_of
from rf3dgs.evaluation import metrics
from rf3dgs.evaluation.lpips import LEAST_SIDE
from rf3dgs.evaluation.scores import Score
from rf3dgs.spectra.codec import DbWindow, PaperEncoding
from rf3dgs.spectra.spectrum import Spectrum

CHANNELS = {1: "azimuth", 2: "zenith", 3: "delay"}
"""What each channel of the paper's encoding shows, beside the gain."""


def _published(name: str) -> tuple[Score, ...]:
    label = name if name == "delay" else f"AoD {name}"
    text = f"Of the paper's picture of the {label}."
    return (
        Score(f"{name}_psnr", f"{label} PSNR", "dB", "higher", f"{name}_psnr_db", "mean", 2, text),
        Score(f"{name}_ssim", f"{label} SSIM", "", "higher", f"{name}_ssim", "mean", 3, text),
        Score(f"{name}_lpips", f"{label} LPIPS", "", "lower", f"{name}_lpips", "mean", 3, text),
    )


def _physical_scores(name: str, label: str, unit: str) -> tuple[Score, ...]:
    text = "Mean over pictures of that of the reached pixels."
    return tuple(
        Score(f"{name}_{key}", f"{label}, {said}", unit, "lower", f"{name}_{key}_{unit}", "mean", 2, text)
        for key, said in (("median", "median"), ("p90", "P90"))
    )


PUBLISHED = (*_published("delay"), *_published("azimuth"), *_published("zenith"))
PHYSICAL = (
    *_physical_scores("delay", "delay", "ns"),
    *_physical_scores("departure", "AoD", "deg"),
    *_physical_scores("azimuth", "AoD azimuth", "deg"),
    *_physical_scores("zenith", "AoD zenith", "deg"),
)


def csi_scores(truth: Spectrum, drawn: Spectrum, window: DbWindow, *, encoding: PaperEncoding) -> dict[str, Tensor]:
    """Columns `[n]` of `PUBLISHED` and `PHYSICAL` for pictures `[n, row, col]`; NaN where `drawn` lacks what they need.

    PUBLISHED compares the channels of `encoding`. PHYSICAL are the median and the 90th percentile over the pixels of a
    picture that a path reaches, whose true power is at or above the window's floor.
    """
    nothing = torch.full((len(truth),), math.nan)
    if drawn.delay is None or drawn.aod is None or truth.delay is None or truth.aod is None:
        return {score.column: nothing for score in (*PUBLISHED, *PHYSICAL)}
    first, second = encoding.encode(truth), encoding.encode(drawn)
    weight, lpips, values = metrics.pixel_weight(truth.grid), lpips_of_user(), {}
    if min(truth.grid.shape) < LEAST_SIDE:
        lpips = None
    for channel, name in CHANNELS.items():
        one, other = first[..., channel], second[..., channel]
        values[f"{name}_psnr_db"] = metrics.psnr(one, other, weight)
        values[f"{name}_ssim"] = metrics.ssim(one, other, truth.grid)
        values[f"{name}_lpips"] = nothing if lpips is None else lpips(one, other)
    return values | _physical(truth, drawn, window)


def _physical(truth: Spectrum, drawn: Spectrum, window: DbWindow) -> dict[str, Tensor]:
    assert truth.delay is not None
    assert truth.aod is not None
    assert drawn.delay is not None
    assert drawn.aod is not None
    blank = torch.linalg.vector_norm(drawn.aod, dim=-1) < 1e-6
    zenith, azimuth = (one - other for one, other in zip(angles_of(truth.aod), angles_of(drawn.aod), strict=True))
    turn = torch.remainder(azimuth + math.pi, 2 * math.pi) - math.pi
    errors = {
        "delay": (1e9 * (truth.delay.double() - drawn.delay.double()).abs().float(), "ns", 0.0),
        "departure": (torch.rad2deg(angle_between(truth.aod, drawn.aod)), "deg", 90.0),
        "azimuth": (torch.rad2deg(turn.abs()), "deg", 90.0),
        "zenith": (torch.rad2deg(zenith.abs()), "deg", 90.0),
    }
    reached = truth.gain_db >= window.floor_db
    values = {}
    for name, (error, unit, guess) in errors.items():
        known = error if guess == 0.0 else torch.where(blank, torch.full_like(error, guess), error)
        known = torch.where(reached, known, math.nan).flatten(1)
        values[f"{name}_median_{unit}"] = known.nanquantile(0.5, dim=1)
        values[f"{name}_p90_{unit}"] = known.nanquantile(0.9, dim=1)
    return values
