import json
import math
import shutil

import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from PIL import Image

from rf3dgs.core.errors import DataError, InputError
from rf3dgs.core.frames import Pose, opengl_from_viewmat
from rf3dgs.core.grids import Camera, pinhole_grid
from rf3dgs.data.dataset import Dataset
from rf3dgs.data.formats.blender import read_blender
from rf3dgs.data.formats.colmap import read_colmap, read_model, write_colmap
from rf3dgs.data.formats.detect import read_photos
from rf3dgs.data.formats.nerfstudio import read_nerfstudio, write_nerfstudio
from rf3dgs.data.formats.rf3dgs_v0 import level_of, read_rf3dgs_v0
from rf3dgs.data.photo import Photo
from rf3dgs.spectra.codec import DbWindow
from rf3dgs.spectra.spectrum import Instrument


def assert_same_photos(found, photos):
    assert [photo.name for photo in found] == [photo.name for photo in photos]
    for new, old in zip(found, photos, strict=True):
        torch.testing.assert_close(new.camera.viewmat, old.camera.viewmat, atol=2e-5, rtol=1e-5)
        torch.testing.assert_close(new.camera.K, old.camera.K)
        assert (new.camera.width, new.camera.height) == (old.camera.width, old.camera.height)
        assert torch.equal(new.load(), old.load())


def random_photos(folder, data) -> list[Photo]:
    folder.mkdir(exist_ok=True)
    photos = []
    generator = torch.Generator().manual_seed(data.draw(st.integers(0, 10_000)))
    size = data.draw(st.sampled_from([(8, 6), (5, 7)]))
    for index in range(data.draw(st.integers(1, 4))):
        width, height = size if data.draw(st.booleans()) else (6, 6)
        Image.new("RGB", (width, height), (index, 20, 30)).save(folder / f"{index}.png")
        centre = (width / 2 + float(torch.rand((), generator=generator)), height / 2)
        focal = 3 + 10 * torch.rand(2, generator=generator)
        K = torch.tensor([[float(focal[0]), 0, centre[0]], [0, float(focal[1]), centre[1]], [0, 0, 1]])
        position, quaternion = 20 * torch.randn(3, generator=generator), torch.randn(4, generator=generator)
        camera = Camera.of(Pose(position, quaternion), pinhole_grid(width, height, K=K))
        photos.append(Photo(f"{index}.png", camera, folder / f"{index}.png"))
    return photos


