import math

import numpy as np
import pytest
import torch

from rf3dgs.core.errors import InputError, TrainingError
from rf3dgs.splats.gaussians import Gaussians


def cloud(count: int = 20, **options: int) -> Gaussians:
    return Gaussians.random(count, (0, 0, 0), (2, 3, 4), **options)


def test_a_random_cloud_fills_its_box_and_is_sound() -> None:
    many = cloud(5000, seed=1)
    many.check()
    assert bool((many.means >= 0).all())
    assert bool((many.means <= torch.tensor([2.0, 3.0, 4.0])).all())
    assert torch.allclose(many.means.mean(0), torch.tensor([1.0, 1.5, 2.0]), atol=0.05)
    assert torch.allclose(many.opacities, torch.tensor(0.1))
    assert (len(many), many.degree, many.channels) == (5000, 3, 3)


def test_the_same_seed_gives_the_same_cloud() -> None:
    for name, tensor in cloud(seed=1).tensors().items():
        assert torch.equal(tensor, cloud(seed=1).tensors()[name]), name
    assert not torch.equal(cloud(seed=1).means, cloud(seed=2).means)


def test_tensors_are_contiguous_float32_whatever_comes_in() -> None:
    one = cloud(4, degree=1)
    tensors = {name: tensor.double().numpy() for name, tensor in one.tensors().items()}
    tensors["means"] = np.asfortranarray(tensors["means"])
    again = Gaussians.from_tensors(tensors)
    for name, tensor in again.tensors().items():
        assert tensor.dtype == torch.float32
        assert tensor.is_contiguous()
        assert torch.equal(tensor, one.tensors()[name])


def test_leaves_of_an_optimiser_are_kept_as_they_are() -> None:
    tensors = {name: tensor.requires_grad_() for name, tensor in cloud().tensors().items()}
    held = Gaussians.from_tensors(tensors)
    assert all(held.tensors()[name] is tensor for name, tensor in tensors.items())
    assert not any(tensor.requires_grad for tensor in held.detach().tensors().values())


def test_activations_undo_the_raw_form() -> None:
    one = cloud(3)
    one.log_scales[0, 0] = math.log(0.25)
    one.logit_opacities[1] = math.log(0.8 / 0.2)
    assert float(one.scales[0, 0]) == pytest.approx(0.25)
    assert float(one.opacities[1]) == pytest.approx(0.8)


def test_subset_and_join_are_inverse() -> None:
    one = cloud(10)
    mask = torch.arange(10) < 4
    joined = Gaussians.join([one.subset(mask), one.subset((~mask).nonzero().squeeze(-1))])
    for name, tensor in one.tensors().items():
        assert torch.equal(tensor, joined.tensors()[name]), name


def test_points_become_round_gaussians_of_their_colour_and_spacing() -> None:
    axis = torch.arange(4.0)
    points = torch.cartesian_prod(axis, axis, axis)
    grown = Gaussians.from_points(points, torch.tensor([1.0, 0.5, 0.0]).expand(64, 3), degree=2)
    assert torch.allclose(grown.scales, torch.ones(64, 3), atol=1e-5)
    assert torch.allclose(grown.sh[:, 0] * 0.28209479 + 0.5, torch.tensor([1.0, 0.5, 0.0]), atol=1e-6)
    assert int(grown.sh[:, 1:].count_nonzero()) == 0
    twins = Gaussians.from_points(torch.zeros(5, 3))
    twins.check()


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("means", torch.nan, "means must be finite; 1 of 20 Gaussians have NaN or infinity"),
        ("sh", torch.inf, "sh must be finite; 1 of 20"),
        ("log_scales", 50.0, "log_scales must stay below 10000 m; 1 of 20 Gaussians do not"),
        ("logit_opacities", 1e6, r"logit_opacities must stay within \+-100; 1 of 20"),
    ],
)
def test_a_bad_value_names_its_tensor(name: str, value: float, message: str) -> None:
    bad = cloud()
    bad.tensors()[name].view(20, -1)[7, 0] = value
    with pytest.raises(InputError, match=message + ".*mend the file"):
        bad.check()
    with pytest.raises(TrainingError, match=message + ".*lower the learning rate"):
        bad.check(source="training")


def test_a_zero_quaternion_and_an_empty_scene_are_refused() -> None:
    bad = cloud()
    bad.quats[3] = 0
    with pytest.raises(InputError, match="quats must not be zero; 1 of 20"):
        bad.check()
    with pytest.raises(InputError, match="at least one Gaussian"):
        bad.subset(torch.zeros(20, dtype=torch.bool)).check()


def test_wrong_shapes_say_what_was_expected() -> None:
    tensors = cloud().tensors()
    with pytest.raises(InputError, match=r"means must be \[gaussian, 3\] for 3 Gaussians; got \[3, 20\]\. Transpose"):
        Gaussians.from_tensors(tensors | {"means": tensors["means"].mT})
    with pytest.raises(InputError, match=r"sh must be \[gaussian, k, channel\] for 20 Gaussians"):
        Gaussians.from_tensors(tensors | {"sh": tensors["sh"][:5]})
    with pytest.raises(InputError, match="1, 4, 9 or 16 coefficients; got 5"):
        Gaussians.from_tensors(tensors | {"sh": tensors["sh"][:, :5]})
    with pytest.raises(InputError, match="missing: quats"):
        Gaussians.from_tensors({name: tensor for name, tensor in tensors.items() if name != "quats"})
