"""DeepMIMO v4 folders: what is written comes back, and what cannot be is refused in one sentence."""

import errno
import json
import math
import zipfile
from dataclasses import replace

import numpy as np
import pytest
import torch

from rf3dgs.channel.binning import stack_paths
from rf3dgs.channel.response import cfr
from rf3dgs.core.angles import angle_between
from rf3dgs.core.errors import DataError, InputError
from rf3dgs.core.frames import Pose
from rf3dgs.core.units import SPEED_OF_LIGHT
from rf3dgs.propagation.exchange import deepmimo_write
from rf3dgs.propagation.exchange.deepmimo import SIONNA, deepmimo_pairs, read_deepmimo
from rf3dgs.propagation.exchange.deepmimo_write import PAIR, write_deepmimo
from rf3dgs.propagation.room import shoebox

SIZE, TX, FREQUENCY = (8.0, 6.0, 3.0), Pose((1.0, 1.5, 2.3)), 28e9
RX = Pose([[4.0, 3.2, 1.2], [2.0, 4.0, 0.7], [6.5, 2.5, 1.9]])


@pytest.fixture
def paths():
    return shoebox(SIZE, TX, RX, FREQUENCY, 2, ["concrete", "glass", -0.7, 0.5j, "wood", "metal"])


@pytest.fixture
def folder(paths, tmp_path):
    write_deepmimo(tmp_path / "site", paths)
    return tmp_path / "site"


def replace_matrix(folder, name, change, pair=PAIR):
    """Write the matrix `name` again after `change` of its array."""
    file = folder / f"{name}_{pair}.npz"
    with np.load(file) as content:
        array = content[name].copy()
    np.savez_compressed(file, **{name: change(array)})
    return file


def set_entry(row, column, value):
    def change(array):
        array[row, column] = value
        return array

    return change


def test_paths_survive_the_folder(paths, folder):
    """Decibels and degrees in float32 keep 1e-6 of an amplitude and 3e-5 degrees of a phase or an angle."""
    back = read_deepmimo(folder)
    sent = paths.strongest(25)
    assert torch.equal(back.valid, sent.valid)
    assert torch.equal(back.delay, sent.delay)
    assert torch.allclose(back.coeff, sent.coeff, rtol=5e-6, atol=1e-12)
    assert float(angle_between(back.aoa, sent.aoa).max()) < 1e-6
    assert float(angle_between(back.aod, sent.aod).max()) < 1e-6
    assert torch.equal(back.order, sent.order)
    assert torch.equal(back.kind, sent.kind)
    assert torch.equal(back.rx.position, RX.position)
    assert torch.equal(back.tx.position, TX.position)
    assert back.frequency == FREQUENCY


def test_channels_survive_the_folder_with_the_carrier(paths, folder):
    """Coherent sums of 25 paths; only the strongest were written."""
    expected = cfr(paths.strongest(25))
    assert torch.allclose(cfr(read_deepmimo(folder)), expected, atol=2e-5 * float(expected.abs().max()))


def test_receivers_without_paths_and_padding_are_nan(paths, random_paths, tmp_path):
    rows = [random_paths(30), random_paths(0), random_paths(4, seed=2)]
    sent = stack_paths([replace(row, rx=Pose((3.0, 4.0 + index, 1.0))) for index, row in enumerate(rows)])
    write_deepmimo(tmp_path / "site", sent)
    with np.load(tmp_path / "site" / f"power_{PAIR}.npz") as content:
        power = content["power"]
    assert power.shape == (3, 25)
    assert (~np.isnan(power)).sum(-1).tolist() == [25, 0, 4]
    for name in ("phase", "delay", "aoa_az", "aod_el", "inter"):
        with np.load(tmp_path / "site" / f"{name}_{PAIR}.npz") as content:
            assert np.array_equal(np.isnan(content[name]), np.isnan(power)), name
    assert read_deepmimo(tmp_path / "site").count.tolist() == [25, 0, 4]


