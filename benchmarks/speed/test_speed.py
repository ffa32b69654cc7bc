"""pytest-benchmark figures: python -m pytest benchmarks/speed --benchmark-only."""

from itertools import cycle

import pytest
import torch

from benchmarks.speed.scenes import cameras_of, room
from benchmarks.speed.subjects import Subject, rendering, training
from rf3dgs.splats.harmonics import evaluate, view_directions
from rf3dgs.splats.image_loss import l1_ssim


def time_views(benchmark, subject: Subject) -> None:
    """One view after the other."""
    view = cycle(range(subject.views))
    benchmark(lambda: subject.task(next(view)))


@pytest.mark.parametrize("gaussians", [50_000, 100_000, 200_000])
def test_render(benchmark, gaussians: int) -> None:
    time_views(benchmark, rendering(room(gaussians)))


@pytest.mark.parametrize("channels", [1, 3])
def test_frozen_step(benchmark, channels: int) -> None:
    time_views(benchmark, training(room(100_000, channels=channels)))


def test_full_step(benchmark) -> None:
    time_views(benchmark, training(room(100_000), frozen=False))


def test_harmonics(benchmark) -> None:
    scene = room(100_000)
    directions = view_directions(scene["means"], cameras_of(1)[0].position)
    benchmark(lambda: evaluate(scene["sh"], directions))


def test_picture_loss(benchmark) -> None:
    generator = torch.Generator().manual_seed(0)
    picture = torch.rand(200, 300, 3, generator=generator).requires_grad_()
    target = torch.rand(200, 300, 3, generator=generator)
    benchmark(lambda: l1_ssim(picture, target).backward())
