"""Laws of PSNR and SSIM of colours, and how jet's relate to the level's."""

import pytest
import torch

from rf3dgs.core.grids import pinhole_grid
from rf3dgs.evaluation.colours import colour_psnr, colour_ssim, jet_gap_db
from rf3dgs.evaluation.metrics import pixel_weight, psnr, ssim
from rf3dgs.spectra.jet import jet_picture

GRID = pinhole_grid(40, 30, fov_deg=90)
WEIGHT = pixel_weight(GRID)


def levels(seed: int) -> torch.Tensor:
    return torch.rand(3, *GRID.shape, generator=torch.Generator().manual_seed(seed))


def test_grey_colours_have_the_scores_of_their_level():
    truth, other = levels(0), levels(1)
    grey = [one[..., None].expand(*one.shape, 3) for one in (truth, other)]
    torch.testing.assert_close(colour_psnr(*grey, WEIGHT), psnr(truth, other, WEIGHT))
    torch.testing.assert_close(colour_ssim(*grey, GRID), ssim(truth, other, GRID))
    torch.testing.assert_close(colour_ssim(grey[0], grey[0], GRID), torch.ones(3))


def test_one_colour_that_is_wrong_is_a_third_of_the_square_error():
    truth = torch.zeros(*GRID.shape, 3)
    wrong = truth.clone()
    wrong[..., 1] = 0.3
    assert float(colour_psnr(truth, wrong, WEIGHT)) == pytest.approx(float(-10 * torch.log10(torch.tensor(0.03))))


def test_the_psnr_of_jet_is_lower_by_the_gap_while_errors_are_small_and_nearer_when_they_are_large():
    truth = 0.1 + 0.8 * levels(2)

    def gap(error: float) -> float:
        other = truth + error * torch.sign(levels(3) - 0.5)
        grey = psnr(truth, other, WEIGHT)
        return float((grey - colour_psnr(jet_picture(truth), jet_picture(other), WEIGHT)).mean())

    assert gap(4 / 255) == pytest.approx(jet_gap_db(truth), abs=0.4)  # 8 bits and corners of the map
    assert 0 < gap(0.5) < gap(0.2) < gap(4 / 255)