def test_the_files_are_those_of_the_specification(folder):
    """Written by hand from the specification: names, shapes, units, and the zenith that is called elevation."""
    names = {
        "power",
        "phase",
        "delay",
        "aoa_az",
        "aoa_el",
        "aod_az",
        "aod_el",
        "inter",
        "inter_pos",
        "rx_pos",
        "tx_pos",
    }
    arrays = {}
    for name in names:
        with np.load(folder / f"{name}_{PAIR}.npz", allow_pickle=False) as content:
            assert content.files == [name]
            arrays[name] = content[name]
            assert arrays[name].dtype == np.float32
    first = (RX.position[0] - TX.position).double().numpy()
    distance = np.linalg.norm(first)
    loss = 20 * math.log10(SPEED_OF_LIGHT / FREQUENCY / (4 * math.pi * distance))
    assert arrays["power"][0, 0] == pytest.approx(loss, abs=1e-4)
    assert arrays["delay"][0, 0] == pytest.approx(distance / SPEED_OF_LIGHT, rel=1e-6)
    assert arrays["aod_el"][0, 0] == pytest.approx(math.degrees(math.acos(first[2] / distance)), abs=1e-3)
    assert arrays["aoa_el"][0, 0] == pytest.approx(180 - arrays["aod_el"][0, 0], abs=1e-3)
    assert arrays["aod_az"][0, 0] == pytest.approx(math.degrees(math.atan2(first[1], first[0])), abs=1e-3)
    # Whole turns of the carrier over the path, less; a float32 delay of 12 ns is exact to 0.02 turns of 28 GHz.
    whole = -360 * FREQUENCY * float(arrays["delay"][0, 0])
    assert (arrays["phase"][0, 0] - whole + 180) % 360 - 180 == pytest.approx(0, abs=0.01)
    assert set(np.unique(arrays["inter"][~np.isnan(arrays["inter"])])) == {0, 1, 11}
    assert arrays["inter_pos"].shape == (3, 25, 2, 3)
    document = json.loads((folder / "params.json").read_text())
    assert document["rt_params"]["frequency"] == FREQUENCY
    sets = {entry["id"]: entry for entry in document["txrx_sets"].values()}
    assert sets[0]["is_tx"]
    assert sets[1]["is_rx"]
    assert sets[1]["num_points"] == 3


@pytest.mark.parametrize(
    ("order", "kind", "code"),
    [
        (0, 0, 0),
        (1, 1, 1),
        (3, 1, 111),
        (1, 2, 3),
        (2, 3, 13),
        (4, 3, 1113),
        (2, 2, 33),
        (3, 5, 411),
        (1, 8, 2),
        (2, 12, 42),
    ],
)
def test_interactions_are_digits_with_scattering_last(random_paths, tmp_path, order, kind, code):
    paths = random_paths(1)
    paths = replace(paths, order=torch.tensor([order]), kind=torch.tensor([kind]))
    write_deepmimo(tmp_path / "site", paths)
    with np.load(tmp_path / "site" / f"inter_{PAIR}.npz") as content:
        assert content["inter"].tolist() == [[code]]
    back = read_deepmimo(tmp_path / "site")
    assert (int(back.order), int(back.kind)) == (order, kind)


def test_long_interaction_codes_keep_order_and_kind(folder):
    """Ten digits do not fit into a float32: the first seven say the kinds, their number is exact."""
    replace_matrix(folder, "inter", set_entry(0, 0, np.float32(1131111111)))
    back = read_deepmimo(folder)
    assert int(back.order[0, 0]) == 10
    assert int(back.kind[0, 0]) == 3


def test_without_interactions_order_and_kind_are_unknown(paths, tmp_path):
    write_deepmimo(tmp_path / "site", replace(paths, kind=None))
    assert not list((tmp_path / "site").glob("inter*"))
    back = read_deepmimo(tmp_path / "site")
    assert back.order is None
    assert back.kind is None


def test_sionnas_folders_have_the_coefficients_phase(paths, folder):
    file = folder / "params.json"
    document = json.loads(file.read_text())
    document["rt_params"]["raytracer_name"] = SIONNA
    file.write_text(json.dumps(document))
    sent = paths.strongest(25)
    replace_matrix(folder, "phase", lambda _: np.degrees(sent.coeff.angle().numpy()))
    assert torch.allclose(read_deepmimo(folder).coeff, sent.coeff, rtol=5e-6, atol=1e-12)
    whole = read_deepmimo(folder, phase="path")
    assert not torch.allclose(whole.coeff, sent.coeff, rtol=0.1)


