import json
import shutil

import h5py
import numpy as np
import pytest
import torch
from PIL import Image

from rf3dgs.core.hdf5 import write_text
from rf3dgs.data.dataset import Dataset
from rf3dgs.data.formats.colmap import write_colmap
from rf3dgs.data.formats.nerfstudio import write_nerfstudio
from rf3dgs.data.validate import validate


def faults_of(path) -> str:
    return "\n".join(str(fault) for fault in validate(path))


def test_sound_folders_have_no_fault(saved, photos, tmp_path):
    assert validate(saved) == []
    folder = photos[0].path.parent
    write_nerfstudio(folder, photos)
    assert validate(folder) == []
    for binary in (True, False):
        site = tmp_path / f"colmap{binary}"
        write_colmap(site, photos, points=torch.randn(4, 3), binary=binary)
        shutil.copytree(folder, site / "images")
        assert validate(site) == []


def test_validate_changes_nothing(saved):
    before = {item: item.read_bytes() for item in saved.rglob("*") if item.is_file()}
    validate(saved)
    assert {item: item.read_bytes() for item in saved.rglob("*") if item.is_file()} == before


def _poses(change):
    def apply(file):
        group = file["spectra"]
        position, orientation = group["position"][()], group["orientation"][()]
        change(position, orientation)
        group["position"][...], group["orientation"][...] = position, orientation

    return apply


def _codes(name, change):
    def apply(file):
        codes = file["spectra"][name][()]
        change(codes)
        file["spectra"][name][...] = codes

    return apply


def _attribute(where, name, value):
    stored = np.bytes_(value.encode()) if isinstance(value, str) else value
    return lambda file: file[where].attrs.__setitem__(name, stored)


def _fewer_poses(file):
    position = file["spectra/position"][()]
    del file["spectra/position"]
    write_text(file["spectra"].create_dataset("position", data=position[:-1]).attrs, "unit", "m")


def _external_link(file):
    file["x"] = h5py.ExternalLink("/etc/hosts", "/")


def _linear_power(file):
    item = file["spectra/gain"]
    item.attrs["offset"], item.attrs["scale"] = 0.0, 1 / 65_536


@pytest.mark.parametrize(
    ("change", "what", "remedy"),
    [
        (_poses(lambda p, q: p.__setitem__(3, np.nan)), "pose of spectrum 3 is NaN", "mend their poses"),
        (_poses(lambda p, q: q.__setitem__(4, 0.0)), "quaternion of spectrum 4 is zero", "Write (1, 0, 0, 0)"),
        (_poses(lambda p, q: q.__setitem__(5, 2.0)), "quaternion of spectrum 5 is not of unit length", "Normalise"),
        (_poses(lambda p, q: p.__setitem__(6, p[2])), "spectra 2 and 6 have one pose", "Remove one"),
        (_poses(lambda p, q: p.__imul__(1000.0)), "arrives before light could", "metres"),
        (_attribute("spectra/delay", "scale", 1.0), "delays reach", "seconds"),
        (_attribute("spectra/delay", "offset", -1e-6), "delays are negative", "seconds"),
        (_codes("gain", lambda c: c.__setitem__(7, 0)), "spectrum 7 is empty", "trace that receiver again"),
        (_codes("gain", lambda c: c.__setitem__(8, 500)), "spectrum 8 is constant", "Remove it"),
        (_attribute("spectra/gain", "offset", 40.0), "the gain reaches", "subtract the transmit power"),
        (_linear_power, "as linear power does", "store 10 log10"),
        (_attribute("spectra", "lobe", 11.5), "more than a full turn", "in degrees"),
        (_attribute("spectra/position", "unit", "mm"), "has unit 'mm'; expected 'm'", "set the attribute to 'm'"),
        (_fewer_poses, "counts differ: 19 of position, 20 of orientation, 20 of gain", "one pose per spectrum"),
        (lambda file: file.__delitem__("spectra/gain"), "expected the dataset '/spectra/gain'", "Write the spectra"),
        (_external_link, "external link", "Write the spectra"),
    ],
)
def test_faults_of_spectra_are_named_with_file_and_remedy(saved, change, what, remedy):
    with h5py.File(saved / "spectra.h5", "r+") as file:
        change(file)
    found = [fault for fault in validate(saved) if what in fault.what]
    assert found, faults_of(saved)
    assert found[0].file == saved / "spectra.h5"
    assert remedy in str(found[0])
    assert "differs from its sha256" in faults_of(saved)
    assert "again. Save the dataset again" not in faults_of(saved)


