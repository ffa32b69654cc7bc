"""Spectra that stay in their file: what is read when, and what happens when the file is not what it was."""

import pickle
from dataclasses import replace

import pytest
import torch

from rf3dgs.core.errors import DataError, InputError
from rf3dgs.core.frames import Pose
from rf3dgs.core.grids import equirect_grid
from rf3dgs.data.dataset import Dataset
from rf3dgs.data.formats.spectra_codes import Precision
from rf3dgs.data.formats.spectra_h5 import common_scales, join_parts, read_spectra, write_part, write_spectra
from rf3dgs.data.formats.stored import SpectraFile, StoredSpectra
from rf3dgs.data.validate import validate
from rf3dgs.spectra.spectrum import Instrument, Spectrum, stack_spectra


@pytest.fixture
def reads(monkeypatch) -> list[tuple[str, int]]:
    """What is read from files of spectra: names of values, and of how many spectra."""
    seen: list[tuple[str, int]] = []
    read = SpectraFile.read

    def counted(self, names, index):
        seen.extend((name, len(index)) for name in names)
        return read(self, names, index)

    monkeypatch.setattr(SpectraFile, "read", counted)
    return seen


def same(first: Spectrum, second: Spectrum) -> bool:
    values = [(getattr(first, name), getattr(second, name)) for name in ("power", "delay", "aod")]
    poses = torch.equal(first.pose.position, second.pose.position)
    return poses and all(torch.equal(one, other) for one, other in values)


def test_values_are_read_when_they_are_asked_for_and_not_before(saved, reads):
    dataset = Dataset.load(saved, unseal_test=True)
    parts = [dataset.train, dataset.validation, dataset.test, dataset.region, dataset.split(seed=4).train]
    assert [len(part.spectra) for part in parts] == [len(part.index) for part in parts]
    assert dataset.pose.position.shape == (20, 3)
    assert dataset.grid.shape == (8, 16)
    assert "StoredSpectra(20 of" in repr(dataset.spectra)
    assert reads == []
    one = parts[0].spectra[2]
    assert [*reads] == [("power", 1), ("delay", 1), ("aod", 1)]
    assert one.power.shape == (8, 16)
    assert parts[0].spectra.power.shape == (len(parts[0].index), 8, 16)
    assert reads[3:] == [("power", len(parts[0].index))]
    assert parts[0].spectra.power is parts[0].spectra.power
    assert len(reads) == 4


def test_any_way_of_looking_gives_the_same_values(saved):
    dataset = Dataset.load(saved, unseal_test=True)
    stored = dataset.spectra
    whole = replace(stored)
    assert type(whole) is Spectrum
    places = torch.tensor([7, 2, 2, 19])
    mask = whole.power.amax((-2, -1)) > whole.power.amax((-2, -1)).median()
    for index in (3, -1, slice(4, 9, 2), places, mask):
        assert same(stored[index], whole[index])
    assert same(stored[places][1:3], whole[places][1:3])
    assert same(stack_spectra(list(stored)), whole)
    assert same(stack_spectra([stored[:12], stored[12:]]), whole)
    assert same(pickle.loads(pickle.dumps(stored[places])), whole[places])
    torch.testing.assert_close(stored.path_gain, whole.path_gain)
    assert same(stored[5:8], whole[5:8])
    with pytest.raises(IndexError, match="there are 20 spectra; there is no number 20"):
        _ = Dataset.load(saved, unseal_test=True).spectra[20]


def test_a_file_that_changed_after_it_was_opened_is_refused(saved, spectra):
    dataset = Dataset.load(saved, unseal_test=True)
    write_spectra(saved / "spectra.h5", spectra)
    with pytest.raises(DataError, match=r"spectra\.h5: was changed after the dataset was loaded; load it again"):
        _ = dataset.train.spectra.power
    with pytest.raises(DataError, match=r"was changed after the dataset was loaded; load it again"):
        dataset.save(saved.parent / "copy")
    (saved / "spectra.h5").unlink()
    with pytest.raises(DataError, match=r"spectra\.h5: cannot be read"):
        _ = dataset.train.spectra[0]


