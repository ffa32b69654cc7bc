"""Laws of how far the levels of paths may be off."""

from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch

from rf3dgs.core.errors import InputError
from rf3dgs.field.path_uncertainty import FARTHEST_DROP, TAIL, PathDoubt, way_numbers
from rf3dgs.field.rays import Rays
from rf3dgs.field.uncertainty import SHARES
from rf3dgs.training.path_uncertainty_fit import LeftOutWays, fit_laws_of_ways, fit_path_doubt

DOUBT = PathDoubt(
    points=torch.tensor([[0.0, 0.0, 0.0], [5.0, 0.0, 0.0]]),
    plane=torch.tensor([0, 1]),
    off=torch.tensor([-1.0, 1.2]),
    wrong=torch.tensor([-2.0, -0.5, 0.6]),
    levels=torch.tensor(SHARES),
)


def drawn(count: int, seed: int = 0) -> tuple[torch.Tensor, torch.Tensor]:
    """Numbers of ways and sizes of their errors by the laws of DOUBT."""
    generator = torch.Generator().manual_seed(seed)

    def uniform(low: float, high: float) -> torch.Tensor:
        return low + (high - low) * torch.rand(count, generator=generator)

    numbers = torch.stack((uniform(-1.0, 1.5), uniform(-2.0, 5.0), uniform(0.0, 3.0), uniform(5.0, 40.0)), -1)
    scale, chance, reach = DOUBT.laws(numbers)
    gone = torch.rand(count, generator=generator) < chance
    near = TAIL * scale * ((1 - torch.rand(count, generator=generator)) ** (-1 / TAIL) - 1)
    return numbers, torch.where(gone, reach * torch.rand(count, generator=generator).sqrt(), near)


def test_half_an_interval_holds_its_share():
    numbers, size = drawn(20_000)
    for share in (0.5, 0.6827, 0.9, 0.95):
        half = DOUBT.half(share, numbers)
        # Standard error of a share of 20,000: 0.4 points.
        assert float((size < half).float().mean()) == pytest.approx(share, abs=0.012)
        assert bool((DOUBT.inside(half, numbers) - share).abs().max() < 1e-3)


def test_laws_are_found_again_where_errors_follow_them():
    numbers, size = drawn(20_000)
    off, wrong = fit_laws_of_ways(numbers.double(), size.double())
    # Both kinds of error overlap; standard errors are about 0.03 and 0.06.
    torch.testing.assert_close(off, DOUBT.off, atol=0.1, rtol=0)
    torch.testing.assert_close(wrong, DOUBT.wrong, atol=0.25, rtol=0)


def test_shares_are_counted_even_where_the_law_is_another():
    numbers, _ = drawn(4000)
    size = numbers[:, 0].exp() * torch.randn(4000, generator=torch.Generator().manual_seed(1)).abs()
    weights = torch.zeros(10).index_fill(0, torch.tensor([0]), 1.0)
    rows = torch.cat((numbers[:, :1], torch.zeros(4000, 9)), -1)
    doubt = fit_path_doubt([LeftOutWays(rows, numbers, size)], weights, DOUBT)
    assert doubt is not None
    for share, level in zip(SHARES, doubt.levels.tolist(), strict=True):
        assert float((size < doubt.half(level, numbers)).float().mean()) == pytest.approx(share, abs=2e-3)


def test_a_few_ways_teach_nothing():
    numbers, size = drawn(10)
    assert fit_path_doubt([LeftOutWays(torch.zeros(10, 10), numbers, size)], torch.zeros(10), DOUBT) is None


def test_a_way_that_is_barely_open_or_was_never_measured_is_less_sure():
    likely = torch.tensor([[0.0, 4.0, 0.0, 20.0]])
    for column, value in ((1, 0.0), (2, 3.0)):
        doubtful = likely.clone()
        doubtful[0, column] = value
        for share in (0.68, 0.9):
            assert float(DOUBT.half(share, doubtful)) > 1.2 * float(DOUBT.half(share, likely))
    # The least that a level can fall is all that a wrong way costs.
    certain = replace(DOUBT, wrong=torch.tensor([30.0, 0.0, 0.0]))
    assert float(certain.half(0.999999, likely)) == pytest.approx(FARTHEST_DROP * 20.0, rel=1e-3)


def test_how_far_a_reflection_is_from_what_was_measured():
    sources = SimpleNamespace(sequence=torch.tensor([[-1, -1, -1], [0, -1, -1], [1, 0, -1], [2, -1, -1]]))
    points = torch.zeros(4, 3, 3)
    points[1, 0, 1], points[2, 1, 2] = 0.6, 1.0
    points[2, 0] = torch.tensor([5.0, 0.0, 0.0])
    one, vector = torch.ones(4), torch.ones(4, 3)
    rays = Rays(torch.arange(4), one, vector, vector, one, torch.tensor([0, 1, 2, 1]), points)
    found = way_numbers(SimpleNamespace(sources=sources), DOUBT, rays, 0.5 * one, 2 * one, torch.tensor([0.9] * 4))
    # None for the straight way, the farther of two, and ten metres on a plane that nobody measured.
    torch.testing.assert_close(found[:, 2].expm1() * 0.2, torch.tensor([0.0, 0.6, 1.0, 10.0]))
    torch.testing.assert_close(found[:, 3], torch.full((4,), 10.0))
    torch.testing.assert_close(found[:, 1], torch.zeros(4), atol=1e-6, rtol=0)


def test_shapes_must_fit():
    with pytest.raises(InputError, match=r"wrong must be \[3\]; got \[2\]"):
        replace(DOUBT, wrong=torch.zeros(2))
