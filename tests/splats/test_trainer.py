"""The trainer: native against its specification, and its laws."""

import math

import pytest
import torch
from torch import Tensor

from rf3dgs.core.errors import InputError
from rf3dgs.core.frames import Pose
from rf3dgs.core.grids import Camera, equirect_grid, pinhole_grid, view_of
from rf3dgs.splats.compositing import Compositing
from rf3dgs.splats.constants import BLUR
from rf3dgs.splats.density import Change
from rf3dgs.splats.draw import draw
from rf3dgs.splats.gaussians import Gaussians
from rf3dgs.splats.image_loss import l1_ssim
from rf3dgs.splats.rates import Rates
from rf3dgs.splats.target import Target
from rf3dgs.splats.trainer import Trainer

EVERYTHING = ("geometry", "opacity", "sh")
RATES = Rates(means=2e-3, quats=3e-3, log_scales=4e-3, logit_opacities=2e-2, level=1e-2, bands=5e-3)
WINDOW = Compositing(transfer="db_window", floor_db=-20.0, ceil_db=5.0)
MOVED = {"geometry": ("means", "quats", "log_scales"), "opacity": ("logit_opacities",), "sh": ("sh",)}


def cloud(count: int = 80, channels: int = 1, degree: int = 3, seed: int = 0) -> dict[str, Tensor]:
    generator = torch.Generator().manual_seed(seed)
    gaussians = Gaussians.random(count, (-1, -1, -1), (1, 1, 1), channels=channels, degree=degree, seed=seed)
    tensors = gaussians.tensors()
    tensors["sh"] = tensors["sh"] + 0.1 * torch.randn(tensors["sh"].shape, generator=generator)
    tensors["logit_opacities"] = torch.randn(count, generator=generator)
    return tensors


def cameras(count: int = 3, width: int = 45, height: int = 33, field: float = 40.0) -> list[Camera]:
    grid = pinhole_grid(width, height, field)
    around = [2 * math.pi * index / count for index in range(count)]
    return [Camera.of(Pose.look_at((3 * math.cos(a), 3 * math.sin(a), 0.7), (0.3, 0.0, 0.0)), grid) for a in around]


def target(channels: int, seed: int = 1, width: int = 45, height: int = 33) -> Target:
    generator = torch.Generator().manual_seed(seed)
    weight = torch.rand(height, width, generator=generator) + 0.2
    weight[10:14, 20:30] = 0.0
    return Target(torch.rand(height, width, channels, generator=generator), weight)


def pair(tensors: dict[str, Tensor], **options) -> tuple[Trainer, Trainer]:
    """The native trainer and the specification in double precision."""
    precise = {name: tensor.double() for name, tensor in tensors.items()}
    more = {name: value.double() if isinstance(value, Tensor) else value for name, value in options.items()}
    return Trainer(**tensors, **options, backend="native"), Trainer(**precise, **more, backend="reference")


def double(goal: Target) -> Target:
    return Target(goal.picture.double(), None if goal.weight is None else goal.weight.double())


def assert_same_movement(native: Trainer, precise: Trainer, start: dict[str, Tensor], bound: float) -> None:
    for name, found in native.tensors().items():
        expected = precise.tensors()[name] - start[name].double()
        error = (found.double() - start[name].double() - expected).norm()
        assert error <= bound * expected.norm() + 1e-12, f"{name}: {error / expected.norm():.1e}"


def assert_same_picture(found: Tensor, exact: Tensor) -> None:
    """Contributions at the cut of 1/255 may fall on either side."""
    error = (found - exact).abs()
    assert error.max() < 2e-2
    assert error.mean() < 3e-6


@pytest.mark.parametrize(("channels", "degree"), [(1, 3), (3, 3), (4, 1), (2, 2), (1, 0), (3, 1)])
@pytest.mark.parametrize("train", [("sh",), ("opacity", "sh"), EVERYTHING], ids=["sh", "frozen", "all"])
def test_steps_move_as_the_specification_says(channels: int, degree: int, train: tuple[str, ...]):
    start = cloud(channels=channels, degree=degree)
    native, precise = pair(start, train=train, eps=1e-4)
    goal = target(channels)
    for number in range(6):
        view = cameras()[number % 3]
        found = native.step(view, goal, RATES, shrink=0.01)
        expected = precise.step(view, double(goal), RATES, shrink=0.01)
        assert found == pytest.approx(expected, abs=2e-5)
    assert_same_movement(native, precise, start, 3e-3)


