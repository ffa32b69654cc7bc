"""Bounded reading of .npz files."""

import zipfile

import numpy as np
import pytest

from rf3dgs.core.errors import DataError
from rf3dgs.core.npz import MAX_MEMBERS, read_npz_array


@pytest.mark.parametrize("dtype", ["<f4", ">f8", "<i2", "|u1", "|b1"])
@pytest.mark.parametrize("shape", [(), (0, 3), (4, 5), (2, 3, 4)])
def test_arrays_of_real_numbers_come_back(tmp_path, dtype, shape):
    array = np.random.default_rng(0).integers(0, 2, shape).astype(dtype)
    np.savez_compressed(tmp_path / "a.npz", values=array)
    back = read_npz_array(tmp_path / "a.npz", "values")
    assert back.dtype == array.dtype
    assert np.array_equal(back, array)
    assert np.array_equal(read_npz_array(tmp_path / "a.npz"), array)


def test_column_major_arrays_come_back(tmp_path):
    array = np.asfortranarray(np.arange(12.0).reshape(3, 4))
    np.savez(tmp_path / "a.npz", values=array)
    assert np.array_equal(read_npz_array(tmp_path / "a.npz"), array)


def test_what_is_no_array_of_numbers_is_refused(tmp_path):
    file = tmp_path / "a.npz"
    with pytest.raises(DataError, match=r"a.npz: there is no such file"):
        read_npz_array(file)
    file.write_bytes(b"no zip at all")
    with pytest.raises(DataError, match=r"a.npz: expected an .npz file; it is damaged or another format"):
        read_npz_array(file)
    np.savez(file, one=np.zeros(3), two=np.zeros(3))
    with pytest.raises(DataError, match="expected one array; it holds one, two"):
        read_npz_array(file)
    with pytest.raises(DataError, match="has no array 'three'; it holds one, two"):
        read_npz_array(file, "three")
    for value in (np.array([{"a": 1}], dtype=object), np.array(["text"]), np.array([1j])):
        np.savez(file, one=value)
        with pytest.raises(DataError, match="expected an array of real numbers; got the dtype"):
            read_npz_array(file)
    with zipfile.ZipFile(file, "w") as archive:
        for number in range(MAX_MEMBERS + 1):
            archive.writestr(f"{number}.npy", b"")
    with pytest.raises(DataError, match="holds 65 arrays; expected at most 64"):
        read_npz_array(file)


@pytest.mark.parametrize(
    ("shape", "stored", "message"),
    [
        ((10**12,), 16, "an array of shape .* does not fit into its"),
        ((4,), 8, "does not fit into its|must take 16 bytes"),
        ((2,), 16, "must take 8 bytes; they do not"),
    ],
)
def test_a_shape_that_its_data_do_not_fill_is_refused(tmp_path, shape, stored, message):
    file = tmp_path / "a.npz"
    with zipfile.ZipFile(file, "w") as archive, archive.open("one.npy", "w") as stream:
        np.lib.format.write_array_header_1_0(stream, {"descr": "<f4", "fortran_order": False, "shape": shape})
        stream.write(bytes(stored))
    with pytest.raises(DataError, match=message):
        read_npz_array(file)


def test_more_bytes_than_asked_for_are_refused(tmp_path):
    np.savez(tmp_path / "a.npz", one=np.zeros(1000))
    with pytest.raises(DataError, match=r"declares 8128 bytes, more than the 100 that"):
        read_npz_array(tmp_path / "a.npz", max_bytes=100)


def test_a_huge_header_is_refused(tmp_path):
    file = tmp_path / "a.npz"
    shape = ", ".join(["1"] * 20_000)
    header = f"{{'descr': '<f4', 'fortran_order': False, 'shape': ({shape})}}\n".encode()
    with zipfile.ZipFile(file, "w") as archive:
        archive.writestr("one.npy", b"\x93NUMPY\x02\x00" + len(header).to_bytes(4, "little") + header)
    with pytest.raises(DataError, match=r"expected an \.npz file; it is damaged"):
        read_npz_array(file)
