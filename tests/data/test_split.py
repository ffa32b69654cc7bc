import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from rf3dgs.core.errors import InputError
from rf3dgs.core.frames import Pose
from rf3dgs.data.split import FRACTIONS, check_roles, every_kth, keep_fraction, places_of, protocol, split_positions

ROOM = ((0, 0, 1), (14, 15, 2))


@settings(max_examples=30, deadline=None)
@given(count=st.integers(20, 200), seed=st.integers(0, 10_000))
def test_shares_and_buffer_are_kept(count, seed):
    positions = Pose.scatter(ROOM, count, seed=seed).position
    roles = split_positions(positions, test=0.15, validation=0.1, region=0.2, buffer=0.5, seed=seed)
    check_roles(positions, roles)
    assert roles == split_positions(positions, test=0.15, validation=0.1, region=0.2, buffer=0.5, seed=seed)
    assert roles.count("region") == round(0.2 * count)
    assert roles.count("test") == round(0.15 * count)
    assert roles.count("validation") == round(0.1 * count)
    region = positions[[role == "region" for role in roles]][:, :2]
    others = positions[[role not in ("region", "buffer") for role in roles]][:, :2]
    centre_distance = torch.cdist(region, others)
    assert float(centre_distance.min()) > 0.0
    inner = torch.cdist(region, region).amax(1).min()
    assert float(inner) >= 0.0


def test_no_training_position_is_within_the_buffer_of_the_region():
    positions = Pose.scatter(ROOM, 400, seed=1).position
    for seed in range(5):
        roles = split_positions(positions, region=0.2, buffer=1.0, seed=seed)
        region = positions[[role == "region" for role in roles]][:, :2]
        train = positions[[role == "train" for role in roles]][:, :2]
        centres = [place for place in positions[:, :2] if torch.linalg.vector_norm(region - place, dim=-1).max()
                   < torch.linalg.vector_norm(train - place, dim=-1).min() - 0.999]  # fmt: skip
        assert centres, "the region is a disc whose rim is 1 m away from every training position"


def test_other_seeds_give_other_splits():
    positions = Pose.scatter(ROOM, 60, seed=0).position
    assert split_positions(positions, seed=0) != split_positions(positions, seed=1)


def test_orientations_at_one_place_share_a_role():
    places = Pose.scatter(ROOM, 40, seed=0).position
    positions = places.repeat_interleave(4, 0) + 1e-4 * torch.randn(160, 3, generator=torch.Generator().manual_seed(0))
    roles = split_positions(positions, seed=3)
    for start in range(0, 160, 4):
        assert len(set(roles[start : start + 4])) == 1
    assert roles.count("test") == 4 * round(0.15 * 40)
    place, first = places_of(positions)
    assert len(first) == 40
    assert place.tolist() == [index // 4 for index in range(160)]


def test_a_place_on_both_sides_is_refused():
    positions = torch.tensor([[0.0, 0, 0], [1, 0, 0], [1.0005, 0, 0]])
    with pytest.raises(InputError, match=r"positions 1 and 2 are the same place .* 'train' and the other 'test'"):
        check_roles(positions, ["train", "train", "test"])
    check_roles(positions, ["test", "train", "train"])


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"test": 1.2}, "share test must lie in"),
        ({"test": 0.5, "validation": 0.3, "region": 0.3}, "must stay below 1"),
        ({"buffer": -1.0}, "buffer >= 0"),
        ({"buffer": 100.0}, "no place of 30 is left for training"),
    ],
)
def test_impossible_splits_are_refused(arguments, message):
    with pytest.raises(InputError, match=message):
        split_positions(Pose.scatter(ROOM, 30, seed=0).position, **arguments)


def test_every_kth_photo_is_tested():
    assert every_kth(9, 4) == ("train",) * 3 + ("test",) + ("train",) * 3 + ("test",) + ("train",)
    assert set(every_kth(9, 0)) == {"train"}
    with pytest.raises(InputError, match="at least 2"):
        every_kth(9, 1)


def test_the_papers_protocol_holds_out_160_of_800():
    positions = Pose.scatter(ROOM, 800, seed=0).position
    roles = protocol(positions, seed=1)
    assert (roles.count("test"), roles.count("train")) == (160, 640)
    assert roles == protocol(positions, seed=1)
    assert roles != protocol(positions, seed=2)
    region = protocol(positions, hold_out="region", seed=1)
    assert region.count("region") == 160
    assert region.count("region") + region.count("buffer") + region.count("train") == 800


@settings(max_examples=20, deadline=None)
@given(count=st.integers(20, 120), seed=st.integers(0, 1000), hold_out=st.sampled_from(["random", "region"]))
def test_fractions_are_nested_and_leave_the_held_out_alone(count, seed, hold_out):
    positions = Pose.scatter(ROOM, count, seed=seed).position.repeat_interleave(4, 0)
    whole = protocol(positions, hold_out=hold_out, seed=seed)
    before: set[int] = set()
    for fraction in FRACTIONS:
        roles = protocol(positions, hold_out=hold_out, fraction=fraction, seed=seed)
        train = {index for index, role in enumerate(roles) if role == "train"}
        assert before <= train
        assert len(train) == 4 * round(fraction * whole.count("train") / 4)
        assert {index // 4 for index in train} == {index // 4 for index in train if index % 4 == 2}, "all four or none"
        kept = [(new, old) for new, old in zip(roles, whole, strict=True) if old != "train"]
        assert all(new == old for new, old in kept)
        assert keep_fraction(positions, roles, 1.0, seed=seed) == whole
        before = train
    assert roles == whole


@settings(max_examples=20, deadline=None)
@given(count=st.integers(20, 60), seed=st.integers(0, 1000), hold_out=st.sampled_from(["random", "region"]))
def test_the_pictures_of_one_place_are_on_one_side(count, seed, hold_out):
    positions = Pose.scatter(ROOM, count, seed=seed).position.repeat_interleave(4, 0)
    order = torch.randperm(len(positions), generator=torch.Generator().manual_seed(seed))
    roles = protocol(positions[order], hold_out=hold_out, fraction=0.4, seed=seed)
    sides: dict[int, set[str]] = {}
    for index, role in zip(order.tolist(), roles, strict=True):
        sides.setdefault(index // 4, set()).add(role)
    assert all(len(side) == 1 for side in sides.values())


def test_wrong_fractions_are_refused():
    positions = Pose.scatter(ROOM, 30, seed=0).position
    for fraction in (0.0, -0.2, 1.5, float("nan")):
        with pytest.raises(InputError, match=r"fraction must lie in \(0, 1\]"):
            protocol(positions, fraction=fraction)
    with pytest.raises(InputError, match="leaves none; take a larger one"):
        protocol(positions, fraction=0.01)
    with pytest.raises(InputError, match='hold_out must be "random" or "region"'):
        protocol(positions, hold_out="corner")
