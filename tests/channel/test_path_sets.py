"""Folders of paths: read like one file, and the same bytes whatever goes on around the writer."""

import shutil
import sys
import threading
from io import BytesIO

import numpy as np
import pytest
import torch

from rf3dgs.channel.io import PathsReader, PathsWriter, load_paths, shard_name
from rf3dgs.core.errors import DataError
from rf3dgs.core.frames import Pose
from rf3dgs.core.manifest import Manifest

COUNT, SIZE = 7, 3


@pytest.fixture
def receivers(random_paths):
    places = Pose(torch.tensor([[3.0 + 0.1 * item, 4.0, 1.0] for item in range(COUNT)]))
    return [random_paths(50 + item, seed=item, rx=places[item]) for item in range(COUNT)]


def shard_bytes(receivers, manifest, shard):
    content = BytesIO()
    part = manifest.part(shard)
    with PathsWriter(content, 60e9, receivers[0].tx, {"set": manifest.digest, "first": part.start}) as writer:
        for item in part:
            writer.append(receivers[item], traced=1000 + item)
    return content.getvalue()


@pytest.fixture
def folder(receivers, tmp_path):
    manifest = Manifest("rf3dgs.paths", COUNT, SIZE, {"rays": 9}, {"llvm": "19"})
    folder = tmp_path / "set.paths"
    folder.mkdir()
    manifest.save(folder)
    for shard in range(manifest.shards):
        (folder / shard_name(shard)).write_bytes(shard_bytes(receivers, manifest, shard))
    return folder


def test_a_folder_reads_like_one_file(folder, receivers, tmp_path):
    with PathsWriter(tmp_path / "one.paths", 60e9, receivers[0].tx) as writer:
        for paths in receivers:
            writer.append(paths)
    with PathsReader(folder) as many, PathsReader(tmp_path / "one.paths") as one:
        assert len(many) == len(one) == COUNT
        assert many.frequency == one.frequency
        assert torch.equal(many.tx.position, one.tx.position)
        assert torch.equal(many.rx.position, one.rx.position)
        for index in (0, 6, 2, 3, -1, -7):
            assert torch.equal(many[index].coeff, one[index].coeff)
            assert torch.equal(many[index].rx.position, one[index].rx.position)
        assert [paths.coeff.shape for paths in many] == [paths.coeff.shape for paths in one]
        assert many.meta["made_from"] == {"rays": 9}
        assert np.array_equal(many.traced, 1000 + np.arange(COUNT))
        assert one.traced is None
        with pytest.raises(IndexError, match="has 7 receivers; there is no number 7"):
            many[7]
    assert torch.equal(load_paths(folder).delay, load_paths(tmp_path / "one.paths").delay)


def test_a_folder_that_lacks_shards_says_how_many(folder):
    (folder / "00001.h5").unlink()
    (folder / ".00001.h5.0123456789ab.partial.h5").write_bytes(b"half")
    with pytest.raises(DataError, match=r"set.paths has 2 of 3 shards; run the same rf3dgs trace command again"):
        PathsReader(folder)


def test_a_shard_of_another_set_or_place_is_refused(folder, receivers):
    other = Manifest("rf3dgs.paths", COUNT, SIZE, {"rays": 10}, {"llvm": "19"})
    (folder / "00001.h5").write_bytes(shard_bytes(receivers, other, 1))
    with PathsReader(folder) as reader:
        assert len(reader[0].delay) == 50
        with pytest.raises(DataError, match=r"00001.h5 does not belong to this set: another run wrote it; delete it"):
            reader[3]
    shutil.copy(folder / "00000.h5", folder / "00001.h5")
    with PathsReader(folder) as reader, pytest.raises(DataError, match=r"00001.h5 does not belong to this set"):
        reader[4]


def test_a_damaged_shard_is_named(folder):
    content = bytearray((folder / "00002.h5").read_bytes())
    (folder / "00002.h5").write_bytes(content[: len(content) // 2])
    with PathsReader(folder) as reader, pytest.raises(DataError, match=r"00002.h5"):
        reader[6]


def test_a_folder_of_something_else_is_refused(tmp_path):
    with pytest.raises(DataError, match="is not a folder of shards"):
        PathsReader(tmp_path)
    Manifest("rf3dgs.photos", 1, 1, {}, {}).save(tmp_path)
    with pytest.raises(DataError, match=r"expected a folder of paths with schema 'rf3dgs.paths'; it holds 'rf3dgs.ph"):
        PathsReader(tmp_path)


def test_a_number_of_traced_paths_for_some_receivers_alone_is_left_out(receivers, tmp_path):
    with PathsWriter(tmp_path / "a.paths", 60e9, receivers[0].tx) as writer:
        writer.append(receivers[0], traced=5)
        writer.append(receivers[1])
    with PathsReader(tmp_path / "a.paths") as reader:
        assert reader.traced is None


def test_the_same_paths_give_the_same_bytes_while_someone_watches_the_writer(receivers, tmp_path):
    """A sampling profiler, such as a worker process has, keeps the objects of running functions alive."""
    manifest = Manifest("rf3dgs.paths", COUNT, COUNT, {}, {})
    calm = shard_bytes(receivers, manifest, 0)
    kept, done = [], threading.Event()

    def watch():
        while not done.wait(0.001):
            for frame in sys._current_frames().values():
                while frame is not None:
                    kept.append(dict(frame.f_locals))
                    frame = frame.f_back
            del kept[:-300]

    watcher = threading.Thread(target=watch)
    watcher.start()
    try:
        watched = [shard_bytes(receivers, manifest, 0) for _ in range(15)]
    finally:
        done.set()
        watcher.join()
    assert kept
    assert all(content == calm for content in watched)
