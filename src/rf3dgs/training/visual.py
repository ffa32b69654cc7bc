"""The visual stage: posed photographs become Gaussians, by 3D Gaussian Splatting (Kerbl et al. 2023; paper IV.C).

Each iteration compares one photograph with its rendering, L1 + D-SSIM, and moves everything by Adam. Pictures begin
at a quarter of their resolution. The population grows where the picture pulls at the Gaussians' positions, and loses
those that are faint, oversized, or seen by no photograph. Walls are held flat where the photographs have them (`flat`).
"""

import dataclasses
from collections.abc import Sequence
from pathlib import Path

import torch
from torch import Tensor

from rf3dgs.core.errors import InputError
from rf3dgs.core.grids import Camera
from rf3dgs.core.progress import Progress
from rf3dgs.core.threads import one_torch_thread
from rf3dgs.data.photo import Photo
from rf3dgs.splats.density import Change, densify, reset_opacity, scene_extent
from rf3dgs.splats.gaussians import Gaussians
from rf3dgs.splats.harmonics import coefficient_count
from rf3dgs.splats.image_loss import l1_ssim
from rf3dgs.splats.rates import Rates
from rf3dgs.splats.target import Target
from rf3dgs.splats.trainer import Trainer
from rf3dgs.training.checkpoint import State, fingerprint
from rf3dgs.training.config import VisualConfig
from rf3dgs.training.flat import Flats, flatten_walls
from rf3dgs.training.initial import camera_box, farthest, pieces_of, random_start, swept_start
from rf3dgs.training.loop import random_at, train, view_at
from rf3dgs.training.photographs import blending_weights, clamp_needles, depth_error, picture_of, shrunk
from rf3dgs.training.schedule import Schedule
from rf3dgs.training.second_look import missing_surfaces

TRAINED = ("geometry", "opacity", "sh")
HIGHER_BANDS_SLOWER = 20.0
LARGEST_SURFACE = 0.05
PHOTOS_OF_A_THING = 3  # by how many photographs a place is usually found: so many points make one Gaussian
KEPT_TARGETS = 1 << 30  # bytes; targets that need more are made anew in each iteration
BYTES_OF_TARGET = 36  # a pixel of a target with its statistics


