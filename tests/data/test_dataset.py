import dataclasses
import json
import logging
import math

import h5py
import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from rf3dgs.core.angles import angle_between
from rf3dgs.core.errors import DataError, InputError, SealedError
from rf3dgs.core.frames import Pose
from rf3dgs.core.grids import list_grid, pinhole_grid
from rf3dgs.core.hdf5 import open_audited, read_attribute
from rf3dgs.data.dataset import Dataset
from rf3dgs.data.formats.spectra_codes import Precision, octahedral_of, vector_of
from rf3dgs.data.formats.spectra_h5 import read_spectra, write_spectra
from rf3dgs.data.photo import Photo
from rf3dgs.spectra.spectrum import Instrument, Spectrum


def test_a_saved_dataset_is_read_back(dataset, tmp_path):
    split = dataset.split(seed=1)
    found = split.save(tmp_path / "site", precision=None)
    before, after = split._spectra, found._spectra
    assert found.roles == split.roles
    assert found.photo_roles == split.photo_roles
    assert found.meta == split.meta
    assert found.path == tmp_path / "site"
    assert (after.frequency, after.method, after.instrument) == (before.frequency, before.method, before.instrument)
    assert after.grid.same_as(before.grid)
    torch.testing.assert_close(after.pose.position, before.pose.position)
    torch.testing.assert_close(after.tx.position, before.tx.position)
    some = before.power > 0
    assert torch.equal(after.power > 0, some)
    assert float((after.gain_db - before.gain_db)[some].abs().max()) < 0.003
    assert float((after.delay - before.delay)[some].abs().max()) < 6e-12
    assert math.degrees(float(angle_between(after.aod, before.aod)[some].max())) < 0.1
    assert [photo.name for photo in found.photos] == [photo.name for photo in split.photos]
    for old, new in zip(split.photos, found.photos, strict=True):
        torch.testing.assert_close(new.camera.viewmat, old.camera.viewmat)
        torch.testing.assert_close(new.camera.K, old.camera.K)
        assert torch.equal(new.load(), old.load())
    assert torch.equal(found.repeat_index, split.repeat_index)