def test_azimuths_of_a_full_turn_are_wrapped(folder):
    replace_matrix(folder, "aoa_az", lambda array: np.mod(array, 360.0))
    back = read_deepmimo(folder)
    assert float(back.aoa_azimuth.abs().max()) <= math.pi + 1e-6


def test_a_transmitter_may_be_a_row_or_a_triple(folder):
    """DeepMIMO's converters write either."""
    replace_matrix(folder, "tx_pos", lambda array: array.reshape(3))
    assert torch.equal(read_deepmimo(folder).tx.position, TX.position)


def test_one_of_several_pairs_is_chosen_by_name(folder):
    for file in list(folder.glob(f"*_{PAIR}.npz")):
        (folder / file.name.replace(PAIR, "t000_tx001_r001")).write_bytes(file.read_bytes())
    assert [pair.code for pair in deepmimo_pairs(folder)] == [PAIR, "t000_tx001_r001"]
    with pytest.raises(InputError, match=rf"several pairs .* one of {PAIR} \(3 receivers\), t000_tx001_r001"):
        read_deepmimo(folder)
    with pytest.raises(InputError, match="has no pair 't009_tx000_r000'; it has"):
        read_deepmimo(folder, "t009_tx000_r000")
    assert read_deepmimo(folder, "t000_tx001_r001").coeff.shape == (3, 25)


def test_an_older_scenario_is_replaced_and_other_folders_are_not(paths, folder, tmp_path):
    write_deepmimo(folder, paths[:1])
    assert read_deepmimo(folder).coeff.shape[0] == 1
    (folder / "diary.txt").write_text("dear diary")
    with pytest.raises(InputError, match=r"holds something else than a DeepMIMO scenario, such as diary\.txt"):
        write_deepmimo(folder, paths)
    assert (folder / "diary.txt").read_text() == "dear diary"
    with pytest.raises(InputError, match="max_paths must be at least 1"):
        write_deepmimo(tmp_path / "new", paths, max_paths=0)
    assert sorted(item.name for item in tmp_path.iterdir()) == ["site"]


@pytest.mark.parametrize(
    ("name", "change", "message"),
    [
        (
            "phase",
            set_entry(1, 2, np.nan),
            r"phase_.*path 2 of receiver 1 is nan but its other matrices are not all NaN",
        ),
        ("power", set_entry(0, 1, -np.inf), r"power_.*path 1 of receiver 0 is -inf"),
        ("power", set_entry(0, 1, 47.0), r"path 1 of receiver 0 has 47, which cannot be dB of path gain"),
        ("delay", lambda array: 1e9 * array, r"delay_.*has 12.\d+, which cannot be seconds"),
        ("delay", lambda array: 0 * array, r"has 0, which cannot be seconds, no earlier than light"),
        (
            "aoa_el",
            lambda array: 90 - array,
            r"aoa_el_.*cannot be degrees from \+z; an elevation from the horizon is 90",
        ),
        ("aod_az", lambda array: 10 * array, r"aod_az_.*cannot be degrees"),
        ("rx_pos", lambda array: array[:2], r"power_.*expected a row for each of the 2 receivers"),
        ("rx_pos", set_entry(0, 0, np.nan), r"rx_pos_.*expected finite positions x y z"),
        ("rx_pos", lambda array: 1e3 * array, r"delay_.*convert them \(and positions to metres\)"),
        ("tx_pos", lambda array: array[:, :2], r"tx_pos_.*one transmitter"),
        ("aod_el", lambda array: array[:, :3], r"aod_el_.*as many columns as in power"),
        ("inter", set_entry(0, 0, 17), r"inter_.*the interaction code 17 has digits other than 1 to 4"),
        ("inter", set_entry(0, 0, -1), r"inter_.*expected interaction codes of every path"),
        (
            "delay",
            lambda array: array.astype(object),
            r"delay_.*expected an array of real numbers; got the dtype object",
        ),
        ("delay", lambda array: array + 1j, r"delay_.*got the dtype complex"),
    ],
)
def test_impossible_values_are_refused_by_the_name_of_their_file(folder, name, change, message):
    replace_matrix(folder, name, change)
    with pytest.raises(DataError, match=message) as caught:
        read_deepmimo(folder)
    assert str(folder) in str(caught.value)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("{", "expected JSON with the carrier in rt_params.frequency"),
        ("[" * 100_000, "expected JSON with the carrier"),
        ("[]", "expected JSON with the carrier"),
        ('{"rt_params": {}}', "KeyError"),
        ('{"rt_params": {"frequency": 28}}', "must be in hertz, 100 MHz to 1 THz; got 28"),
        ('{"rt_params": {"frequency": NaN}}', "must be in hertz"),
    ],
)
def test_damaged_parameters_are_refused(folder, text, message):
    (folder / "params.json").write_text(text)
    with pytest.raises(DataError, match=message):
        read_deepmimo(folder)