@one_torch_thread()
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
        self.box = config.bounds or camera_box(self.cameras)
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
        self.first_degree = min(initial.degree, config.degree) if isinstance(initial, Gaussians) else 0
        self.depths: list[Tensor] = []
        self.targets: dict[tuple[int, int], tuple[Camera, Target]] = {}
        self.trainer: Trainer | None = None
        self.flats: Flats | None = None

    def begin(self) -> Trainer:
        """Make the first Gaussians; a run that goes on from a checkpoint needs none."""
        start = self._start(self.initial)
        missing = coefficient_count(self.config.degree) - start.sh.shape[1]
        sh = torch.nn.functional.pad(start.sh, (0, 0, 0, missing))
        shape = start.means, start.quats, start.log_scales, start.logit_opacities
        trainer = Trainer(*shape, sh, train=TRAINED, backend=self.config.backend)
        trainer.degree = self.first_degree
        self.trainer = trainer
        return trainer

    def _start(self, initial: Gaussians | Tensor | None) -> Gaussians:
        degree = self.config.degree
        if isinstance(initial, Tensor):
            return Gaussians.from_points(initial, degree=degree)
        if initial is not None:
            initial.check()
            return initial
        low, high = self.box
        count, seed = self.config.start_count, self.config.seed
        if self.config.start == "random":
            return random_start(self.cameras, count, low, high, degree=degree, seed=seed)
        gaussians, self.depths = swept_start(self.cameras, self.pictures, count, low, high, degree=degree, seed=seed)
        return gaussians

    def gaussians(self) -> Gaussians:
        """The present Gaussians, with all harmonics that the configuration asks for."""
        return (self.trainer or self.begin()).gaussians()

    def step(self, iteration: int) -> float:
        """One photograph, one update, and what the schedule asks for after it; returns the loss."""
        config, schedule = self.config, self.schedule
        trainer = self.trainer or self.begin()
        trainer.degree = max(self.first_degree, schedule.degree_at(iteration))
        view = view_at(config.seed, iteration, len(self.cameras))
        camera, target = self._target(view, schedule.shrink_at(iteration))
        background = torch.zeros(4)
        if config.background == "random":
            background[:3] = torch.rand(3, generator=random_at(config.seed, iteration, "background"))
        rates = self._rates(iteration)
        depth_weight = schedule.depth_weight_at(iteration) if self.depths else 0.0
        if depth_weight > 0:
            values = trainer.draw(camera, depth=True, background=background).values.requires_grad_()
            loss = l1_ssim(values[..., :3].contiguous(), target.picture, ssim_weight=config.ssim_weight)
            loss = loss + depth_weight * depth_error(values[..., 3], self.depths[view])
            trainer.update(torch.autograd.grad(loss, values)[0], rates)
            loss = float(loss.detach())
        else:
            loss = trainer.step(camera, target, rates, ssim_weight=config.ssim_weight, background=background[:3])
        self._change_population(trainer, iteration)
        return loss

    def _target(self, view: int, shrink: int) -> tuple[Camera, Target]:
        """Camera and target of a view, kept while all of them fit in memory."""
        known = self.targets.get((view, shrink))
        if known is None:
            camera, picture = shrunk(self.cameras[view], self.pictures[view], shrink)
            known = camera, Target(picture)
            pixels = sum(camera.width * camera.height for camera in self.cameras)
            if BYTES_OF_TARGET * pixels <= KEPT_TARGETS:
                self.targets[view, shrink] = known
        return known

    def _rates(self, iteration: int) -> Rates:
        config, haste = self.config, self.schedule.haste
        pace = 1 / haste if self.depths else haste
        return Rates(
            means=pace * self.schedule.means_rate(iteration) * self.extent,
            quats=haste * config.lr_quats,
            log_scales=haste * config.lr_scales,
            logit_opacities=config.lr_opacities,
            level=haste * config.lr_sh,
            bands=haste * config.lr_sh / HIGHER_BANDS_SLOWER,
        )

    def _change_population(self, trainer: Trainer, iteration: int) -> None:
        """Grow, prune, flatten and reset opacity where the schedule says so."""
        config, schedule = self.config, self.schedule
        if schedule.densifies_after(iteration):
            limits_size = 2 * iteration >= schedule.densify_from + schedule.densify_until
            change = densify(
                self._bounded(trainer.gaussians(), iteration),
                trainer.density(),
                extent=self.extent,
                generator=random_at(config.seed, iteration, "split"),
                gradient_threshold=config.grow_gradient,
                dense_fraction=config.split_size,
                max_count=config.max_count - schedule.reserve_at(iteration),
                opacity_floor=config.prune_opacity,
                largest_scale=config.prune_size * self.extent if limits_size else None,
            )
            self._follow(trainer, change)
        if schedule.prunes_unseen_after(iteration) and config.prune_unseen > 0:
            now = trainer.gaussians()
            seen = blending_weights(now, self.cameras, backend=config.backend) >= config.prune_unseen
            if bool(seen.any()):
                source = seen.nonzero().squeeze(-1)
                self._follow(trainer, Change(now.subset(source), source, torch.zeros(len(source), dtype=torch.bool)))
        if schedule.flattens_after(iteration):
            found = flatten_walls(trainer.gaussians(), self.cameras, self.pictures)
            if found is not None:
                self.flats = found[1]
                trainer.follow(found[0])
        if schedule.looks_again_after(iteration):
            self._add_missing(trainer, iteration)
        if schedule.holds_after(iteration) and self.flats is not None:
            for name, value in self.flats.held(trainer.gaussians()).tensors().items():
                if name in ("means", "quats", "log_scales"):
                    trainer.place(name, value)
        if schedule.resets_after(iteration):
            trainer.assign("logit_opacities", reset_opacity(trainer.gaussians()).logit_opacities)

    def _add_missing(self, trainer: Trainer, iteration: int) -> None:
        """Add Gaussians on small things that photographs show and the present Gaussians lack, on no plane so far."""
        config, now = self.config, trainer.gaussians().detach()
        far = farthest(self.cameras, *self.box)
        found = missing_surfaces(now, self.cameras, self.pictures, far, config.backend)
        room = min(config.max_count - len(now), round(len(found.points) / PHOTOS_OF_A_THING))
        if room < 2:
            return
        found = found.thinned(room, random_at(config.seed, iteration, "second look"))
        new = pieces_of(found, far, degree=config.degree)
        source = torch.cat((torch.arange(len(now)), torch.zeros(len(new), dtype=torch.long)))
        trainer.follow(Change(Gaussians.join((now, new)), source, torch.arange(len(source)) >= len(now)))
        if self.flats is not None:
            self.flats = Flats(self.flats.planes, torch.cat((self.flats.plane_of, torch.full((len(new),), -1))))

    def _follow(self, trainer: Trainer, change: Change) -> None:
        """Go on with a changed population, the planes' own too."""
        trainer.follow(change)
        self.flats = None if self.flats is None else self.flats.followed(change)

    def _bounded(self, gaussians: Gaussians, iteration: int) -> Gaussians:
        """While depths guide the surfaces, no Gaussian is a needle or larger than a piece of surface."""
        if self.depths and self.schedule.depth_weight_at(iteration) > 0:
            clamp_needles(gaussians.log_scales, LARGEST_SURFACE * self.extent)
        return gaussians

    def state(self) -> State:
        """Parameters, moments and density statistics, the depths of the sweep, and the planes."""
        trainer = self.trainer or self.begin()
        tensors = {f"trainer.{name}": tensor for name, tensor in trainer.state().items()}
        tensors |= {f"depth.{view}": depth for view, depth in enumerate(self.depths)}
        flats = {} if self.flats is None else self.flats.tensors()
        return State(tensors | {f"flat.{name}": tensor for name, tensor in flats.items()}, {})

    def restore(self, state: State) -> None:
        """Continue from what `state()` gave."""

        def group(prefix: str) -> dict[str, Tensor]:
            return {
                name.removeprefix(prefix): value for name, value in state.tensors.items() if name.startswith(prefix)
            }

        self.trainer = Trainer.resume(group("trainer."), train=TRAINED, backend=self.config.backend)
        self.depths = [depth for _, depth in sorted(group("depth.").items(), key=lambda item: int(item[0]))]
        flats = group("flat.")
        self.flats = Flats.from_tensors(flats) if flats else None
