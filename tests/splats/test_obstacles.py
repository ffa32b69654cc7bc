"""The obstacles against their specification, and the laws that hold for any way to compute them."""

import copy
import math
import pickle
import time
from dataclasses import replace
from typing import Any

import pytest
import torch
from torch import Tensor

from rf3dgs.core.errors import InputError
from rf3dgs.core.native import native_core
from rf3dgs.splats.gaussians import Gaussians
from rf3dgs.splats.obstacles import Obstacles, visibility_of
from rf3dgs.splats.surface import sample_mesh
from rf3dgs.splats.transmittance import segment_transmittance

THINNEST = 1e-3  # m: thinnest Gaussians of random scenes
# Float32 keeps points ten metres apart to about 2e-6 m; a Gaussian of THINNEST turns that into 2e-3 standard
# deviations, by which exp(-d^2 / 2) changes by at most 0.61 x 2e-3. Where less than 1e-4 passes the core may stop.
TOLERANCE = 2e-3
Cloud = tuple[Tensor, Tensor, Tensor, Tensor]


def scattered(low: list[float], high: list[float], count: int, seed: int) -> Tensor:
    corner, other = torch.tensor(low), torch.tensor(high)
    return corner + (other - corner) * torch.rand(count, 3, generator=torch.Generator().manual_seed(seed))


def plate(x: float, spacing: float = 0.08) -> Gaussians:
    """A wall of 4 m x 3 m across the x axis."""
    corners = torch.tensor([[x, -2.0, 0.0], [x, 2.0, 0.0], [x, 2.0, 3.0], [x, -2.0, 3.0]])
    return sample_mesh(corners, torch.tensor([[0, 1, 2], [0, 2, 3]]), spacing=spacing)


def obstacles_of(cloud: Gaussians, labels: Tensor | None = None, **options: float) -> Obstacles:
    return Obstacles(cloud.means, cloud.quats, cloud.scales, cloud.opacities, labels, **options)


def exact(of: Obstacles, start: Tensor, end: Tensor) -> Tensor:
    """What the specification says in double precision."""
    means, quats, scales, opacities = (part.double() for part in (of.means, of.quats, of.scales, of.opacities))
    return segment_transmittance(means, quats, scales, opacities, start.double(), end.double())


def random_scene(seed: int, count: int) -> tuple[Cloud, Tensor, Tensor, Tensor, dict[str, Any]]:
    """Balls, needles and pancakes of all sizes (activated), their labels, segments and what these skip."""
    generator = torch.Generator().manual_seed(seed)

    def uniform(*shape: int) -> Tensor:
        return torch.rand(*shape, generator=generator)

    scales = THINNEST * torch.exp(math.log(800.0) * uniform(count, 3))
    opacities = uniform(count) * 1.1
    cloud = (10 * uniform(count, 3) - 5, torch.randn(count, 4, generator=generator), scales, opacities)
    labels = torch.randint(-1, 5, (count,), generator=generator)
    start, end = 12 * uniform(300, 3) - 6, 12 * uniform(300, 3) - 6
    end[:40] = start[:40] + 0.3 * torch.randn(40, 3, generator=generator)
    end[40:60, :2] = start[40:60, :2]
    end[60:80] = cloud[0][torch.randint(count, (20,), generator=generator)]
    skips = torch.randint(-3, 5, (2, 300), generator=generator)
    return cloud, labels, start, end, {"skip_start": skips[0], "skip_end": skips[1]}


@pytest.mark.parametrize(("seed", "count"), [(0, 1), (1, 16), (2, 17), (3, 300), (4, 3000), (5, 3000)])
def test_the_core_agrees_with_the_specification(seed: int, count: int) -> None:
    cloud, labels, start, end, skips = random_scene(seed, count)
    means, quats, scales, opacities = (tensor.double() for tensor in cloud)
    for stop_short in (0.0, 0.1, 0.7):
        for chosen in ({}, skips):
            passed = Obstacles(*cloud, labels).transmittance(start, end, stop_short=stop_short, **chosen)
            expected = segment_transmittance(
                *(means, quats, scales, opacities, start.double(), end.double()),
                labels=labels,
                stop_short=stop_short,
                **chosen,
            )
            torch.testing.assert_close(passed.double(), expected, atol=TOLERANCE, rtol=0)
    if count >= 3000:
        assert 0.1 < float((expected > 0.5).double().mean()) < 0.95


