"""PSNR and SSIM against scikit-image and torchmetrics, which share no code with us or with each other.

At the edge both mirror the picture where our windows see zeros. In a black frame wide enough all three see the same.
"""

import pytest
import torch
from skimage.metrics import peak_signal_noise_ratio, structural_similarity
from torchmetrics.functional.image import peak_signal_noise_ratio as torch_psnr
from torchmetrics.functional.image import structural_similarity_index_measure as torch_ssim

from rf3dgs.core.grids import pinhole_grid
from rf3dgs.evaluation.metrics import pixel_weight, psnr, ssim

pytestmark = pytest.mark.oracle

GRID = pinhole_grid(75, 50, fov_deg=90)
FRAME = 12  # pixels, of which a window of SSIM reaches over 5


def pair(noise: float, seed: int = 0) -> tuple[torch.Tensor, torch.Tensor]:
    """A smooth picture and a noisy copy of it `[50, 75]` (float64) in a black frame."""
    generator = torch.Generator().manual_seed(seed)
    coarse = torch.rand(1, 1, 6, 8, generator=generator, dtype=torch.float64)
    shape = (GRID.height - 2 * FRAME, GRID.width - 2 * FRAME)
    picture = torch.nn.functional.interpolate(coarse, shape, mode="bilinear")[0, 0]
    noisy = (picture + noise * torch.randn(shape, generator=generator, dtype=torch.float64)).clamp(0, 1)
    return tuple(torch.nn.functional.pad(one, (FRAME,) * 4) for one in (picture, noisy))


@pytest.mark.parametrize("noise", [0.003, 0.05, 0.4])
def test_psnr_agrees_with_both(noise):
    truth, prediction = pair(noise)
    ours = float(psnr(truth, prediction, pixel_weight(GRID)))
    assert ours == pytest.approx(peak_signal_noise_ratio(truth.numpy(), prediction.numpy(), data_range=1.0), abs=1e-4)
    assert ours == pytest.approx(float(torch_psnr(prediction, truth, data_range=1.0)), abs=1e-4)


@pytest.mark.parametrize("noise", [0.003, 0.05, 0.4])
def test_ssim_agrees_with_both(noise):
    truth, prediction = pair(noise)
    ours = float(ssim(truth, prediction, GRID))
    settings = {"gaussian_weights": True, "sigma": 1.5, "use_sample_covariance": False, "data_range": 1.0}
    _, values = structural_similarity(truth.numpy(), prediction.numpy(), full=True, **settings)
    assert ours == pytest.approx(float(values.mean()), abs=1e-6)
    other = torch_ssim(prediction[None, None], truth[None, None], sigma=1.5, kernel_size=11, data_range=1.0)
    assert ours == pytest.approx(float(other), abs=1e-6)


def test_zeros_beyond_the_edge_flatter_ssim_a_little():
    generator = torch.Generator().manual_seed(1)
    truth = torch.nn.functional.interpolate(torch.rand(1, 1, 6, 8, generator=generator), GRID.shape, mode="bilinear")
    noisy = (truth + 0.05 * torch.randn(truth.shape, generator=generator)).clamp(0, 1)
    mirrored = float(torch_ssim(noisy, truth, sigma=1.5, kernel_size=11, data_range=1.0))
    assert mirrored < float(ssim(truth[0, 0], noisy[0, 0], GRID)) < mirrored + 0.1
