"""What is timed: pictures and training steps of the synthetic room, with the work that each consists of."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from benchmarks.speed.floor import Phase, Work, render, step
from benchmarks.speed.scenes import cameras_of, panoramas, room
from benchmarks.speed.timing import Task
from rf3dgs.core.grids import View
from rf3dgs.splats.harmonics import basis, evaluate, view_directions
from rf3dgs.splats.image_loss import l1_ssim, l1_ssim_reference
from rf3dgs.splats.rasterize import Backend, rasterize

VIEWS = 16


@dataclass(frozen=True)
class Subject:
    """What is done for a view, for how many views, and the phases of the work, averaged over the views."""

    task: Task
    views: int
    phases: list[Phase]


def rendering(count: int, *, channels: int = 3, width: int = 300, height: int = 200, sphere: bool = False) -> Subject:
    """Pictures of `count` Gaussians with harmonics of degree 3; `sphere`: of all directions, 360x180."""
    scene = room(count, channels=channels)
    cameras = panoramas(VIEWS) if sphere else cameras_of(VIEWS, width, height)
    arguments = [scene[name] for name in ("means", "quats", "scales", "opacities")]

    def draw(index: int) -> Tensor:
        camera = cameras[index]
        values = evaluate(scene["sh"], view_directions(scene["means"], camera.position), offset=0.5)
        return rasterize(*arguments, values, camera, backend="native").values

    return Subject(draw, VIEWS, render(work_of(scene, cameras)))


def training(
    count: int,
    *,
    channels: int = 3,
    width: int = 300,
    height: int = 200,
    frozen: bool = True,
    views: int = VIEWS,
    backend: Backend = "native",
) -> Subject:
    """Training steps of `count` Gaussians with L1 + SSIM and Adam; `frozen`: opacities and harmonics only."""
    scene, cameras = room(count, channels=channels), cameras_of(views, width, height)
    targets = torch.rand(views, height, width, channels, generator=torch.Generator().manual_seed(1))
    learn = stepper(scene, frozen=frozen, backend=backend)
    work = work_of(scene, cameras)
    return Subject(lambda index: learn(cameras[index], targets[index]), views, step(work, frozen=frozen))


def stepper(scene: dict[str, Tensor], *, frozen: bool, backend: Backend) -> Callable[[View, Tensor], float]:
    """A function that does one training step towards a target picture and returns its loss."""
    means, quats, scales = (scene[name].clone().requires_grad_(not frozen) for name in ("means", "quats", "scales"))
    logit = torch.logit(scene["opacities"]).requires_grad_()
    sh = scene["sh"].clone().requires_grad_()
    optimiser = torch.optim.Adam([logit, sh] if frozen else [means, quats, scales, logit, sh], lr=1e-3)
    native = backend == "native"

    def learn(camera: View, target: Tensor) -> float:
        optimiser.zero_grad(set_to_none=True)
        directions = view_directions(means.detach(), camera.position)
        values = evaluate(sh, directions) if native else torch.einsum("gk,gkc->gc", basis(directions, 3), sh)
        raster = rasterize(means, quats, scales, torch.sigmoid(logit), values + 0.5, camera, backend=backend)
        loss = (l1_ssim if native else l1_ssim_reference)(raster.values, target)
        loss.backward()
        optimiser.step()
        return float(loss.detach())

    return learn


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
        kind="pinhole" if hasattr(cameras[0], "K") else "sphere",
    )


def _drawn(picture: Tensor):
    """The core's scene behind a picture that wants gradients."""
    node = picture.grad_fn
    while node is not None and not hasattr(node, "scene"):
        node = node.next_functions[0][0]
    assert node is not None
    return node.scene  # type: ignore[attr-defined]
