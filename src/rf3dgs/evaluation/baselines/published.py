"""RF-3DGS as it was published: the second stage's recipe, pictures of spectra on frozen Gaussians. Paper IV.B, IV.C.

Means, rotations and scales stay. Harmonics of degree 3 begin at zero, which shows grey, and are all trained at once;
opacity begins where photographs left it and is trained too. Every iteration of Adam, with constant rates, takes one
picture in random order and 0.8 L1 + 0.2 (1 - SSIM) of what is drawn before black. What the pictures show is the choice
(`scales`). There is no transmitter, no line of sight, no delay and no departure.
"""

from collections.abc import Mapping
from dataclasses import asdict, dataclass

import torch
from torch import Tensor

from rf3dgs.core.errors import InputError
from rf3dgs.core.frames import Pose
from rf3dgs.core.grids import DirectionGrid, view_of
from rf3dgs.core.progress import Progress
from rf3dgs.evaluation.baselines import scales
from rf3dgs.evaluation.baselines.scales import Scale
from rf3dgs.spectra.codec import DbWindow
from rf3dgs.spectra.spectrum import Instrument, Spectrum, stack_spectra
from rf3dgs.splats.gaussians import Gaussians
from rf3dgs.splats.harmonics import evaluate, view_directions
from rf3dgs.splats.rasterize import Backend, rasterize
from rf3dgs.splats.rates import Rates
from rf3dgs.splats.target import Target
from rf3dgs.splats.trainer import Trainer
from rf3dgs.training.checkpoint import State
from rf3dgs.training.loop import train, view_at


@dataclass(frozen=True)
class PublishedConfig:
    """The second stage as published; the rates are those of its public code."""

    target: scales.Target = "jet"
    """What a training picture shows: "jet" is the published one."""
    steps: int = 10_000
    """Iterations; each takes one picture."""
    seed: int = 0
    """Decides the order of the pictures."""
    degree: int = 3
    """Degree of the harmonics, from the first iteration on."""
    lr_sh: float = 2.5e-3
    """Adam's learning rate of the constant harmonic; the higher ones learn at a twentieth of it."""
    lr_opacity: float = 5e-2
    """Adam's learning rate of the opacity logits."""
    ssim_weight: float = 0.2
    """Share of D-SSIM in the loss; the rest is L1."""
    backend: Backend = "auto"
    """Which rasterizer works."""


@dataclass(frozen=True, eq=False)
class PublishedField:
    """Gaussians whose colours `sh` `[N, K, channel]` show spectra by `scale`; what they show is read as power."""

    gaussians: Gaussians
    scale: Scale
    frequency: float
    instrument: Instrument
    tx: Pose | None = None
    backend: Backend = "auto"

    @property
    def window(self) -> DbWindow:
        """The dB window of the pictures."""
        return self.scale.window

    def picture(self, pose: Pose, grid: DirectionGrid) -> Tensor:
        """What is drawn at one pose, `[row, col, channel]`, in the scale's own colours, not clipped."""
        one = self.gaussians
        with torch.no_grad():
            view = view_of(pose, grid)
            values = evaluate(one.sh, view_directions(one.means, view.position), offset=0.5, clamp=True)
            return rasterize(one.means, one.quats, one.scales, one.opacities, values, view, backend=self.backend).values

    def render(self, pose: Pose, grid: DirectionGrid) -> Spectrum:
        """The spectrum on `grid` at one pose, or `[n, row, col]` at n poses; without delay and departure."""
        if pose.batch_shape:
            return stack_spectra([self.render(pose[index], grid) for index in range(len(pose))])
        power = self.scale.read(self.picture(pose, grid))
        return Spectrum(power, grid, pose, self.frequency, self.instrument, "published", tx=self.tx)


class Recolouring:
    """What the training loop drives: colours and opacity, a picture an iteration."""

    def __init__(self, geometry: Gaussians, spectra: Spectrum, scale: Scale, config: PublishedConfig) -> None:
        self.config = config
        sh = torch.zeros(len(geometry), (config.degree + 1) ** 2, scale.channels)
        shape = (geometry.means, geometry.quats, geometry.log_scales, geometry.logit_opacities)
        self.trainer = Trainer(*shape, sh, train=("opacity", "sh"), backend=config.backend)
        self.views = [view_of(spectra.pose[index], spectra.grid) for index in range(len(spectra))]
        area = spectra.grid.solid_angle / spectra.grid.solid_angle.mean()
        weight = area if spectra.grid.kind == "equirect" else None
        self.targets = [Target(picture, weight) for picture in scale.paint(spectra.power)]
        self.rates = Rates(logit_opacities=config.lr_opacity, level=config.lr_sh, bands=config.lr_sh / 20.0)

    def step(self, iteration: int) -> float:
        number = view_at(self.config.seed, iteration, len(self.views))
        weight = self.config.ssim_weight
        return self.trainer.step(self.views[number], self.targets[number], self.rates, ssim_weight=weight)

    def state(self) -> State:
        return State(self.trainer.state(), {})

    def restore(self, state: State) -> None:
        self.trainer.restore(state.tensors)


def fit_published(
    geometry: Gaussians,
    spectra: Spectrum,
    config: PublishedConfig | None = None,
    *,
    window: DbWindow,
    progress: Progress | None = None,
) -> PublishedField:
    """Colour frozen `geometry` after `spectra` `[picture, row, col]`, whose levels are painted in `window`.

    Pixels of pinholes count alike, as published, those of spheres by their solid angle. A picture may be dark. Raises
    InputError for spectra that have no power at all, or power that is negative or not finite, and TrainingError when
    training cannot go on.
    """
    config = PublishedConfig() if config is None else config
    if config.steps < 1:
        raise InputError(f"steps must be at least 1; got {config.steps}")
    geometry.check()
    _check(spectra.power)
    if spectra.grid.kind == "list":
        raise InputError("the published recipe needs pinhole or equirectangular spectra; got a list of directions")
    scale = Scale.of(config.target, window, spectra.power)
    stage = Recolouring(geometry, spectra, scale, config)
    identity: Mapping[str, object] = {"stage": "published", "config": asdict(config)}
    train(stage, config.steps, label=f"published recipe, {config.target}", identity=identity, progress=progress)
    coloured = stage.trainer.gaussians()
    return PublishedField(coloured, scale, spectra.frequency, spectra.instrument, spectra.tx, config.backend)


def _check(power: Tensor) -> None:
    if power.dim() != 3 or not len(power):
        raise InputError(f"the published recipe needs spectra [picture, row, col]; got power {list(power.shape)}")
    if not bool(torch.isfinite(power).all()) or bool((power < 0).any()):
        raise InputError("spectra have power that is negative, NaN or infinite; power must be linear and finite")
    if not bool((power > 0).any()):
        raise InputError("spectra have no power anywhere; check their source")
