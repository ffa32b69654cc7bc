"""FLIP (Andersson et al. 2020): how different two pictures look to an eye that flips between them. It needs no weights.

Written from "FLIP: A Difference Evaluator for Alternating Images" (Proc. ACM CGIT 3, 2), the version for pictures of
a screen (LDR). A picture goes through the contrast sensitivity of the eye; the difference of what is left is measured
in a perceptually uniform colour space, and raised where edges or points appear or vanish. The sphere's pictures run on
over the seam and the poles, others repeat their edge.
"""

import math

import torch
from torch import Tensor

from rf3dgs.core.errors import InputError
from rf3dgs.core.grids import DirectionGrid
from rf3dgs.evaluation.metrics import padded, pixel_weight

PIXELS_PER_DEGREE = 3840 * math.pi / 180  # 67: the observer sits 0.7 m from a screen 0.7 m and 3840 pixels wide
XYZ_FROM_RGB = (
    (10135552 / 24577794, 8788810 / 24577794, 4435075 / 24577794),
    (2613072 / 12288897, 8788810 / 12288897, 887015 / 12288897),
    (1425312 / 73733382, 8788810 / 73733382, 70074185 / 73733382),
)
# Contrast sensitivity to luminance, red-green and blue-yellow: sums of a sqrt(pi / b) exp(-pi^2 r^2 / b), r in degrees,
# as pairs (a, b).
SENSITIVITY = (((1.0, 0.0047),), ((1.0, 0.0053),), ((34.1, 0.04), (13.5, 0.025)))
COLOUR_EXPONENT = 0.7  # q_c
KNEE, KNEE_VALUE = 0.4, 0.95  # p_c, p_t
FEATURE_WIDTH = 0.082  # w [deg], of an edge that the eye sees best
FEATURE_EXPONENT = 0.5  # q_f


def flip(truth: Tensor, prediction: Tensor, grid: DirectionGrid) -> Tensor:
    """FLIP `[*batch]` of pictures `[*batch, row, col]` (grey) or `[*batch, row, col, 3]` (sRGB) in [0, 1]; 0 if equal.

    The mean over pixels (by `pixel_weight`) of `dE_c ^ (1 - dE_f)`, which lies in [0, 1]: `dE_c` is the difference in
    colour and `dE_f` that in features. Pixels are seen as on the paper's screen, 67 to a degree.
    """
    if truth.shape != prediction.shape:
        raise InputError(f"FLIP compares pictures of one size; got {list(truth.shape)} and {list(prediction.shape)}")
    grey = tuple(truth.shape[-2:]) == grid.shape
    if not grey and tuple(truth.shape[-3:]) != (*grid.shape, 3):
        raise InputError(
            f"FLIP compares pictures of [*batch, {grid.height}, {grid.width}], or that with 3 colours; got "
            f"{list(truth.shape)}. Draw them on the grid that is passed"
        )
    channels = 1 if grey else 3
    batch = truth.shape[: -2 if grey else -3]
    first, second = (
        _linear(picture.reshape(-1, *grid.shape, channels).float().clamp(0.0, 1.0)) for picture in (truth, prediction)
    )
    colour = _redistributed(_hyab(_perceived(first, grid), _perceived(second, grid)))
    features = _feature_difference(_luminance(first), _luminance(second), grid)
    error = colour ** (1.0 - features)
    return (error * pixel_weight(grid)).sum((-2, -1)).reshape(batch)


def _linear(picture: Tensor) -> Tensor:
    """Linear light of sRGB values, elementwise."""
    return torch.where(picture <= 0.04045, picture / 12.92, ((picture + 0.055) / 1.055) ** 2.4)


def _luminance(light: Tensor) -> Tensor:
    """Relative luminance `[n, row, col]` of linear light `[n, row, col, 1 or 3]`."""
    return light[..., 0] if light.shape[-1] == 1 else light @ torch.tensor(XYZ_FROM_RGB[1])


def _perceived(light: Tensor, grid: DirectionGrid) -> Tensor:
    """L* `[n, row, col, 1]` of grey, and L*, a, b with Hunt's correction of coloured light, as the eye resolves it.

    Opponent colours (YCxCz without its constant factors, which a filter of sum 1 does not see) are filtered with the
    eye's sensitivity to each, and what no screen can show is clipped.
    """
    if light.shape[-1] == 1:
        return 116.0 * _cube_root(_seen(light[..., 0], grid, SENSITIVITY[0]))[..., None] - 16.0
    matrix = torch.tensor(XYZ_FROM_RGB)
    white = matrix.sum(1)
    x, y, z = (light @ matrix.mT / white).unbind(-1)
    planes = zip((y, x - y, y - z), SENSITIVITY, strict=True)
    y, red, blue = (_seen(plane, grid, sensitivity) for plane, sensitivity in planes)
    shown = (torch.stack((red + y, y, y - blue), -1) * white) @ torch.linalg.inv(matrix).mT
    return _hunt_lab(shown.clamp(0.0, 1.0))


