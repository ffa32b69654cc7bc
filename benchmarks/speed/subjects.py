"""What is timed: pictures and training steps, with the work that each consists of."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from benchmarks.speed.floor import Phase, Work, render, step
from benchmarks.speed.scenes import cameras_of, panoramas
from benchmarks.speed.timing import Task
from rf3dgs.core.grids import Camera, View
from rf3dgs.splats.rasterize import Backend, rasterize
from rf3dgs.splats.rates import Rates
from rf3dgs.splats.target import Target
from rf3dgs.splats.trainer import Trainer

# Small, so that what is drawn stays what it was.
RATES = Rates(means=1e-6, quats=1e-6, log_scales=1e-6, logit_opacities=1e-5, level=1e-5, bands=1e-5)
VIEWS = 16


@dataclass(frozen=True)
class Subject:
    """What is done for a view, for how many views, and the phases of the work, averaged over the views."""

    task: Task
    views: int
    phases: list[Phase]


def rendering(scene: dict[str, Tensor], *, width: int = 300, height: int = 200, sphere: bool = False) -> Subject:
    """Pictures of a scene with harmonics of degree 3; `sphere`: of all directions, 360x180."""
    cameras = panoramas(VIEWS) if sphere else cameras_of(VIEWS, width, height)
    trainer = trainer_of(scene, frozen=True, backend="native")
    return Subject(lambda index: trainer.draw(cameras[index]), VIEWS, render(work_of(scene, cameras)))


def training(
    scene: dict[str, Tensor],
    *,
    width: int = 300,
    height: int = 200,
    frozen: bool = True,
    views: int = VIEWS,
    backend: Backend = "native",
) -> Subject:
    """Training steps of a scene with L1 + SSIM and Adam; `frozen`: opacities and harmonics only."""
    cameras, channels = cameras_of(views, width, height), scene["sh"].shape[2]
    generator = torch.Generator().manual_seed(1)
    targets = [Target(torch.rand(height, width, channels, generator=generator)) for _ in range(views)]
    trainer = trainer_of(scene, frozen=frozen, backend=backend)
    phases = step(work_of(scene, cameras), frozen=frozen)
    return Subject(lambda index: trainer.step(cameras[index], targets[index], RATES), views, phases)


def trainer_of(scene: dict[str, Tensor], *, frozen: bool, backend: Backend) -> Trainer:
    """A trainer of opacities and harmonics, and of geometry unless that is `frozen`."""
    return Trainer(
        *(scene["means"], scene["quats"], scene["scales"].log(), torch.logit(scene["opacities"]), scene["sh"]),
        train=("opacity", "sh") if frozen else ("geometry", "opacity", "sh"),
        backend=backend,
    )


def work_of(scene: dict[str, Tensor], cameras: Sequence[View]) -> Work:
    """The mean work of these views of a scene, as the core counts it."""
    arguments = [scene[name] for name in ("means", "quats", "scales", "opacities")]
    values = torch.zeros(len(scene["means"]), 1, requires_grad=True)
    drawn = [_drawn(rasterize(*arguments, values, camera, backend="native").values) for camera in cameras]
    return Work(
        gaussians=len(values),
        visible=sum(scene.visible for scene in drawn) / len(drawn),
        entries=sum(scene.entries for scene in drawn) / len(drawn),
        pairs=sum(scene.pairs for scene in drawn) / len(drawn),
        pixels=cameras[0].width * cameras[0].height,
        channels=scene["sh"].shape[2],
        kind="pinhole" if isinstance(cameras[0], Camera) else "sphere",
    )


def _drawn(picture: Tensor):
    """The core's scene behind a picture that wants gradients."""
    node = picture.grad_fn
    while node is not None and not hasattr(node, "scene"):
        node = node.next_functions[0][0]
    assert node is not None
    return node.scene  # type: ignore[attr-defined]
