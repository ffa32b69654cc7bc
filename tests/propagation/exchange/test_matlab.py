"""What is written for MATLAB, parsed here; MATLAB itself is not run."""

import math
import re
from dataclasses import replace

import h5py
import numpy as np
import pytest
from scipy.io import loadmat

from rf3dgs.channel.binning import stack_paths
from rf3dgs.channel.io import save_paths
from rf3dgs.channel.response import cfr
from rf3dgs.core.errors import DataError, InputError
from rf3dgs.core.frames import Pose
from rf3dgs.core.units import SPEED_OF_LIGHT
from rf3dgs.propagation.exchange.matlab import READER, ray_rows, write_mat, write_matlab
from rf3dgs.propagation.room import shoebox

SIZE, TX, FREQUENCY = (8.0, 6.0, 3.0), Pose((1.0, 1.5, 2.3)), 28e9
RX = Pose([[4.0, 3.2, 1.2], [2.0, 4.0, 0.7]])


@pytest.fixture
def paths():
    return shoebox(SIZE, TX, RX, FREQUENCY, 2, "concrete")


def parsed(text):
    """Frequency, positions and the rows of each receiver, as MATLAB would read the literals."""
    number = r"-?\d+(?:\.\d+)?(?:e[+-]?\d+)?"
    rows = {}
    for index, body in re.findall(r"^paths\{(\d+)\} = (\[\n.*?\n\]|zeros\(0, 7\));$", text, re.DOTALL | re.MULTILINE):
        lines = [] if body.startswith("zeros") else body.split("\n")[1:-1]
        assert all(re.fullmatch(rf"{number}( {number}){{6}}", line) for line in lines)
        rows[int(index)] = np.array([[float(value) for value in line.split()] for line in lines]).reshape(-1, 7)
    frequency = float(re.search(rf"^frequency = ({number});$", text, re.MULTILINE)[1])
    tx = np.array(re.search(r"^txPosition = \[(.*)\]';$", text, re.MULTILINE)[1].split(), dtype=float)
    rx = re.search(r"^rxPosition = \[\n(.*?)\n\]';$", text, re.DOTALL | re.MULTILINE)[1]
    return frequency, tx, np.array([line.split() for line in rx.split("\n")], dtype=float), rows


def test_the_numbers_of_the_rays_parse_back_exactly(paths, tmp_path):
    write_matlab(tmp_path / "my_rays.m", paths, strongest=6)
    frequency, tx, rx, rows = parsed((tmp_path / "my_rays.m").read_text())
    assert frequency == FREQUENCY
    assert np.array_equal(tx, TX.position.double().numpy())
    assert np.array_equal(rx, RX.position.double().numpy())
    for index in range(2):
        assert np.array_equal(rows[index + 1], ray_rows(paths[index].strongest(6)).numpy())


def test_rays_have_matlabs_units_and_add_up_to_our_channel(paths, tmp_path):
    """Sum of 10^(-PathLoss/20) exp(-j PhaseShift): the narrow-band channel with its carrier."""
    write_matlab(tmp_path / "my_rays.m", paths, strongest=100)
    rows = parsed((tmp_path / "my_rays.m").read_text())[3]
    for index in range(2):
        delay, loss, lag, aod_az, aod_el, aoa_az, aoa_el = rows[index + 1].T
        ours = complex(cfr(paths[index]).squeeze())
        assert (10 ** (-loss / 20) * np.exp(-1j * lag)).sum() == pytest.approx(ours, rel=1e-5)
        assert ((lag >= 0) & (lag < 2 * math.pi)).all()
        towards = (RX.position[index] - TX.position).double().numpy()
        distance = np.linalg.norm(towards)
        assert delay[0] * SPEED_OF_LIGHT == pytest.approx(distance, rel=1e-6)
        assert aod_el[0] == pytest.approx(math.degrees(math.asin(towards[2] / distance)), abs=1e-4)
        assert aoa_el[0] == pytest.approx(-aod_el[0], abs=1e-4)
        assert aod_az[0] == pytest.approx(math.degrees(math.atan2(towards[1], towards[0])), abs=1e-4)
        assert abs(abs(aoa_az[0] - aod_az[0]) - 180) < 1e-4
        assert (np.diff(loss) > -1e-5).all(), "strongest first, but for float32 ties"