def test_a_damaged_picture_is_refused_and_the_others_are_read(saved):
    file = saved / "spectra.h5"
    stored, _, _ = read_spectra(file)
    with stored.source._opened() as group:
        place = group["gain"].id.get_chunk_info(5)
    content = bytearray(file.read_bytes())
    content[place.byte_offset + place.size // 2] ^= 255
    file.write_bytes(content)
    stored, _, _ = read_spectra(file)
    assert stored[4].power.amax() > 0
    with pytest.raises(DataError, match=r"spectra\.h5: cannot be read .* damaged"):
        _ = stored[5]
    assert any("damaged" in str(fault) for fault in validate(saved))


def test_saving_what_a_file_holds_copies_it_and_anything_else_is_written_anew(saved, tmp_path):
    before = (saved / "spectra.h5").read_bytes()
    dataset = Dataset.load(saved)
    dataset.split(seed=9).save(tmp_path / "again")
    assert (tmp_path / "again" / "spectra.h5").read_bytes() == before
    coarse = dataset.save(tmp_path / "coarse", precision=Precision(gain_db=0.1))
    assert (tmp_path / "coarse" / "spectra.h5").stat().st_size < len(before)
    whole, rough = dataset._spectra, coarse._spectra
    some = whole.power > 0
    error = (rough.gain_db - whole.gain_db)[some].abs().max()
    assert 0.03 < float(error) < 0.0501, "half a step of 0.1 dB"
    named = Dataset((), whole, meta={"generator": "another"}).save(tmp_path / "named")
    assert same(named._spectra, whole)
    assert validate(tmp_path / "named") == []
    few = Dataset((), whole[torch.tensor([3, 1])]).save(tmp_path / "few")
    assert few._repeat is None
    assert float((few._spectra.gain_db - whole[torch.tensor([3, 1])].gain_db).abs().max()) < 0.0026


def test_parts_written_one_by_one_are_one_file_in_the_end(spectra, tmp_path):
    scales = common_scales(Precision(), longest=float(spectra.delay.max()))
    parts = []
    for start in range(0, 20, 7):
        parts.append(tmp_path / f"{start}.h5")
        some = [spectra[start : start + 4], spectra[start + 4 : min(start + 7, 20)]]
        write_part(parts[-1], some, sum(map(len, some)), scales, {"generator": "test", "seed": 3})
    join_parts(parts, tmp_path / "joined.h5", 20)
    write_part(tmp_path / "at-once.h5", [spectra], 20, scales, {"generator": "test", "seed": 3})
    joined, _, _ = read_spectra(tmp_path / "joined.h5")
    at_once, _, _ = read_spectra(tmp_path / "at-once.h5")
    assert same(joined, at_once)
    assert same(joined[9], at_once[9])
    assert float((joined.gain_db - spectra.gain_db)[spectra.power > 0].abs().max()) < 0.00251
    assert float((joined.delay - spectra.delay)[spectra.power > 0].abs().max()) < 5.1e-12
    assert joined.tx is not None
    torch.testing.assert_close(joined.tx.position, spectra.tx.position)
    with pytest.raises(InputError, match="expected 21 spectra; got 20"):
        join_parts(parts, tmp_path / "short.h5", 21)
    with pytest.raises(InputError, match=r"delay must lie between .* to be stored in steps of"):
        write_part(tmp_path / "late.h5", [spectra], 20, common_scales(Precision(delay=1e-13), longest=1e-9), {})
    other = common_scales(Precision(gain_db=0.01), longest=float(spectra.delay.max()))
    write_part(tmp_path / "other.h5", [spectra], 20, other, {})
    with pytest.raises(DataError, match=r"other\.h5: is stored in other scales than the parts before"):
        join_parts([parts[0], tmp_path / "other.h5"], tmp_path / "mixed.h5", 27)


def test_a_stored_spectrum_without_delays_says_so(spectra, tmp_path):
    write_spectra(tmp_path / "s.h5", replace(spectra, delay=None, aod=None))
    stored, _, _ = read_spectra(tmp_path / "s.h5")
    assert isinstance(stored, StoredSpectra)
    assert stored.delay is None
    assert stored[0].aod is None
    assert stored[0].delay is None


def test_pictures_of_little_but_nothing_are_read_back(tmp_path):
    count, rows, cols = 450, 100, 200
    power = torch.zeros(count, rows, cols)
    power[:, 50, 100] = 1e-9
    pose = Pose.scatter(((0, 0, 0), (9, 9, 2)), count, seed=0)
    aod = torch.zeros(1, rows, cols, 3).expand(count, -1, -1, -1)
    few = Spectrum(power, equirect_grid(cols, rows), pose, 6e10, Instrument.gaussian(0.1), "ideal", 1e2 * power, aod)
    write_spectra(tmp_path / "s.h5", few)
    declared = 8 * count * rows * cols
    assert declared > 200 * (tmp_path / "s.h5").stat().st_size, "more than is believed of other files"
    assert declared > 64 * 2**20
    stored, _, _ = read_spectra(tmp_path / "s.h5")
    assert float(stored[449].gain_db.max()) == pytest.approx(-90.0, abs=0.0026)
