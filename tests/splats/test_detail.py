"""Laws of the level of detail: what merging keeps, what it never mixes, and what it refuses."""

import math
import re

import pytest
import torch

from rf3dgs.core.errors import InputError
from rf3dgs.core.frames import Pose, matrix_from_quaternion
from rf3dgs.core.grids import Camera, Panorama, equirect_grid, pinhole_grid
from rf3dgs.splats.detail import largest_weights, level_of_detail, prune_unseen
from rf3dgs.splats.gaussians import Gaussians
from rf3dgs.splats.rasterize import rasterize
from rf3dgs.splats.surface import normals, sample_mesh

PIXEL = math.radians(1.0)


def wall(spacing: float = 0.02, half: float = 2.0, height: float = 0.0, **options) -> Gaussians:
    corner = torch.tensor([[-half, -half, height], [half, -half, height], [half, half, height], [-half, half, height]])
    return sample_mesh(corner, torch.tensor([[0, 1, 2], [0, 2, 3]]), spacing=spacing, **options)


def corner_of_walls(spacing: float = 0.02) -> Gaussians:
    """The floor z = 0 and the wall x = 0, which meet at a right angle."""
    vertices = torch.tensor([[0, 0, 0], [2, 0, 0], [2, 2, 0], [0, 2, 0], [0, 0, 2], [0, 2, 2]], dtype=torch.float32)
    faces = torch.tensor([[0, 1, 2], [0, 2, 3], [0, 3, 5], [0, 5, 4]])
    return sample_mesh(vertices, faces, spacing=spacing)


def weight_of(gaussians: Gaussians, position: tuple, target: tuple, size: int = 64) -> torch.Tensor:
    camera = Camera.of(Pose.look_at(position=position, target=target), pinhole_grid(size, size, 60.0))
    shape = gaussians.means, gaussians.quats, gaussians.scales, gaussians.opacities
    return rasterize(*shape, torch.ones(len(gaussians), 1), camera).weight


def test_a_closed_wall_stays_closed_with_a_tenth_of_the_gaussians():
    before = wall()
    after = level_of_detail(before, torch.tensor([[0.0, 0.0, 2.0]]), pixel=PIXEL, widest=0.2).gaussians
    assert len(after) < 0.1 * len(before)
    assert weight_of(after, (0.0, 0.01, 2.0), (0.0, 0.0, 0.0)).min() > 0.99


def test_the_total_weight_of_a_picture_is_kept():
    before = corner_of_walls()
    after = level_of_detail(before, torch.tensor([[1.5, 1.0, 1.5]]), pixel=PIXEL, margin=0.0).gaussians
    assert len(after) < 0.35 * len(before)
    for target in ((0.0, 1.0, 0.0), (0.0, 2.5, 1.0), (2.0, 2.5, 0.0)):
        weight = [weight_of(one, (1.7, 0.6, 1.2), target).mean() for one in (before, after)]
        assert (weight[1] - weight[0]).abs() < 0.01  # outlines move by a third of a pixel


def test_walls_that_meet_do_not_merge_across_the_edge():
    before = corner_of_walls()
    detail = level_of_detail(before, torch.tensor([[1.5, 1.0, 1.5]]), pixel=4 * PIXEL, margin=0.0)
    old, new = normals(before), normals(detail.gaussians)
    assert ((old * new[detail.cluster]).sum(-1) > 0.999).all()
    off_plane = torch.minimum(detail.gaussians.means[:, 0].abs(), detail.gaussians.means[:, 2].abs())
    assert off_plane.max() < 1e-4


def test_two_sides_of_a_thin_wall_stay_two():
    front, back = wall(height=0.0), wall(height=0.06)
    before = Gaussians.join([front, back])
    detail = level_of_detail(before, torch.tensor([[0.0, 0.0, 1.5]]), pixel=PIXEL, margin=0.0)
    assert len(detail.gaussians) < 0.2 * len(before)
    moved = (detail.gaussians.means[detail.cluster, 2] - before.means[:, 2]).abs()
    assert moved.max() < 1e-3