@pytest.mark.parametrize("train", [("opacity", "sh"), EVERYTHING])
def test_one_gradient_agrees_to_single_precision(train: tuple[str, ...]):
    """With a large eps, a first step is proportional to the gradient."""
    start = cloud(channels=3)
    native, precise = pair(start, train=train, eps=1e3)
    rates = Rates(*(1e3,) * 6)
    native.step(cameras()[0], target(3), rates)
    precise.step(cameras()[0], double(target(3)), rates)
    moved, expected = native.state(), precise.state()
    for group in train:
        for name in MOVED[group]:
            found = native._engine.read(f"first.{name}").double()
            exact = expected[f"first.{name}"]
            assert (found - exact).norm() <= 3e-4 * exact.norm(), name
    assert moved["numbers"].tolist()[0] == 1


def test_extra_channels_depth_and_background_are_drawn_and_trained_through():
    start, view = cloud(channels=2), cameras()[0]
    generator = torch.Generator().manual_seed(4)
    extra, background = torch.rand(80, 2, generator=generator), torch.rand(5, generator=generator)
    native, precise = pair(start, train=EVERYTHING, eps=1e-4)
    of_picture = torch.randn(33, 45, 5, generator=generator) / 1e3
    of_weight = torch.randn(33, 45, generator=generator) / 1e3
    for _ in range(3):
        drawn = native.draw(view, extra=extra, depth=True, background=background)
        exact = precise.draw(view, extra=extra.double(), depth=True, background=background.double())
        assert_same_picture(drawn.values, exact.values)
        assert (drawn.radii - exact.radii).abs().max() < 1e-2
        native.update(of_picture, RATES, weight_gradient=of_weight)
        precise.update(of_picture.double(), RATES, weight_gradient=of_weight.double())
    assert_same_movement(native, precise, start, 3e-3)


@pytest.mark.parametrize("blur", [BLUR, 3.0])
@pytest.mark.parametrize("normalise", [False, True])
@pytest.mark.parametrize("transfer", ["identity", "db_window", ("db_window", "identity", "db_window")])
def test_finished_pictures_and_their_gradients_agree(normalise: bool, transfer, blur: float):
    start, view = cloud(channels=3), cameras()[1]
    how = Compositing(normalise=normalise, transfer=transfer, floor_db=-20.0, ceil_db=5.0, blur=blur)
    native, precise = pair(start, train=EVERYTHING, eps=1e-4)
    generator = torch.Generator().manual_seed(5)
    added = 0.3 * torch.rand(33, 45, 3, generator=generator)
    gradient = torch.randn(33, 45, 3, generator=generator) / 1e3
    for _ in range(3):
        found = native.draw(view, compositing=how, added=added).values
        exact = precise.draw(view, compositing=how, added=added.double()).values
        assert_same_picture(found, exact)
        native.update(gradient, RATES)
        precise.update(gradient.double(), RATES)
    assert_same_movement(native, precise, start, 5e-3)


def test_base_and_distance_are_added_before_the_cut():
    start = cloud(channels=4, degree=1)
    base, along = torch.randn(80, 4, generator=torch.Generator().manual_seed(6)), torch.tensor([0.3, 0.0, -0.2, 0.1])
    native, precise = pair(start, train=("sh",), base=base, along=along, offset=0.1, eps=1e-4)
    for view in cameras():
        assert_same_picture(native.draw(view).values, precise.draw(view).values)
        native.step(view, target(4), RATES)
        precise.step(view, double(target(4)), RATES)
    assert_same_movement(native, precise, start, 3e-3)


@pytest.mark.parametrize("backend", ["native", "reference"])
def test_gaussians_that_a_view_does_not_draw_keep_parameters_and_moments(backend):
    start = cloud(channels=3)
    trainer = Trainer(**start, train=EVERYTHING, backend=backend)
    views = [
        Camera.of(Pose.look_at((0.0, 0.0, 0.0), towards), pinhole_grid(45, 33, 50))
        for towards in ((1, 0, 0), (-1, 0, 0))
    ]
    trainer.step(views[0], target(3), RATES)
    names = [name for name in trainer.state() if name not in ("numbers", "order")]
    before = {name: trainer._engine.read(name) for name in names}
    unseen = trainer.draw(views[1]).radii == 0
    assert 10 < int(unseen.sum()) < 70
    trainer.step(views[1], target(3), RATES)
    for name in names:
        after = trainer._engine.read(name)
        assert torch.equal(after[unseen], before[name][unseen]), name
        assert not torch.equal(after[~unseen], before[name][~unseen]), name