def test_millimetres_without_delays_are_suspected(spectra, tmp_path):
    from dataclasses import replace

    from rf3dgs.core.frames import Pose

    far = replace(spectra, delay=None, aod=None, pose=Pose(1000.0 * spectra.pose.position))
    Dataset((), far).save(tmp_path / "site")
    assert "more than 1000 m; are they millimetres?" in faults_of(tmp_path / "site")


def test_truncated_files_are_named(saved, photos):
    picture = saved / "photos" / "002.png"
    picture.write_bytes(picture.read_bytes()[:200])
    spectra = saved / "spectra.h5"
    spectra.write_bytes(spectra.read_bytes()[:3000])
    (saved / "points.ply").write_bytes(
        b"ply\nformat binary_little_endian 1.0\nelement vertex 1000000000000\nproperty float x\nproperty float y\n"
        b"property float z\nend_header\nabc"
    )
    found = {fault.file.name: fault for fault in validate(saved)}
    assert "truncated or damaged" in faults_of(saved)
    assert {"002.png", "spectra.h5", "points.ply"} <= set(found)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b'{"frames": NaN}', "finite numbers; got NaN"),
        (b"[" * 200_000, "nested more than 64 deep"),
        (b'{"a": ' * 5000, "nested more than 64 deep"),
        (b'{"frames": [', "expected JSON"),
        (b"\xff\xfe\x00", "expected UTF-8"),
        (b"[1, 2]", "expected a JSON object"),
        (b"", "expected JSON"),
    ],
)
@pytest.mark.parametrize("name", ["transforms.json", "dataset.json"])
def test_unreadable_json_is_named(tmp_path, name, content, message):
    (tmp_path / name).write_bytes(content)
    found = validate(tmp_path)
    assert len(found) == 1
    assert found[0].file == tmp_path / name
    assert message in found[0].what


def test_oversized_json_is_not_read(tmp_path, monkeypatch):
    monkeypatch.setattr("rf3dgs.data.safe.MAX_JSON_BYTES", 100)
    (tmp_path / "transforms.json").write_text(" " * 200)
    assert "has 200 bytes; expected at most 100" in faults_of(tmp_path)


def test_pictures_and_cameras_that_do_not_match_are_named(photos):
    folder = photos[0].path.parent
    write_nerfstudio(folder, [*photos[:5], photos[4]])
    Image.new("RGB", (16, 12), (9, 9, 9)).save(folder / "001.png")
    shutil.copy(folder / "002.png", folder / "003.png")
    content = json.loads((folder / "transforms.json").read_text())
    content["frames"][0] |= {"w": 32, "h": 24}
    Image.new("RGB", (32, 24), (1, 2, 3)).save(folder / "000.png")
    (folder / "transforms.json").write_text(json.dumps(content))
    text = faults_of(folder)
    assert "001.png: the picture shows a single colour" in text
    assert "003.png: the picture is a duplicate of 002.png" in text
    assert "004.png: the picture has 2 cameras" in text
    assert "mixed resolutions: 16x12 mostly, 1 others" in text
    assert "5 cameras but 6 pictures; without a camera: 005.png" in text


def test_every_broken_frame_is_named(photos):
    folder = photos[0].path.parent
    write_nerfstudio(folder, photos)
    content = json.loads((folder / "transforms.json").read_text())
    content["frames"][0]["transform_matrix"][0][0] = None
    content["frames"][1]["transform_matrix"] = [[0.0] * 4] * 4
    content["frames"][2]["file_path"] = "../000.png"
    content["frames"][3]["file_path"] = "gone.png"
    (folder / "transforms.json").write_text(json.dumps(content))
    text = faults_of(folder)
    assert "frame 0: transform_matrix must be 4 rows" in text
    assert "frame 1: the camera pose is no rotation" in text
    assert "'../000.png' leads outside" in text
    assert "gone.png: there is no such picture" in text
    assert len(validate(folder)) == 4


def test_colmap_faults_are_named(photos, tmp_path):
    site = tmp_path / "site"
    write_colmap(site, photos, binary=False)
    shutil.copytree(photos[0].path.parent, site / "images")
    (site / "images" / "001.png").unlink()
    images = site / "sparse" / "0" / "images.txt"
    lines = images.read_text().splitlines()
    lines[2] = "1 0 0 0 0 1 2 3 1 000.png"
    images.write_text("\n".join(lines) + "\n")
    text = faults_of(site)
    assert "expected a unit quaternion" in text
    assert "001.png: there is no such picture" in text
    images.write_text("")
    assert "no image is registered" in faults_of(site)
    images.write_text("1 2 3\n")
    assert "expected 'number qw" in faults_of(site)


def test_a_folder_of_no_layout_is_a_fault(tmp_path):
    assert "found none of these" in faults_of(tmp_path)
    assert "found none of these" in faults_of(tmp_path / "gone")
