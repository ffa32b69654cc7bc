"""Laws of the split: nothing leaks, buffers are kept, training sets are nested."""

from itertools import pairwise

import numpy as np
import pytest
import torch
from benchmarks.quality.protocol.split import HOLDOUTS, JUDGES, SplitConfig, split_of

from rf3dgs.core.errors import InputError

SMALL = SplitConfig(test=20, region=20, validation=10, near=10)


def positions(count: int = 200, seed: int = 0) -> torch.Tensor:
    """Receivers in a hall of 13 x 14 m between 1 and 2 m above the floor."""
    generator = torch.Generator().manual_seed(seed)
    return torch.tensor([0.5, 0.5, 1.0]) + torch.tensor([13.0, 14.0, 1.0]) * torch.rand(count, 3, generator=generator)


def test_parts_have_the_sizes_asked_for_and_share_no_position():
    split = split_of(positions(480))
    sizes = {name: len(split.where(name)) for name in set(split.names)}
    assert sizes["test"] == sizes["region"] == 100
    assert sizes["validation"] == sizes["validation region"] == 40
    assert sizes["pool"] >= 160
    assert sum(sizes.values()) == 480
    parts = [set(split.part(judge, holdout)) for judge in JUDGES for holdout in HOLDOUTS]
    assert sum(map(len, parts)) == len(set.union(*parts))


def test_training_positions_are_never_held_out():
    split = split_of(positions(), SMALL)
    for seed in range(3):
        training = set(split.training(50, seed))
        assert len(training) == 50
        for judge in JUDGES:
            for holdout in HOLDOUTS:
                assert not training & set(split.part(judge, holdout))


def test_training_sets_of_one_seed_are_nested_and_those_of_two_differ():
    split = split_of(positions(), SMALL)
    for seed in range(3):
        sets = [set(split.training(count, seed)) for count in (10, 20, 40, 80)]
        assert all(small < large for small, large in pairwise(sets))
    assert set(split.training(20, 0)) != set(split.training(20, 1))


@pytest.mark.parametrize("seed", range(5))
def test_everything_else_stays_a_buffer_away_from_both_regions(seed):
    place = positions()
    split = split_of(place, SplitConfig(test=20, region=20, validation=10, near=10, buffer=0.4, seed=seed))
    names, ground = np.array(split.names), place[:, :2].double().numpy()
    for region in ("region", "validation region"):
        inside = ground[names == region]
        middle, held = inside.mean(0), np.isin(names, (region, "buffer"))
        others = ground[~held]
        # The cylinder is centred on one of its positions: whoever serves something lies outside its radius + buffer.
        centres = np.linalg.norm(inside[:, None] - inside, axis=-1).max(1)
        candidates = inside[np.argsort(centres)]
        margins = [
            np.linalg.norm(others - centre, axis=1).min() - np.linalg.norm(inside - centre, axis=1).max()
            for centre in candidates
        ]
        assert max(margins) > 0.4, middle
    away = np.linalg.norm(ground[names == "region"][:, None] - ground[names == "validation region"], axis=-1)
    assert away.min() > 0.0


def test_the_validation_region_lies_beside_the_sealed_one():
    place = positions(480)
    names, ground = np.array(split_of(place).names), place[:, :2].numpy()
    middle = {name: ground[names == name].mean(0) for name in ("region", "validation region")}
    apart = np.linalg.norm(middle["region"] - middle["validation region"])
    assert apart < 8.0  # two cylinders of about 3.4 and 2.2 m and a buffer, in a hall of 13 x 14 m


def test_the_same_seed_gives_the_same_split():
    assert split_of(positions(), SMALL) == split_of(positions(), SMALL)
    assert split_of(positions(), SMALL) != split_of(positions(), SplitConfig(20, 20, 10, 10, seed=1))


def test_the_dataset_roles_seal_what_the_test_judges():
    split = split_of(positions(), SMALL)
    roles = np.array(split.roles)
    assert set(roles[split.part("test", "random")]) == {"test"}
    assert set(roles[split.part("test", "region")]) == {"region"}
    assert set(roles[split.part("validation", "region")]) == {"validation"}
    assert set(roles[split.training(40, 0)]) == {"train"}


@pytest.mark.parametrize(
    ("count", "config", "message"),
    [
        (50, SMALL, "60 positions are held out and there are 50"),
        (70, SplitConfig(20, 20, 10, 10, buffer=5.0), "validation region|left outside"),
        (200, SplitConfig(0, 20, 10, 10), "every part needs a position"),
    ],
)
def test_what_does_not_fit_is_refused(count, config, message):
    with pytest.raises(InputError, match=message):
        split_of(positions(count), config)


def test_more_training_positions_than_there_are_is_refused():
    with pytest.raises(InputError, match="500 training positions were asked for"):
        split_of(positions(), SMALL).training(500, 0)


def test_two_receivers_at_one_place_are_refused():
    place = positions()
    place[7] = place[3]
    with pytest.raises(InputError, match="one place"):
        split_of(place, SMALL)