def test_a_merged_gaussian_has_the_moments_and_the_thickness_of_its_members():
    generator = torch.Generator().manual_seed(1)
    count = 5
    means = torch.tensor([0.303, 0.402, 0.0]) + 0.02 * torch.rand(count, 3, generator=generator) * torch.tensor(
        [1, 1, 0.1]
    )
    log_scales = torch.tensor([0.01, 0.008, 0.001]).log() + 0.2 * torch.randn(count, 3, generator=generator)
    quats = torch.tensor([1.0, 0, 0, 0]) + 0.05 * torch.randn(count, 4, generator=generator)
    logit = -3.0 + torch.rand(count, generator=generator)
    before = Gaussians(means, quats, log_scales, logit, torch.randn(count, 4, 2, generator=generator))
    detail = level_of_detail(before, torch.tensor([[0.0, 0.0, 3.0]]), pixel=0.05, flat=0)
    assert len(detail.gaussians) == 1
    area = 2 * math.pi * before.scales[:, 0] * before.scales[:, 1]
    share = before.opacities * area / (before.opacities * area).sum()
    torch.testing.assert_close(detail.share, share)
    mean = (share[:, None] * means).sum(0)
    torch.testing.assert_close(detail.gaussians.means[0], mean)
    spread = matrix_from_quaternion(before.quats) * before.scales[:, None]
    offset = means - mean
    covariance = (share[:, None, None] * (spread @ spread.mT + offset[:, :, None] * offset[:, None])).sum(0)
    spread = matrix_from_quaternion(detail.gaussians.quats)[0] * detail.gaussians.scales[0]
    torch.testing.assert_close(spread @ spread.mT, covariance, rtol=1e-4, atol=1e-9)
    longest = detail.gaussians.scales[0].sort().values[1:]
    thickness = detail.gaussians.opacities[0] * 2 * math.pi * longest.prod()
    torch.testing.assert_close(thickness, (before.opacities * area).sum(), rtol=1e-4, atol=0)
    torch.testing.assert_close(detail.gaussians.sh[0], (share[:, None, None] * before.sh).sum(0))


def test_gaussians_alone_in_their_cell_or_larger_than_it_are_untouched():
    spread_out, large = wall(spacing=0.5), wall(spacing=0.02).subset(torch.arange(300))
    large = Gaussians(large.means, large.quats, large.log_scales + 2.5, large.logit_opacities, large.sh)
    for before in (spread_out, large, spread_out.subset(torch.tensor([3]))):
        detail = level_of_detail(before, torch.tensor([[0.0, 0.0, 2.0]]), pixel=PIXEL)
        assert len(detail.gaussians) == len(before)
        for name, tensor in detail.gaussians.tensors().items():
            assert torch.equal(tensor[detail.cluster], before.tensors()[name]), name


def test_the_result_does_not_depend_on_the_order():
    before = corner_of_walls(spacing=0.04)
    order = torch.randperm(len(before), generator=torch.Generator().manual_seed(0))
    positions = torch.tensor([[1.5, 1.0, 1.5], [1.0, 0.5, 1.0]])
    first = level_of_detail(before, positions, pixel=2 * PIXEL)
    again = level_of_detail(before, positions, pixel=2 * PIXEL)
    other = level_of_detail(before.subset(order), positions, pixel=2 * PIXEL)
    for name, tensor in first.gaussians.tensors().items():
        assert torch.equal(tensor, again.gaussians.tensors()[name]), name
    assert len(first.gaussians) == len(other.gaussians) < len(before)
    for name in ("means", "log_scales", "logit_opacities", "sh"):
        one, two = (getattr(detail.gaussians, name) for detail in (first, other))
        torch.testing.assert_close(two[other.cluster], one[first.cluster][order], rtol=1e-4, atol=1e-5)


