import math
import struct
import zlib

import h5py
import numpy as np
import pytest
import scipy.io
import torch

from rf3dgs.channel.arrays import ofdm, planar_array
from rf3dgs.channel.sounding import Sounding
from rf3dgs.core.errors import DataError, InputError
from rf3dgs.core.frames import Pose
from rf3dgs.propagation.exchange.mat5 import read_mat5
from rf3dgs.propagation.exchange.measured import read_sounding, write_sounding

SUFFIXES = [".h5", ".hdf5", ".mat", ".csv"]


def example(points=6, **changes):
    generator = torch.Generator().manual_seed(0)
    fields = {
        "response": torch.view_as_complex(torch.randn(2, 4, 3, points, 2, generator=generator, dtype=torch.float64)),
        "offsets": ofdm(3e8, points),
        "frequency": 60e9,
        "tx": Pose.from_yaw((0.1, 0.2, 2.6), 0.4),
        "rx": Pose.from_yaw(((3.0, 4.0, 1.0), (5.0, 1.0, 1.5)), torch.tensor([0.3, -2.0])),
        "array_rx": planar_array(2, 2, "patch", vertical=0.6),
        "array_tx": planar_array(1, 3, "tr38901"),
        "noise_power": torch.tensor([1e-12, 3e-12], dtype=torch.float64),
        "fov_rx": math.radians(45.0),
        "fov_tx": math.radians(60.0),
        "delay_offset": True,
    }
    return Sounding(**{**fields, **changes})


def assert_same(again, sounding):
    for name in ("response", "offsets"):
        assert torch.equal(getattr(again, name), getattr(sounding, name)), name
    for name in ("frequency", "array_rx", "array_tx", "fov_rx", "fov_tx", "delay_offset"):
        assert getattr(again, name) == getattr(sounding, name), name
    for name in ("tx", "rx"):
        mine, theirs = getattr(again, name), getattr(sounding, name)
        assert torch.equal(mine.position, theirs.position)
        assert torch.allclose(mine.orientation, theirs.orientation, atol=1e-6)
    assert (again.noise_power is None) == (sounding.noise_power is None)
    if sounding.noise_power is not None:
        assert torch.equal(again.noise_power, sounding.noise_power)


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_a_sounding_survives_its_file(tmp_path, suffix):
    write_sounding(tmp_path / f"site{suffix}", example())
    assert_same(read_sounding(tmp_path / f"site{suffix}"), example())


def test_a_sounding_has_the_same_bytes_whoever_holds_the_writers_objects(tmp_path, held_by_others):
    write_sounding(tmp_path / "alone.h5", example(600))
    with held_by_others() as held:
        write_sounding(tmp_path / "watched.h5", example(600))
    assert held
    assert (tmp_path / "watched.h5").read_bytes() == (tmp_path / "alone.h5").read_bytes()


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_the_smallest_sounding_survives_its_file(tmp_path, suffix):
    small = example(
        1,
        response=torch.full((1, 1, 1), 1e-5j, dtype=torch.complex128),
        offsets=torch.zeros(1, dtype=torch.float64),
        rx=Pose((3.0, 4.0, 1.0)),
        array_rx=None,
        array_tx=None,
        noise_power=None,
    )
    write_sounding(tmp_path / f"site{suffix}", small)
    assert_same(read_sounding(tmp_path / f"site{suffix}"), small.flat())


def error_of(path):
    """The message of the DataError that reading raises; None where a damaged number is a number all the same."""
    try:
        read_sounding(path)
    except DataError as error:
        return str(error)
    return None


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_damage_anywhere_is_one_error_or_none(tmp_path, suffix):
    path = tmp_path / f"site{suffix}"
    write_sounding(path, example(2))
    whole = path.read_bytes()
    generator = np.random.default_rng(0)
    for cut in generator.integers(0, len(whole), 25):
        path.write_bytes(whole[:cut])
        with pytest.raises(DataError, match="site"):
            read_sounding(path)
    for place in generator.integers(0, len(whole), 60):
        damaged = bytearray(whole)
        damaged[place] ^= 1 << int(generator.integers(8))
        path.write_bytes(bytes(damaged))
        error = error_of(path)
        assert error is None or "site" in error


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_missing_and_foreign_files_are_one_error(tmp_path, suffix):
    with pytest.raises(DataError, match="there is none of that name"):
        read_sounding(tmp_path / f"nowhere{suffix}")
    (tmp_path / f"other{suffix}").write_bytes(b"\x00\x01\x02 not a sounding \xff" * 20)
    with pytest.raises(DataError, match=f"other{suffix}"):
        read_sounding(tmp_path / f"other{suffix}")
    (tmp_path / f"empty{suffix}").touch()
    with pytest.raises(DataError, match=f"empty{suffix}"):
        read_sounding(tmp_path / f"empty{suffix}")


