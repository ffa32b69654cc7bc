"""The radio stage: spectra and frozen geometry to a `RadioField`. Paper IV.B, IV.C.

Means, rotations and scales stay as they are. Opacity and the gain's harmonics follow L1 + D-SSIM of the gain in the
field's one dB window; delay and departure follow their own weighted L1 through the opacities as they are. The line of
sight is a point source, fitted in closed form before the surface is trained on what remains.
"""

from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path

import torch
from torch import Tensor

from rf3dgs.core.errors import InputError
from rf3dgs.core.frames import Pose
from rf3dgs.core.progress import Progress, Silent
from rf3dgs.field.radiance import Surface, csi_values, gain_values, in_view, reach_of
from rf3dgs.field.radio_field import RadioField
from rf3dgs.field.sources import Blockers, PointSource, estimate_transmitter, fit_line_of_sight, fit_opening
from rf3dgs.spectra.codec import DbWindow, PaperEncoding, window_of
from rf3dgs.spectra.spectrum import Spectrum
from rf3dgs.splats.gaussians import Gaussians
from rf3dgs.splats.harmonics import C0, view_directions
from rf3dgs.splats.image_loss import l1_ssim
from rf3dgs.splats.rasterize import rasterize
from rf3dgs.training.adam import Adam
from rf3dgs.training.backprojection import ridge_start
from rf3dgs.training.checkpoint import State, fingerprint
from rf3dgs.training.config import RadioConfig
from rf3dgs.training.loop import train, view_at
from rf3dgs.training.radio_views import RadioView, radio_views

DELAY_SCALE_NS = 10.0
START_DEGREE = 2


def fit_radio(
    geometry: Gaussians,
    spectra: Spectrum,
    config: RadioConfig | None = None,
    *,
    tx: Pose | None = None,
    progress: Progress | None = None,
    checkpoint_dir: str | Path | None = None,
) -> RadioField:
    """Train a field on `spectra` `[position, row, col]` over frozen `geometry`.

    `tx` is the transmitter's pose; None takes that of the spectra, or estimates its position from the strongest
    bearings. With a `checkpoint_dir` a killed run goes on where it stopped and ends with the same bits. Raises
    InputError for spectra that are empty, constant or not finite, and TrainingError when training cannot go on.
    """
    config = RadioConfig() if config is None else config
    progress = Silent() if progress is None else progress
    geometry.check()
    check_spectra(spectra)
    where = spectra.tx if tx is None else tx
    estimated = where is None
    where = estimate_transmitter(spectra) if where is None else where
    window = _window(spectra, config)
    blockers = Blockers(geometry.means, geometry.quats, geometry.scales, geometry.opacities)
    sources, seen = (), torch.zeros(len(spectra), dtype=torch.bool)
    if config.line_of_sight == "source":
        source, seen = fit_line_of_sight(PointSource(where.position, where.position), spectra)
        sources = (fit_opening(source, seen, spectra.pose.position, blockers),)
    span = PaperEncoding.of(spectra).delay_span if config.encoding == "paper" and spectra.delay is not None else 1e-7
    bare = Surface.bare(
        geometry,
        tx=where.position,
        window=window,
        encoding=config.encoding,
        degree=config.degree,
        delay_span=span,
    )
    views = radio_views(
        spectra,
        window,
        sources=[(source, seen) for source in sources],
        encoding=PaperEncoding(window, span) if config.encoding == "paper" else None,
        face_size=config.face_size,
    )
    stage = RadioStage(bare, views, config)
    pose = spectra.pose
    measured = (spectra.power, spectra.delay, spectra.aod, pose.position, pose.orientation, spectra.grid.directions)
    identity = {
        "stage": "radio",
        "config": asdict(config),
        "tx": where.position.tolist(),
        "instrument": asdict(spectra.instrument),
        "frequency": spectra.frequency,
        "data": fingerprint([*geometry.tensors().values(), *(part for part in measured if part is not None)]),
    }
    train(
        stage,
        config.steps,
        label="radio stage",
        identity=identity,
        progress=progress,
        checkpoint_dir=checkpoint_dir,
        every_steps=config.checkpoint_every,
    )
    meta = {
        "steps": config.steps,
        "seed": config.seed,
        "positions": len(spectra),
        "transmitter": "estimated" if estimated else "given",
        "positions in sight": int(seen.sum()),
    }
    return RadioField(
        surface=stage.surface(),
        sources=sources,
        solidity=geometry.opacities.detach(),
        frequency=spectra.frequency,
        instrument=spectra.instrument,
        tx=where,
        bounds=torch.stack((pose.position.amin(0), pose.position.amax(0))),
        colour=_colour(geometry),
        meta=meta,
        backend=config.backend,
    )


def check_spectra(spectra: Spectrum, numbers: Tensor | None = None) -> None:
    """Raise InputError for spectra that nothing can be learned from, naming the position.

    `numbers` `[position]` are what the positions are called in the message, such as their places in a file.
    """
    if not spectra.pose.batch_shape or len(spectra.pose.batch_shape) != 1 or len(spectra) == 0:
        raise InputError(f"the radio stage needs spectra at a list of positions; got batch {spectra.pose.batch_shape}")
    power = spectra.power
    rules = (
        (~torch.isfinite(power).all((-2, -1)), "has NaN or infinite power"),
        ((power < 0).any(-1).any(-1), "has negative power; spectra are linear power, not dB"),
        (power.amax((-2, -1)) <= 0, "is empty: no power from any direction"),
        (power.amax((-2, -1)) == power.amin((-2, -1)), "is constant: the same power from every direction"),
    )
    for wrong, text in rules:
        if bool(wrong.any()):
            first = int(wrong.nonzero()[0])
            number = first if numbers is None else int(numbers[first])
            raise InputError(f"the spectrum of position {number} {text}; remove or repair it")


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
        """The surface as it is now, outside any graph."""
        current = self._surface()
        return Surface(
            current.means,
            current.quats,
            current.log_scales,
            current.logit_opacities.detach(),
            current.gain_sh.detach(),
            current.csi_sh.detach(),
            current.tx,
            current.window,
            current.encoding,
            current.delay_span,
        )

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


def _window(spectra: Spectrum, config: RadioConfig) -> DbWindow:
    window = window_of(spectra)
    floor_db = window.floor_db if config.floor_db is None else config.floor_db
    ceil_db = window.ceil_db if config.ceil_db is None else config.ceil_db
    if not ceil_db > floor_db:
        raise InputError(f"the dB window needs floor_db < ceil_db; got {floor_db} and {ceil_db}")
    return DbWindow(floor_db, ceil_db)


def _colour(geometry: Gaussians) -> Tensor:
    """How a viewer paints the Gaussians `[N, 3]` uint8: their constant colour, or grey."""
    if geometry.channels != 3:
        return torch.full((len(geometry), 3), 160, dtype=torch.uint8)
    return ((geometry.sh[:, 0] * C0 + 0.5).clamp(0, 1) * 255).round().to(torch.uint8)
