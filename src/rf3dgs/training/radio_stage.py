"""The radio stage as the training loop drives it: what is trained, from what it begins, and its losses."""

from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from rf3dgs.core.units import SPEED_OF_LIGHT
from rf3dgs.field.radiance import NANOSECOND, Surface, bounce
from rf3dgs.splats.compositing import Compositing
from rf3dgs.splats.harmonics import C0
from rf3dgs.splats.rates import Rates
from rf3dgs.splats.target import Target
from rf3dgs.splats.trainer import Trainer
from rf3dgs.training.backprojection import ridge_start
from rf3dgs.training.checkpoint import State
from rf3dgs.training.config import RadioConfig
from rf3dgs.training.loop import view_at
from rf3dgs.training.radio_views import RadioView

CSI_UNITS = torch.tensor([10.0, 1.0, 1.0, 1.0])
"""An error of so many nanoseconds of delay weighs as much as one of 1 in a component of the departure."""
START_DEGREE = 2
MEANS = Compositing(normalise=True)


class RadioStage:
    """What the loop drives: a trainer of gain and opacity, one of delay and departure beside it, and the views.

    In the paper's encoding all channels are one picture of the first trainer.
    """

    def __init__(self, bare: Surface, views: Sequence[RadioView], config: RadioConfig) -> None:
        self.bare, self.views, self.config = bare, views, config
        self.has_csi = all(view.csi is not None for view in views)
        self.is_paper = config.encoding == "paper"
        gain_sh, self.csi_sh = self._start()
        sh = gain_sh[..., None]
        if self.is_paper and self.has_csi:
            sh = torch.cat((sh, self.csi_sh), -1)
        opacity = bare.logit_opacities.clamp(-6.0, 6.0)
        train = ("opacity", "sh") if config.train_opacity else ("sh",)
        shape = (bare.means, bare.quats, bare.log_scales, opacity)
        self.gain = Trainer(*shape, sh, train=train, backend=config.backend)
        self.targets = [self._target(view) for view in views]
        self.csi: Trainer | None = None
        if self.has_csi and not self.is_paper and config.csi_every > 0:
            base, along = bounce(bare.means, bare.tx), torch.zeros(4)
            along[0] = 1 / (SPEED_OF_LIGHT * NANOSECOND)
            options = {"offset": 0.0, "clamp": False, "base": base / CSI_UNITS, "along": along / CSI_UNITS}
            self.csi = self.gain.beside(self.csi_sh / CSI_UNITS, **options)
        self.csi_targets = [_csi_target(view) for view in views] if self.csi is not None else []

    def step(self, iteration: int) -> float:
        """One view: its gain, and in every n-th iteration its delay and departure."""
        config = self.config
        number = view_at(config.seed, iteration, len(self.views))
        view = self.views[number].view
        fall = config.lr_final ** (iteration / max(1, config.steps))
        level, bands, csi = (rate / C0 * fall for rate in (config.lr_level, config.lr_harmonics, config.lr_csi))
        others = self.gain.channels - 1
        rates = Rates(
            logit_opacities=config.lr_opacity * fall,
            level=(level, *[csi] * others),
            bands=(bands, *[csi] * others),
        )
        loss = self.gain.step(view, self.targets[number], rates, ssim_weight=config.ssim_weight, shrink=config.shrink)
        if self.csi is not None and iteration % config.csi_every == 0:
            target = self.csi_targets[number]
            if target is not None:
                each = tuple((csi / CSI_UNITS).tolist())
                rates = Rates(level=each, bands=each)
                error = self.csi.step(view, target, rates, ssim_weight=0.0, compositing=MEANS)
                loss += self.csi.channels * error
        return loss

    def state(self) -> State:
        """Parameters and moments."""
        tensors = {f"gain.{name}": tensor for name, tensor in self.gain.state().items()}
        if self.csi is not None:
            tensors |= {f"csi.{name}": tensor for name, tensor in self.csi.state().items()}
        return State(tensors, {})

    def restore(self, state: State) -> None:
        """Go on from a state."""
        for prefix, trainer in (("gain.", self.gain), ("csi.", self.csi)):
            if trainer is not None:
                own = {name: value for name, value in state.tensors.items() if name.startswith(prefix)}
                trainer.restore({name.removeprefix(prefix): value for name, value in own.items()})

    def surface(self) -> Surface:
        """A copy of the surface as it is now; further steps do not change it."""
        trained = self.gain.tensors()
        gain_sh, csi_sh = trained["sh"][..., 0].contiguous(), self.csi_sh
        if self.is_paper and self.has_csi:
            csi_sh = trained["sh"][..., 1:].contiguous()
        elif self.csi is not None:
            csi_sh = self.csi.tensors()["sh"] * CSI_UNITS
        return replace(self.bare, logit_opacities=trained["logit_opacities"], gain_sh=gain_sh, csi_sh=csi_sh)

    def _start(self) -> tuple[Tensor, Tensor]:
        config, bare = self.config, self.bare
        if config.start == "grey":
            return bare.gain_sh, bare.csi_sh
        degree = min(config.degree, START_DEGREE) if config.start == "ridge" else 0
        with torch.enable_grad():
            found, csi = ridge_start(bare, self.views, degree=degree, ridge=config.ridge, backend=config.backend)
        gain_sh = torch.zeros_like(bare.gain_sh)
        gain_sh[:, : found.shape[1]] = found
        return gain_sh, csi

    def _target(self, view: RadioView) -> Target:
        """Gain, and in the paper's encoding its other channels; pixels that a point source rules do not count."""
        picture = view.gain[..., None]
        if self.is_paper and view.csi is not None and self.has_csi:
            picture = torch.cat((picture, view.csi), -1)
        return Target(picture, view.keep)


def _csi_target(view: RadioView) -> Target | None:
    """Delay and departure, weighted by what a path reaches: solid angle times gain in the window."""
    assert view.csi is not None
    weight = view.keep * view.gain
    return Target(view.csi / CSI_UNITS, weight) if float(weight.sum()) > 0 else None