def test_other_suffixes_are_refused(tmp_path):
    with pytest.raises(DataError, match=r"must end in .h5, .hdf5, .mat, .csv"):
        read_sounding(tmp_path / "site.npz")
    with pytest.raises(InputError, match=r"must end in .h5, .hdf5, .mat, .csv"):
        write_sounding(tmp_path / "site.npz", example())


def matlab(path, **changes):
    """What a user's MATLAB script saves: row vectors, no orientation, one isotropic element, other variables too."""
    fields = {
        "response": np.arange(10.0).reshape(2, 1, 1, 5) + 1j,
        "offsets": np.arange(5.0)[None] * 1e6,
        "frequency": 28e9,
        "tx_position": np.array([[0.0, 0.0, 2.0]]),
        "rx_position": np.array([[3.0, 4.0, 1.0], [1.0, 4.0, 1.0]]),
        "comment": "walked along the corridor",
        "notes": {"a": 1.0},
    }
    fields.update(changes)
    scipy.io.savemat(path, {name: value for name, value in fields.items() if value is not None})
    return path


def test_a_plain_matlab_file_is_read(tmp_path):
    sounding = read_sounding(matlab(tmp_path / "site.mat"))
    assert sounding.response.shape == (2, 1, 1, 5)
    assert complex(sounding.response[1, 0, 0, 2]) == 7 + 1j
    assert sounding.array_rx is None
    assert sounding.noise_power is None
    assert sounding.fov_rx == math.pi
    assert not sounding.delay_offset


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"response": None}, "expected the field 'response'"),
        ({"frequency": None}, r"expected the field 'frequency' \[\]; it is missing"),
        ({"rx_position": None}, r"expected the field 'rx_position' \[2, 3\]"),
        ({"frequency": 28.0}, "'frequency' must be in hertz"),
        ({"offsets": np.arange(4.0) * 1e6}, r"'offsets' must be \[5\]; got \[1, 4\]"),
        ({"offsets": 28e9 + np.arange(5.0) * 1e6}, "Subtract the carrier"),
        ({"fov_rx": 45.0}, "'fov_rx' must be in radians"),
        ({"delay_offset": 3.0}, "'delay_offset' must be 0 or 1"),
        ({"array_rx": np.array([1.5, 2.0, 0.5, 0.5])}, "'array_rx' must be rows, columns"),
        ({"array_rx": np.array([2.0, 2.0, 0.5, 0.5])}, r"response must be .* \[4, 1, 5\] last"),
        ({"array_rx": np.array([1.0, 1.0, 0.5, 0.5]), "pattern_rx": "yagi"}, "pattern must be one of"),
        ({"array_rx": np.array([1.0, 1.0, 0.5, 0.5]), "pattern_rx": 3.0}, "'pattern_rx' must be text"),
        ({"rx_position": np.full((2, 3), np.nan)}, "'rx_position' must be finite real numbers"),
        ({"noise_power": np.array([-1.0, 1.0])}, "noise_power must be"),
        ({"response": np.full((2, 1, 1, 5), np.nan)}, "NaN or infinite"),
        ({"response": {"real": 1.0}}, "'response' must be numbers or text; got a MATLAB struct"),
        ({"response": "loud"}, "expected the field 'response', complex"),
        ({"response": np.ones((2, 1, 1, 1, 5))}, r"'response' must be \[position, rx_ant, tx_ant, frequency\]"),
    ],
)
def test_fields_that_do_not_fit_are_one_error(tmp_path, changes, message):
    with pytest.raises(DataError, match=message) as caught:
        read_sounding(matlab(tmp_path / "site.mat", **changes))
    assert "site.mat" in str(caught.value)


def test_matlab_7_3_is_refused_by_name(tmp_path):
    (tmp_path / "site.mat").write_bytes(b"MATLAB 7.3 MAT-file".ljust(512) + b"\x89HDF\r\n\x1a\n" + bytes(600))
    with pytest.raises(DataError, match=r"is a MATLAB 7\.3 file; save it with -v7"):
        read_sounding(tmp_path / "site.mat")


def test_a_matlab_file_that_unpacks_without_end_is_refused(tmp_path):
    packer = zlib.compressobj(9)
    packed = b"".join(packer.compress(bytes(2**20)) for _ in range(96)) + packer.flush()
    head = b"MATLAB 5.0 MAT-file".ljust(124) + struct.pack("<H", 0x0100) + b"IM"
    (tmp_path / "bomb.mat").write_bytes(head + struct.pack("<II", 15, len(packed)) + packed)
    with pytest.raises(DataError, match="unpacks to far more than the file's size explains"):
        read_sounding(tmp_path / "bomb.mat")


CSV = """# frequency = 28e9
# tx_position = 0 0 2
# rx_position = 3 4 1; 1, 4, 1
# made by = hand
position, rx_ant, tx_ant, offset, real, imag
1,0,0,1e6,4,0
0,0,0,0,1,-1
1,0,0,0,3,0
0,0,0,1e6,2,0.5
"""


