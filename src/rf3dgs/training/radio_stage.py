"""The radio stage as the training loop drives it: what is trained, from what it begins, and its losses."""

from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from rf3dgs.field.radiance import Surface, csi_values, gain_values, in_view, reach_of
from rf3dgs.splats.harmonics import C0, view_directions
from rf3dgs.splats.image_loss import l1_ssim
from rf3dgs.splats.rasterize import rasterize
from rf3dgs.training.adam import Adam
from rf3dgs.training.backprojection import ridge_start
from rf3dgs.training.checkpoint import State
from rf3dgs.training.config import RadioConfig
from rf3dgs.training.loop import view_at
from rf3dgs.training.radio_views import RadioView

DELAY_SCALE_NS = 10.0
START_DEGREE = 2


class RadioStage:
    """What the loop drives: parameters of the surface, their optimiser, and the views."""

    def __init__(self, bare: Surface, views: Sequence[RadioView], config: RadioConfig) -> None:
        self.bare, self.views, self.config = bare, views, config
        reach = reach_of(bare.scales)
        self.visible = [in_view(bare.means, reach, view.camera) for view in views]
        self.has_csi = all(view.csi is not None for view in views)
        gain_sh, csi_sh = self._start()
        values = {
            "level": gain_sh[:, :1],
            "harmonics": gain_sh[:, 1:],
            "opacity": bare.logit_opacities.clamp(-6.0, 6.0),
            "csi": csi_sh,
        }
        self.parameters = {name: value.clone().contiguous().requires_grad_() for name, value in values.items()}
        self.parameters["opacity"].requires_grad_(config.train_opacity)
        self.optimiser = Adam(self.parameters)

    def step(self, iteration: int) -> float:
        """One view: its gain, and in every n-th iteration its delay and departure."""
        number = view_at(self.config.seed, iteration, len(self.views))
        view, surface = self.views[number], self._surface().select(self.visible[number])
        directions = view_directions(surface.means, view.camera.position)
        if self.config.encoding == "paper":
            loss = self._paper_loss(surface, view, directions)
        else:
            loss = self._gain_loss(surface, view, directions)
            every = self.config.csi_every
            if self.has_csi and every > 0 and iteration % every == 0:
                loss = loss + self._csi_loss(surface, view, directions)
        if self.config.shrink > 0:
            loss = loss + self.config.shrink * surface.gain_sh[:, 1:].square().mean()
        loss.backward()
        fall = self.config.lr_final ** (iteration / max(1, self.config.steps))
        rates = {
            "level": self.config.lr_level / C0 * fall,
            "harmonics": self.config.lr_harmonics / C0 * fall,
            "opacity": self.config.lr_opacity * fall,
            "csi": self.config.lr_csi / C0 * fall,
        }
        self.optimiser.step(rates)
        return float(loss.detach())

    def state(self) -> State:
        """Parameters and moments."""
        tensors = {name: value.detach() for name, value in self.parameters.items()}
        tensors |= {f"first.{name}": value for name, value in self.optimiser.first.items()}
        tensors |= {f"second.{name}": value for name, value in self.optimiser.second.items()}
        return State(tensors, {"count": self.optimiser.count})

    def restore(self, state: State) -> None:
        """Go on from a state."""
        with torch.no_grad():
            for name, value in self.parameters.items():
                value.copy_(state.tensors[name])
                self.optimiser.first[name].copy_(state.tensors[f"first.{name}"])
                self.optimiser.second[name].copy_(state.tensors[f"second.{name}"])
        self.optimiser.count = int(str(state.numbers["count"]))

    def surface(self) -> Surface:
        """A copy of the surface as it is now, outside any graph; further steps do not change it."""
        current = self._surface()
        trained = ("logit_opacities", "gain_sh", "csi_sh")
        return replace(current, **{name: getattr(current, name).detach().clone() for name in trained})

    def _surface(self) -> Surface:
        bare, own = self.bare, self.parameters
        gain_sh = torch.cat((own["level"], own["harmonics"]), 1)
        shape = (bare.means, bare.quats, bare.log_scales, own["opacity"], gain_sh, own["csi"])
        return Surface(*shape, bare.tx, bare.window, bare.encoding, bare.delay_span)

    def _start(self) -> tuple[Tensor, Tensor]:
        config, bare = self.config, self.bare
        if config.start == "grey":
            return bare.gain_sh, bare.csi_sh
        degree = min(config.degree, START_DEGREE) if config.start == "ridge" else 0
        with torch.enable_grad():
            found, csi = ridge_start(
                bare, self.views, self.visible, degree=degree, ridge=config.ridge, backend=config.backend
            )
        gain_sh = torch.zeros_like(bare.gain_sh)
        gain_sh[:, : found.shape[1]] = found
        return gain_sh, csi

    def _gain_loss(self, surface: Surface, view: RadioView, directions: Tensor) -> Tensor:
        values = gain_values(surface.gain_sh, directions)
        picture = self._raster(surface, values, view, surface.opacities)[0]
        target = torch.where((view.keep > 0)[..., None], view.gain[..., None], picture.detach())
        return l1_ssim(picture, target, ssim_weight=self.config.ssim_weight, weight=view.keep)

    def _csi_loss(self, surface: Surface, view: RadioView, directions: Tensor) -> Tensor:
        """L1 of delay and departure, weighted by what a path reaches: solid angle times gain in the window."""
        assert view.csi is not None
        values = csi_values(surface, view.camera.position, directions)
        blended, weight = self._raster(surface, values, view, surface.opacities.detach())
        picture = blended / weight.detach().clamp_min(1e-3)[..., None]
        reached = view.keep * view.gain * (weight.detach() > 1e-3)
        late, turned = (picture - view.csi).abs().split((1, 3), -1)
        error = late.squeeze(-1) / DELAY_SCALE_NS + turned.sum(-1)
        return (reached * error).sum() / reached.sum().clamp_min(1e-6)

    def _paper_loss(self, surface: Surface, view: RadioView, directions: Tensor) -> Tensor:
        """The paper's channels all in one picture, every one through the opacities."""
        values = gain_values(surface.gain_sh, directions)
        target = view.gain[..., None]
        if view.csi is not None:
            values = torch.cat((values, csi_values(surface, view.camera.position, directions)), -1)
            target = torch.cat((target, view.csi), -1)
        picture = self._raster(surface, values, view, surface.opacities)[0]
        target = torch.where((view.keep > 0)[..., None], target, picture.detach())
        return l1_ssim(picture, target, ssim_weight=self.config.ssim_weight, weight=view.keep)

    def _raster(self, surface: Surface, values: Tensor, view: RadioView, opacities: Tensor) -> tuple[Tensor, Tensor]:
        raster = rasterize(
            surface.means,
            surface.quats,
            surface.scales,
            opacities,
            values,
            view.camera,
            backend=self.config.backend,
        )
        return raster.values, raster.weight