@settings(max_examples=20, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_nerfstudio_round_trip(tmp_path, data):
    photos = random_photos(tmp_path / "p", data)
    write_nerfstudio(tmp_path / "p", photos)
    assert_same_photos(read_nerfstudio(tmp_path / "p"), photos)


@settings(max_examples=20, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data(), binary=st.booleans())
def test_colmap_round_trip(tmp_path, data, binary):
    shutil.rmtree(tmp_path / "site", ignore_errors=True)
    photos = random_photos(tmp_path / "images", data)
    points = torch.randn(data.draw(st.integers(0, 5)), 3)
    write_colmap(tmp_path / "site", photos, points=points, colours=torch.ones_like(points) * 0.2, binary=binary)
    found = read_colmap(tmp_path / "site", images=tmp_path / "images")
    assert_same_photos(found, photos)
    if len(points):
        torch.testing.assert_close(found.points, points)
        torch.testing.assert_close(found.colours, torch.full_like(points, 0.2), atol=1e-6, rtol=0)
    else:
        assert found.points is None


@pytest.mark.oracle
@pytest.mark.filterwarnings("ignore::DeprecationWarning")
@pytest.mark.parametrize("binary", [True, False])
def test_pycolmap_reads_what_is_written(photos, tmp_path, binary):
    pycolmap = pytest.importorskip("pycolmap")
    points = torch.randn(4, 3)
    write_colmap(tmp_path, photos, points=points, binary=binary)
    model = pycolmap.Reconstruction(str(tmp_path / "sparse" / "0"))
    assert model.num_points3D() == 4
    assert model.num_cameras() == 1
    by_name = {image.name: image for image in model.images.values()}
    assert sorted(by_name) == sorted(photo.name for photo in photos)
    ours = photos[2].camera
    theirs = by_name[photos[2].name].cam_from_world()
    np.testing.assert_allclose(theirs.matrix(), ours.viewmat[:3].numpy(), atol=1e-6)
    camera = next(iter(model.cameras.values()))
    np.testing.assert_allclose(camera.calibration_matrix(), ours.K.numpy(), rtol=1e-6)
    (tmp_path / "again").mkdir()
    (model.write_text if binary else model.write_binary)(str(tmp_path / "again"))
    shutil.copytree(photos[0].path.parent, tmp_path / "images")
    assert_same_photos(
        sorted(read_colmap(tmp_path / "again", images=tmp_path / "images"), key=lambda p: p.name), photos
    )


def test_an_opengl_camera_looks_along_its_minus_z(tmp_path):
    Image.new("RGB", (4, 4)).save(tmp_path / "a.png")
    matrix = [[1, 0, 0, 5], [0, 0, -1, 6], [0, 1, 0, 7], [0, 0, 0, 1]]
    frame = {"file_path": "./a.png", "transform_matrix": matrix, "fl_x": 4, "w": 4, "h": 4}
    (tmp_path / "transforms.json").write_text(json.dumps({"frames": [frame], "applied_transform": matrix[:3]}))
    found = read_nerfstudio(tmp_path)
    pose = found[0].camera.pose
    torch.testing.assert_close(found[0].camera.position, torch.tensor([5.0, 6.0, 7.0]))
    torch.testing.assert_close(
        pose.to_world(torch.tensor([1.0, 0, 0])), torch.tensor([0.0, 1.0, 0.0]), atol=1e-6, rtol=0
    )
    assert found[0].camera.K[1, 1] == 4
    assert "applied_transform" in found.notes[0]


def test_intrinsics_follow_pictures_of_another_size(photos, tmp_path):
    folder = photos[0].path.parent
    write_nerfstudio(folder, photos)
    with Image.open(photos[0].path) as picture:
        half = picture.resize((8, 6))
    half.save(photos[0].path)
    found = read_nerfstudio(folder)
    torch.testing.assert_close(found[0].camera.K[:2], photos[0].camera.K[:2] / 2)
    assert found[0].load().shape == (6, 8, 3)
    half.resize((16, 5)).save(photos[0].path)
    with pytest.raises(DataError, match=r"000\.png: has 16x5 pixels, but its camera 16x12"):
        read_nerfstudio(folder)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda c: c.update(k1=0.1), r"lens distortion; undistort"),
        (lambda c: c.update(camera_model="OPENCV_FISHEYE"), r"'OPENCV_FISHEYE' is not a pinhole; undistort"),
        (lambda c: c.update(frames=[]), r"expected 1 to 1000000 frames; got 0"),
        (lambda c: c.pop("frames"), r"expected a list of objects under \"frames\""),
        (lambda c: c["frames"][1].update(file_path="../../x.png"), r"leads outside"),
        (lambda c: c["frames"][1].update(file_path="/etc/x.png"), r"leads outside"),
        (lambda c: c["frames"][1].update(file_path="gone.png"), r"gone\.png: there is no such picture"),
        (lambda c: c["frames"][1].update(file_path=7), r"expected a file name"),
        (lambda c: c["frames"][1].update(transform_matrix=[[1, 2], [3]]), r"frame 1: transform_matrix must be 4 rows"),
        (lambda c: c["frames"][1]["transform_matrix"][0].__setitem__(0, 3.0), r"frame 1: .* no rotation"),
        (lambda c: c["frames"][1]["transform_matrix"][0].__setitem__(0, None), r"frame 1: transform_matrix must"),
        (lambda c: (c.pop("fl_x"), c.update(camera_angle_x=60)), r"camera_angle_x must lie .* degrees\?"),
        (lambda c: c.update(fl_x="wide"), r"expected a number under 'fl_x'; got 'wide'"),
        (lambda c: c.update(fl_x=-5), r"focal lengths must be positive"),
    ],
)
def test_wrong_transforms_are_refused_by_name(photos, change, message):
    folder = photos[0].path.parent
    write_nerfstudio(folder, photos)
    content = json.loads((folder / "transforms.json").read_text())
    change(content)
    (folder / "transforms.json").write_text(json.dumps(content))
    with pytest.raises(DataError, match=rf"(?s){message}"):
        read_nerfstudio(folder)


def _colmap_site(photos, tmp_path, *, binary=False):
    site = tmp_path / "site"
    write_colmap(site, photos, points=torch.randn(5, 3), binary=binary)
    shutil.copytree(photos[0].path.parent, site / "images")
    return site


