import math
import sys
from collections.abc import Iterable
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from scipy.ndimage import map_coordinates

from rf3dgs.core.errors import DataError, InputError, MissingDependencyError
from rf3dgs.core.frames import Pose
from rf3dgs.core.grids import Camera, pinhole_grid
from rf3dgs.core.progress import Silent
from rf3dgs.data.align import align
from rf3dgs.data.photo import PhotoSet
from rf3dgs.data.sfm import NOTE, distortion_of, poses_from_photos, the_model
from rf3dgs.splats.gaussians import Gaussians
from rf3dgs.splats.harmonics import view_values
from rf3dgs.splats.rasterize import rasterize
from rf3dgs.splats.surface import sample_mesh

ROOM = torch.tensor([6.0, 5.0, 2.5])
FOCAL = 160 / math.tan(math.radians(35))


def painted_room(count: int = 6000) -> Gaussians:
    """Flat blobs of many sizes and colours on the floor, the ceiling and the walls of a room."""
    random = torch.Generator().manual_seed(0)
    number = torch.arange(count)
    means = torch.rand(count, 3, generator=random) * ROOM
    axis = torch.randint(0, 3, (count,), generator=random)
    means[number, axis] = torch.randint(0, 2, (count,), generator=random) * ROOM[axis]
    size = torch.empty(count).uniform_(math.log(0.02), math.log(0.12), generator=random)
    log_scales = size[:, None].repeat(1, 3)
    log_scales[number, axis] = math.log(1e-3)
    quats = torch.tensor([[1.0, 0, 0, 0]]).repeat(count, 1)
    sh = (torch.rand(count, 1, 3, generator=random) - 0.5) / 0.2820948
    return Gaussians(means, quats, log_scales, torch.full((count,), 3.0), sh)


def walk(count: int = 12) -> list[Camera]:
    """Cameras on an arc that look across the room, neighbours sharing most of their view."""
    grid = pinhole_grid(320, 240, 70)
    turns = [3.6 + 0.7 * math.pi * index / count for index in range(count)]
    return [
        Camera.of(
            Pose.look_at(
                (3 + 1.6 * math.cos(turn), 2.5 + 1.6 * math.sin(turn), 1.2 + 0.1 * math.sin(3 * turn)),
                (3 - math.cos(turn), 2.5 - math.sin(turn), 1.1),
            ),
            grid,
        )
        for turn in turns
    ]


def write_pictures(folder: Path, pictures: Iterable[np.ndarray]) -> Path:
    folder.mkdir()
    for index, picture in enumerate(pictures):
        Image.fromarray(picture).save(folder / f"{index:02d}.png")
    return folder


def render(room: Gaussians, camera: Camera) -> np.ndarray:
    with torch.no_grad():
        colours = view_values(room.sh, room.means, camera.position, offset=0.5, clamp=True)
        raster = rasterize(room.means, room.quats, room.scales, room.opacities, colours, camera)
    return (raster.values.clamp(0, 1) * 255).round().byte().numpy()


@pytest.fixture(scope="module")
def pictures(tmp_path_factory) -> Path:
    pytest.importorskip("pycolmap")
    room = painted_room()
    return write_pictures(tmp_path_factory.mktemp("sfm") / "walk", (render(room, camera) for camera in walk()))


@pytest.fixture(scope="module")
def found(pictures) -> PhotoSet:
    return poses_from_photos(pictures, lens="pinhole", progress=Silent())


def test_cameras_stand_and_look_where_the_pictures_were_taken(found):
    truth = walk()
    assert [photo.name for photo in found] == [f"{index:02d}.png" for index in range(len(truth))]
    similarity = align(
        torch.stack([photo.camera.position for photo in found]), torch.stack([camera.position for camera in truth])
    )
    assert float(similarity.residuals.median()) < 0.02
    for photo, camera in zip(similarity.photos(found), truth, strict=True):
        cosine = float(photo.camera.viewmat[2, :3] @ camera.viewmat[2, :3])
        assert cosine > math.cos(math.radians(1.0)), photo.name
        assert float(photo.camera.K[0, 0]) == pytest.approx(FOCAL, rel=0.01)