def test_the_function_sets_the_properties_of_a_ray(paths, tmp_path):
    """Names and values of comm.Ray's documentation; brackets and blocks close."""
    write_matlab(tmp_path / "my_rays.m", paths)
    text = (tmp_path / "my_rays.m").read_text()
    assert text.startswith("function [rays, txPosition, rxPosition] = my_rays()\n")
    assert "'PathSpecification', 'Delay and angles'" in text
    assert "'PathLossSource', 'Custom'" in text
    for name in ("PropagationDelay", "PathLoss", "PhaseShift", "AngleOfDeparture", "AngleOfArrival"):
        assert f"found(k).{name} = row(" in text
    _closes(text)


def _closes(text):
    code = [re.sub(r"'[^']*'", "", line.split("%")[0]) if "]'" not in line else line for line in text.split("\n")]
    words = re.findall(r"\b(?:function|for|if|end)\b", re.sub(r"\(end\)", "", "\n".join(code)))
    assert words.count("end") == sum(words.count(word) for word in ("function", "for", "if"))
    for pair in ("()", "[]", "{}"):
        assert text.count(pair[0]) == text.count(pair[1])


def test_a_receiver_without_paths_has_no_rays(random_paths, tmp_path):
    write_matlab(tmp_path / "few.m", stack_paths([random_paths(0), random_paths(3)]))
    rows = parsed((tmp_path / "few.m").read_text())[3]
    assert [len(rows[1]), len(rows[2])] == [0, 3]


@pytest.mark.parametrize("name", ["2rays.m", "my rays.m", "rays.txt", "a" * 64 + ".m"])
def test_a_name_that_matlab_would_not_call_is_refused(paths, tmp_path, name):
    with pytest.raises(InputError, match=r"is named like my_rays\.m: letters, digits and _; got"):
        write_matlab(tmp_path / name, paths)
    assert not list(tmp_path.iterdir())


def test_no_paths_at_all_are_refused(paths, tmp_path):
    with pytest.raises(InputError, match="strongest must be at least 1; got 0"):
        write_matlab(tmp_path / "rays.m", paths, strongest=0)


def test_paths_survive_a_mat_file(paths, random_paths, tmp_path):
    rows = [random_paths(4), random_paths(0), random_paths(9, seed=3)]
    sent = stack_paths([replace(row, rx=Pose.from_yaw((3.0, 4.0, index), 0.3)) for index, row in enumerate(rows)])
    hole = sent.valid.clone()
    hole[2, 0] = False
    sent = replace(sent, valid=hole)
    write_mat(tmp_path / "a.mat", sent)
    back = loadmat(tmp_path / "a.mat")
    assert back["count"].ravel().tolist() == [4, 0, 8]
    for name in ("coeff", "delay", "aoa_zenith", "aoa_azimuth", "aod_zenith", "aod_azimuth"):
        assert back[name].shape == (3, 8)
        for index in range(3):
            count = int(sent.count[index])
            expected = getattr(sent, name)[index][sent.valid[index]].numpy()
            assert np.array_equal(back[name][index, :count], expected), name
            assert np.isnan(back[name][index, count:]).all()
    assert back["kind"].dtype == np.int8
    assert float(back["frequency"].item()) == sent.frequency
    assert np.array_equal(back["rx_orientation"], sent.rx.orientation.numpy())
    assert np.array_equal(back["tx_position"], sent.tx.position.numpy()[None])


def test_nothing_is_written_when_writing_a_mat_file_fails(paths, tmp_path, monkeypatch):
    def fail(stream, *_, **__):
        stream.write(b"half")
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("scipy.io.savemat", fail)
    with pytest.raises(DataError, match="No space left on device; free space or choose another folder"):
        write_mat(tmp_path / "a.mat", paths)
    assert not list(tmp_path.iterdir())


def test_matlabs_reader_names_what_our_files_hold(paths, tmp_path):
    """Every dataset and attribute that read_paths.m asks for is in a file, and it asks for all of them."""
    save_paths(paths, tmp_path / "a.paths")
    text = READER.read_text()
    _closes(text)
    lists = re.findall(r"^(?:columns|optional) = \{(.*)\};$", text, re.MULTILINE)
    asked = set(re.findall(r"h5read\(file, '/(\w+)'\)", text)) | set(re.findall(r"'(\w+)'", " ".join(lists)))
    with h5py.File(tmp_path / "a.paths") as file:
        assert asked == set(file)
        attributes = set(re.findall(r"h5readatt\(file, '/', '(\w+)'\)", text))
        assert attributes <= set(file.attrs)
        assert file["rx_position"].shape == (2, 3), "MATLAB sees 3 x N"
        assert file.attrs["schema"].decode().startswith("rf3dgs.paths")