def test_nearer_positions_and_margins_keep_more():
    before = wall()
    counts = [
        len(level_of_detail(before, torch.tensor([[0.0, 0.0, z]]), pixel=PIXEL, widest=1.0, margin=margin).gaussians)
        for z, margin in ((4.0, 0.0), (2.0, 0.0), (1.0, 0.0), (1.0, 0.3))
    ]
    assert counts[0] < counts[1] < counts[2] < counts[3] <= len(before)


def test_two_colours_share_no_cell_wider_than_a_pixel():
    before = wall()
    before.sh[:, 0] = torch.where(before.means[:, :1] > 0.013, 1.0, -1.0)
    detail = level_of_detail(before, torch.tensor([[0.0, 0.0, 4.0]]), pixel=PIXEL, widest=1.0)
    mixed = (detail.gaussians.sh[:, 0, 0].abs() < 0.99)[detail.cluster]
    assert mixed.any()
    assert (before.means[mixed, 0] - 0.013).abs().max() < PIXEL * before.means[mixed].norm(dim=-1).add(4.0).max()
    plain = level_of_detail(wall(), torch.tensor([[0.0, 0.0, 4.0]]), pixel=PIXEL, widest=1.0)
    assert len(detail.gaussians) > len(plain.gaussians)


def test_harmonics_are_carried_both_ways():
    before = corner_of_walls(spacing=0.04)
    detail = level_of_detail(before, torch.tensor([[1.5, 1.0, 1.5]]), pixel=2 * PIXEL, margin=0.0)
    values = torch.randn(len(before), 4, 2, generator=torch.Generator().manual_seed(0))
    gathered = detail.gather(values)
    assert gathered.shape == (len(detail.gaussians), 4, 2)
    torch.testing.assert_close(detail.gather(detail.spread(gathered)), gathered)
    torch.testing.assert_close(detail.gather(torch.ones(len(before))), torch.ones(len(detail.gaussians)))
    torch.testing.assert_close(detail.gather(before.means), detail.gaussians.means, rtol=1e-5, atol=1e-6)
    with pytest.raises(InputError, match=rf"a row for each of the {len(before)} old Gaussians; got \[1, 4\]"):
        detail.gather(torch.zeros(1, 4))
    with pytest.raises(InputError, match=rf"a row for each of the {len(detail.gaussians)} new Gaussians"):
        detail.spread(values)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"positions": torch.zeros(0, 3)}, "positions must be [position, 3] in metres, at least one; got [0, 3]"),
        ({"positions": torch.zeros(3)}, "positions must be [position, 3] in metres, at least one; got [3]"),
        ({"positions": torch.full((2, 3), math.nan)}, "positions must be finite"),
        ({"pixel": 0.0}, "pixel [rad] and widest [m] must be positive and finite; got 0.0 and 0.1"),
        ({"widest": math.nan}, "pixel [rad] and widest [m] must be positive and finite"),
        ({"flat": -1}, "flat and colour must be at least 0; got -1"),
        ({"margin": -0.1}, "margin must be at least 0 m; got -0.1"),
    ],
)
def test_bad_input_is_refused(options, message):
    with pytest.raises(InputError, match=re.escape(message)):
        level_of_detail(wall(0.5), **({"positions": torch.ones(2, 3), "pixel": PIXEL} | options))


def test_gaussians_that_are_none_or_not_finite_are_refused():
    broken = wall(0.5)
    broken.means[1, 2] = math.nan
    for gaussians, message in (
        (wall(0.5).subset(torch.arange(0)), "at least one Gaussian"),
        (broken, "must be finite"),
    ):
        with pytest.raises(InputError, match=message):
            level_of_detail(gaussians, torch.ones(1, 3), pixel=PIXEL)


def view(position: tuple, target: tuple, size: int = 32) -> Camera:
    return Camera.of(Pose.look_at(position=position, target=target), pinhole_grid(size, size, 60.0))


