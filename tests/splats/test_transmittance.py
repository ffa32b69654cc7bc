import math
import time

import pytest
import torch

from rf3dgs.core.errors import InputError
from rf3dgs.splats.gaussians import Gaussians
from rf3dgs.splats.surface import sample_mesh
from rf3dgs.splats.transmittance import segment_transmittance


def wall(spacing: float = 0.06) -> Gaussians:
    """A wall of 4 m x 3 m in the plane x = 2."""
    corners = torch.tensor([[2.0, -2.0, 0.0], [2.0, 2.0, 0.0], [2.0, 2.0, 3.0], [2.0, -2.0, 3.0]])
    return sample_mesh(corners, torch.tensor([[0, 1, 2], [0, 2, 3]]), spacing=spacing)


def through(cloud: Gaussians, start: torch.Tensor, end: torch.Tensor, **options: float) -> torch.Tensor:
    return segment_transmittance(cloud.means, cloud.quats, cloud.scales, cloud.opacities, start, end, **options)


def scattered(low: list[float], high: list[float], count: int, seed: int) -> torch.Tensor:
    corner, other = torch.tensor(low), torch.tensor(high)
    return corner + (other - corner) * torch.rand(count, 3, generator=torch.Generator().manual_seed(seed))


def test_a_wall_blocks_and_free_space_passes() -> None:
    start = scattered([0.0, -1.5, 0.5], [1.5, 1.5, 2.5], 200, 0)
    behind = scattered([2.5, -1.5, 0.5], [4.0, 1.5, 2.5], 200, 1)
    beside = scattered([0.0, -1.5, 0.5], [1.5, 1.5, 2.5], 200, 2)
    assert float(through(wall(), start, behind).max()) < 0.1
    assert float(through(wall(), start, beside).min()) > 0.9


def test_a_closed_room_lets_nothing_out_at_its_edges() -> None:
    corners = torch.cartesian_prod(torch.tensor([0.0, 4.0]), torch.tensor([0.0, 3.0]), torch.tensor([0.0, 2.5]))
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    faces = torch.tensor([(q[0], *pair) for q in quads for pair in ((q[1], q[2]), (q[2], q[3]))])
    room = sample_mesh(corners, faces, spacing=0.08)
    direction = torch.nn.functional.normalize(torch.randn(500, 3, generator=torch.Generator().manual_seed(3)), dim=-1)
    edge = corners[[0, 0, 7]] + torch.tensor([[2.0, 0, 0], [0, 0, 1.2], [0, -1.4, 0]])
    centre = torch.tensor([[1.7, 1.4, 1.1]])
    target = torch.cat((centre + 9 * direction, centre + 3 * (edge - centre)))
    passed = through(room, centre, target)
    assert float(passed.max()) < 0.1


def test_one_gaussian_blocks_by_its_peak_along_the_segment() -> None:
    mean, quat = torch.tensor([[1.0, 0.3, 0.0]]), torch.tensor([[1.0, 0.0, 0.0, 0.0]])
    scale, opacity = torch.tensor([[0.5, 0.2, 0.1]]), torch.tensor([0.8])
    start, end = torch.zeros(1, 3), torch.tensor([[3.0, 0.0, 0.0]])
    expected = 1 - 0.8 * math.exp(-0.5 * (0.3 / 0.2) ** 2)
    assert float(segment_transmittance(mean, quat, scale, opacity, start, end)) == pytest.approx(expected, rel=1e-5)


def test_the_nearest_point_stays_inside_the_shortened_segment() -> None:
    mean, quat = torch.tensor([[1.0, 0.0, 0.0]]), torch.tensor([[2.0, 0.0, 0.0, 0.0]])
    scale, opacity = torch.full((1, 3), 0.2), torch.tensor([0.9])
    for end, stop in ((0.9, 0.1), (0.9, 0.0), (1.4, 0.3)):
        passed = segment_transmittance(
            mean, quat, scale, opacity, torch.zeros(1, 3), torch.tensor([[end, 0.0, 0.0]]), stop_short=stop
        )
        distance = max(0.0, 1.0 - (end - stop)) / 0.2
        assert float(passed) == pytest.approx(1 - 0.9 * math.exp(-0.5 * distance**2), rel=1e-5)