def test_what_is_frozen_does_not_change_a_bit():
    start = cloud()
    trainer = Trainer(**start, train=("opacity",))
    for view in cameras():
        trainer.step(view, target(1), RATES)
    found = trainer.tensors()
    for name in ("means", "quats", "log_scales", "sh"):
        assert torch.equal(found[name], start[name])
    assert not torch.equal(found["logit_opacities"], start["logit_opacities"])


@pytest.mark.parametrize("how", [Compositing(), Compositing(normalise=True), Compositing(blur=3.0), WINDOW])
def test_a_step_is_drawing_loss_and_update_bit_by_bit(how: Compositing):
    whole, parts = (Trainer(**cloud(channels=3), train=EVERYTHING) for _ in range(2))
    for view in cameras():
        goal = target(3)
        found = whole.step(view, goal, RATES, shrink=0.1, compositing=how)
        picture = parts.draw(view, compositing=how).values.requires_grad_()
        loss = l1_ssim(picture, goal.picture, weight=goal.weight)
        (gradient,) = torch.autograd.grad(loss, picture)
        addition = parts.update(gradient, RATES, shrink=0.1)
        assert found == pytest.approx(loss.item() + addition, rel=1e-6)
    for name, tensor in whole.tensors().items():
        assert torch.equal(tensor, parts.tensors()[name]), name


def test_results_do_not_depend_on_the_number_of_threads(monkeypatch):
    results = []
    for threads in ("1", "2"):
        monkeypatch.setenv("RF3DGS_THREADS", threads)
        trainer = Trainer(**cloud(5000, channels=3), train=EVERYTHING)
        losses = [trainer.step(view, target(3), RATES, shrink=0.1, compositing=WINDOW) for view in cameras()]
        results.append((losses, trainer.tensors(), trainer.density().tensors()))
    assert results[0][0] == results[1][0]
    for group in (1, 2):
        for name, tensor in results[0][group].items():
            assert torch.equal(tensor, results[1][group][name]), name


@pytest.mark.parametrize("moments", ["float32", "bfloat16"])
@pytest.mark.parametrize("backend", ["native", "reference"])
def test_a_resumed_run_ends_with_the_same_bits(moments, backend):
    options = {"train": EVERYTHING, "moments": moments, "backend": backend, "betas": (0.9, 0.99)}
    calm, killed = (Trainer(**cloud(channels=3, degree=2), **options) for _ in range(2))
    views, goal = cameras(), target(3)
    for view in views:
        calm.step(view, goal, RATES)
        killed.step(view, goal, RATES)
    saved = {name: tensor.clone() for name, tensor in killed.state().items()}
    killed.step(views[0], goal, RATES)
    fresh = Trainer(**cloud(channels=3, degree=2), **options)
    fresh.restore(saved)
    for resumed in (Trainer.resume(saved, **options), fresh):
        for view in views:
            resumed.step(view, goal, RATES)
    for view in views:
        calm.step(view, goal, RATES)
    for other in (resumed, fresh):
        for name, tensor in calm.state().items():
            assert torch.equal(tensor, other.state()[name]), name


def test_halved_moments_train_nearly_as_well():
    views, goal = cameras(), Target(torch.full((33, 45, 1), 0.4))
    losses = []
    for moments in ("float32", "bfloat16"):
        trainer = Trainer(**cloud(), betas=(0.9, 0.99), moments=moments)
        losses.append([trainer.step(views[number % 3], goal, RATES) for number in range(60)])
    assert losses[0][-1] < 0.5 * losses[0][0]
    assert losses[1][-1] == pytest.approx(losses[0][-1], rel=0.1)


@pytest.mark.parametrize("backend", ["native", "reference"])
def test_a_trainer_beside_another_sees_its_opacities(backend):
    start, view = cloud(), cameras()[0]
    first = Trainer(**start, backend=backend)
    second = first.beside(torch.ones(80, 1, 2), offset=0.0)
    before = second.draw(view).weight
    still = first.tensors()["sh"]
    second.step(view, target(2), RATES)
    assert torch.equal(first.tensors()["sh"], still)
    first.step(view, target(1), RATES)
    after = second.draw(view).weight
    assert not torch.equal(before, after)
    assert torch.equal(after, first.draw(view).weight)