def test_points_lie_on_the_walls_and_wear_their_colours(found):
    similarity = align(
        torch.stack([photo.camera.position for photo in found]), torch.stack([camera.position for camera in walk()])
    )
    points = similarity.photos(found).points
    assert points is not None
    assert found.colours is not None
    assert found.colours.shape == points.shape
    assert len(points) > 500
    from_walls = torch.minimum(points.abs(), (points - ROOM).abs()).amin(-1)
    assert float(from_walls.median()) < 0.03
    assert float(found.colours.std(0).min()) > 0.05
    assert 0.0 <= float(found.colours.min()) <= float(found.colours.max()) <= 1.0


def test_photos_are_pinholes_whose_pictures_fit_them(found):
    assert found.layout == "sfm"
    assert NOTE in found.notes
    for photo in found:
        assert photo.pixels is None
        assert photo.load().shape == (photo.camera.height, photo.camera.width, 3)


def through_a_lens(picture: np.ndarray, focal: float, radial: float, width: int, height: int) -> np.ndarray:
    """What a lens with one radial distortion makes of a wider picture of a pinhole with the same focal length."""
    col, row = np.meshgrid(np.arange(width) + 0.5 - width / 2, np.arange(height) + 0.5 - height / 2)
    seen = np.stack((row, col)) / focal
    straight = seen.copy()
    for _ in range(20):
        straight = seen / (1 + radial * (straight**2).sum(0))
    centre = np.array(picture.shape[:2])[:, None, None] / 2
    where = straight * focal + centre - 0.5
    layers = [map_coordinates(picture[..., layer].astype(float), where, order=1) for layer in range(3)]
    return np.stack(layers, -1).round().astype(np.uint8)


def test_distorted_pictures_come_back_undistorted(tmp_path):
    pytest.importorskip("pycolmap")
    room, cameras, radial = painted_room(), walk(), -0.12
    K = cameras[0].K + torch.tensor([[0, 0, 60.0], [0, 0, 60.0], [0, 0, 0]])
    wide = [Camera(camera.viewmat, K, 440, 360) for camera in cameras]
    bent = (through_a_lens(render(room, camera), FOCAL, radial, 320, 240) for camera in wide)
    found = poses_from_photos(write_pictures(tmp_path / "bent", bent))
    assert any("pictures were undistorted" in note for note in found.notes)
    similarity = align(
        torch.stack([photo.camera.position for photo in found]), torch.stack([camera.position for camera in cameras])
    )
    assert float(similarity.residuals.median()) < 0.02
    errors = []
    for photo in similarity.photos(found):
        truth = torch.from_numpy(render(room, photo.camera)).float() / 255
        errors.append(float((photo.load() - truth).abs().mean()))
    assert max(errors) < 0.08, "straight pictures differ by 0.05 through two interpolations, bent ones by 0.10"


def test_the_same_seed_gives_the_same_poses(pictures, tmp_path):
    few = write_pictures(tmp_path / "few", [np.asarray(Image.open(pictures / f"{i:02d}.png")) for i in range(5)])
    first, second = poses_from_photos(few, seed=3), poses_from_photos(few, seed=3)
    assert first.points is not None
    assert second.points is not None
    assert torch.equal(first.points, second.points)
    assert first[0].load().shape == (first[0].camera.height, first[0].camera.width, 3)
    for one, other in zip(first, second, strict=True):
        assert torch.equal(one.camera.viewmat, other.camera.viewmat)


def test_pictures_that_share_nothing_are_refused(tmp_path):
    pytest.importorskip("pycolmap")
    random = np.random.default_rng(0)
    noise = write_pictures(tmp_path / "noise", random.integers(0, 256, (4, 48, 64, 3), dtype=np.uint8))
    with pytest.raises(DataError, match=r"noise: no poses could be found for its 4 pictures; take more pictures"):
        poses_from_photos(noise)


