import json
from dataclasses import replace

import pytest
import torch

from rf3dgs.core.errors import DataError, InputError
from rf3dgs.core.frames import Pose
from rf3dgs.field.images import sequences
from rf3dgs.field.io import load_field, save_field
from rf3dgs.field.radio_field import RadioField
from rf3dgs.field.reflections import RIPPLE, Marks
from rf3dgs.field.sources import PointSources
from rf3dgs.geometry import Patches, Planes

HERE = Pose([4.0, 3.0, 1.4])


@pytest.fixture
def saved(field, tmp_path):
    path = tmp_path / "room.field"
    field.save(path)
    return path


def test_a_field_comes_back_from_disk(field, saved, sphere):
    before, after = field.render(HERE, sphere), RadioField.load(saved).render(HERE, sphere)
    error = (before.gain_db - after.gain_db).abs()
    assert float(error.mean()) < 0.05
    assert float(error.max()) < 0.5
    assert before.delay is not None
    assert after.delay is not None
    torch.testing.assert_close(before.delay, after.delay, atol=5e-11, rtol=0)
    assert RadioField.load(saved).meta == field.meta


def test_saving_what_was_loaded_changes_nothing(saved, tmp_path):
    once = load_field(saved)
    save_field(once, tmp_path / "again.field")
    assert (tmp_path / "again.field" / "tensors.safetensors").read_bytes() == (
        saved / "tensors.safetensors"
    ).read_bytes()


def test_mirrors_come_back_from_disk_and_give_the_same_rays(field, tmp_path):
    floor = Planes(torch.tensor([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0]]), torch.tensor([0.0, 0.0]))
    steps = torch.arange(0.05, 6.0, 0.1)
    zero = torch.zeros(1)
    spots = [torch.cartesian_prod(steps, steps, zero), torch.cartesian_prod(zero, steps, steps)]
    marks = Marks(torch.tensor([[2.0, 2.0, 0.0]]), torch.zeros(1, dtype=torch.long), torch.tensor([4.0]), 0.5)
    sources = PointSources(
        field.tx.position,
        field.frequency,
        floor,
        Patches.of(floor, spots, 0.2),
        sequences(2, 2),
        torch.tensor([[-3.0, -5.0, 1.0], [-6.0, 0.0, 0.0]]),
        level_db=0.5,
        open_above=0.2,
        marks=marks,
        ripple=torch.linspace(-3, 3, 2 * RIPPLE).reshape(2, RIPPLE),
        slabs=torch.tensor([[1.5, 0.1, 0.02], [6.8, 0.25, 0.03]]),
    )
    plane_of = torch.where(field.surface.means[:, 2].abs() < 0.01, 0, -1)
    mirrors = replace(field, sources=sources, plane_of=plane_of)
    mirrors.save(tmp_path / "mirrors.field")
    loaded = load_field(tmp_path / "mirrors.field")
    assert torch.equal(loaded.plane_of, plane_of)
    assert loaded.sources.patches.cell == 0.2
    assert torch.equal(loaded.sources.slabs, sources.slabs)
    before, after = mirrors.paths(HERE, parts="sources"), loaded.paths(HERE, parts="sources")
    assert int(before.valid.sum()) >= 3
    torch.testing.assert_close(before.delay, after.delay)
    torch.testing.assert_close(before.path_gain, after.path_gain)
    assert torch.equal(before.order, after.order)
    save_field(replace(field, sources=None), tmp_path / "bare.field")
    assert load_field(tmp_path / "bare.field").sources is None


def test_fields_of_schema_1_keep_their_line_of_sight(saved, field):
    def older(body):
        position = field.tx.position.tolist()
        body.update(schema=1, sources=[{"position": position, "tx": position, "gain_db": 1.5, "open_above": 0.3}])

    change(saved, older)
    sources = load_field(saved).sources
    assert len(sources) == 1
    assert (sources.level_db, sources.open_above) == (1.5, 0.3)
    assert torch.equal(sources.tx, field.tx.position)


def test_a_field_takes_at_most_a_hundred_bytes_a_gaussian(field, saved):
    size = (saved / "tensors.safetensors").stat().st_size - 2_000
    assert size / len(field.surface) < 100


def test_every_flipped_byte_is_noticed(saved):
    generator = torch.Generator().manual_seed(0)
    for name in ("field.json", "tensors.safetensors"):
        good = (saved / name).read_bytes()
        places = torch.randint(len(good) - 1, (40,), generator=generator).tolist()
        for place in places:
            bad = bytearray(good)
            bad[place] ^= 0x21
            if name == "field.json" and bad[place] in b" \n" and good[place] in b" \n":
                continue
            (saved / name).write_bytes(bytes(bad))
            with pytest.raises(DataError, match=r"room\.field"):
                load_field(saved)
        (saved / name).write_bytes(good)
    load_field(saved)


@pytest.mark.parametrize("name", ["field.json", "tensors.safetensors"])
def test_truncated_and_missing_files_are_named(saved, name):
    data = (saved / name).read_bytes()
    (saved / name).write_bytes(data[: len(data) // 2])
    with pytest.raises(DataError, match=name):
        load_field(saved)
    (saved / name).unlink()
    with pytest.raises(DataError, match=name):
        load_field(saved)
    with pytest.raises(DataError, match="no such field"):
        load_field(saved / "nowhere")


def change(saved, edit):
    """Edit the description and give it a right checksum again: a well-formed file with wrong contents."""
    from rf3dgs.field.io import _digest

    record = json.loads((saved / "field.json").read_text())
    edit(record["body"])
    record["sha256"] = _digest(record["body"])
    (saved / "field.json").write_text(json.dumps(record))


@pytest.mark.parametrize(
    ("edit", "message"),
    [
        (lambda body: body.update(schema=99), "expected a field of schema 1 or 2; got 99"),
        (lambda body: body.pop("window_db"), "window_db"),
        (lambda body: body.update(gaussians=7), "must be"),
        (lambda body: body.update(encoding="polar"), "polar"),
        (lambda body: body["sources"].update(planes=3), "lacks the tensor source_plane_normals"),
        (lambda body: body["sources"].update(tx=[0, 1]), "three finite numbers"),
        (lambda body: body.update(frequency=True), "frequency must be a finite number"),
        (lambda body: body.update(bounds=[[0, 0], [1, 1]]), "bounds must be three numbers"),
        (lambda body: body["tx"].update(orientation=[0, 0, 0, 0]), "zero or non-finite quaternion"),
    ],
)
def test_wrong_descriptions_are_refused(saved, edit, message):
    change(saved, edit)
    with pytest.raises(DataError, match=message):
        load_field(saved)


def test_fields_that_are_not_finite_are_not_saved(field, tmp_path):
    gain_sh = field.surface.gain_sh.clone()
    gain_sh[3, 2] = float("nan")
    with pytest.raises(InputError, match="gain_sh has NaN"):
        save_field(replace(field, surface=replace(field.surface, gain_sh=gain_sh)), tmp_path / "bad.field")
    assert not list(tmp_path.iterdir())


def test_a_folder_that_is_no_field_is_not_overwritten(field, tmp_path):
    (tmp_path / "notes").mkdir()
    (tmp_path / "notes" / "diary.txt").write_text("keep me")
    with pytest.raises(InputError, match="something else than a field"):
        save_field(field, tmp_path / "notes")
    assert (tmp_path / "notes" / "diary.txt").read_text() == "keep me"
