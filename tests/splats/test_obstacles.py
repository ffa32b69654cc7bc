"""The obstacles against their specification, and the laws that hold for any way to compute them."""

import math

import pytest
import torch
from torch import Tensor

from rf3dgs.core.errors import InputError
from rf3dgs.splats.gaussians import Gaussians
from rf3dgs.splats.obstacles import Obstacles, visibility_of
from rf3dgs.splats.surface import sample_mesh


def scattered(low: list[float], high: list[float], count: int, seed: int) -> Tensor:
    corner, other = torch.tensor(low), torch.tensor(high)
    return corner + (other - corner) * torch.rand(count, 3, generator=torch.Generator().manual_seed(seed))


def plate(x: float, spacing: float = 0.08) -> Gaussians:
    """A wall of 4 m x 3 m across the x axis."""
    corners = torch.tensor([[x, -2.0, 0.0], [x, 2.0, 0.0], [x, 2.0, 3.0], [x, -2.0, 3.0]])
    return sample_mesh(corners, torch.tensor([[0, 1, 2], [0, 2, 3]]), spacing=spacing)


def obstacles_of(cloud: Gaussians, labels: Tensor | None = None, **options: float) -> Obstacles:
    return Obstacles(cloud.means, cloud.quats, cloud.scales, cloud.opacities, labels, **options)


def two_plates() -> Obstacles:
    """Plates at x = 2 (label 0) and x = 4 (label 1)."""
    near, far = plate(2.0), plate(4.0)
    labels = torch.cat((torch.zeros(len(near), dtype=torch.long), torch.ones(len(far), dtype=torch.long)))
    return obstacles_of(Gaussians.join((near, far)), labels)


def test_a_leg_passes_the_plane_it_ends_on_and_no_other() -> None:
    obstacles = two_plates()
    start = scattered([0.0, -1.0, 0.8], [1.0, 1.0, 2.0], 40, 0)
    end = scattered([2.2, -1.0, 0.8], [2.2, 1.0, 2.0], 40, 1)
    behind = scattered([5.0, -1.0, 0.8], [6.0, 1.0, 2.0], 40, 2)
    none, first, second = (torch.full((40,), label) for label in (-1, 0, 1))
    assert float(obstacles.transmittance(start, end).max()) < 0.1
    assert float(obstacles.transmittance(start, end, skip_end=first).min()) == 1.0
    assert float(obstacles.transmittance(end, start, skip_start=first, skip_end=none).min()) == 1.0
    assert float(obstacles.transmittance(start, behind, skip_end=first).max()) < 0.1
    assert float(obstacles.transmittance(start, behind, skip_start=second, skip_end=first).min()) == 1.0
    torch.testing.assert_close(
        obstacles.transmittance(start, behind, skip_start=none), obstacles.transmittance(start, behind), atol=0, rtol=0
    )


def test_gaussians_without_a_label_are_never_skipped() -> None:
    cloud = plate(2.0)
    obstacles = obstacles_of(cloud, torch.full((len(cloud),), -1))
    start, end, skip = torch.tensor([[0.0, 0.0, 1.5]]), torch.tensor([[4.0, 0.0, 1.5]]), torch.tensor([-1])
    assert float(obstacles.transmittance(start, end, skip_start=skip, skip_end=skip)) < 0.1


def test_what_is_not_finite_passes_nothing_and_spoils_nothing() -> None:
    obstacles = two_plates()
    start = scattered([0.0, -1.0, 0.8], [1.0, 1.0, 2.0], 8, 0)
    end = scattered([1.2, -1.0, 0.8], [1.8, 1.0, 2.0], 8, 1)
    clean = obstacles.transmittance(start, end)
    start[2, 1], end[3, 0], end[5, 2] = math.nan, math.inf, 3e38
    passed = obstacles.transmittance(start, end)
    spoilt = torch.tensor([2, 3, 5])
    assert passed[spoilt].tolist() == [0.0, 0.0, 0.0]
    kept = torch.tensor([0, 1, 4, 6, 7])
    torch.testing.assert_close(passed[kept], clean[kept], atol=0, rtol=0)


def test_soft_is_a_share_at_an_edge_and_the_same_away_from_it() -> None:
    obstacles = two_plates()
    start = torch.tensor([[0.0, 0.0, 1.5], [0.0, 0.0, 1.5], [0.0, 2.03, 1.5]])
    end = torch.tensor([[3.0, 0.0, 1.5], [1.0, 0.0, 1.5], [3.0, 2.03, 1.5]])
    passed = obstacles.soft(start, end)
    assert float(passed[0]) < 0.01
    assert float(passed[1]) == 1.0
    assert 0.2 < float(passed[2]) < 0.8


def test_a_lit_surface_sees_the_transmitter_and_the_one_behind_does_not() -> None:
    obstacles, tx = two_plates(), torch.tensor([0.0, 0.0, 1.5])
    assert obstacles.labels is not None
    inner = (obstacles.means[:, 1].abs() < 1.0) & ((obstacles.means[:, 2] - 1.5).abs() < 0.8)
    normals = torch.tensor([-1.0, 0.0, 0.0]).expand_as(obstacles.means)
    visible = visibility_of(obstacles, obstacles.means, normals, tx, obstacles.labels)
    assert float(visible[inner & (obstacles.labels == 0)].min()) > 0.99
    assert float(visible[inner & (obstacles.labels == 1)].max()) < 0.1


def test_wrong_shapes_and_missing_labels_are_refused() -> None:
    cloud = plate(2.0)
    bare, start = obstacles_of(cloud), torch.zeros(4, 3)
    with pytest.raises(InputError, match=r"means must be \[gaussian, 3\]"):
        Obstacles(cloud.means.mT, cloud.quats, cloud.scales, cloud.opacities)
    with pytest.raises(InputError, match=r"labels must be \[gaussian\]"):
        obstacles_of(cloud, torch.zeros(3, dtype=torch.long))
    with pytest.raises(InputError, match=r"start and end must be \[segment, 3\]"):
        bare.transmittance(start[:, :2], start)
    with pytest.raises(InputError, match="as many, or one of them one; got 4 and 3"):
        bare.transmittance(start, start[:3])
    with pytest.raises(InputError, match="needs obstacles with labels"):
        bare.transmittance(start, start, skip_end=torch.zeros(4))
    with pytest.raises(InputError, match=r"skip_start must be \[segment\] for 4"):
        two_plates().transmittance(start, start, skip_start=torch.zeros(3))
    with pytest.raises(InputError, match="normals must be"):
        visibility_of(bare, cloud.means, cloud.means[:1], torch.zeros(3))
