import math

import numpy as np
import pytest
import torch
from scipy.ndimage import correlate

from rf3dgs.core.errors import InputError
from rf3dgs.core.grids import equirect_grid, pinhole_grid
from rf3dgs.evaluation.perceptual import flip

GRID = pinhole_grid(40, 30, fov_deg=90)
MATRIX = np.array(  # XYZ from linear sRGB
    [
        [10135552 / 24577794, 8788810 / 24577794, 4435075 / 24577794],
        [2613072 / 12288897, 8788810 / 12288897, 887015 / 12288897],
        [1425312 / 73733382, 8788810 / 73733382, 70074185 / 73733382],
    ]
)
WHITE = MATRIX @ np.ones(3)
PER_DEGREE = 0.7 * 3840 / 0.7 * math.pi / 180


def ycxcz(light: np.ndarray) -> np.ndarray:
    x, y, z = np.moveaxis(light @ MATRIX.T / WHITE, -1, 0)
    return np.stack((116 * y - 16, 500 * (x - y), 200 * (y - z)), -1)


def light_of_ycxcz(value: np.ndarray) -> np.ndarray:
    y = (value[..., 0] + 16) / 116
    return np.stack((y + value[..., 1] / 500, y, y - value[..., 2] / 200), -1) * WHITE @ np.linalg.inv(MATRIX).T


def hunt_lab(light: np.ndarray) -> np.ndarray:
    def root(t):
        return np.where(t > (6 / 29) ** 3, np.cbrt(t), t * 29**2 / (3 * 6**2) + 4 / 29)

    x, y, z = np.moveaxis(root(light @ MATRIX.T / WHITE), -1, 0)
    lightness = 116 * y - 16
    return np.stack((lightness, 0.01 * lightness * 500 * (x - y), 0.01 * lightness * 200 * (y - z)), -1)


