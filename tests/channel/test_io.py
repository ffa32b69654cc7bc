import subprocess
import sys
from dataclasses import replace

import h5py
import numpy as np
import pytest
import torch

from rf3dgs.channel.binning import stack_paths
from rf3dgs.channel.io import PathsReader, PathsWriter, load_paths, save_paths
from rf3dgs.core.errors import DataError, InputError
from rf3dgs.core.frames import Pose
from rf3dgs.core.hdf5 import open_audited, read_attribute, write_text

COLUMNS = ("coeff", "delay", "aoa_zenith", "aoa_azimuth", "aod_zenith", "aod_azimuth", "valid", "order", "kind")


@pytest.fixture
def paths(random_paths):
    turned = Pose.from_yaw([1.0, 2.0, 3.0], 0.5)
    return stack_paths([random_paths(300), random_paths(0), random_paths(40, seed=1, rx=turned)])


def test_paths_survive_the_file_bit_for_bit(paths, tmp_path):
    save_paths(paths, tmp_path / "a.paths", meta={"seed": 3, "scene": "lobby"})
    loaded = load_paths(tmp_path / "a.paths")
    for name in COLUMNS:
        assert torch.equal(getattr(loaded, name), getattr(paths, name)), name
    assert torch.equal(loaded.rx.position, paths.rx.position)
    assert torch.equal(loaded.rx.orientation, paths.rx.orientation)
    assert loaded.frequency == paths.frequency
    with PathsReader(tmp_path / "a.paths") as reader:
        assert reader.meta == {"seed": 3, "scene": "lobby"}
        assert len(reader) == 3
        assert torch.equal(reader[-1].delay, paths[2].delay[:40])


def test_receivers_are_written_one_at_a_time(random_paths, paths, tmp_path):
    with PathsWriter(tmp_path / "a.paths", 60e9, paths.tx) as writer:
        writer.append(random_paths(300))
        writer.append(random_paths(0))
        writer.append(paths[2])
    assert torch.equal(load_paths(tmp_path / "a.paths").coeff, paths.coeff)


def test_a_failed_writer_leaves_nothing_and_keeps_the_older_file(paths, tmp_path):
    file = tmp_path / "a.paths"
    save_paths(paths, file)
    before = file.read_bytes()
    other = replace(paths, frequency=28e9)
    with pytest.raises(InputError, match="holds paths at"), PathsWriter(file, 60e9, paths.tx) as writer:
        writer.append(other)
    other = replace(paths, tx=Pose([9.0, 0.0, 2.0]))
    refused = pytest.raises(InputError, match=r"holds paths from .* Write one file per transmitter")
    with refused, PathsWriter(file, 60e9, paths.tx) as writer:
        writer.append(other)
    with pytest.raises(InputError, match="no receiver was written"), PathsWriter(file, 60e9, paths.tx):
        pass
    assert file.read_bytes() == before
    assert [item.name for item in tmp_path.iterdir()] == ["a.paths"]


def test_the_file_states_its_conventions(paths, tmp_path):
    save_paths(paths, tmp_path / "a.paths")
    with open_audited(tmp_path / "a.paths") as file:
        assert read_attribute(file, "schema") == "rf3dgs.paths"
        assert file.attrs["version"] == 1
        assert "zenith" in str(read_attribute(file, "angles"))
        assert "rad" in str(read_attribute(file, "units"))
        assert file.attrs["frequency"] == 60e9
        assert file["delay"].compression == "gzip"
        assert file["delay"].shuffle
        assert file["delay"].fletcher32