def test_the_largest_weights_of_the_core_are_those_of_the_reference():
    cloud = Gaussians.random(150, (-1.0, -1.0, -1.0), (1.0, 1.0, 1.0), channels=1, degree=0, seed=2)
    sphere = Panorama.of(Pose(torch.tensor([0.2, 0.1, -2.2])), equirect_grid(48, 24))
    views = [view((3.0, 0.5, 0.2), (0.0, 0.0, 0.0)), sphere]
    fast = largest_weights(cloud, views, backend="native")
    torch.testing.assert_close(fast, largest_weights(cloud, views, backend="reference"), rtol=0, atol=2e-5)
    assert 0.05 < fast.median() < 0.5
    only = [largest_weights(cloud, [one]) for one in views]
    assert torch.equal(fast, torch.maximum(*only))


def test_a_panorama_sees_all_around():
    before = Gaussians.join([wall(0.1, height=-1.0), wall(0.1, height=1.0), wall(0.1, height=1.4)])
    panorama = Panorama.of(Pose(torch.tensor([0.1, 0.2, 0.0])), equirect_grid(64, 32))
    largest = largest_weights(before, [panorama])
    ahead = before.means[:, :2].norm(dim=-1) < 1.0
    below, above, behind = (largest[ahead & ((before.means[:, 2] - z).abs() < 0.1)] for z in (-1.0, 1.0, 1.4))
    assert min(below.min(), above.min()) > 0.005
    assert min(below.median(), above.median()) > 0.15
    assert behind.max() < 1e-3


def test_pruning_removes_what_a_wall_hides_and_the_picture_stays():
    before = Gaussians.join([wall(0.1, height=0.0), wall(0.1, height=-0.5)])
    views = [view((0.0, 0.01, 2.0), (0.0, 0.0, 0.0))]
    detail = prune_unseen(before, views)
    assert 0.05 * len(before) < len(detail.gaussians) < 0.5 * len(before)
    assert (detail.gaussians.means[:, 2] == 0).float().mean() > 0.95
    lost = [weight_of(one, (0.0, 0.01, 2.0), (0.0, 0.0, 0.0), 32) for one in (before, detail.gaussians)]
    assert (lost[0] - lost[1]).abs().max() < 0.01
    kept = detail.cluster >= 0
    assert torch.equal(detail.gaussians.means[detail.cluster[kept]], before.means[kept])
    assert torch.equal(detail.gather(before.means), detail.gaussians.means)
    assert torch.equal(detail.spread(torch.ones(len(detail.gaussians))), kept.float())


def test_two_steps_are_one():
    before = corner_of_walls(spacing=0.04)
    seen = prune_unseen(before, [view((1.5, 1.0, 1.5), (0.0, 1.0, 0.0))])
    merged = level_of_detail(seen.gaussians, torch.tensor([[1.5, 1.0, 1.5]]), pixel=2 * PIXEL, margin=0.0)
    both = seen.then(merged)
    values = torch.rand(len(before), 3, generator=torch.Generator().manual_seed(0))
    assert len(both.gaussians) < len(seen.gaussians) < len(before)
    torch.testing.assert_close(both.gather(values), merged.gather(seen.gather(values)))
    assert torch.equal(both.spread(both.gaussians.means), seen.spread(merged.spread(both.gaussians.means)))


def test_pruning_refuses_what_it_cannot_judge():
    gaussians, views = wall(0.5), [view((0.0, 0.01, 2.0), (0.0, 0.0, 0.0))]
    with pytest.raises(InputError, match="at least one view; got none"):
        prune_unseen(gaussians, [])
    with pytest.raises(InputError, match="keep_weight must be above 0 and at most 1; got 0"):
        prune_unseen(gaussians, views, keep_weight=0.0)
    with pytest.raises(InputError, match="no view shows any of the"):
        prune_unseen(gaussians, [view((0.0, 0.01, 2.0), (0.0, 0.0, 4.0))])
