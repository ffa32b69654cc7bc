import h5py
import numpy as np
import pytest

from rf3dgs.core.errors import DataError
from rf3dgs.core.hdf5 import open_audited, read_array, read_attribute


@pytest.fixture
def path(tmp_path):
    return tmp_path / "file.h5"


def test_plain_arrays_and_text_are_read(path):
    with h5py.File(path, "w") as file:
        file.attrs["unit"] = "m"
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


def _texts_attribute(file, secret):
    file.attrs.create("x", ["a"] * 5, dtype=h5py.string_dtype())


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
        (_texts_attribute, "attribute 'x'"),
    ],
)
def test_unsafe_files_are_refused_by_name(path, tmp_path, make, message):
    secret = tmp_path / "secret"
    secret.write_bytes(b"root")
    with h5py.File(path, "w") as file:
        make(file, secret)
    with pytest.raises(DataError, match=rf"file\.h5.*{message}"):
        open_audited(path)


def test_a_group_that_contains_itself_ends(path):
    with h5py.File(path, "w") as file:
        group = file.create_group("a")
        group["loop"] = group
    with open_audited(path) as file:
        assert list(file) == ["a"]


def test_truncated_files_and_other_formats_are_refused(path):
    with h5py.File(path, "w") as file:
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
    with h5py.File(path, "w") as file:
        file.create_dataset("x", data=data, chunks=(4096,), fletcher32=True)
    raw = bytearray(path.read_bytes())
    where = bytes(raw).index(data.tobytes()[:64])
    raw[where + 1000] ^= 0x10
    path.write_bytes(raw)
    with open_audited(path) as file, pytest.raises(DataError, match=r"'/x' is damaged"):
        read_array(file, "x")