def test_a_truncated_file_is_named_wherever_it_was_cut(paths, tmp_path):
    whole = tmp_path / "a.paths"
    save_paths(paths, whole)
    data = whole.read_bytes()
    for length in (0, 7, 100, len(data) // 3, len(data) - 1):
        cut = tmp_path / "cut.paths"
        cut.write_bytes(data[:length])
        with pytest.raises(DataError, match=r"cut\.paths"):
            load_paths(cut)


def test_flipped_bytes_never_crash_and_never_change_a_column_unnoticed(paths, tmp_path):
    whole = tmp_path / "a.paths"
    save_paths(paths, whole)
    data = bytearray(whole.read_bytes())
    generator = np.random.default_rng(0)
    for position in generator.integers(0, len(data), 60):
        flipped = data.copy()
        flipped[position] ^= 0xFF
        bad = tmp_path / "flipped.paths"
        bad.write_bytes(flipped)
        try:
            loaded = load_paths(bad)
        except DataError:
            continue
        for name in COLUMNS:
            assert torch.equal(getattr(loaded, name), getattr(paths, name)), (position, name)
        assert torch.equal(loaded.rx.position, paths.rx.position)


DAMAGE = """
import sys
from pathlib import Path

import numpy as np

from rf3dgs.channel.io import load_paths
from rf3dgs.core.errors import DataError

path, random, refused = Path(sys.argv[1]), np.random.default_rng(0), 0
whole = path.read_bytes()
for _ in range(150):
    raw = bytearray(whole)
    for place in random.integers(0, len(raw), 8):
        raw[place] = random.integers(256)
    path.write_bytes(raw)
    try:
        load_paths(path)
    except DataError:
        refused += 1
print(refused)
"""


def test_random_damage_never_hangs_or_crashes(paths, tmp_path):
    file = tmp_path / "a.paths"
    save_paths(paths, file, meta={"seed": 3, "scene": "lobby"})
    # A process of its own: damage that makes the library hang or crash fails this test and no other.
    done = subprocess.run([sys.executable, "-c", DAMAGE, str(file)], capture_output=True, text=True, timeout=180)
    assert done.returncode == 0, done.stderr
    assert 100 < int(done.stdout) <= 150


def test_meta_too_long_for_the_file_is_refused_before_anything_is_traced(paths, tmp_path):
    writer = PathsWriter(tmp_path / "a.paths", 60e9, paths.tx, {"note": "x" * 60_000})
    with pytest.raises(InputError, match="'meta' must take at most"), writer:
        pytest.fail("the writer must not open")
    assert not list(tmp_path.iterdir())


def test_external_links_are_refused(paths, tmp_path):
    save_paths(paths, tmp_path / "a.paths")
    with h5py.File(tmp_path / "a.paths", "a") as file:
        del file["delay"]
        file["delay"] = h5py.ExternalLink("/etc/passwd", "/x")
    with pytest.raises(DataError, match=r"a\.paths.*link"):
        load_paths(tmp_path / "a.paths")


def test_a_small_file_that_declares_terabytes_is_refused(paths, tmp_path):
    save_paths(paths, tmp_path / "a.paths")
    with h5py.File(tmp_path / "a.paths", "a") as file:
        del file["delay"]
        file.create_dataset("delay", shape=(2**40,), chunks=(1024,), dtype="f4")
    with pytest.raises(DataError, match=r"a\.paths.*declares more than"):
        load_paths(tmp_path / "a.paths")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda file: write_text(file.attrs, "schema", "other"), "expected a file of paths"),
        (lambda file: file.attrs.__delitem__("schema"), "expected a file of paths"),
        (lambda file: file.attrs.__setitem__("schema", "rf3dgs.paths"), "'schema' of '/' has variable length"),
        (lambda file: file.attrs.__setitem__("version", 2), "schema version 2"),
        (lambda file: file.__delitem__("delay"), "'delay' must have"),
        (lambda file: file["offset"].__setitem__(1, 10**6), "'offset' must rise"),
        (lambda file: file["delay"].__setitem__(0, np.nan), "'delay' has NaN"),
        (lambda file: file["rx_orientation"].__setitem__(0, 0.0), "zero or non-finite quaternion"),
        (lambda file: write_text(file.attrs, "meta", "{"), "head is damaged"),
    ],
)
def test_damage_is_told_in_one_sentence_with_the_file(paths, tmp_path, change, message):
    file = tmp_path / "a.paths"
    save_paths(paths, file)
    with h5py.File(file, "a") as opened:
        change(opened)
    with pytest.raises(DataError, match=message) as caught:
        load_paths(file)
    assert "a.paths" in str(caught.value)


def test_paths_with_nan_are_not_written(random_paths, tmp_path):
    bad = random_paths(5)
    bad.delay[2] = float("nan")
    with pytest.raises(InputError, match="NaN or infinite"):
        save_paths(bad._map(lambda value: value[None], rx=Pose(bad.rx.position[None])), tmp_path / "a.paths")
    assert not list(tmp_path.iterdir())