def test_the_core_is_exact_for_surfaces() -> None:
    """Sampled surfaces are 7 mm thick: positions good to 2e-6 m are 3e-4 standard deviations."""
    obstacles = two_plates()
    start, end = (
        scattered([0.0, -3.0, -1.0], [6.0, 3.0, 4.0], 400, 3),
        scattered([0.0, -3.0, -1.0], [6.0, 3.0, 4.0], 400, 4),
    )
    expected = exact(obstacles, start, end)
    torch.testing.assert_close(obstacles.transmittance(start, end).double(), expected, atol=3e-4, rtol=0)


def test_threads_and_batches_do_not_change_a_bit(monkeypatch: pytest.MonkeyPatch) -> None:
    cloud, labels, start, end, skips = random_scene(7, 2000)
    obstacles = Obstacles(*cloud, labels)
    answers = []
    for threads in ("1", "2"):
        monkeypatch.setenv("RF3DGS_THREADS", threads)
        answers.append(obstacles.transmittance(start, end, **skips))
    one_by_one = [
        obstacles.transmittance(
            start[i], end[i], skip_start=skips["skip_start"][i : i + 1], skip_end=skips["skip_end"][i : i + 1]
        )
        for i in range(0, 300, 7)
    ]
    assert torch.equal(answers[0], answers[1])
    assert torch.equal(torch.cat(one_by_one), answers[0][::7])
    assert torch.equal(Obstacles(*cloud, labels).transmittance(start, end, **skips), answers[0])


def test_what_goes_there_comes_back() -> None:
    cloud, _, start, end, _ = random_scene(8, 1000)
    obstacles = Obstacles(*cloud)
    there, back = obstacles.transmittance(start, end), obstacles.transmittance(end, start)
    torch.testing.assert_close(there, back, atol=TOLERANCE, rtol=0)


def test_damaged_gaussians_stop_nothing() -> None:
    cloud, _, start, end, _ = random_scene(9, 400)
    means, quats, scales, opacities = (tensor.clone() for tensor in cloud)
    clean = Obstacles(means[8:], quats[8:], scales[8:], opacities[8:]).transmittance(start, end)
    means[0, 1], means[1, 0], quats[2, 3], scales[3, 0] = math.nan, math.inf, math.nan, math.inf
    scales[4, 2], opacities[5], opacities[6], quats[7] = math.nan, math.nan, 0.29, 0.0
    passed = Obstacles(means, quats, scales, opacities).transmittance(start, end)
    torch.testing.assert_close(passed, clean, atol=1e-6, rtol=1e-5)
    expected = exact(Obstacles(means, quats, scales, opacities), start, end)
    torch.testing.assert_close(passed.double(), expected, atol=TOLERANCE, rtol=0)


def test_nothing_to_meet_and_nothing_to_pass() -> None:
    empty = Obstacles(torch.zeros(0, 3), torch.zeros(0, 4), torch.zeros(0, 3), torch.zeros(0))
    start, end = torch.zeros(3, 3), torch.tensor([[1.0, 0, 0], [math.nan, 0, 0], [0, 0, 0]])
    assert empty.transmittance(start, end).tolist() == [1.0, 0.0, 1.0]
    obstacles = two_plates()
    assert obstacles.transmittance(torch.zeros(0, 3), torch.zeros(0, 3)).shape == (0,)
    assert obstacles.soft(torch.zeros(0, 3), torch.zeros(0, 3)).shape == (0,)
    inside = obstacles.means[:5]
    assert obstacles.transmittance(inside, inside, stop_short=0.0).tolist() == [1.0] * 5
    assert obstacles.transmittance(inside, inside + 0.05).tolist() == [1.0] * 5
    far = torch.tensor([[1e4, 1e4, 1e4]])
    assert float(obstacles.transmittance(far, far + 3.0)) == 1.0