@pytest.mark.parametrize(
    ("file", "old", "new", "message"),
    [
        ("cameras.txt", "PINHOLE 16 12", "FOV 16 12", "'number model width height parameters'"),
        ("cameras.txt", "1 PINHOLE 16 12 ", "1 OPENCV 16 12 0.1 0 0 0 ", "lens distortion .* undistort"),
        ("cameras.txt", "16 12", "16 many", "expected whole numbers"),
        ("cameras.txt", "16 12", "16 -12", "16x-12 pixels"),
        ("cameras.txt", "1 PINHOLE", "2 PINHOLE", "its camera 1 is not in the list"),
        ("images.txt", "000.png", "../000.png", "leads outside"),
        ("images.txt", "\n1 ", "\n1 nan 0 0 0 0 0 0 1 000.png\n\n2 ", "expected a unit quaternion"),
        ("images.txt", "\n1 ", "\n1 0 0 0 0 0 0 0 1 000.png\n\n2 ", "expected a unit quaternion"),
        ("images.txt", "\n1 ", "\n1 1 0 0 0 0 0 inf 1 000.png\n\n2 ", "NaN or infinity"),
        ("images.txt", "\n1 ", "\n1 1 0\n\n2 ", "'number qw qx qy qz"),
        ("points3D.txt", "\n1 ", "\n1 2\n2 ", "'number x y z r g b"),
    ],
)
def test_wrong_colmap_text_is_refused_by_name(photos, tmp_path, file, old, new, message):
    site = _colmap_site(photos, tmp_path)
    path = site / "sparse" / "0" / file
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, 1))
    with pytest.raises(DataError, match=message):
        read_colmap(site)