def hyab(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.abs(a[..., 0] - b[..., 0]) + np.sqrt(((a - b)[..., 1:] ** 2).sum(-1))


def written_again(first: np.ndarray, second: np.ndarray) -> float:
    """FLIP of sRGB pictures `[row, col, 3]`, step by step with whole two-dimensional kernels in double precision."""
    linear = [np.where(p <= 0.04045, p / 12.92, ((p + 0.055) / 1.055) ** 2.4) for p in (first, second)]
    opponent = [ycxcz(light) for light in linear]
    reach = math.ceil(3 * math.sqrt(0.04 / (2 * math.pi**2)) * PER_DEGREE)
    y, x = np.mgrid[-reach : reach + 1, -reach : reach + 1] / PER_DEGREE
    kernels = []
    for gaussians in ([(1, 0.0047)], [(1, 0.0053)], [(34.1, 0.04), (13.5, 0.025)]):
        kernel = sum(a * math.sqrt(math.pi / b) * np.exp(-(math.pi**2) * (x**2 + y**2) / b) for a, b in gaussians)
        kernels.append(kernel / kernel.sum())
    labs = []
    for picture in opponent:
        seen = [correlate(picture[..., c], kernels[c], mode="nearest") for c in range(3)]
        labs.append(hunt_lab(np.clip(light_of_ycxcz(np.stack(seen, -1)), 0, 1)))
    distance = hyab(*labs) ** 0.7
    largest = hyab(hunt_lab(np.array([0.0, 1, 0])), hunt_lab(np.array([0.0, 0, 1]))) ** 0.7
    knee = 0.4 * largest
    colour = np.where(distance < knee, 0.95 / knee * distance, 0.95 + (distance - knee) / (largest - knee) * (1 - 0.95))
    sigma = 0.5 * 0.082 * PER_DEGREE
    reach = math.ceil(3 * sigma)
    y, x = np.mgrid[-reach : reach + 1, -reach : reach + 1]
    bell = np.exp(-(x**2 + y**2) / (2 * sigma**2))
    features = []
    for kernel in (-x * bell, (x**2 / sigma**2 - 1) * bell):
        kernel = np.where(kernel > 0, kernel / kernel[kernel > 0].sum(), kernel / -kernel[kernel < 0].sum())
        sizes = []
        for picture in opponent:
            grey = (picture[..., 0] + 16) / 116
            along, down = (correlate(grey, k, mode="nearest") for k in (kernel, kernel.T))
            sizes.append(np.sqrt(along**2 + down**2))
        features.append(np.abs(sizes[0] - sizes[1]))
    feature = (np.maximum(*features) / math.sqrt(2)) ** 0.5
    return float((colour ** (1 - feature)).mean())


def pictures(noise: float, channels: int) -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(4)
    coarse = torch.rand(1, channels, 5, 6, generator=generator)
    first = torch.nn.functional.interpolate(coarse, GRID.shape, mode="bilinear")[0].permute(1, 2, 0)
    return first, (first + noise * torch.randn(first.shape, generator=generator)).clamp(0, 1)


@pytest.mark.parametrize("noise", [0.02, 0.2, 1.0])
@pytest.mark.parametrize("channels", [1, 3])
def test_flip_is_the_paper_written_a_second_time(noise, channels):
    first, second = pictures(noise, channels)
    expected = written_again(*(picture.expand(*GRID.shape, 3).double().numpy() for picture in (first, second)))
    got = flip(first.squeeze(-1), second.squeeze(-1), GRID)
    assert float(got) == pytest.approx(expected, abs=2e-5)  # single against double precision


def test_grey_is_three_equal_colours():
    first, second = (picture[..., 0] for picture in pictures(0.1, 1))
    colour = [picture[..., None].expand(*GRID.shape, 3) for picture in (first, second)]
    torch.testing.assert_close(flip(first, second, GRID), flip(*colour, GRID), atol=1e-5, rtol=0)


def test_black_against_white_is_the_worst_grey_can_do_and_equal_is_zero():
    black, white = torch.zeros(GRID.shape), torch.ones(GRID.shape)
    largest = hyab(hunt_lab(np.array([0.0, 1, 0])), hunt_lab(np.array([0.0, 0, 1]))) ** 0.7
    expected = 0.95 + (100**0.7 - 0.4 * largest) / (0.6 * largest) * 0.05
    assert float(flip(black, white, GRID)) == pytest.approx(expected, abs=1e-5)
    assert float(flip(white, white, GRID)) == 0.0


def test_an_edge_that_vanishes_is_worse_than_the_same_difference_in_level():
    edge = torch.full(GRID.shape, 0.4)
    edge[:, 20:] = 0.5
    level, flat = torch.full(GRID.shape, 0.5), torch.full(GRID.shape, 0.4)
    by_edge, by_level = float(flip(edge, flat, GRID)), float(flip(level, flat, GRID))
    assert by_edge > 0.5 * by_level  # the edge differs in half of the pixels


def test_flip_runs_on_over_the_seam_and_keeps_the_batch():
    grid = equirect_grid(60, 30)
    pair = torch.rand(2, 2, 3, *grid.shape, generator=torch.Generator().manual_seed(5))
    value = flip(pair[0], pair[1], grid)
    assert value.shape == (2, 3)
    torch.testing.assert_close(flip(pair[0].roll(23, -1), pair[1].roll(23, -1), grid), value, atol=1e-5, rtol=0)


def test_pictures_that_are_not_of_the_grid_are_refused():
    with pytest.raises(InputError, match=r"FLIP compares pictures of one size; got \[30, 40\] and \[30, 41\]"):
        flip(torch.zeros(30, 40), torch.zeros(30, 41), GRID)
    with pytest.raises(InputError, match=r"\[\*batch, 30, 40\].*got \[40, 30\]. Draw them on the grid"):
        flip(torch.zeros(40, 30), torch.zeros(40, 30), GRID)