def test_foreign_and_incomplete_folders_are_refused(folder, tmp_path):
    with pytest.raises(DataError, match=r"expected a DeepMIMO v4 scenario folder; it has no params.json"):
        read_deepmimo(tmp_path)
    with pytest.raises(InputError, match='phase must be "auto", "path" or "coefficient"'):
        read_deepmimo(folder, phase="total")
    (folder / f"delay_{PAIR}.npz").unlink()
    with pytest.raises(DataError, match=rf"delay_{PAIR}.npz: there is no such file"):
        read_deepmimo(folder)
    for file in folder.glob("*.npz"):
        file.unlink()
    with pytest.raises(DataError, match=r"it has no power_t\*_tx\*_r\*.npz"):
        read_deepmimo(folder)
    (folder / "power_t001_tx000_r000.mat").touch()
    with pytest.raises(DataError, match=r"it has matrices as .mat. Save it with DeepMIMO 4.0 or later"):
        read_deepmimo(folder)
    (folder / "scene_0").mkdir()
    with pytest.raises(DataError, match="but folders, as a scenario of several scenes has"):
        read_deepmimo(folder)


def test_a_folder_with_flipped_bytes_is_refused_or_reads_as_it_was(folder):
    """The checksums of the zip format notice damage; what they do not cover may be read, but never crashes."""
    good = read_deepmimo(folder)
    file = folder / f"power_{PAIR}.npz"
    whole = file.read_bytes()
    refused = 0
    for position in np.random.default_rng(0).integers(0, len(whole), 150):
        damaged = bytearray(whole)
        damaged[position] ^= 0x10
        file.write_bytes(bytes(damaged))
        try:
            read = read_deepmimo(folder).coeff
        except DataError:
            refused += 1
        else:
            assert torch.equal(read, good.coeff)
    assert refused > 100


def test_a_zip_bomb_is_refused_before_it_is_read(folder):
    file = folder / f"power_{PAIR}.npz"
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive, archive.open("power.npy", "w") as stream:
        np.lib.format.write_array_header_1_0(stream, {"descr": "<f4", "fortran_order": False, "shape": (3, 25_000_000)})
        for _ in range(300):
            stream.write(bytes(10**6))
    assert file.stat().st_size < 400_000
    with pytest.raises(
        DataError, match=r"declares 300000128 bytes, more than the \d+ that a file of its size may hold"
    ):
        read_deepmimo(folder)


def test_a_disk_that_fills_up_leaves_the_older_scenario(paths, folder, monkeypatch):
    before = {item.name: item.read_bytes() for item in folder.iterdir()}
    save = deepmimo_write._save

    def fail(path, name, matrix):
        if name == "inter":
            raise OSError(errno.ENOSPC, "No space left on device")
        save(path, name, matrix)

    monkeypatch.setattr(deepmimo_write, "_save", fail)
    with pytest.raises(DataError, match=r"cannot write .*site: No space left on device; free space or choose another"):
        write_deepmimo(folder, paths[:1])
    assert {item.name: item.read_bytes() for item in folder.iterdir()} == before
    assert [item.name for item in folder.parent.iterdir()] == ["site"]