def test_the_surfaces_a_segment_joins_do_not_hide_each_other() -> None:
    cloud = wall()
    on_the_wall = cloud.means[len(cloud) // 2][None]
    away = on_the_wall - torch.tensor([[1.5, 0.2, 0.1]])
    assert float(through(cloud, on_the_wall, away)) > 0.9
    assert float(through(cloud, away, on_the_wall)) > 0.9


def test_both_directions_see_the_same() -> None:
    start = scattered([0.0, -3.0, 0.0], [1.9, 3.0, 4.0], 50, 5)
    end = scattered([2.1, -3.0, 0.0], [4.0, 3.0, 4.0], 50, 6)
    assert torch.allclose(through(wall(), start, end), through(wall(), end, start), atol=1e-4)


def test_faint_and_broken_gaussians_are_ignored() -> None:
    cloud = wall().tensors()
    cloud["logit_opacities"] = torch.full_like(cloud["logit_opacities"], math.log(0.29 / 0.71))
    start, end = torch.tensor([[0.0, 0.0, 1.5]]), torch.tensor([[4.0, 0.0, 1.5]])
    assert float(through(Gaussians.from_tensors(cloud), start, end)) == 1.0
    broken = wall()
    broken.means[:100] = torch.nan
    broken.quats[100:200] = 0
    broken.log_scales[200:300] = torch.nan
    assert bool(torch.isfinite(through(broken, start, end)).all())


def test_a_segment_of_no_length_is_free() -> None:
    point = torch.tensor([[2.0, 0.0, 1.5]])
    assert float(through(wall(), point, point)) == 1.0
    assert float(through(wall(), point, point + 0.05)) == 1.0


def test_many_segments_equal_each_alone() -> None:
    cloud = wall(0.15)
    start = scattered([0.0, -3.0, 0.0], [1.9, 3.0, 4.0], 20, 7)
    end = scattered([1.0, -3.0, 0.0], [4.0, 3.0, 4.0], 20, 8)
    alone = torch.cat([through(cloud, start[i], end[i]) for i in range(20)])
    assert torch.allclose(through(cloud, start, end), alone, atol=1e-5)


def test_the_prefilter_leaves_nothing_out() -> None:
    cloud = wall(0.15)
    start = scattered([0.0, -3.0, 0.0], [1.9, 3.0, 4.0], 20, 7)
    end = scattered([1.0, -3.0, 0.0], [4.0, 3.0, 4.0], 20, 8)
    steps = torch.linspace(0, 1, 4001)[:, None]
    from rf3dgs.core.frames import matrix_from_quaternion

    inverse = matrix_from_quaternion(cloud.quats).mT / cloud.scales[:, :, None]
    for index in range(20):
        along = (end[index] - start[index]) / torch.linalg.vector_norm(end[index] - start[index])
        points = start[index] + 0.1 * along + steps * (end[index] - start[index] - 0.2 * along)
        local = torch.einsum("gij,gj->gi", inverse, -cloud.means)[:, None] + torch.einsum(
            "gij,pj->gpi", inverse, points
        )
        blocked = cloud.opacities * torch.exp(-0.5 * local.square().sum(-1).amin(-1))
        expected = float(torch.prod(1 - blocked))
        assert float(through(cloud, start[index], end[index])) == pytest.approx(expected, abs=2e-3)


def test_one_segment_through_a_large_scene_is_quick() -> None:
    cloud = wall(0.017)
    assert len(cloud) > 45_000
    arguments = (
        cloud.means,
        cloud.quats,
        cloud.scales,
        cloud.opacities,
        torch.zeros(1, 3),
        torch.tensor([[4.0, 1, 1]]),
    )
    durations = []
    for _ in range(7):
        began = time.process_time()
        segment_transmittance(*arguments)
        durations.append(time.process_time() - began)
    assert min(durations) < 0.05


def test_wrong_shapes_are_refused() -> None:
    with pytest.raises(InputError, match=r"start and end must be \[segment, 3\]"):
        through(wall(0.3), torch.zeros(4, 2), torch.zeros(4, 2))
