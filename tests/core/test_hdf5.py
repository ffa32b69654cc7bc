import subprocess
import sys

import h5py
import numpy as np
import pytest

from rf3dgs.core.errors import DataError, InputError
from rf3dgs.core.hdf5 import LIBVER, open_audited, read_array, read_attribute, write_text


@pytest.fixture
def path(tmp_path):
    return tmp_path / "file.h5"


def test_plain_arrays_and_text_are_read(path):
    with h5py.File(path, "w", libver=LIBVER) as file:
        write_text(file.attrs, "unit", "m")
        group = file.create_group("a")
        data = np.arange(100.0)
        group.create_dataset("x", data=data, compression="gzip", shuffle=True, fletcher32=True)
    with open_audited(path) as file:
        assert read_attribute(file, "unit") == "m"
        np.testing.assert_array_equal(read_array(file["a"], "x"), data)
        with pytest.raises(DataError, match=r"file\.h5.*'/a/y'.*missing"):
            read_array(file["a"], "y")
        with pytest.raises(DataError, match=r"lacks the attribute 'scale'"):
            read_attribute(file["a"], "scale")


@pytest.mark.parametrize("text", ["", "m", "Zürich, 60 GHz", "x" * 60_000])
def test_text_is_fixed_length_utf8_and_survives_the_file(path, text):
    with h5py.File(path, "w", libver=LIBVER) as file:
        write_text(file.attrs, "note", "before")
        write_text(file.attrs, "note", text)
        kind = file.attrs.get_id("note").get_type()
        assert not kind.is_variable_str()
        assert kind.get_cset() == h5py.h5t.CSET_UTF8
    with open_audited(path) as file:
        assert read_attribute(file, "note") == text


def test_text_too_long_for_an_attribute_is_not_written(path):
    with (
        h5py.File(path, "w", libver=LIBVER) as file,
        pytest.raises(InputError, match=r"'note' must take at most 60000.*got 60001"),
    ):
        write_text(file.attrs, "note", "x" * 60_001)


@pytest.mark.parametrize(
    ("value", "dtype"),
    [
        ("m", h5py.string_dtype()),
        ("m", h5py.string_dtype("ascii")),
        (["a", "b"], h5py.string_dtype()),
        (np.array([np.arange(3.0), np.arange(2.0)], dtype=object), h5py.vlen_dtype(np.float64)),
    ],
)
def test_attributes_of_variable_length_are_refused_with_the_remedy(path, value, dtype):
    with h5py.File(path, "w", libver=LIBVER) as file:
        file.create_group("a").attrs.create("unit", value, dtype=dtype)
    with pytest.raises(DataError, match=r"file\.h5.*'unit' of '/a' has variable length.*fixed-length text"):
        open_audited(path)
    if isinstance(value, str):
        with h5py.File(path, "r+") as file:
            file["a"].attrs["unit"] = np.bytes_(value.encode())
        with open_audited(path) as file:
            assert read_attribute(file["a"], "unit") == "m"


def _external_storage(file, secret):
    file.create_dataset("x", shape=(4,), dtype="u1", external=[(str(secret), 0, 4)])


def _external_link(file, secret):
    file["x"] = h5py.ExternalLink(str(secret), "/x")


def _soft_link(file, secret):
    file["x"] = h5py.SoftLink("/y")


def _virtual(file, secret):
    layout = h5py.VirtualLayout(shape=(4,), dtype="u1")
    layout[:] = h5py.VirtualSource(str(secret), "x", shape=(4,))
    file.create_virtual_dataset("x", layout)


def _text(file, secret):
    file.create_dataset("x", data=["a", "b"], dtype=h5py.string_dtype())


def _ragged(file, secret):
    file.create_dataset("x", shape=(2,), dtype=h5py.vlen_dtype(np.float32))


def _reference(file, secret):
    file.create_dataset("x", shape=(2,), dtype=h5py.ref_dtype)


def _compound(file, secret):
    file.create_dataset("x", data=np.zeros(3, np.complex64))


def _bomb(file, secret):
    file.create_dataset("x", shape=(10**14,), dtype="f8", chunks=(1024,), compression="gzip")


def _wide_chunk(file, secret):
    file.create_dataset("x", shape=(1,), maxshape=(None,), dtype="f8", chunks=(2**27,), compression="gzip")


def _filter(file, secret):
    file.create_dataset("x", data=np.zeros(64), compression="lzf")


