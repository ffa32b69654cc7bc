"""The visual stage: posed photographs become Gaussians, by 3D Gaussian Splatting (Kerbl et al. 2023; paper IV.C).

Each iteration compares one photograph with its rendering, L1 + D-SSIM, and moves everything by Adam. Pictures begin
at a quarter of their resolution. The population grows where the picture pulls at the Gaussians' positions, and loses
those that are faint, oversized, or seen by no photograph.
"""

import dataclasses
from collections.abc import Sequence
from pathlib import Path

import torch
from torch import Tensor

from rf3dgs.core.errors import InputError
from rf3dgs.core.progress import Progress
from rf3dgs.data.photo import Photo
from rf3dgs.splats.density import Change, DensityState, densify, reset_opacity, scene_extent
from rf3dgs.splats.gaussians import Gaussians
from rf3dgs.splats.harmonics import coefficient_count
from rf3dgs.splats.image_loss import l1_ssim
from rf3dgs.splats.rasterize import rasterize
from rf3dgs.training.adam import Adam
from rf3dgs.training.checkpoint import State, fingerprint
from rf3dgs.training.config import VisualConfig
from rf3dgs.training.initial import camera_box, random_start, swept_start
from rf3dgs.training.loop import random_at, train, view_at
from rf3dgs.training.photographs import blending_weights, clamp_needles, colour_towards, depth_error, picture_of, shrunk
from rf3dgs.training.schedule import Schedule

TRAINED = ("means", "quats", "log_scales", "logit_opacities", "level", "bands")
HIGHER_BANDS_SLOWER = 20.0
LARGEST_SURFACE = 0.05


def fit_geometry(
    photos: Sequence[Photo],
    config: VisualConfig | None = None,
    *,
    progress: Progress | None = None,
    checkpoint_dir: str | Path | None = None,
    initial: Gaussians | Tensor | None = None,
) -> Gaussians:
    """Fit Gaussians to posed photographs.

    `initial` is where to begin: Gaussians, points `[point, 3]` [m] such as those of structure from motion, or None for
    random ones (in `config.bounds`, or around the cameras). With a `checkpoint_dir` a run that was stopped or killed
    goes on from its newest checkpoint. Raises `InputError` without photographs or for one that does not fit its camera,
    `DataError` for a damaged file, `TrainingError` as `training.loop.train` does.
    """
    config = VisualConfig() if config is None else config
    stage = VisualStage(photos, config, initial)
    train(
        stage,
        config.steps,
        label="visual stage",
        identity=stage.identity,
        progress=progress,
        checkpoint_dir=checkpoint_dir,
        every_steps=config.checkpoint_every,
    )
    return stage.gaussians()