@settings(max_examples=15, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_any_spectra_survive_the_file(tmp_path, data):
    count, rows, cols = (data.draw(st.integers(1, 4)) for _ in range(3))
    low = data.draw(st.floats(-250, 0))
    span = data.draw(st.floats(0, 200))
    longest = data.draw(st.floats(1e-9, 1e-4))
    generator = torch.Generator().manual_seed(data.draw(st.integers(0, 1000)))
    shape = (count, rows, cols)
    gain = low + span * torch.rand(shape, generator=generator, dtype=torch.float64)
    power = (10 ** (gain / 10)).float() * (torch.rand(shape, generator=generator) > 0.3)
    delay = longest * torch.rand(shape, generator=generator)
    aod = torch.nn.functional.normalize(torch.randn(*shape, 3, generator=generator), dim=-1)
    K = torch.tensor([[5.0, 0, cols / 2], [0, 6.0, rows / 2], [0, 0, 1]])
    grid = data.draw(st.sampled_from(["pinhole", "list"]))
    if grid == "pinhole":
        grid = pinhole_grid(cols, rows, K=K)
    else:
        grid = list_grid(torch.randn(rows * cols, 3, generator=generator), torch.ones(rows * cols))
        power, delay, aod = power.reshape(count, 1, -1), delay.reshape(count, 1, -1), aod.reshape(count, 1, -1, 3)
    pose = Pose(torch.randn(count, 3, generator=generator), torch.randn(count, 4, generator=generator))
    spectrum = Spectrum(power, grid, pose, 2.4e9, Instrument.gaussian(0.1), "ideal", delay, aod)
    write_spectra(tmp_path / "spectra.h5", spectrum)
    found, repeat, index = read_spectra(tmp_path / "spectra.h5")
    assert repeat is None
    assert index is None
    assert found.tx is None
    some = power > 0
    assert torch.equal(found.power > 0, some)
    torch.testing.assert_close(found.pose.orientation, pose.orientation)
    assert found.grid.same_as(grid)
    torch.testing.assert_close(found.grid.solid_angle, grid.solid_angle)
    if some.any():
        assert float((found.gain_db - spectrum.gain_db)[some].abs().max()) < max(0.005, span / 60_000)
        assert float((found.delay - delay)[some].abs().max()) < max(6e-12, longest / 60_000)
        assert math.degrees(float(angle_between(found.aod, aod)[some].max())) < 0.1


@given(st.lists(st.floats(-1, 1), min_size=3, max_size=3).filter(lambda v: np.linalg.norm(v) > 1e-3))
def test_the_octahedral_map_and_back_is_the_same_direction(vector):
    vector = np.array(vector) / np.linalg.norm(vector)
    components = octahedral_of(vector)
    assert np.abs(components).max() <= 1 + 1e-12
    np.testing.assert_allclose(vector_of(components), vector, atol=1e-9)


def test_stored_arrays_state_scale_offset_unit_and_missing(saved):
    with open_audited(saved / "spectra.h5") as file:
        units = {"gain": "dB", "delay": "s", "aod": "octahedral"}
        for name, unit in units.items():
            item = file["spectra"][name]
            assert item.dtype == np.uint16
            assert read_attribute(item, "unit") == unit
            assert item.attrs["missing"] == 0
            assert item.attrs["scale"] > 0
            assert item.fletcher32
            assert item.shuffle
            assert item.compression == "gzip"
            assert item.chunks[0] == 1
        assert read_attribute(file["spectra"], "frequency_unit") == "Hz"
        assert read_attribute(file, "generator") == "test"
        assert read_attribute(file, "seed") == "0"
        assert read_attribute(file["spectra"]["position"], "unit") == "m"


def test_power_below_the_floor_is_stored_as_no_power(spectra, tmp_path):
    write_spectra(tmp_path / "s.h5", spectra, how=Precision(floor_db=-115.0))
    found, _, _ = read_spectra(tmp_path / "s.h5")
    kept = spectra.gain_db >= -115.0
    assert torch.equal(found.power > 0, kept)
    assert float(found.delay[~kept].abs().max()) == 0.0
    assert bool((found.delay[kept] > 0).all())


def test_saving_twice_gives_the_same_bytes(dataset, tmp_path):
    dataset.save(tmp_path / "a")
    dataset.save(tmp_path / "b")
    for name in ("spectra.h5", "dataset.json", "photos/transforms.json"):
        assert (tmp_path / "a" / name).read_bytes() == (tmp_path / "b" / name).read_bytes()


def test_saving_into_its_own_folder_keeps_photos_and_other_files(saved):
    (saved / "notes.txt").write_text("mine")
    found = Dataset.load(saved)
    found.split(seed=5).save(saved)
    again = Dataset.load(saved)
    assert (saved / "notes.txt").read_text() == "mine"
    assert len(again.photos) == len(found.photos)
    assert again.meta["split"]["seed"] == 5


def test_photos_in_memory_are_saved_as_png(photos, tmp_path):
    picture = photos[0].load()
    memory = Photo("first", photos[0].camera, pixels=picture)
    found = Dataset([memory]).save(tmp_path / "site")
    assert found.photos[0].name == "first.png"
    assert float((found.photos[0].load() - picture).abs().max()) < 1e-6


def test_train_and_test_are_apart(dataset):
    split = dataset.split(seed=0, unseal_test=True)
    parts = [split.train, split.validation, split.test, split.region]
    indices = torch.cat([part.index for part in parts])
    assert len(indices) == len(set(indices.tolist()))
    assert len(indices) + split.roles.count("buffer") == 20
    for part in parts:
        assert len(part.spectra) == len(part.index)
        torch.testing.assert_close(part.spectra.pose.position, dataset.pose.position[part.index])
        torch.testing.assert_close(part.repeat.pose.position, part.spectra.pose.position[part.repeat_index])
    train, test = {p.name for p in split.train.photos}, {p.name for p in split.test.photos}
    assert not train & test
    assert len(train | test) == len(split.photos)


def test_the_public_face_splits_photos_and_spectra(photos, spectra, tmp_path):
    from rf3dgs.data.formats.nerfstudio import write_nerfstudio

    write_nerfstudio(tmp_path / "pictures", photos)
    split = Dataset(photos=str(tmp_path / "pictures"), spectra=spectra).split(test=0.2, seed=0, unseal_test=True)
    assert len(split.train.photos) > 0
    assert len(split.test.spectra) == 4


def test_the_sealed_test_needs_its_flag_and_is_logged(saved, caplog):
    found = Dataset.load(saved)
    for name in ("test", "region"):
        with pytest.raises(SealedError, match=rf"the {name} is sealed.*open_test"):
            getattr(found, name)
    for name in ("spectra", "repeat"):
        with pytest.raises(SealedError, match=r"includes the sealed test"):
            getattr(found, name)
    assert len(found.pose) == 20
    assert found.grid.shape == (8, 16)
    with caplog.at_level(logging.INFO):
        part = found.open_test("final evaluation")
    assert len(part.spectra) == 3
    assert "final evaluation" in caplog.text
    opened = Dataset.load(saved, unseal_test=True)
    assert len(opened.spectra) == 20
    assert len(opened.test.spectra) == 3
    lines = (saved / "test_reads.log").read_text().splitlines()
    assert len(lines) == 2
    assert "test final evaluation" in lines[0]
    assert "unseal_test=True" in lines[1]
    with pytest.raises(InputError, match="needs the reason"):
        found.open_test(" ")
    with pytest.raises(InputError, match="role must be one of test, region"):
        found.open_test("why", "train")


def test_an_unsplit_dataset_says_so(dataset):
    with pytest.raises(InputError, match=r"has not been split; call split"):
        _ = dataset.train
    with pytest.raises(InputError, match="photos only"):
        _ = Dataset(dataset.photos).pose


def test_wrong_combinations_are_refused(spectra, photos):
    with pytest.raises(InputError, match="one role per position, 20; got 3"):
        Dataset((), spectra, roles=["train"] * 3)
    with pytest.raises(InputError, match="roles must be among"):
        Dataset((), spectra, roles=["practice"] * 20)
    with pytest.raises(InputError, match="without spectra"):
        Dataset(photos, roles=["train"])
    with pytest.raises(InputError, match="one role per photo, 6; got 2"):
        Dataset(photos, photo_roles=["train"] * 2)
    with pytest.raises(InputError, match="belong together"):
        Dataset((), spectra, repeat=spectra)
    with pytest.raises(InputError, match="repeat was not taken at the positions"):
        Dataset((), spectra, repeat=spectra[torch.tensor([0, 1])], repeat_index=[0, 5])
    with pytest.raises(InputError, match="must name spectra 0 to 19"):
        Dataset((), spectra, repeat=spectra[torch.tensor([0])], repeat_index=[20])
    with pytest.raises(InputError, match=r"must be \[position, row, col\]"):
        Dataset((), spectra[0])


def _edit(path, change):
    content = json.loads((path / "dataset.json").read_text())
    change(content)
    (path / "dataset.json").write_text(json.dumps(content))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda c: c.update(version=99), r"expected schema rf3dgs.dataset version 1; got rf3dgs.dataset version 99"),
        (lambda c: c.update(schema="other"), r"expected schema rf3dgs.dataset"),
        (lambda c: c["units"].update(length="mm"), r"units.length must be 'm'; got 'mm'. Convert the values"),
        (lambda c: c["units"].update(angle="deg"), r"units.angle must be 'rad'; got 'deg'"),
        (lambda c: c["frames"].update(world="y up"), r"frames.world must be 'right-handed, metric, z up'"),
        (lambda c: c.pop("units"), r"expected 'units' to be a JSON dict; got None"),
        (lambda c: c.update(roles=["train"]), r"one role per position"),
        (lambda c: c.update(roles=5), r"expected 'roles' to be a JSON list"),
        (lambda c: c["photos"]["files"].pop("000.png"), r"transforms.json: names 6 photos"),
    ],
)
def test_other_versions_and_units_are_refused_by_name(saved, change, message):
    _edit(saved, change)
    with pytest.raises(DataError, match=message):
        Dataset.load(saved)


