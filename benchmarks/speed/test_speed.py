"""pytest-benchmark figures: python -m pytest benchmarks/speed."""

import pytest
import torch

from benchmarks.speed.scenes import room, view
from benchmarks.speed.step import make_step
from rf3dgs.splats.harmonics import evaluate, view_directions
from rf3dgs.splats.image_loss import l1_ssim
from rf3dgs.splats.rasterize import rasterize


@pytest.mark.parametrize("gaussians", [50_000, 100_000, 200_000])
def test_render(benchmark, gaussians: int):
    scene, camera = room(gaussians), view()
    values = evaluate(scene["sh"], view_directions(scene["means"], camera.position))
    arguments = [scene[name] for name in ("means", "quats", "scales", "opacities")]
    raster = benchmark(lambda: rasterize(*arguments, values, camera, backend="native"))
    assert float(raster.weight.mean()) > 0.5


@pytest.mark.parametrize("frozen", [True, False], ids=["frozen", "full"])
def test_training_step(benchmark, frozen: bool):
    assert benchmark(make_step("native", 100_000, 300, 200, frozen=frozen)) > 0


def test_harmonics(benchmark):
    scene = room(100_000)
    directions = view_directions(scene["means"], view().position)
    benchmark(lambda: evaluate(scene["sh"], directions))


def test_picture_loss(benchmark):
    generator = torch.Generator().manual_seed(0)
    picture = torch.rand(200, 300, 3, generator=generator).requires_grad_()
    target = torch.rand(200, 300, 3, generator=generator)
    benchmark(lambda: l1_ssim(picture, target).backward())