def _hunt_lab(light: Tensor) -> Tensor:
    """L*, and a* and b* times 0.01 L* (colours fade as light does), of linear light `[*batch, 3]`."""
    matrix = torch.tensor(XYZ_FROM_RGB)
    x, y, z = _cube_root(light @ matrix.mT / matrix.sum(1)).unbind(-1)
    lightness = 116.0 * y - 16.0
    return torch.stack((lightness, 5.0 * lightness * (x - y), 2.0 * lightness * (y - z)), -1)


def _cube_root(value: Tensor) -> Tensor:
    """CIELAB's cube root, straight near zero."""
    edge = 6.0 / 29.0
    return torch.where(value > edge**3, value.clamp_min(edge**3) ** (1 / 3), value / (3 * edge**2) + 4.0 / 29.0)


def _hyab(first: Tensor, second: Tensor) -> Tensor:
    """Distance of large colour differences: that in lightness plus the Euclidean one in chroma."""
    difference = first - second
    return difference[..., 0].abs() + torch.linalg.vector_norm(difference[..., 1:], dim=-1)


def _redistributed(distance: Tensor) -> Tensor:
    """Distances in [0, 1]: the lower 40 % of the range, where pictures mostly lie, get 95 % of it."""
    green, blue = _hunt_lab(torch.tensor([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]))
    largest = float(_hyab(green, blue)) ** COLOUR_EXPONENT
    knee = KNEE * largest
    value = distance**COLOUR_EXPONENT
    above = KNEE_VALUE + (value - knee) / (largest - knee) * (1.0 - KNEE_VALUE)
    return torch.where(value < knee, value * (KNEE_VALUE / knee), above)


def _feature_difference(first: Tensor, second: Tensor, grid: DirectionGrid) -> Tensor:
    """Difference in edges and points `[n, row, col]`, in [0, 1], of luminances.

    `(max(| |e_1| - |e_2| |, | |p_1| - |p_2| |) / sqrt(2)) ^ q_f` with gradients e and p by the first and second
    derivatives of a Gaussian, whose positive and negative values each add up to one.
    """
    deviation = 0.5 * FEATURE_WIDTH * PIXELS_PER_DEGREE
    x = torch.arange(-math.ceil(3 * deviation), math.ceil(3 * deviation) + 1, dtype=torch.float32)
    smooth = torch.exp(-(x**2) / (2 * deviation**2))
    differences = []
    for detector in (-x * smooth, (x**2 / deviation**2 - 1.0) * smooth):
        level = torch.where(
            detector > 0, detector / detector.clamp_min(0).sum(), detector / -detector.clamp_max(0).sum()
        )
        strengths = [
            torch.hypot(
                _filtered(picture, grid, smooth / smooth.sum(), level),
                _filtered(picture, grid, level, smooth / smooth.sum()),
            )
            for picture in (first, second)
        ]
        differences.append((strengths[0] - strengths[1]).abs())
    return (torch.maximum(*differences) / math.sqrt(2.0)) ** FEATURE_EXPONENT


def _seen(plane: Tensor, grid: DirectionGrid, sensitivity: tuple[tuple[float, float], ...]) -> Tensor:
    """`[n, row, col]` as the eye resolves it: filtered with a sum of round Gaussians whose values add up to 1."""
    widest = max(b for gaussians in SENSITIVITY for _, b in gaussians)
    radius = math.ceil(3 * math.sqrt(widest / (2 * math.pi**2)) * PIXELS_PER_DEGREE)
    x = torch.arange(-radius, radius + 1, dtype=torch.float32) / PIXELS_PER_DEGREE
    kernels = [(a * math.sqrt(math.pi / b), torch.exp(-(math.pi**2) * x**2 / b)) for a, b in sensitivity]
    whole = sum(scale * float(kernel.sum()) ** 2 for scale, kernel in kernels)
    parts = [scale / whole * _filtered(plane, grid, kernel, kernel) for scale, kernel in kernels]
    return torch.stack(parts).sum(0)


def _filtered(picture: Tensor, grid: DirectionGrid, down: Tensor, across: Tensor) -> Tensor:
    """`[n, row, col]` correlated with the product of two kernels of one odd length."""
    wide = padded(picture, grid, len(down) // 2, edge="replicate")[:, None]
    wide = torch.nn.functional.conv2d(wide, down[None, None, :, None])
    return torch.nn.functional.conv2d(wide, across[None, None, None, :])[:, 0]
