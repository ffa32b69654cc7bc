"""The kinds of spectra of Fig. 10: their methods, their scales, and scores between pictures of two kinds."""

import json
import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from functools import partial
from typing import Any

import torch
from torch import Tensor

from benchmarks.quality.methods.field import config_of, field
from benchmarks.quality.methods.method import Method, Scale, Task
from rf3dgs.core.frames import Pose
from rf3dgs.core.grids import DirectionGrid, equirect_grid
from rf3dgs.evaluation import metrics
from rf3dgs.evaluation.protocol import Predictor
from rf3dgs.evaluation.scores import Score
from rf3dgs.spectra.codec import DbWindow, PerViewLinear, paper_scale
from rf3dgs.spectra.config import Method as SpectrumMethod
from rf3dgs.spectra.spectrum import Instrument, Spectrum
from rf3dgs.spectra.synthesis import default_lobe
from rf3dgs.training.config import RadioConfig
from rf3dgs.training.radio import fit_radio

KINDS: Mapping[SpectrumMethod, str] = {"ideal": "ideal", "bartlett": "CBF", "tapered": "TCBF", "capon": "MVDR"}
STEPS: Mapping[Scale, int] = {"smoke": 40, "laptop": 3_000, "paper": 10_000}
Scales = Mapping[str, PerViewLinear | DbWindow]

OWN_SCORES = (
    Score("psnr_paper", "PSNR, paper's scales", "dB", "higher", "psnr_paper_db", "mean", 2, "Each on its own scale."),
    Score("ssim_paper", "SSIM, paper's scales", "", "higher", "ssim_paper", "mean", 3, "Of the same pictures."),
    Score("psnr_sr", "PSNR per sr", "dB", "higher", "psnr_sr_db", "mean", 2, "Of power per solid angle."),
    Score("rmse_sr", "RMSE per sr", "dB", "lower", "rmse_sr_db", "mean", 2, "Of power per solid angle."),
)


def scale_of(train: Spectrum, window: DbWindow) -> PerViewLinear | DbWindow:
    """The scale that the paper gives the pictures of this kind; its dB scale is the window of the study."""
    return PerViewLinear() if isinstance(paper_scale(train), PerViewLinear) else window


def between_kinds(truth: Spectrum, drawn: Spectrum, window: DbWindow, *, scales: Scales) -> dict[str, Tensor]:
    """Columns `[n]` of `OWN_SCORES` for pictures `[n, row, col]` of any two instruments.

    scales: of the pictures that an instrument of a name shows. Per sr: power of a surface grows with the solid angle of
    the lobe that sees it, so that power over solid angle is compared, at the level of the truth's instrument.
    """
    weight = metrics.pixel_weight(truth.grid)
    first = scales[truth.instrument.name].encode(truth.power)
    second = scales[drawn.instrument.name].encode(drawn.power)
    share = truth.instrument.beam_solid_angle / drawn.instrument.beam_solid_angle
    return {
        "psnr_paper_db": metrics.psnr(first, second, weight),
        "ssim_paper": metrics.ssim(first, second, truth.grid),
        "psnr_sr_db": metrics.psnr(window.encode(truth.power), window.encode(share * drawn.power), weight),
        "rmse_sr_db": metrics.rmse_db(truth.power, share * drawn.power, window, weight),
    }


@dataclass(frozen=True, eq=False)
class PerView:
    """A field that learned pictures between 0 and 1, each over its own peak; levels are those of `peak`, the mean."""

    field: Predictor
    window: DbWindow
    peak: float

    def render(self, pose: Pose, grid: DirectionGrid) -> Spectrum:
        """The spectrum `[row, col]` at one pose."""
        shown = self.field.render(pose, grid)
        return replace(shown, power=self.peak * self.window.encode(shown.power), delay=None, aod=None)


def per_view(task: Task, *, steps: int) -> PerView:
    """The published recipe on linear pictures, each over its own peak, as the paper shows it CBF and TCBF.

    The radio stage learns the place of a level in a dB window. Levels are chosen so that this place is the linear
    value.
    """
    assert task.geometry is not None
    spectra, window = task.spectra, task.window
    peak = float(spectra.power.amax((-2, -1)).mean())
    placed = replace(spectra, power=window.decode(PerViewLinear().encode(spectra.power)), floor=None)
    config = config_of("paper", {"preset": "paper", "steps": steps, "ceil_db": window.ceil_db}, task)
    return PerView(fit_radio(task.geometry, placed, config), window, peak)


def methods_for(kind: SpectrumMethod, scale: Scale) -> list[Method]:
    """What is trained on pictures of a kind."""
    steps = STEPS[scale]
    found = [field("published", "paper", {"preset": "paper", "steps": steps})]
    if kind in ("bartlett", "tapered"):
        fit = partial(per_view, steps=steps)
        found.append(Method("published-per-view", fit, ("geometry",), lambda task: {"steps": steps}))
    ours = field("mirror", "mirror") if kind == "ideal" else Method("mirror", behind, ("geometry",), settings_behind)
    return [*found, ours]


def config_behind(task: Task) -> RadioConfig:
    """Our settings for the waves behind an array's pictures, with the window's floor as the field's lobe sees it.

    A surface that an array shows at a level is weaker through a narrower lobe, by the ratio of their solid angles.
    """
    plain = config_of("mirror", {}, task)
    lobe = Instrument.gaussian(default_lobe(equirect_grid(*plain.array_grid)))
    share = lobe.beam_solid_angle / task.spectra.instrument.beam_solid_angle
    return replace(plain, floor_db=task.window.floor_db + 10.0 * math.log10(share))


def behind(task: Task) -> Predictor:
    """Our field, fitted to the waves behind an array's pictures."""
    assert task.geometry is not None
    return fit_radio(task.geometry, task.spectra, config_behind(task))


def settings_behind(task: Task) -> dict[str, Any]:
    return json.loads(json.dumps(asdict(config_behind(task))))


def same_places(one: Spectrum, other: Spectrum) -> bool:
    """Whether both were taken at the same poses, in the same order."""
    pairs = zip((one.pose.position, one.pose.orientation), (other.pose.position, other.pose.orientation), strict=True)
    return len(one) == len(other) and all(torch.equal(first, second) for first, second in pairs)