@pytest.mark.parametrize("backend", ["native", "reference"])
def test_moments_follow_a_changed_population(backend):
    trainer = Trainer(**cloud(channels=3), train=EVERYTHING, backend=backend)
    for view in cameras():
        trainer.step(view, target(3), RATES)
    before = {name: trainer._engine.read(f"first.{name}") for name in trainer.tensors()}
    gaussians, source = trainer.gaussians(), torch.tensor([5, 3, 70, 70, 12])
    fresh = torch.tensor([False, False, False, True, False])
    trainer.follow(Change(gaussians.subset(source), source, fresh))
    assert len(trainer) == 5
    for name, tensor in trainer.tensors().items():
        assert torch.equal(tensor, gaussians.tensors()[name][source])
        expected = before[name][source] * (~fresh).reshape(-1, *[1] * (before[name].dim() - 1))
        assert torch.equal(trainer._engine.read(f"first.{name}"), expected)
    assert float(trainer.density().seen.sum()) == 0
    assert trainer.steps == 3
    trainer.step(cameras()[0], target(3), RATES)


def test_density_statistic_agrees_with_the_specification():
    native, precise = pair(cloud(channels=3), train=EVERYTHING, eps=1e-4)
    for view in cameras():
        native.step(view, target(3), RATES)
        precise.step(view, double(target(3)), RATES)
    for name, found in native.density().tensors().items():
        exact = precise.density().tensors()[name]
        assert (found - exact).norm() <= 1e-3 * exact.norm(), name


@pytest.mark.parametrize("backend", ["native", "reference"])
def test_a_lower_degree_leaves_the_higher_coefficients_alone(backend):
    start = cloud(channels=3)
    trainer = Trainer(**start, backend=backend)
    low = Trainer(**start | {"sh": start["sh"][:, :4]}, backend=backend)
    trainer.degree = 1
    for view in cameras():
        assert trainer.step(view, target(3), RATES) == pytest.approx(low.step(view, target(3), RATES), rel=1e-6)
    sh = trainer.tensors()["sh"]
    assert torch.equal(sh[:, 4:], start["sh"][:, 4:])
    assert (sh[:, :4] - low.tensors()["sh"]).abs().max() < 1e-5
    trainer.degree = 3
    trainer.step(cameras()[0], target(3), RATES)
    assert not torch.equal(trainer.tensors()["sh"][:, 4:], start["sh"][:, 4:])


def test_an_assigned_parameter_begins_anew():
    trainer = Trainer(**cloud(), train=("opacity", "sh"))
    trainer.step(cameras()[0], target(1), RATES)
    trainer.assign("logit_opacities", torch.full((80,), -2.0))
    assert torch.equal(trainer.tensors()["logit_opacities"], torch.full((80,), -2.0))
    assert float(trainer._engine.read("first.logit_opacities").abs().sum()) == 0
    assert float(trainer._engine.read("first.sh").abs().sum()) > 0
    same = Trainer(**trainer.tensors())
    assert torch.equal(trainer.draw(cameras()[0]).values, same.draw(cameras()[0]).values)


def test_broken_gaussians_are_neither_drawn_nor_moved():
    start = cloud(channels=3)
    start["sh"][7, 0, 1], start["means"][8, 2], start["quats"][9] = math.nan, math.inf, 0.0
    trainer = Trainer(**start, train=EVERYTHING)
    for view in cameras():
        assert math.isfinite(trainer.step(view, target(3), RATES))
    for name, tensor in trainer.tensors().items():
        assert torch.equal(tensor[7:10].nan_to_num(), start[name][7:10].nan_to_num()), name
        assert bool(torch.isfinite(tensor[10:]).all())


def test_no_gaussians_and_one_pixel_are_enough():
    nobody = {name: tensor[:0] for name, tensor in cloud().items()}
    trainer = Trainer(**nobody)
    assert trainer.step(cameras()[0], target(1), RATES) > 0
    single = Trainer(**cloud(1))
    assert math.isfinite(single.step(cameras(width=1, height=1)[0], Target(torch.ones(1, 1, 1)), RATES))