def _compound_attribute(file, secret):
    file.attrs["x"] = np.zeros(3, np.complex64)


def _large_attribute(file, secret):
    file.attrs["x"] = np.zeros(10_000)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (_external_storage, "external storage"),
        (_external_link, "soft or external link"),
        (_soft_link, "soft or external link"),
        (_virtual, "virtual dataset"),
        (_text, "plain array of numbers"),
        (_ragged, "plain array of numbers"),
        (_reference, "plain array of numbers"),
        (_compound, "plain array of numbers"),
        (_bomb, "declares more than"),
        (_wide_chunk, "declares more than"),
        (_filter, "filter other than"),
        (_compound_attribute, "attribute 'x'"),
        (_large_attribute, "attribute 'x'"),
    ],
)
def test_unsafe_files_are_refused_by_name(path, tmp_path, make, message):
    secret = tmp_path / "secret"
    secret.write_bytes(b"root")
    with h5py.File(path, "w", libver=LIBVER) as file:
        make(file, secret)
    with pytest.raises(DataError, match=rf"file\.h5.*{message}"):
        open_audited(path)


@pytest.mark.parametrize("libver", ["earliest", "v108"])
def test_the_format_without_checksums_is_refused_with_the_remedy(path, libver):
    with h5py.File(path, "w", libver=libver if libver == "earliest" else (libver, libver)) as file:
        file["x"] = np.zeros(3)
    with pytest.raises(DataError, match=r"file\.h5: .* before HDF5 1\.10.*libver='v110'"):
        open_audited(path)


def test_a_group_that_contains_itself_ends(path):
    with h5py.File(path, "w", libver=LIBVER) as file:
        group = file.create_group("a")
        group["loop"] = group
    with open_audited(path) as file:
        assert list(file) == ["a"]


def test_truncated_files_and_other_formats_are_refused(path):
    with h5py.File(path, "w", libver=LIBVER) as file:
        file.create_dataset("x", data=np.random.default_rng(0).random(5000))
    whole = path.read_bytes()
    for content in (b"", b"not hdf5 at all", whole[:100], whole[: len(whole) // 2]):
        path.write_bytes(content)
        with pytest.raises(DataError, match=r"file\.h5"):
            open_audited(path)
    with pytest.raises(DataError, match="no such file"):
        open_audited(path.with_name("other.h5"))


def test_a_flipped_byte_in_the_data_is_noticed_by_its_checksum(path):
    data = np.random.default_rng(0).integers(0, 2**16, 4096).astype(np.uint16)
    with h5py.File(path, "w", libver=LIBVER) as file:
        file.create_dataset("x", data=data, chunks=(4096,), fletcher32=True)
    raw = bytearray(path.read_bytes())
    where = bytes(raw).index(data.tobytes()[:64])
    raw[where + 1000] ^= 0x10
    path.write_bytes(raw)
    with open_audited(path) as file, pytest.raises(DataError, match=r"'/x' is damaged"):
        read_array(file, "x")


DAMAGE = """
import sys
from pathlib import Path

import h5py
import numpy as np

from rf3dgs.core.errors import DataError
from rf3dgs.core.hdf5 import open_audited, read_array, read_attribute

path, random, refused = Path(sys.argv[1]), np.random.default_rng(0), 0
whole = path.read_bytes()
for _ in range(300):
    raw = bytearray(whole)
    for place in random.integers(0, len(raw), 2):
        raw[place] = random.integers(256)
    path.write_bytes(raw)
    try:
        with open_audited(path) as file:
            read_attribute(file, "unit")
            read_array(file, "x")
            read_array(file, "y")
            for item in (item for item in file.values() if "scale" in item.attrs):
                read_attribute(item, "scale")
    except DataError:
        refused += 1
print(refused)
"""


def test_random_damage_is_refused_or_harmless(path):
    with h5py.File(path, "w", libver=LIBVER) as file:
        write_text(file.attrs, "unit", "m")
        file.create_dataset("x", data=np.arange(50.0)).attrs["scale"] = 2.0
        file.create_dataset("y", data=np.arange(200.0), chunks=(50,), compression="gzip", fletcher32=True)
    # A process of its own: damage that makes the library hang or crash fails this test and no other.
    done = subprocess.run([sys.executable, "-c", DAMAGE, str(path)], capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    assert 100 < int(done.stdout) < 300