def test_rows_of_a_csv_file_come_in_any_order(tmp_path):
    (tmp_path / "site.csv").write_text(CSV)
    sounding = read_sounding(tmp_path / "site.csv")
    assert sounding.response.reshape(2, 2).tolist() == [[1 - 1j, 2 + 0.5j], [3, 4]]
    assert sounding.offsets.tolist() == [0.0, 1e6]
    assert sounding.rx.position[1].tolist() == [1.0, 4.0, 1.0]


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("0,0,0,1e6,2,0.5\n", "", "need 4 rows; got 3"),
        ("0,0,0,1e6,2,0.5", "0,0,0,0,2,0.5", "occur twice"),
        ("0,0,0,1e6,2,0.5", "0,0,0,1e6,2", "a row is not six numbers"),
        ("0,0,0,1e6,2,0.5", "0,0,0,1e6,2,loud", "a row is not six numbers"),
        ("0,0,0,1e6,2,0.5", "0,0,0,1e6,2,nan", "six finite numbers"),
        ("1,0,0,1e6,4,0", "1.5,0,0,1e6,4,0", "must count from 0"),
        ("1,0,0,1e6,4,0", "9e15,0,0,1e6,4,0", "must count from 0"),
        ("position, rx", "place, rx", "expected the line 'position,rx_ant"),
        ("3 4 1; 1, 4, 1", "3 4 1; 1 4", "'rx_position' must be numbers, rows apart by ';'"),
        ("# frequency = 28e9\n", "", "expected the field 'frequency'"),
    ],
)
def test_csv_files_that_do_not_fit_are_one_error(tmp_path, old, new, message):
    assert old in CSV
    (tmp_path / "site.csv").write_text(CSV.replace(old, new))
    with pytest.raises(DataError, match=message) as caught:
        read_sounding(tmp_path / "site.csv")
    assert "site.csv" in str(caught.value)


def test_hdf5_of_another_schema_or_version_is_refused(tmp_path):
    path = tmp_path / "site.h5"
    write_sounding(path, example())
    with h5py.File(path, "r+", libver="v110") as file:
        file.attrs["version"] = 2
    with pytest.raises(DataError, match="schema version 2 is not 1"):
        read_sounding(path)
    with h5py.File(path, "w", libver="v110") as file:
        file["response"] = np.zeros(3)
    with pytest.raises(DataError, match=r"schema = 'rf3dgs.sounding'; got None"):
        read_sounding(path)


def test_hdf5_parts_of_different_shape_are_refused(tmp_path):
    path = tmp_path / "site.h5"
    write_sounding(path, example())
    with h5py.File(path, "r+", libver="v110") as file:
        del file["response_imag"]
        file["response_imag"] = np.zeros((1, 4, 3, 6))
    with pytest.raises(DataError, match="'response_real' and 'response_imag' differ in shape"):
        read_sounding(path)


def test_damage_to_an_unpacked_matlab_file_is_one_error_or_none(tmp_path):
    path = matlab(tmp_path / "site.mat", array_rx=np.array([1.0, 1.0, 0.5, 0.5]), pattern_rx="patch")
    whole, generator = path.read_bytes(), np.random.default_rng(1)
    refused = 0
    for place in generator.integers(128, len(whole), 400):
        damaged = bytearray(whole)
        damaged[place] = int(generator.integers(256))
        path.write_bytes(bytes(damaged))
        error = error_of(path)
        refused += error is not None
        assert error is None or "site.mat" in error
    assert refused > 100


@pytest.mark.parametrize("packed", [False, True])
def test_matlab_variables_are_read_as_scipy_wrote_them(tmp_path, packed):
    path, generator = tmp_path / "some.mat", np.random.default_rng(0)
    wanted = {
        "cube": generator.normal(size=(2, 3, 4)) + 1j * generator.normal(size=(2, 3, 4)),
        "small": np.arange(6, dtype=np.int8).reshape(2, 3),
        "single": np.float32(0.5),
        "yes": np.array([True, False]),
        "nothing": np.zeros((0, 3)),
        "text": "grüße",
    }
    scipy.io.savemat(path, {**wanted, "other": {"a": [1, 2]}}, do_compression=packed)
    found = read_mat5(path, tuple(wanted))
    assert set(found) == set(wanted)
    assert found["text"] == wanted["text"]
    for name in ("cube", "small", "single", "yes", "nothing"):
        assert np.array_equal(found[name], np.atleast_2d(wanted[name])), name


def test_matlab_text_of_several_lines_and_variables_twice_are_refused(tmp_path):
    path = matlab(tmp_path / "site.mat", pattern_rx=np.array(["patch", "ghost"]))
    with pytest.raises(DataError, match="'pattern_rx' must be one line of text"):
        read_sounding(path)
    once = matlab(tmp_path / "site.mat").read_bytes()
    (tmp_path / "site.mat").write_bytes(once + once[128:])
    with pytest.raises(DataError, match=r"site\.mat.*occurs twice"):
        read_sounding(tmp_path / "site.mat")