class VisualStage:
    """The visual stage as the training loop drives it."""

    def __init__(
        self, photos: Sequence[Photo], config: VisualConfig, initial: Gaussians | Tensor | None = None
    ) -> None:
        if not photos:
            raise InputError(
                "the visual stage needs at least one photograph; got none. Use geometry from a mesh instead"
            )
        self.config, self.schedule = config, Schedule.of(config)
        self.cameras = [photo.camera for photo in photos]
        self.pictures = [picture_of(photo) for photo in photos]
        self.extent = scene_extent(torch.stack([camera.position for camera in self.cameras]))
        self.initial = initial
        first = initial.tensors().values() if isinstance(initial, Gaussians) else [] if initial is None else [initial]
        data = [*self.pictures, *(t for camera in self.cameras for t in (camera.viewmat, camera.K))]
        self.identity = {
            "stage": "visual",
            "configuration": dataclasses.asdict(config),
            "photographs": fingerprint(data),
            "first Gaussians": fingerprint(first),
        }
        self.degree = min(initial.degree, config.degree) if isinstance(initial, Gaussians) else 0
        self.depths: list[Tensor] = []
        self.parameters: dict[str, Tensor] = {}
        self.adam = Adam({})
        self.density = DensityState(0)

    def begin(self) -> None:
        """Make the first Gaussians; a run that goes on from a checkpoint needs none."""
        start = self._start(self.initial)
        self.parameters = _leaves(start, self.degree)
        self.adam = Adam(self.parameters)
        self.density = DensityState(len(start))

    def _start(self, initial: Gaussians | Tensor | None) -> Gaussians:
        degree = self.config.degree
        if isinstance(initial, Tensor):
            return Gaussians.from_points(initial, degree=degree)
        if initial is not None:
            initial.check()
            return initial
        low, high = self.config.bounds or camera_box(self.cameras)
        count, seed = self.config.start_count, self.config.seed
        if self.config.start == "random":
            return random_start(self.cameras, count, low, high, degree=degree, seed=seed)
        gaussians, self.depths = swept_start(self.cameras, self.pictures, count, low, high, degree=degree, seed=seed)
        return gaussians

    def gaussians(self) -> Gaussians:
        """The present Gaussians, with all harmonics that the configuration asks for."""
        if not self.parameters:
            self.begin()
        tensors = {name: tensor.detach() for name, tensor in self.parameters.items()}
        level, bands = tensors.pop("level"), tensors.pop("bands")
        missing = coefficient_count(self.config.degree) - 1 - bands.shape[1]
        return Gaussians(**tensors, sh=torch.cat((level, bands, level.new_zeros(len(level), missing, 3)), 1))

    def step(self, iteration: int) -> float:
        """One photograph, one update, and what the schedule asks for after it; returns the loss."""
        config, schedule = self.config, self.schedule
        if not self.parameters:
            self.begin()
        now = self.parameters
        if schedule.degree_at(iteration) > self.degree:
            self._raise_degree(schedule.degree_at(iteration))
            now = self.parameters
        view = view_at(config.seed, iteration, len(self.cameras))
        camera, target = shrunk(self.cameras[view], self.pictures[view], schedule.shrink_at(iteration))
        background = torch.zeros(4)
        if config.background == "random":
            background[:3] = torch.rand(3, generator=random_at(config.seed, iteration, "background"))
        depth = now["means"] @ camera.viewmat[2, :3] + camera.viewmat[2, 3]
        colour = colour_towards(now["level"], now["bands"], now["means"], camera)
        offset = torch.zeros(len(now["means"]), 2, requires_grad=True)
        raster = rasterize(
            now["means"],
            now["quats"],
            torch.exp(now["log_scales"]),
            torch.sigmoid(now["logit_opacities"]),
            torch.cat((colour, depth[:, None]), 1),
            camera,
            background=background,
            screen_offset=offset,
            backend=config.backend,
        )
        loss = l1_ssim(raster.values[..., :3].contiguous(), target, ssim_weight=config.ssim_weight)
        if self.depths and schedule.depth_weight > 0:
            loss = loss + schedule.depth_weight * depth_error(raster.values[..., 3], self.depths[view])
        loss.backward()
        if offset.grad is not None:
            self.density.observe(offset.grad, raster.radii, camera.width, camera.height)
        self.adam.step(self._rates(iteration))
        if self.depths and schedule.depth_weight > 0:
            clamp_needles(self.parameters["log_scales"].data, LARGEST_SURFACE * self.extent)
        self._change_population(iteration)
        return float(loss.detach())

    def _rates(self, iteration: int) -> dict[str, float]:
        config, haste = self.config, self.schedule.haste
        pace = 1 / haste if self.depths else haste
        return {
            "means": pace * self.schedule.means_rate(iteration) * self.extent,
            "quats": haste * config.lr_quats,
            "log_scales": haste * config.lr_scales,
            "logit_opacities": config.lr_opacities,
            "level": haste * config.lr_sh,
            "bands": haste * config.lr_sh / HIGHER_BANDS_SLOWER,
        }

    def _raise_degree(self, degree: int) -> None:
        """Add zero coefficients for the next degrees of the harmonics."""
        for group in (self.parameters, self.adam.first, self.adam.second):
            bands = group["bands"].detach()
            missing = coefficient_count(degree) - 1 - bands.shape[1]
            group["bands"] = torch.cat((bands, bands.new_zeros(len(bands), missing, 3)), 1)
        self.parameters["bands"].requires_grad_()
        self.degree = degree

    def _change_population(self, iteration: int) -> None:
        """Grow, prune and reset opacity where the schedule says so."""
        config, schedule = self.config, self.schedule
        if schedule.densifies_after(iteration):
            limits_size = 2 * iteration >= schedule.densify_from + schedule.densify_until
            change = densify(
                self.gaussians(),
                self.density,
                extent=self.extent,
                generator=random_at(config.seed, iteration, "split"),
                gradient_threshold=config.grow_gradient,
                dense_fraction=config.split_size,
                max_count=config.max_count,
                opacity_floor=config.prune_opacity,
                largest_scale=config.prune_size * self.extent if limits_size else None,
            )
            self._follow(change)
        if schedule.prunes_unseen_after(iteration) and config.prune_unseen > 0:
            now = self.gaussians()
            seen = blending_weights(now, self.cameras, backend=config.backend) >= config.prune_unseen
            if bool(seen.any()):
                source = seen.nonzero().squeeze(-1)
                self._follow(Change(now.subset(source), source, torch.zeros(len(source), dtype=torch.bool)))
        if schedule.resets_after(iteration):
            self.parameters["logit_opacities"].data = reset_opacity(self.gaussians()).logit_opacities
            self.adam.forget("logit_opacities")

    def _follow(self, change: Change) -> None:
        """Go on with a changed population: parameters, moments and a new density statistic."""
        self.parameters = _leaves(change.gaussians, self.degree)
        self.adam.follow(change, self.parameters)
        self.density = DensityState(len(change.gaussians))

    def state(self) -> State:
        """Parameters, moments and density statistics."""
        tensors = {name: tensor.detach() for name, tensor in self.parameters.items()}
        for group, values in (
            ("first", self.adam.first),
            ("second", self.adam.second),
            ("density", self.density.tensors()),
        ):
            tensors |= {f"{group}.{name}": tensor for name, tensor in values.items()}
        tensors |= {f"depth.{view}": depth for view, depth in enumerate(self.depths)}
        return State(tensors, {"adam_steps": self.adam.count, "degree": self.degree})

    def restore(self, state: State) -> None:
        """Continue from what `state()` gave."""

        def group(prefix: str) -> dict[str, Tensor]:
            return {
                name.removeprefix(prefix): value for name, value in state.tensors.items() if name.startswith(prefix)
            }

        self.parameters = {name: state.tensors[name].requires_grad_() for name in TRAINED}
        self.adam = Adam(self.parameters)
        self.adam.first, self.adam.second = group("first."), group("second.")
        self.adam.count = int(str(state.numbers["adam_steps"]))
        self.degree = int(str(state.numbers["degree"]))
        self.density = DensityState.from_tensors(group("density."))
        self.depths = [depth for _, depth in sorted(group("depth.").items(), key=lambda item: int(item[0]))]


def _leaves(gaussians: Gaussians, degree: int) -> dict[str, Tensor]:
    """The trained tensors by name: those of the Gaussians, the harmonics as `level` and `bands` up to `degree`."""
    tensors = gaussians.tensors()
    sh = tensors.pop("sh")
    tensors |= {"level": sh[:, :1], "bands": sh[:, 1 : coefficient_count(degree)]}
    return {
        name: value.detach().clone(memory_format=torch.contiguous_format).requires_grad_()
        for name, value in tensors.items()
    }