def test_one_huge_gaussian_blocks_and_one_point_does_not_disturb() -> None:
    means, quats = torch.tensor([[0.0, 0, 0], [5.0, 0.3, 0.0]]), torch.tensor([[1.0, 0, 0, 0]] * 2)
    scales, opacities = torch.tensor([[1e4, 1e4, 1e4], [0.0, 0.0, 0.0]]), torch.tensor([0.75, 1.0])
    start, end = torch.tensor([[-3.0, 0, 0], [0.0, 0.3, 0.0]]), torch.tensor([[3.0, 0, 0], [9.0, 0.3, 0.0]])
    passed = Obstacles(means, quats, scales, opacities).transmittance(start, end)
    assert float(passed[0]) == pytest.approx(0.25, abs=1e-5)
    assert float(passed[1]) == pytest.approx(0.0, abs=1e-3)


def test_the_gate_closes_behind_a_column() -> None:
    """A column of 0.3 m radius: what its circle hides is closed, what passes it by more than 5 cm is open."""
    angle = torch.linspace(0, 2 * math.pi, 25)[:-1]
    ring = 0.3 * torch.stack((torch.cos(angle), torch.sin(angle)), -1)
    low, high = (torch.cat((ring, torch.full((24, 1), z)), -1) for z in (0.0, 3.0))
    at, after = torch.arange(24), (torch.arange(24) + 1) % 24
    faces = torch.cat((torch.stack((at, after, after + 24), -1), torch.stack((at, after + 24, at + 24), -1)))
    obstacles = obstacles_of(sample_mesh(torch.cat((low, high)), faces, spacing=0.05))
    start = torch.tensor([[-3.0, 0.2, 1.5]]).expand(400, 3)
    end = scattered([1.0, -3.0, 0.5], [3.0, 3.0, 2.5], 400, 2)
    span = (end - start)[:, :2]
    across = (start[:, 0] * span[:, 1] - start[:, 1] * span[:, 0]).abs() / torch.linalg.vector_norm(span, dim=-1)
    for passed in (obstacles.transmittance(start, end), obstacles.soft(start, end, radius=0.02)):
        assert float(passed[across < 0.25].max()) < 0.1
        assert float(passed[across > 0.37].min()) > 0.9
    assert int((across < 0.25).sum()) > 20


def test_a_copy_answers_alike() -> None:
    cloud, labels, start, end, skips = random_scene(10, 200)
    obstacles = Obstacles(*cloud, labels, min_opacity=0.5)
    expected = obstacles.transmittance(start, end, **skips)
    for copied in (pickle.loads(pickle.dumps(obstacles)), copy.deepcopy(obstacles)):
        assert torch.equal(copied.transmittance(start, end, **skips), expected)


def test_a_few_segments_are_answered_at_once() -> None:
    assert native_core() is not None
    cloud, _, start, end, _ = random_scene(11, 3000)
    obstacles = Obstacles(*cloud)
    durations = []
    for _ in range(40):
        began = time.process_time()
        obstacles.transmittance(start[:100], end[:100])
        durations.append(time.process_time() - began)
    assert min(durations) < 1e-3


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
    passed = obstacles.soft(start, end, radius=0.05)
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


@pytest.mark.parametrize("seed", [0, 1])
def test_a_segment_that_is_known_to_be_free_is_cleared(seed: int) -> None:
    cloud, labels, start, end, skips = random_scene(seed, 200)
    obstacles = Obstacles(*cloud, labels)
    some = {name: skip[100:160] for name, skip in skips.items()}
    start, end = start[100:160], end[100:160]
    before = obstacles.transmittance(start, end, **some)
    every = torch.ones(len(start), dtype=torch.bool)
    cleared = obstacles.cleared(start, end, every, **some)
    after = cleared.transmittance(start, end, **some)
    assert float(before.min()) < 0.5
    assert bool((after >= before - TOLERANCE).all())
    # What is left of a Gaussian in the way is under the opacity that counts, or its rim stops a twentieth.
    assert float(after.min()) > 0.8
    assert bool((cleared.opacities <= obstacles.opacities).all())
    # Alone in its segment, a Gaussian in the middle of it keeps a twentieth, which counts as nothing.
    lump = Obstacles(torch.zeros(1, 3), torch.tensor([[1.0, 0, 0, 0]]), torch.full((1, 3), 0.1), torch.tensor([0.9]))
    ends, free = (torch.tensor([[-1.0, 0, 0]]), torch.tensor([[1.0, 0, 0]])), torch.tensor([True])
    assert float(lump.cleared(*ends, free).opacities) == pytest.approx(0.05, rel=1e-5)
    aside = torch.tensor([0.0, 0.2, 0.0])  # two standard deviations off: 0.05 / exp(-2)
    assert float(lump.cleared(ends[0] + aside, ends[1] + aside, free).opacities) == pytest.approx(
        0.05 * math.exp(2), rel=1e-4
    )
    far = torch.tensor([0.0, 0.6, 0.0])
    assert float(lump.cleared(ends[0] + far, ends[1] + far, free).opacities) == pytest.approx(0.9)
    nowhere = torch.tensor([[float("nan"), 0, 0]]), torch.tensor([[float("inf"), 0, 0]])
    assert float(lump.cleared(*nowhere, free).opacities) == pytest.approx(0.9)
    with pytest.raises(InputError, match="stop_short must be a length"):
        lump.cleared(*ends, free, stop_short=-0.1)
    labelled = replace(lump, labels=torch.tensor([4]))
    assert float(labelled.cleared(*ends, free, skip_start=torch.tensor([4])).opacities) == pytest.approx(0.9)


