import math

import pytest
import torch
from scipy.special import sph_harm_y

from rf3dgs.core.angles import angles_of
from rf3dgs.core.errors import InputError
from rf3dgs.splats.harmonics import basis, coefficient_count, degree_of, evaluate, view_values


def directions(count: int, seed: int = 0) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    return torch.nn.functional.normalize(torch.randn(count, 3, generator=generator, dtype=torch.float64), dim=-1)


def test_harmonics_equal_scipys_up_to_the_sign_of_3dgs() -> None:
    """3DGS keeps the Condon-Shortley sign: sqrt(2) Re or Im of Y_lm, which SciPy has too."""
    direction = directions(50)
    zenith, azimuth = angles_of(direction)
    ours = basis(direction, 3)
    for degree in range(4):
        for order in range(-degree, degree + 1):
            complex_value = torch.from_numpy(sph_harm_y(degree, abs(order), zenith.numpy(), azimuth.numpy()))
            if order == 0:
                expected = complex_value.real
            else:
                expected = math.sqrt(2) * (complex_value.real if order > 0 else complex_value.imag)
            column = ours[:, degree * degree + degree + order]
            assert torch.allclose(column, expected, atol=1e-9), (degree, order)


def test_harmonics_are_orthonormal_on_the_sphere() -> None:
    nodes, weights = (torch.from_numpy(array) for array in __import__("numpy").polynomial.legendre.leggauss(8))
    azimuth = torch.arange(16, dtype=torch.float64) * (2 * math.pi / 16)
    z, phi = nodes.repeat_interleave(16), azimuth.repeat(8)
    ring = torch.sqrt(1 - z * z)
    values = basis(torch.stack((ring * torch.cos(phi), ring * torch.sin(phi), z), -1), 3)
    area = weights.repeat_interleave(16) * (2 * math.pi / 16)
    assert torch.allclose(values.T @ (values * area[:, None]), torch.eye(16, dtype=torch.float64), atol=1e-12)


def test_a_lower_degree_is_the_beginning_of_a_higher_one() -> None:
    direction = directions(5)
    for degree in range(4):
        assert torch.equal(basis(direction, degree), basis(direction, 3)[:, : coefficient_count(degree)])
        assert degree_of(coefficient_count(degree)) == degree


def test_the_first_degree_points_as_in_3dgs() -> None:
    axes = torch.eye(3)
    c1 = 0.4886025119029199
    expected = torch.tensor([[0, 0, -c1], [-c1, 0, 0], [0, c1, 0]])
    assert torch.allclose(basis(axes, 1)[:, 1:], expected)


def test_constant_colour_is_half_plus_the_first_term_and_never_negative() -> None:
    sh = torch.zeros(2, 4, 3)
    sh[0, 0] = 0.3 / 0.28209479177387814
    sh[1, 0] = -9.0
    values = evaluate(sh, directions(2).float(), offset=0.5, clamp=True)
    assert torch.allclose(values, torch.tensor([[0.8] * 3, [0.0] * 3]))
    assert bool((evaluate(sh, directions(2).float())[1] < 0).all())


def test_values_depend_on_where_the_viewer_stands() -> None:
    sh = torch.zeros(1, 4, 1, dtype=torch.float64)
    sh[0, 2, 0] = 1.0
    means = torch.tensor([[1.0, 2.0, 3.0]], dtype=torch.float64)
    above = view_values(sh, means, torch.tensor([1.0, 2.0, 9.0]))
    below = view_values(sh, means, torch.tensor([1.0, 2.0, -9.0]))
    assert float(above) == pytest.approx(-0.4886025119029199)
    assert float(below) == pytest.approx(0.4886025119029199)


def test_a_gaussian_at_the_viewer_gives_finite_gradients() -> None:
    means = torch.zeros(1, 3, requires_grad=True)
    value = view_values(torch.ones(1, 16, 2), means, torch.zeros(3))
    (gradient,) = torch.autograd.grad(value.sum() * 0.0, means)
    assert bool(torch.isfinite(value).all())
    assert bool(torch.isfinite(gradient).all())


def test_gradients_agree_with_finite_differences() -> None:
    sh = torch.randn(3, 16, 2, dtype=torch.float64, generator=torch.Generator().manual_seed(1)).requires_grad_()
    means = (3 * directions(3)).requires_grad_()
    centre = torch.tensor([0.3, 0.1, -0.2], dtype=torch.float64)
    assert torch.autograd.gradcheck(lambda s, m: view_values(s, m, centre, offset=0.5), (sh, means))


def test_wrong_counts_are_refused() -> None:
    with pytest.raises(InputError, match="1, 4, 9 or 16 coefficients; got 7"):
        degree_of(7)
    with pytest.raises(InputError, match="degree of the harmonics must be 0 to 3; got 4"):
        basis(directions(1), 4)
    with pytest.raises(InputError, match=r"sh must be \[gaussian, k, channel\]"):
        evaluate(torch.zeros(2, 4, 1), torch.zeros(3, 3))


@pytest.mark.parametrize("channels", [1, 2, 3, 4, 5])
def test_single_precision_equals_double_with_its_gradient(channels: int) -> None:
    """Single precision goes through the native core where it is built."""
    exact = torch.randn(40, 16, channels, dtype=torch.float64, generator=torch.Generator().manual_seed(2))
    direction = directions(40)
    quick = exact.float().requires_grad_()
    exact.requires_grad_()
    weights = torch.arange(40.0 * channels).reshape(40, channels) / 40
    for sh, along in ((exact, direction), (quick, direction.float())):
        values = evaluate(sh, along, offset=0.5, clamp=True)
        (values * weights.to(values.dtype)).sum().backward()
    assert torch.allclose(
        evaluate(quick, direction.float(), offset=0.5), evaluate(exact, direction, offset=0.5).float()
    )
    assert exact.grad is not None
    assert quick.grad is not None
    assert torch.allclose(quick.grad, exact.grad.float(), atol=1e-5)
