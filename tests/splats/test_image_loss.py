"""The picture loss: native against torch, against finite differences, and its laws."""

import pytest
import torch

from rf3dgs.core.errors import InputError
from rf3dgs.splats.backends.native import core
from rf3dgs.splats.image_loss import l1_ssim, l1_ssim_reference, psnr, ssim
from rf3dgs.splats.target import Target


@pytest.mark.parametrize("shape", [(40, 50, 3), (33, 47, 1), (7, 3, 2), (1, 1, 4)])
@pytest.mark.parametrize("weighted", [False, True])
def test_loss_and_gradient_agree_with_the_specification(shape: tuple[int, int, int], weighted: bool):
    generator = torch.Generator().manual_seed(0)
    picture, target = torch.rand(shape, generator=generator), torch.rand(shape, generator=generator)
    weight = torch.rand(shape[:2], generator=generator) if weighted else None
    mine, precise = picture.clone().requires_grad_(), picture.double().requires_grad_()
    found = l1_ssim(mine, target, weight=weight)
    expected = l1_ssim_reference(precise, target.double(), weight=None if weight is None else weight.double())
    assert found.item() == pytest.approx(expected.item(), abs=1e-6)
    found.backward()
    expected.backward()
    assert mine.grad is not None
    assert precise.grad is not None
    assert (mine.grad - precise.grad).norm() / precise.grad.norm() < 1e-5


def test_gradient_agrees_with_finite_differences():
    generator = torch.Generator().manual_seed(1)
    target = 0.2 + 0.3 * torch.rand(20, 24, 2, generator=generator)
    picture = target + 0.3
    leaf = picture.clone().requires_grad_()
    l1_ssim(leaf, target, ssim_weight=0.5).backward()
    direction = torch.randn(picture.shape, generator=generator)
    precise, along, step = picture.double(), direction.double(), 1e-5
    ahead = l1_ssim_reference(precise + step * along, target.double(), ssim_weight=0.5)
    behind = l1_ssim_reference(precise - step * along, target.double(), ssim_weight=0.5)
    assert leaf.grad is not None
    assert float((leaf.grad * direction).sum()) == pytest.approx(float(ahead - behind) / (2 * step), rel=1e-4)


def test_equal_pictures_lose_nothing():
    picture = torch.rand(16, 16, 3, generator=torch.Generator().manual_seed(2))
    assert float(l1_ssim(picture, picture)) == pytest.approx(0, abs=1e-6)
    assert float(ssim(picture, picture)) == pytest.approx(1, abs=1e-6)
    assert float(psnr(picture, picture)) == float("inf")
    assert float(psnr(picture, picture + 0.1)) == pytest.approx(20, abs=1e-3)


def test_masked_pixels_have_no_say_in_l1():
    picture, target = torch.zeros(8, 8, 1), torch.zeros(8, 8, 1)
    picture[:, :4] = 1.0
    weight = torch.ones(8, 8)
    weight[:, :4] = 0.0
    assert float(l1_ssim(picture, target, ssim_weight=0.0, weight=weight)) == 0


def test_uniform_weight_is_no_weight():
    generator = torch.Generator().manual_seed(3)
    picture, target = torch.rand(12, 9, 3, generator=generator), torch.rand(12, 9, 3, generator=generator)
    weighted = l1_ssim(picture, target, weight=torch.full((12, 9), 7.0))
    assert float(weighted) == pytest.approx(float(l1_ssim(picture, target)), abs=1e-6)


def test_wrong_pictures_are_named():
    with pytest.raises(InputError, match=r"got \[4, 4, 3\] and \[4, 5, 3\]"):
        l1_ssim(torch.zeros(4, 4, 3), torch.zeros(4, 5, 3))
    with pytest.raises(InputError, match=r"weight must be \[row, col\] = \[4, 4\]; got \[3, 3\]"):
        l1_ssim(torch.zeros(4, 4, 3), torch.zeros(4, 4, 3), weight=torch.ones(3, 3))
    with pytest.raises(InputError, match="all pixels are masked"):
        l1_ssim(torch.zeros(4, 4, 3), torch.zeros(4, 4, 3), weight=torch.zeros(4, 4))
    with pytest.raises(InputError, match="ssim_weight must lie between 0 and 1; got 2"):
        l1_ssim(torch.zeros(4, 4, 3), torch.zeros(4, 4, 3), ssim_weight=2.0)


@pytest.mark.parametrize("shape", [(40, 50, 1), (33, 47, 3), (7, 3, 2)])
@pytest.mark.parametrize("masked", [False, True])
def test_known_statistics_of_the_target_change_no_bit(shape: tuple[int, int, int], masked: bool):
    generator = torch.Generator().manual_seed(4)
    picture, goal = torch.rand(shape, generator=generator), torch.rand(shape, generator=generator)
    weight = torch.ones(shape[:2])
    if masked:
        weight[2:4, 1:3] = 0.0
    target = Target(goal, weight)
    results = []
    for statistics in (None, target.statistics):
        gradient = torch.empty_like(picture)
        loss = core().l1_ssim(picture, goal, weight, 0.3, statistics, gradient, 2)
        results.append((loss, gradient))
    assert results[0][0] == results[1][0]
    assert torch.equal(results[0][1], results[1][1])


@pytest.mark.parametrize("ssim_weight", [0.0, 0.2])
def test_masked_pixels_count_as_equal_in_the_windows_of_their_neighbours(ssim_weight: float):
    generator = torch.Generator().manual_seed(5)
    picture, target = torch.rand(30, 26, 2, generator=generator), torch.rand(30, 26, 2, generator=generator)
    weight = torch.rand(30, 26, generator=generator) + 0.1
    weight[8:12, 5:9] = 0.0
    equal = torch.where((weight > 0)[..., None], target, picture)
    other = torch.where((weight > 0)[..., None], target, 7.0)
    results = []
    for goal in (target, equal, other):
        leaf = picture.clone().requires_grad_()
        loss = l1_ssim(leaf, goal, weight=weight, ssim_weight=ssim_weight)
        loss.backward()
        results.append((loss.item(), leaf.grad))
    precise = picture.double().requires_grad_()
    exact = l1_ssim_reference(precise, target.double(), weight=weight.double(), ssim_weight=ssim_weight)
    exact.backward()
    assert precise.grad is not None
    for loss, gradient in results:
        assert loss == pytest.approx(exact.item(), abs=1e-6)
        assert (gradient - precise.grad).norm() <= 1e-5 * precise.grad.norm()