def test_two_models_and_lost_pictures_are_refused():
    folder = Path("tour")
    names = [f"{index:02d}" for index in range(10)]
    assert the_model({0: set(names[:8])}, 10, folder) == 0
    assert the_model({0: set(names[:2]), 1: set(names), 2: set(names[4:8])}, 10, folder) == 1
    with pytest.raises(DataError, match="tour: the 10 pictures fall into 2 models of 6 and 4, whose scales"):
        the_model({0: set(names[:4]), 1: set(names[4:])}, 10, folder)
    with pytest.raises(DataError, match="tour: only 7 of 10 pictures could be registered, expected at least 80%"):
        the_model({0: set(names[:7])}, 10, folder)


def test_a_damaged_picture_is_named_before_the_work_begins(pictures, tmp_path):
    folder = write_pictures(tmp_path / "cut", [np.asarray(Image.open(pictures / f"{i:02d}.png")) for i in range(3)])
    whole = (folder / "01.png").read_bytes()
    (folder / "01.png").write_bytes(whole[: len(whole) // 2])
    with pytest.raises(DataError, match=r"01\.png: the picture is truncated"):
        poses_from_photos(folder)
    (folder / "01.png").unlink()
    with pytest.raises(InputError, match="at least 3 JPEG or PNG pictures that overlap; got 2"):
        poses_from_photos(folder)
    with pytest.raises(DataError, match="there is no such folder"):
        poses_from_photos(folder / "gone")
    with pytest.raises(InputError, match='"shared" or "each"'):
        poses_from_photos(folder, camera="none")  # type: ignore[arg-type]
    with pytest.raises(InputError, match='"radial" or "pinhole"'):
        poses_from_photos(folder, lens="fish")  # type: ignore[arg-type]


def test_without_pycolmap_the_message_says_what_to_install(pictures, monkeypatch):
    monkeypatch.setitem(sys.modules, "pycolmap", None)
    with pytest.raises(MissingDependencyError, match=r'pip install "rf3dgs\[sfm\]"'):
        poses_from_photos(pictures)


def test_distortion_is_how_far_the_farthest_corner_moves():
    assert distortion_of(np.array([200.0, 160, 120, 0.0]), 320, 240) == 0.0
    moved = distortion_of(np.array([200.0, 160, 120, -0.1]), 320, 240)
    assert moved == pytest.approx(200 * (1.0 - (1 - 0.1 * 1.0)))


def test_the_command_line_fits_geometry_to_pictures_without_poses(pictures, tmp_path, capsys):
    from rf3dgs.cli.main import main
    from rf3dgs.splats.ply import read_ply

    few = write_pictures(tmp_path / "few", [np.asarray(Image.open(pictures / f"{i:02d}.png")) for i in range(5)])
    out = tmp_path / "geometry.ply"
    command = ["fit-geometry", str(few), "--poses", "sfm", "--out", str(out), "--visual.steps", "10"]
    assert main(command) == 0
    assert len(read_ply(out)) > 100
    assert NOTE in capsys.readouterr().err
    assert sorted(item.name for item in tmp_path.iterdir()) == ["few", "geometry.ply"]


@pytest.mark.parametrize("lens", ["pinhole", "radial"])
def test_a_walk_through_the_lobby_is_found_within_two_centimetres(tmp_path, lens):
    pytest.importorskip("pycolmap")
    from rf3dgs.propagation.sites.lobby import lobby

    vertices, faces, colours = lobby().mesh(0.1)
    painted = sample_mesh(vertices, faces, count=150_000, seed=0, colours=colours)
    grid = pinhole_grid(320, 240, 85)
    cameras = []
    for step in range(12):
        share = step / 11
        position = (3 + 6 * share, 6.5 + 0.8 * math.sin(5 * share), 1.5 + 0.2 * math.sin(9 * share))
        cameras.append(Camera.of(Pose.look_at(position, (5 + 3 * share, 13.5, 1.6)), grid))
    folder = write_pictures(tmp_path / "lobby", (render(painted, camera) for camera in cameras))
    found = poses_from_photos(folder, lens=lens)
    truth = torch.stack([cameras[int(Path(photo.name).stem)].position for photo in found])
    similarity = align(torch.stack([photo.camera.position for photo in found]), truth)
    assert len(found) >= 10
    assert float(similarity.residuals.median()) < 0.02