def test_wrong_wishes_are_named():
    start, view = cloud(channels=3), cameras()[0]
    trainer = Trainer(**start, train=EVERYTHING)
    with pytest.raises(InputError, match="train takes geometry, opacity, sh; got colour"):
        Trainer(**start, train=("colour",))
    with pytest.raises(InputError, match="sh must be"):
        Trainer(**start | {"sh": start["sh"][:, :, 0]})
    with pytest.raises(InputError, match="means must be"):
        Trainer(**start | {"means": start["means"].mT})
    with pytest.raises(InputError, match="draw first"):
        trainer.update(torch.zeros(33, 45, 3), RATES)
    with pytest.raises(InputError, match=r"the target must be \[33, 45, 3\]"):
        trainer.step(view, target(1), RATES)
    with pytest.raises(InputError, match="level must be one rate or one for each of 3 channels; got 2"):
        trainer.step(view, target(3), Rates(level=(1.0, 2.0)))
    with pytest.raises(InputError, match="geometry is trained on cameras"):
        trainer.step(view_of(view.pose, equirect_grid(32, 16)), Target(torch.zeros(16, 32, 3)), RATES)
    with pytest.raises(InputError, match="nothing is trained"):
        Trainer(**start, train=()).step(view, target(3), RATES)
    with pytest.raises(InputError, match="all pixels are masked"):
        Target(torch.zeros(4, 4, 1), torch.zeros(4, 4))
    with pytest.raises(InputError, match="other names"):
        trainer.restore({"numbers": torch.zeros(4)})


@pytest.mark.parametrize(("channels", "degree"), [(1, 3), (3, 3), (4, 1), (3, 0), (2, 2)])
def test_drawing_alone_is_what_a_trainer_draws(channels: int, degree: int):
    start, view = cloud(channels=channels, degree=degree), cameras()[0]
    extra, background = torch.rand(80, 1, generator=torch.Generator().manual_seed(8)), torch.full((channels + 2,), 0.3)
    options = {"extra": extra, "depth": True, "background": background}
    found = draw(Gaussians(**start), view, **options)
    kept = Trainer(**start, train=()).draw(view, **options)
    exact = draw(Gaussians(**start), view, backend="reference", **options)
    assert (found.values - kept.values).abs().max() < 1e-5
    assert torch.equal(found.radii, kept.radii)
    assert_same_picture(found.values, exact.values)


@pytest.mark.parametrize(("channels", "train", "expected"), [(1, ("opacity", "sh"), 265.25), (3, EVERYTHING, 740)])
def test_memory_of_a_gaussian_is_as_stated(channels: int, train: tuple[str, ...], expected: float):
    engine = Trainer(**cloud(256, channels=channels), train=train, backend="native")._engine
    tensors = [*engine.memory.values(), *engine._activated.values()]
    assert sum(tensor.nbytes for tensor in tensors) == 256 * expected


def room(count: int = 3000, seed: int = 4) -> dict[str, Tensor]:
    """A cloud of 20 m, in which a view sees little, of which some are large, some broken and some far away."""
    tensors = cloud(count, seed=seed)
    tensors["means"] = tensors["means"] * 10.0
    tensors["log_scales"] = tensors["log_scales"] - 2.0
    tensors["log_scales"][::97] = 0.5
    tensors["means"][::101, 0], tensors["means"][::103, 1] = math.nan, 1e6
    return tensors


def test_groups_left_out_by_their_bounds_would_not_have_been_drawn():
    start, grid = room(), pinhole_grid(61, 45, 70.0)
    resting = Trainer(**start, train=("sh",), backend="native")
    moving = Trainer(**start, train=("geometry", "sh"), backend="native")
    generator = torch.Generator().manual_seed(5)
    for _ in range(12):
        place, ahead = (torch.rand(3, generator=generator) * 24 - 12 for _ in range(2))
        view = Camera.of(Pose.look_at(tuple(place.tolist()), tuple(ahead.tolist())), grid)
        for found, exact in zip(resting.draw(view).__dict__.values(), moving.draw(view).__dict__.values(), strict=True):
            assert torch.equal(found, exact)


def test_bounds_follow_means_that_are_assigned():
    start, view = room(), cameras()[0]
    resting, other = Trainer(**start, train=("sh",)), room(seed=9)
    beside = resting.beside(start["sh"])
    for name in ("means", "log_scales"):
        resting.assign(name, other[name])
    exact = Trainer(**start | {name: other[name] for name in ("means", "log_scales")}, train=("geometry", "sh"))
    expected = exact.draw(view).values
    assert float(expected.std()) > 0.01
    assert torch.equal(beside.draw(view).values.isfinite(), expected.isfinite())
    assert_same_picture(resting.draw(view).values, expected)
    assert_same_picture(beside.draw(view).values, expected)
