import math

import pytest
import torch

from rf3dgs.core.errors import InputError, TrainingError
from rf3dgs.splats.density import Change, DensityState, densify, grow, prune, reset_opacity, scene_extent
from rf3dgs.splats.gaussians import Gaussians


def scene(*scales: float) -> tuple[Gaussians, DensityState]:
    """Gaussians with the given largest scales, all of them drawn once with a gradient over the threshold."""
    cloud = Gaussians.random(len(scales), (0, 0, 0), (10, 10, 10), degree=1, seed=0)
    tensors = cloud.tensors()
    tensors["log_scales"] = torch.log(torch.tensor(scales))[:, None] + torch.tensor([0.0, -0.5, -1.0])
    state = DensityState(len(scales))
    state.observe(torch.full((len(scales), 2), 1e-3), torch.ones(len(scales)), 2, 2)
    return Gaussians.from_tensors(tensors), state


def generator(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def test_gradients_are_measured_in_half_pictures_and_averaged_over_the_views_that_drew() -> None:
    state = DensityState(3)
    state.observe(torch.tensor([[3e-5, 0.0], [0.0, 1e-5], [1.0, 1.0]]), torch.tensor([4.0, 2.0, 0.0]), 200, 100)
    state.observe(torch.tensor([[1e-5, 0.0], [0.0, 5.0], [1.0, 1.0]]), torch.tensor([1.0, 0.0, 0.0]), 200, 100)
    assert torch.allclose(state.mean_gradient, torch.tensor([2e-3, 5e-4, 0.0]))
    assert state.radius.tolist() == [4.0, 2.0, 0.0]


def test_the_threshold_does_not_depend_on_the_resolution() -> None:
    coarse, fine = DensityState(1), DensityState(1)
    coarse.observe(torch.tensor([[4e-5, 4e-5]]), torch.ones(1), 100, 100)
    fine.observe(torch.tensor([[2e-5, 2e-5]]), torch.ones(1), 200, 200)
    assert torch.allclose(coarse.mean_gradient, fine.mean_gradient)


def test_small_ones_are_cloned_in_place_and_keep_their_optimiser_state() -> None:
    gaussians, state = scene(0.05, 0.05)
    state.gradient[1] = 0
    change = grow(gaussians, state, extent=10.0, generator=generator())
    assert change.source.tolist() == [0, 1, 0]
    assert change.fresh.tolist() == [False, False, True]
    for name, tensor in change.gaussians.tensors().items():
        assert torch.equal(tensor, gaussians.tensors()[name][[0, 1, 0]]), name
    assert change.follow(torch.tensor([[5.0], [7.0]])).flatten().tolist() == [5.0, 7.0, 0.0]


def test_large_ones_are_replaced_by_two_1_6_times_smaller() -> None:
    gaussians, state = scene(0.5, 0.05)
    state.gradient[1] = 0
    change = grow(gaussians, state, extent=10.0, generator=generator())
    assert change.source.tolist() == [1, 0, 0]
    assert change.fresh.tolist() == [False, True, True]
    assert torch.allclose(change.gaussians.scales[1:], gaussians.scales[[0, 0]] / 1.6)
    assert torch.equal(change.gaussians.logit_opacities[1:], gaussians.logit_opacities[[0, 0]])
    assert not torch.equal(change.gaussians.means[1], change.gaussians.means[2])


def test_the_limit_between_clone_and_split_is_a_hundredth_of_the_extent() -> None:
    gaussians, state = scene(0.099, 0.101)
    change = grow(gaussians, state, extent=10.0, generator=generator())
    assert change.source.tolist() == [0, 0, 1, 1]


def test_parts_of_a_split_are_drawn_from_the_gaussian_itself() -> None:
    count = 4000
    gaussians, _ = scene(0.5)
    many = gaussians.subset(torch.zeros(count, dtype=torch.long))
    state = DensityState(count)
    state.observe(torch.ones(count, 2), torch.ones(count), 2, 2)
    parts = grow(many, state, extent=1.0, generator=generator(5)).gaussians.means - gaussians.means
    from rf3dgs.core.frames import matrix_from_quaternion

    rotation = matrix_from_quaternion(gaussians.quats[0])
    local = parts @ rotation / gaussians.scales[0]
    assert len(local) == 2 * count
    assert float(local.mean(0).abs().max()) < 4 / math.sqrt(2 * count)
    assert torch.allclose(local.T @ local / len(local), torch.eye(3), atol=0.1)


def test_the_same_seed_grows_the_same_gaussians() -> None:
    gaussians, state = scene(0.5, 0.5, 0.05)
    first, again, other = (
        grow(gaussians, state, extent=10.0, generator=generator(s)).gaussians.means for s in (1, 1, 2)
    )
    assert torch.equal(first, again)
    assert not torch.equal(first, other)


def test_the_cap_lets_the_largest_gradients_grow_first() -> None:
    gaussians, state = scene(0.05, 0.5, 0.05, 0.05)
    state.gradient = torch.tensor([1e-3, 4e-3, 3e-3, 2e-3])
    change = grow(gaussians, state, extent=10.0, generator=generator(), max_count=6)
    assert len(change.gaussians) == 6
    assert change.source.tolist() == [0, 2, 3, 2, 1, 1]
    full = grow(gaussians, state, extent=10.0, generator=generator(), max_count=3)
    assert full.source.tolist() == [0, 1, 2, 3]


def test_pruning_removes_the_faint_the_wide_and_the_near_ones() -> None:
    gaussians, state = scene(0.05, 0.05, 2.0, 0.05)
    gaussians.logit_opacities[1] = math.log(0.004 / 0.996)
    state.radius[3] = 50
    assert prune(gaussians, state).source.tolist() == [0, 2, 3]
    change = prune(gaussians, state, largest_scale=1.0, largest_radius=20)
    assert change.source.tolist() == [0]
    assert change.fresh.tolist() == [False]
    assert torch.equal(change.gaussians.means, gaussians.means[:1])


def test_pruning_everything_stops_training() -> None:
    gaussians, _ = scene(0.05, 0.05)
    gaussians.logit_opacities[:] = -10
    with pytest.raises(TrainingError, match="pruning would remove all 2 Gaussians"):
        prune(gaussians)


def test_densify_is_growing_then_pruning() -> None:
    gaussians, state = scene(0.05, 0.5, 0.05)
    gaussians.logit_opacities[0] = -9
    state.gradient[2] = 0
    change = densify(gaussians, state, extent=10.0, generator=generator())
    assert change.source.tolist() == [2, 1, 1]
    assert change.fresh.tolist() == [False, True, True]
    assert torch.equal(change.gaussians.sh, gaussians.sh[change.source])


def test_two_changes_compose() -> None:
    gaussians, _ = scene(1.0, 1.0, 1.0)
    first = Change(gaussians, torch.tensor([4, 2, 4]), torch.tensor([False, False, True]))
    later = Change(gaussians.subset(torch.tensor([2, 1])), torch.tensor([2, 1]), torch.tensor([False, True]))
    both = first.then(later)
    assert both.source.tolist() == [4, 2]
    assert both.fresh.tolist() == [True, True]


def test_opacity_reset_only_lowers() -> None:
    gaussians, _ = scene(1.0, 1.0)
    gaussians.logit_opacities[:] = torch.tensor([3.0, -8.0])
    reset = reset_opacity(gaussians)
    assert torch.allclose(reset.opacities, torch.tensor([0.01, torch.sigmoid(torch.tensor(-8.0))]))
    assert torch.equal(gaussians.logit_opacities, torch.tensor([3.0, -8.0]))


def test_the_state_survives_a_checkpoint_and_refuses_other_gaussians() -> None:
    gaussians, state = scene(1.0, 1.0)
    again = DensityState.from_tensors(state.tensors())
    assert torch.equal(again.mean_gradient, state.mean_gradient)
    with pytest.raises(
        InputError, match=r"must belong to these 1 Gaussians; it has 2\. Make a new one after each change"
    ):
        grow(gaussians.subset(torch.tensor([0])), state, extent=1.0, generator=generator())
    with pytest.raises(InputError, match=r"screen_gradient must be \[2, 2\]"):
        state.observe(torch.zeros(3, 2), torch.zeros(3), 10, 10)


def test_scene_extent_is_the_reach_of_the_cameras() -> None:
    assert scene_extent(torch.tensor([[1.0, 0, 0], [-1.0, 0, 0]])) == pytest.approx(1.1)
    assert scene_extent(torch.zeros(1, 3)) == pytest.approx(1.1)