def test_what_closed_segments_need_is_not_cleared() -> None:
    """A thing in a free segment goes; a wall that stops two closed ones stays, though a free segment meets it."""
    cloud = plate(2.0)  # across the x axis
    wall, count = obstacles_of(cloud), len(cloud.means)
    thing = Obstacles(*(torch.cat((part, part[:1])) for part in (wall.means, wall.quats, wall.scales, wall.opacities)))
    thing.means[-1] = torch.tensor([1.0, 0.0, 1.5])
    start = torch.tensor([[0.0, 0.0, 1.5]]).expand(3, 3)
    end = torch.tensor([[3.0, 0.0, 1.5], [3.0, 0.01, 1.5], [3.0, -0.01, 1.5]])
    kept = thing.cleared(start, end, torch.tensor([True, False, False]))
    assert torch.equal(kept.opacities[:count], thing.opacities[:count])
    near = torch.tensor([[0.0, 0.0, 1.5], [0.0, 0.0, 1.5]]), torch.tensor([[1.8, 0.0, 1.5], [3.0, 0.5, 1.5]])
    gone = thing.cleared(*near, torch.tensor([True, False]))
    assert float(gone.opacities[-1]) == pytest.approx(0.05, rel=1e-4)
    assert torch.equal(gone.opacities[:count], thing.opacities[:count])
    with pytest.raises(InputError, match=r"free must be \[segment\] for 2 segments; got \[3\]"):
        thing.cleared(*near, torch.ones(3, dtype=torch.bool))


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


def test_what_stands_alone_off_all_planes_stops_nothing() -> None:
    ball = scattered([1.0, -0.3, 1.0], [1.6, 0.3, 1.6], 300, seed=2)
    alone = torch.tensor([[-1.0, 0.0, 1.5], [3.0, 0.0, 1.0]])
    hung = Gaussians.from_points(torch.cat((ball, alone)), degree=0, opacity=0.9)
    scales = torch.full_like(hung.log_scales, math.log(0.05))
    cloud = Gaussians.join((plate(4.0), replace(hung, log_scales=scales, sh=torch.zeros(len(hung), 1, 3))))
    labels = torch.full((len(cloud),), -1)
    wall = len(cloud) - len(hung)
    labels[:wall] = 0
    before = obstacles_of(cloud, labels)
    after = before.without_strays()
    assert (after.opacities == 0).nonzero().flatten().tolist() == [len(cloud) - 2, len(cloud) - 1]
    assert torch.equal(after.opacities[:-2], before.opacities[:-2])
    past = torch.tensor([[-1.0, -2.0, 1.5]]), torch.tensor([[-1.0, 2.0, 1.5]])
    assert float(before.transmittance(*past)) < 0.2
    assert float(after.transmittance(*past)) == 1.0


def test_an_even_surface_has_no_strays_and_a_few_gaussians_none() -> None:
    even = obstacles_of(plate(0.0))
    assert torch.equal(even.without_strays().opacities, even.opacities)
    few = obstacles_of(plate(0.0).subset(torch.arange(5)))
    assert few.without_strays() is few
    labelled = obstacles_of(plate(0.0), torch.zeros(len(plate(0.0)), dtype=torch.long))
    assert labelled.without_strays() is labelled