def test_changed_or_truncated_spectra_are_refused(saved):
    file = saved / "spectra.h5"
    whole = file.read_bytes()
    for content in (whole[: len(whole) // 2], whole[:-1] + bytes([whole[-1] ^ 1])):
        file.write_bytes(content)
        with pytest.raises(DataError, match=r"spectra\.h5: differs from its sha256 in dataset\.json"):
            Dataset.load(saved)
    file.unlink()
    with pytest.raises(DataError, match=r"spectra\.h5: there is no such file"):
        Dataset.load(saved)


@pytest.mark.parametrize(
    ("where", "attribute", "value", "message"),
    [
        ("spectra/position", "unit", "mm", r"'/spectra/position' has unit 'mm'; expected 'm'"),
        ("spectra", "lobe_unit", "deg", r"'/spectra' has lobe_unit 'deg'; expected 'rad'"),
        ("spectra", "frequency_unit", "GHz", r"frequency_unit 'GHz'; expected 'Hz'"),
        ("spectra/gain", "unit", "linear", r"unit 'linear'; expected 'dB'"),
        ("spectra/delay", "unit", "ns", r"unit 'ns'; expected 's'"),
        ("spectra/gain", "scale", float("nan"), r"scale nan"),
        ("spectra", "frequency", -1.0, r"frequency must be a positive number; got -1.0"),
        ("spectra", "grid", "cube", r"grid must be equirect, pinhole or list; got 'cube'"),
        ("spectra", "rows", 10**9, r"gain of another size"),
        ("/", "version", 7, r"expected schema rf3dgs.spectra version 1; got rf3dgs.spectra version 7"),
    ],
)
def test_spectra_in_other_units_are_refused_by_name(spectra, tmp_path, where, attribute, value, message):
    path = tmp_path / "s.h5"
    write_spectra(path, spectra)
    with h5py.File(path, "r+") as file:
        file[where].attrs[attribute] = np.bytes_(value.encode()) if isinstance(value, str) else value
    with pytest.raises(DataError, match=rf"s\.h5.*{message}"):
        read_spectra(path)


def test_unsound_spectra_are_not_written(spectra, tmp_path):
    nan = dataclasses.replace(spectra, power=torch.full_like(spectra.power, float("nan")))
    with pytest.raises(InputError, match="finite, non-negative power"):
        Dataset((), nan).save(tmp_path / "site")
    late = dataclasses.replace(spectra, delay=torch.full_like(spectra.power, float("inf")))
    with pytest.raises(InputError, match="delay has NaN or infinite values"):
        Dataset((), late).save(tmp_path / "site")
    with pytest.raises(InputError, match="what JSON can hold"):
        Dataset((), spectra, meta={"x": float("nan")}).save(tmp_path / "site")
    assert list(tmp_path.iterdir()) == []


def test_a_folder_without_a_manifest_is_no_dataset(tmp_path):
    with pytest.raises(DataError, match=r"expected dataset\.json in it; this is no dataset, or saving .* interrupted"):
        Dataset.load(tmp_path)


def test_a_part_that_was_solved_once_has_no_repeat(spectra):
    roles = ("validation", *("train",) * 19)
    split = Dataset((), spectra, repeat=spectra[torch.tensor([5])], repeat_index=[5], roles=roles)
    assert split.validation.repeat is None
    assert split.validation.repeat_index is None
    assert split.train.repeat_index.tolist() == [4]


def test_a_fraction_follows_the_seed_of_the_split_and_is_kept_in_the_folder(dataset, tmp_path):
    whole = dataset.protocol(seed=5)
    half = whole.with_fraction(0.5)
    assert half.roles == whole.with_fraction(0.5, seed=5).roles
    assert half.roles != whole.with_fraction(0.5, seed=6).roles
    assert half.roles.count("train") == half.roles.count("unused") == 8
    loaded = half.save(tmp_path / "half")
    assert loaded.roles == half.roles
    assert loaded.with_fraction(1.0).roles == whole.roles
    assert len(loaded.train.spectra) == 8
    with pytest.raises(InputError, match="has not been split"):
        dataset.with_fraction(0.5)
