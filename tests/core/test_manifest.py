import json
from dataclasses import replace

import pytest

from rf3dgs.core.errors import DataError, InputError
from rf3dgs.core.manifest import Manifest, difference, load_manifest

SET = Manifest("test.set", 11, 4, {"rays": 1000, "names": ["a", "b"]}, {"llvm": "19.1.7"})


def test_a_manifest_survives_its_file(tmp_path):
    SET.save(tmp_path)
    assert load_manifest(tmp_path) == SET
    first = (tmp_path / "manifest.json").read_bytes()
    SET.save(tmp_path)
    assert (tmp_path / "manifest.json").read_bytes() == first


def test_shards_are_a_partition_of_the_items():
    parts = [SET.part(shard) for shard in range(SET.shards)]
    assert [item for part in parts for item in part] == list(range(11))
    assert [SET.shard_of(item) for item in range(11)] == [0] * 4 + [1] * 4 + [2] * 3


def test_the_digest_sees_the_arguments_and_not_who_made_it():
    assert replace(SET, made_by={"llvm": "20"}).digest == SET.digest
    others = [replace(SET, count=12), replace(SET, shard_size=5), replace(SET, made_from={"rays": 1001})]
    assert len({SET.digest, *(other.digest for other in others)}) == 4


@pytest.mark.parametrize(("count", "size"), [(0, 4), (4, 0), (-1, 4), (1.5, 4), (True, 4)])
def test_sizes_that_are_none_are_refused(count, size):
    with pytest.raises(InputError, match="must be whole numbers from 1"):
        Manifest("test.set", count, size, {}, {})


def test_the_first_difference_is_named_by_its_place():
    assert difference(vars(SET), vars(SET)) == ""
    assert difference({"a": {"b": 1, "c": 2}}, {"a": {"b": 1, "c": 3}}) == "a.c (it had 2, this run has 3)"
    assert difference({}, {"a": "x" * 40}) == 'a (it had null, this run has "xxxxxxxxxxxxxxxxxxx...)'


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ("", "not a readable manifest"),
        ("[]", "not a readable manifest"),
        ("[" * 100_000, "not a readable manifest"),
        ('{"version": 2}', "manifest version 2 is not 1; update rf3dgs"),
        ('{"version": 1}', "not a readable manifest"),
        (json.dumps({"version": 1, **vars(SET), "count": "many"}), "not a readable manifest"),
        (json.dumps({"version": 1, **vars(SET), "count": -3}), "not a readable manifest"),
        (json.dumps({"version": 1, **vars(SET), "made_from": 5}), "not a readable manifest"),
        (json.dumps({"version": 1, **vars(SET), "more": 5}), "not a readable manifest"),
        (" " * 5_000_000, "at most 4194304 bytes"),
    ],
)
def test_a_damaged_manifest_is_one_sentence(tmp_path, content, words):
    (tmp_path / "manifest.json").write_text(content)
    with pytest.raises(DataError, match=words):
        load_manifest(tmp_path)


def test_a_folder_without_manifest_is_one_sentence(tmp_path):
    with pytest.raises(DataError, match=r"there is no such file, so .* is not a folder of shards"):
        load_manifest(tmp_path)