@pytest.mark.parametrize("name", ["cameras.bin", "images.bin", "points3D.bin"])
def test_truncated_colmap_binaries_are_refused(photos, tmp_path, name):
    site = _colmap_site(photos, tmp_path, binary=True)
    path = site / "sparse" / "0" / name
    whole = path.read_bytes()
    for length in range(0, len(whole), max(1, len(whole) // 40)):
        path.write_bytes(whole[:length])
        with pytest.raises(DataError, match=rf"{name}.*(truncated|damaged)"):
            read_model(site)
    path.write_bytes(b"\xff" * 8 + whole[8:])
    with pytest.raises(DataError, match="truncated"):
        read_model(site)


def test_simple_colmap_models_are_pinholes_and_gaps_are_noted(photos, tmp_path):
    site = _colmap_site(photos, tmp_path)
    cameras = site / "sparse" / "0" / "cameras.txt"
    Image.new("RGB", (16, 12)).save(site / "images" / "extra.png")
    (site / "sparse" / "1").mkdir()
    for line in ("1 SIMPLE_PINHOLE 16 12 9 8 6", "1 SIMPLE_RADIAL 16 12 9 8 6 0", "1 OPENCV 16 12 9 9 8 6 0 0 0 0"):
        cameras.write_text(line + "\n")
        found = read_colmap(site)
        torch.testing.assert_close(found[0].camera.K, torch.tensor([[9.0, 0, 8], [0, 9, 6], [0, 0, 1]]))
    notes = " ".join(found.notes)
    assert "arbitrary scale" in notes
    assert "1 pictures in" in notes
    assert "several models; 1 are left out" in notes


def _blender_site(photos, folder):
    width = photos[0].camera.width
    angle = 2 * math.atan(0.5 * width / float(photos[0].camera.K[0, 0]))
    for split, chosen in (("train", photos[:3]), ("val", photos[3:4]), ("test", photos[4:])):
        (folder / split).mkdir(parents=True)
        frames = []
        for photo in chosen:
            shutil.copy(photo.path, folder / split / photo.name)
            matrix = opengl_from_viewmat(photo.camera.viewmat).tolist()
            frames.append({"file_path": f"./{split}/{photo.path.stem}", "transform_matrix": matrix})
        content = {"camera_angle_x": angle, "frames": frames}
        (folder / f"transforms_{split}.json").write_text(json.dumps(content))


def test_blender_files_are_read_with_their_roles(photos, tmp_path):
    _blender_site(photos, tmp_path / "site")
    found = read_blender(tmp_path / "site")
    assert found.roles == ("train",) * 3 + ("validation",) + ("test",) * 2
    for new, old in zip(found, photos, strict=True):
        torch.testing.assert_close(new.camera.viewmat, old.camera.viewmat, atol=1e-5, rtol=1e-5)
        torch.testing.assert_close(new.camera.K, old.camera.K)
        assert torch.equal(new.load(), old.load())
    with pytest.raises(DataError, match=r"expected transforms_train\.json"):
        read_blender(tmp_path)


def _v0_site(photos, tmp_path, *, jet=False):
    site = tmp_path / "site"
    write_colmap(site, photos)
    (site / "images").mkdir()
    ramp = np.linspace(0, 1, 16)[None].repeat(12, 0)
    if jet:
        from matplotlib import colormaps

        pixels = (colormaps["jet"](ramp)[..., :3] * 255).round().astype(np.uint8)
    else:
        pixels = (ramp[..., None].repeat(3, -1) * 255).round().astype(np.uint8)
    for photo in photos:
        Image.fromarray(pixels).save(site / "images" / photo.name)
    (site / "train_index.txt").write_text("".join(f"{photo.path.stem}\n" for photo in photos[:4]))
    (site / "test_index.txt").write_text("".join(f"{photo.name}\n" for photo in photos[4:]))
    return site, torch.from_numpy(ramp).float()


@pytest.mark.parametrize("jet", [False, True])
def test_rf3dgs_v0_pictures_become_spectra_through_the_users_window(photos, tmp_path, jet):
    site, ramp = _v0_site(photos, tmp_path, jet=jet)
    found = read_rf3dgs_v0(site, DbWindow(-145.0, -105.0), frequency=2.4e9, instrument=Instrument.gaussian(0.1))
    assert found.roles == ("train",) * 4 + ("test",) * 2
    part = found.train
    assert part.spectra.grid.kind == "pinhole"
    torch.testing.assert_close(part.spectra.gain_db[0], -145 + 40 * ramp, atol=0.35 if jet else 0.1, rtol=0)
    torch.testing.assert_close(part.spectra.pose.position[1], photos[1].camera.position, atol=1e-5, rtol=1e-5)
    forward = part.spectra.pose.to_world(torch.tensor([1.0, 0, 0]).expand(4, 3))
    torch.testing.assert_close(forward[2], photos[2].camera.viewmat[2, :3], atol=1e-5, rtol=1e-5)


def test_rf3dgs_v0_without_units_says_what_to_supply(photos, tmp_path):
    site, _ = _v0_site(photos, tmp_path)
    with pytest.raises(InputError, match=r"carry no units: give window=DbWindow\(floor_db, ceil_db\), freq"):
        read_rf3dgs_v0(site)
    found = read_photos(site)
    assert found.layout == "rf3dgs_v0"
    assert all(photo.note.startswith("uncalibrated") for photo in found)
    assert float(level_of(found[0].load()).max()) == 1.0
    (site / "test_index.txt").write_text("000\n")
    with pytest.raises(DataError, match=r"'000' is in both index files"):
        read_photos(site)
    (site / "test_index.txt").write_text("004\n")
    with pytest.raises(DataError, match=r"1 pictures are in neither index file, such as '005\.png'"):
        read_photos(site)


def test_photos_of_a_dataset_keep_the_roles_of_its_split(dataset, tmp_path):
    saved = tmp_path / "site"
    dataset.split(seed=1, photo_test_every=3).save(saved)
    assert read_photos(saved).roles == ("train", "train", "test") * 2
    assert Dataset.load(saved).photo_roles == read_photos(saved).roles
    dataset.save(tmp_path / "whole")
    assert read_photos(tmp_path / "whole").roles is None
    manifest = saved / "dataset.json"
    manifest.write_text(json.dumps(json.loads(manifest.read_text()) | {"photo_roles": ["train"]}))
    with pytest.raises(DataError, match=r"dataset.json: expected one role per photo, 6; got 1. Save the dataset again"):
        read_photos(saved)


def test_read_photos_says_which_layout_it_found(photos, saved, tmp_path):
    assert read_photos(saved).layout == "native"
    assert read_photos(saved / "photos").layout == "nerfstudio"
    assert read_photos(_colmap_site(photos, tmp_path / "colmap")).layout == "colmap"
    _blender_site(photos, tmp_path / "blender")
    assert read_photos(tmp_path / "blender").layout == "blender"
    (tmp_path / "empty").mkdir()
    with pytest.raises(DataError, match=r"expected photos as COLMAP .* found none of these"):
        read_photos(tmp_path / "empty")
    with pytest.raises(DataError, match="there is no such folder"):
        read_photos(tmp_path / "gone")
