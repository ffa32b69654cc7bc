"""Bad input through the command line: one sentence that names the file and the remedy, status 2, nothing written."""

import hashlib
import json
import math
import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import h5py
import numpy as np
import pytest
import torch
from PIL import Image

from rf3dgs.channel.io import save_paths
from rf3dgs.channel.paths import Paths
from rf3dgs.cli.main import main
from rf3dgs.core.angles import angles_of
from rf3dgs.core.frames import Pose
from rf3dgs.core.grids import Camera, equirect_grid, pinhole_grid
from rf3dgs.core.units import SPEED_OF_LIGHT, power_from_db
from rf3dgs.data.dataset import Dataset
from rf3dgs.data.formats.nerfstudio import write_nerfstudio
from rf3dgs.data.photo import Photo
from rf3dgs.spectra.spectrum import Instrument, Spectrum
from rf3dgs.splats.gaussians import Gaussians
from rf3dgs.splats.ply import write_ply

COUNT, WIDTH, HEIGHT = 14, 16, 8
TX = Pose((0.5, 0.5, 2.5))
FIT = ("--visual.steps", "2", "--visual.start", "random", "--visual.start-count", "50")


@dataclass(frozen=True)
class Site:
    """A folder with one sound file of every kind, and an empty folder to write to."""

    root: Path

    @property
    def dataset(self) -> Path:
        return self.root / "site"

    @property
    def photos(self) -> Path:
        return self.root / "pictures"

    @property
    def geometry(self) -> Path:
        return self.root / "geometry.ply"

    @property
    def field(self) -> Path:
        return self.root / "site.field"

    @property
    def paths(self) -> Path:
        return self.root / "site.paths"

    @property
    def out(self) -> Path:
        return self.root / "out"

    def commands(self, *names: str) -> list[list[str]]:
        """The commands of these names, each reading this site and writing below `out`."""
        known = {
            "fit": ["fit", str(self.dataset), "--out", str(self.out / "new.field"), *FIT],
            "fit-radio": [
                *("fit-radio", str(self.geometry), str(self.dataset)),
                *("--out", str(self.out / "new.field")),
            ],
            "fit-geometry": [
                *("fit-geometry", str(self.photos), "--out", str(self.out / "new.ply")),
                *FIT,
            ],
            "fit-geometry dataset": [
                *("fit-geometry", str(self.dataset), "--out", str(self.out / "new.ply")),
                *FIT,
            ],
            "eval": [
                *("eval", str(self.field), str(self.dataset), "--out", str(self.out / "report.html")),
                *("--json-out", str(self.out / "report.json")),
            ],
            "render": [
                *("render", str(self.field), "--at", "7", "7", "1.5", "--size", "30", "20"),
                *("--out", str(self.out / "spectrum.npz")),
            ],
            "csi": [
                *("csi", str(self.field), "--at", "7", "7", "1.5", "--format", "csv"),
                *("--out", str(self.out / "paths.csv")),
            ],
            "spectra": ["spectra", str(self.paths), "--out", str(self.out / "new"), "--size", "36", "18"],
            "info": ["info", str(self.dataset)],
            "info geometry": ["info", str(self.geometry)],
            "info field": ["info", str(self.field)],
            "info paths": ["info", str(self.paths)],
            "validate": ["validate", str(self.dataset)],
            "validate photos": ["validate", str(self.photos)],
        }
        return [known[name] for name in names]


def make_spectra() -> Spectrum:
    random = torch.Generator().manual_seed(0)
    pose = Pose.scatter(((1, 1, 1), (13, 14, 2)), COUNT, seed=7)
    shape = (COUNT, HEIGHT, WIDTH)
    distance = torch.linalg.vector_norm(pose.position - TX.position, dim=-1)
    delay = distance[:, None, None] / SPEED_OF_LIGHT + 60e-9 * torch.rand(shape, generator=random)
    aod = torch.nn.functional.normalize(torch.randn(*shape, 3, generator=random), dim=-1)
    power = power_from_db(-130 + 30 * torch.rand(shape, generator=random))
    grid = equirect_grid(WIDTH, HEIGHT)
    return Spectrum(power, grid, pose, 60e9, Instrument.gaussian(0.5), "ideal", delay, aod, TX)


def make_photos(folder: Path) -> list[Photo]:
    folder.mkdir()
    random = np.random.default_rng(3)
    photos = []
    for index in range(9):
        name = f"{index:03d}{'.png' if index % 2 else '.jpg'}"
        Image.fromarray(random.integers(0, 256, (12, 16, 3), dtype=np.uint8)).save(folder / name)
        turn = 2 * np.pi * index / 9
        pose = Pose.look_at((7 + 4 * np.cos(turn), 7 + 4 * np.sin(turn), 1.5), (7.0, 7.0, 1.0))
        photos.append(Photo(name, Camera.of(pose, pinhole_grid(16, 12, 70)), folder / name))
    write_nerfstudio(folder, photos)
    return photos


def make_paths(rx: Pose) -> Paths:
    ray = rx.position - TX.position
    distance = torch.linalg.vector_norm(ray, dim=-1, keepdim=True)
    aoa, aod = angles_of(-ray), angles_of(ray)
    return Paths(
        coeff=torch.complex(1e-3 / distance, torch.zeros_like(distance)),
        delay=distance / SPEED_OF_LIGHT,
        aoa_zenith=aoa[0][:, None],
        aoa_azimuth=aoa[1][:, None],
        aod_zenith=aod[0][:, None],
        aod_azimuth=aod[1][:, None],
        valid=torch.ones(distance.shape, dtype=torch.bool),
        frequency=60e9,
        tx=TX,
        rx=rx,
    )


@pytest.fixture(scope="module")
def sound(tmp_path_factory) -> Site:
    site = Site(tmp_path_factory.mktemp("sound"))
    site.out.mkdir()
    spectra = make_spectra()
    Dataset(make_photos(site.photos), spectra, meta={"seed": 0}).split(seed=1).save(site.dataset)
    write_ply(site.geometry, Gaussians.random(60, (0, 0, 0), (14, 15, 3), degree=0, seed=4))
    save_paths(make_paths(spectra.pose), site.paths)
    radio = ["--radio.model", "paper", "--radio.steps", "2", "--out", str(site.field)]
    assert main(["fit-radio", str(site.geometry), str(site.dataset), *radio]) == 0
    return site


@pytest.fixture
def site(sound, tmp_path) -> Site:
    """A copy of the sound site, to be damaged."""
    shutil.copytree(sound.root, tmp_path / "work")
    return Site(tmp_path / "work")


def listing(folder: Path) -> dict[str, str]:
    """Every file below a folder, hidden ones too, with its digest; the log of test reads is no output."""
    return {
        str(item.relative_to(folder)): "" if item.is_dir() else hashlib.sha256(item.read_bytes()).hexdigest()
        for item in folder.rglob("*")
    }


def reseal(dataset: Path) -> None:
    """Write the checksums anew, as a foreign program would that wrote wrong values in good faith."""
    file = dataset / "dataset.json"
    manifest = json.loads(file.read_text())
    manifest["spectra"]["sha256"] = hashlib.sha256((dataset / "spectra.h5").read_bytes()).hexdigest()
    manifest["photos"]["sha256"] = hashlib.sha256((dataset / "photos" / "transforms.json").read_bytes()).hexdigest()
    names = manifest["photos"]["files"]
    for name in names:
        names[name] = hashlib.sha256((dataset / "photos" / name).read_bytes()).hexdigest()
    file.write_text(json.dumps(manifest))


def truncate(file: Path, share: float = 0.6) -> None:
    data = file.read_bytes()
    file.write_bytes(data[: int(share * len(data))])


def assert_refused(site: Site, capsys, file: Path, message: str, *commands: str) -> None:
    """Each command ends with status 2 and one sentence that names `file`; nothing anywhere is written or changed."""
    before = listing(site.root)
    for command in site.commands(*commands):
        capsys.readouterr()
        status = main(command)
        said = capsys.readouterr()
        if command[0] == "validate":
            assert status == 1, said.out
            assert str(file) in said.out
            continue
        assert status == 2, f"{command}: {said.out}"
        ours = [line for line in said.err.splitlines() if line.startswith("rf3dgs: ")]
        assert len(ours) == 1, said.err
        assert said.err.endswith(ours[0] + "\n"), said.err
        assert str(file) in ours[0], ours[0]
        assert message in ours[0], f"{command[0]}: {ours[0]}"
        assert "Traceback" not in said.err
        assert listing(site.root) == before, f"{command[0]} left something behind"


Change = Callable[[h5py.File], None]


def in_pose(name: str, row: int, value: object) -> Change:
    def change(file: h5py.File) -> None:
        values = file[f"spectra/{name}"][()]  # type: ignore[index]
        values[row] = value
        file[f"spectra/{name}"][...] = values  # type: ignore[index]

    return change


def scaled(name: str, factor: float) -> Change:
    def change(file: h5py.File) -> None:
        file[f"spectra/{name}"][...] = factor * file[f"spectra/{name}"][()]  # type: ignore[index,operator]

    return change


def gain_of_all(value: int) -> Change:
    def change(file: h5py.File) -> None:
        codes = file["spectra/gain"][()]  # type: ignore[index]
        codes[:] = value
        file["spectra/gain"][...] = codes  # type: ignore[index]

    return change


def attribute(where: str, name: str, value: object) -> Change:
    return lambda file: file[where].attrs.__setitem__(name, value)


def one_pose_less(file: h5py.File) -> None:
    group = file["spectra"]
    positions, unit = group["position"][()], group["position"].attrs["unit"]  # type: ignore[index]
    del group["position"]  # type: ignore[attr-defined]
    group.create_dataset("position", data=positions[:-1]).attrs["unit"] = unit  # type: ignore[attr-defined]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        pytest.param(in_pose("position", 3, np.nan), "NaN", id="NaN position"),
        pytest.param(in_pose("orientation", 3, np.nan), "quaternion", id="NaN orientation"),
        pytest.param(in_pose("orientation", 4, 0.0), "zero", id="zero quaternion"),
        pytest.param(one_pose_less, "", id="one pose too few"),
        pytest.param(scaled("position", 1000.0), "metres", id="millimetres"),
        pytest.param(attribute("spectra/position", "unit", np.bytes_("mm")), "set the attribute to 'm'", id="unit mm"),
        pytest.param(attribute("spectra", "lobe", 28.6), "radians", id="lobe in degrees"),
        pytest.param(attribute("spectra", "lobe_unit", np.bytes_("deg")), "'rad'", id="unit deg"),
        pytest.param(attribute("spectra/delay", "scale", 1.0), "seconds", id="delay in nanoseconds"),
        pytest.param(attribute("spectra/gain", "offset", 40.0), "dBm", id="gain in dBm"),
    ],
)
def test_wrong_values_in_spectra(site, capsys, change, message):
    with h5py.File(site.dataset / "spectra.h5", "r+") as file:
        change(file)
    reseal(site.dataset)
    file = site.dataset / "spectra.h5"
    assert_refused(site, capsys, file, message, "fit", "fit-radio", "eval", "info", "validate")


@pytest.mark.parametrize(("code", "message"), [(0, "is empty"), (500, "is constant")])
def test_spectra_that_teach_nothing_are_refused_before_training(site, capsys, code, message):
    with h5py.File(site.dataset / "spectra.h5", "r+") as file:
        gain_of_all(code)(file)
    reseal(site.dataset)
    assert_refused(site, capsys, site.dataset / "spectra.h5", message, "fit", "fit-radio", "validate")


def test_truncated_and_changed_spectra(site, capsys):
    file = site.dataset / "spectra.h5"
    whole = file.read_bytes()
    commands = ("fit", "fit-radio", "eval", "info", "validate")
    file.write_bytes(whole[:-100] + bytes(100))
    assert_refused(site, capsys, file, "sha256", *commands)
    for share in (0.0, 0.02, 0.5, 0.99):
        file.write_bytes(whole[: int(share * len(whole))])
        assert_refused(site, capsys, file, "sha256", *commands)
        reseal(site.dataset)
        assert_refused(site, capsys, file, "", *commands)
    file.unlink()
    assert_refused(site, capsys, file, "there is no such file", *commands)


@pytest.mark.parametrize("name", ["003.png", "002.jpg"])
@pytest.mark.parametrize("share", [0.0, 0.1, 0.6])
def test_truncated_pictures(site, capsys, name, share):
    for file in (site.photos / name, site.dataset / "photos" / name):
        truncate(file, share)
    assert_refused(site, capsys, site.photos / name, "truncated", "fit-geometry", "validate photos")
    picture = site.dataset / "photos" / name
    assert_refused(site, capsys, picture, "truncated", "fit", "fit-geometry dataset", "validate")


def in_frames(change: Callable[[list], object]) -> Callable[[dict], object]:
    return lambda content: change(content["frames"])


def matrix_value(value: object) -> Callable[[dict], object]:
    return in_frames(lambda frames: frames[1]["transform_matrix"][0].__setitem__(0, value))


def angle_in_degrees(content: dict) -> None:
    for key in ("fl_x", "fl_y"):
        del content[key]
    content["camera_angle_x"] = 70.0


@pytest.mark.parametrize(
    ("change", "message"),
    [
        pytest.param(matrix_value(math.nan), "NaN", id="NaN pose"),
        pytest.param(matrix_value(1e39), "NaN or infinity", id="infinite pose"),
        pytest.param(matrix_value(7.0), "no rotation", id="no rotation"),
        pytest.param(matrix_value("x"), "4 rows of 4 numbers", id="text in a pose"),
        pytest.param(angle_in_degrees, "degrees", id="angle in degrees"),
        pytest.param(lambda content: content.__setitem__("fl_x", 0.0), "positive", id="no focal length"),
        pytest.param(lambda content: content.__setitem__("w", 160), "pixels", id="another size"),
        pytest.param(in_frames(lambda frames: frames.clear()), "frames", id="no frames"),
        pytest.param(in_frames(lambda frames: frames[0].pop("file_path")), "file name", id="no file name"),
    ],
)
def test_wrong_cameras(site, capsys, change, message):
    for folder in (site.photos, site.dataset / "photos"):
        content = json.loads((folder / "transforms.json").read_text())
        change(content)
        (folder / "transforms.json").write_text(json.dumps(content))
    reseal(site.dataset)
    commands = ("fit-geometry", "validate photos") if message != "pixels" else ("fit-geometry",)
    name = "" if message == "pixels" else "transforms.json"
    assert_refused(site, capsys, site.photos / name, message, *commands)
    commands = ("fit", "fit-radio", "info", "fit-geometry dataset")
    assert_refused(site, capsys, site.dataset / "photos" / name, message, *commands)


def test_photos_and_cameras_of_different_numbers(site, capsys):
    folder = site.photos
    (folder / "001.png").unlink()
    assert_refused(site, capsys, folder / "001.png", "no such picture", "fit-geometry", "validate photos")
    file = site.dataset / "photos" / "transforms.json"
    content = json.loads(file.read_text())
    content["frames"].pop()
    file.write_text(json.dumps(content))
    reseal(site.dataset)
    assert_refused(site, capsys, file, "lists 9", "fit", "info", "fit-radio", "validate")


@pytest.mark.parametrize("share", [0.0, 0.3, 0.9])
def test_truncated_json(site, capsys, share):
    truncate(site.photos / "transforms.json", share)
    assert_refused(site, capsys, site.photos / "transforms.json", "expected JSON", "fit-geometry", "validate photos")
    file = site.dataset / "dataset.json"
    truncate(file, share)
    assert_refused(site, capsys, file, "expected JSON", "fit", "fit-radio", "eval", "info", "validate")


@pytest.mark.parametrize("share", [0.0, 0.01, 0.2, 0.95])
def test_truncated_geometry(site, capsys, share):
    truncate(site.geometry, share)
    assert_refused(site, capsys, site.geometry, "", "fit-radio", "info geometry")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda gaussians: gaussians.means.__setitem__((3, 0), math.nan), "means"),
        (lambda gaussians: gaussians.quats.__setitem__(3, 0.0), "quat"),
        (lambda gaussians: gaussians.log_scales.__setitem__(3, math.inf), "scales"),
        (lambda gaussians: gaussians.means.mul_(1000.0), "millimetres"),
    ],
)
def test_wrong_values_in_geometry(site, capsys, monkeypatch, change, message):
    gaussians = Gaussians.random(60, (0, 0, 0), (14, 15, 3), degree=0, seed=4)
    change(gaussians)
    with monkeypatch.context() as patch:
        patch.setattr(Gaussians, "check", lambda self: None)
        write_ply(site.geometry, gaussians)
    assert_refused(site, capsys, site.geometry, message, "fit-radio")


@pytest.mark.parametrize("name", ["tensors.safetensors", "field.json"])
@pytest.mark.parametrize("share", [0.0, 0.05, 0.9])
def test_truncated_field(site, capsys, name, share):
    truncate(site.field / name, share)
    assert_refused(site, capsys, site.field / name, "", "render", "csi", "eval", "info field")
    (site.field / name).unlink()
    if name == "tensors.safetensors":
        assert_refused(site, capsys, site.field / name, "no such file", "render", "csi", "eval", "info field")


def test_one_flipped_bit_in_a_field(site, capsys):
    file = site.field / "tensors.safetensors"
    data = bytearray(file.read_bytes())
    data[-40] ^= 4
    file.write_bytes(data)
    assert_refused(site, capsys, file, "checksum", "render", "csi", "eval", "info field")


@pytest.mark.parametrize("share", [0.0, 0.02, 0.5, 0.99])
def test_truncated_paths(site, capsys, share):
    truncate(site.paths, share)
    assert_refused(site, capsys, site.paths, "", "spectra", "info paths")


@pytest.mark.parametrize(
    ("name", "change", "message"),
    [
        pytest.param("rx_position", lambda v: v.__setitem__(2, np.nan), "NaN", id="NaN receiver"),
        pytest.param("rx_orientation", lambda v: v.__setitem__(2, 0.0), "zero", id="zero quaternion"),
        pytest.param("tx_position", lambda v: v.__setitem__(2, np.inf), "NaN", id="infinite transmitter"),
        pytest.param("delay", lambda v: v.__setitem__(2, np.nan), "NaN", id="NaN delay"),
        pytest.param("aoa_azimuth", lambda v: v.__imul__(180 / np.pi), "radians", id="azimuth in degrees"),
        pytest.param("aod_zenith", lambda v: v.__imul__(180 / np.pi), "radians", id="zenith in degrees"),
        pytest.param("rx_position", lambda v: v.__imul__(1000.0), "metres", id="receivers in millimetres"),
        pytest.param("delay", lambda v: v.__imul__(1e9), "seconds", id="delay in nanoseconds"),
        pytest.param("offset", lambda v: v.__setitem__(-1, 99), "", id="counts that differ"),
    ],
)
def test_wrong_values_in_paths(site, capsys, name, change, message):
    with h5py.File(site.paths, "r+") as file:
        values = file[name][()]  # type: ignore[index]
        change(values)
        file[name][...] = values  # type: ignore[index]
    assert_refused(site, capsys, site.paths, message, "spectra")


IMPOSSIBLE = {
    "a place that is no number": ("render FIELD --at nan 7 1 --out OUT/s.png", "NaN or infinity"),
    "an infinite place": ("csi FIELD --at 7 inf 1", "NaN or infinity"),
    "too many pixels": ("render FIELD --at 7 7 1 --size 99999999 99999999 --out OUT/s.png", "at most 64 million"),
    "a part of the paper's field": ("render FIELD --at 7 7 1 --part lit --out OUT/s.png", "belong to the mirror model"),
    "no pixels": ("render FIELD --at 7 7 1 --size 0 9 --out OUT/s.png", "at least one pixel"),
    "a field of view beyond a half turn": ("render FIELD --at 7 7 1 --fov-deg 200 --out OUT/s.png", "0 and 180"),
    "a format nobody writes": ("render FIELD --at 7 7 1 --out OUT/s.gif", ".png or .npz"),
    "no paths": ("csi FIELD --at 7 7 1 --strongest 0", "at least 1"),
    "a paper's field elsewhere": ("csi FIELD --at 7 7 1 --tx 3 3 2", "needs a field of the mirror model"),
    "a transmitter nowhere": ("render FIELD --at 7 7 1 --tx 3 3 nan --out OUT/s.png", "NaN or infinite"),
    "a file as a folder": ("render FIELD --at 7 7 1 --size 9 9 --out PLY/s.npz", "cannot write"),
    "a folder as a file": ("fit-geometry PICTURES --out OUT --visual.steps 1 --visual.start random", "is a folder"),
    "a field over a file": ("fit-radio PLY SITE --out PLY", "is a file, but a field is a folder"),
    "a field over a dataset": ("fit SITE --out SITE", "something else than a field"),
    "a demo over a file": ("demo --scene box --out PLY", "geometry.ply"),
    "a dataset without photographs": ("fit-geometry BARE --out OUT/g.ply", "no photographs"),
    "negative receivers": ("trace lobby --rx.count -2 --out OUT/x.paths", "count from 1"),
    "no photographs": ("photos lobby --count 0 --out OUT/photos", "at least 1"),
    "an array of no elements": ("spectra PATHS --out OUT/x --method capon --array 0x4", "rows x columns"),
    "noise without elements": ("spectra PATHS --out OUT/x --snr-db 10", "no array to process"),
    "an unknown scene": ("fit SITE --mesh nowhere --out OUT/x.field", "no scene is named"),
    "no such dataset": ("fit OUT/gone --out OUT/x.field", "there is no dataset folder"),
    "no such field": ("eval OUT/gone SITE --out OUT/r.html", "there is no field"),
    "no such file": ("info OUT/gone", "there is no such file"),
}


@pytest.mark.parametrize("name", IMPOSSIBLE)
def test_impossible_wishes(site, capsys, name):
    words, message = IMPOSSIBLE[name]
    if "BARE" in words:
        Dataset((), make_spectra()).save(site.root / "bare")
    places = {"FIELD": site.field, "OUT": site.out, "PLY": site.geometry, "PICTURES": site.photos}
    places |= {"SITE": site.dataset, "PATHS": site.paths, "BARE": site.root / "bare"}
    for word, place in places.items():
        words = words.replace(word, str(place))
    before = listing(site.root)
    assert main(words.split()) == 2
    said = capsys.readouterr()
    last = said.err.splitlines()[-1]
    assert last.startswith("rf3dgs: ")
    assert message in last
    assert "Traceback" not in said.err
    assert listing(site.root) == before


def test_the_sound_site_passes_every_command(sound, tmp_path, capsys):
    shutil.copytree(sound.root, tmp_path / "work")
    site = Site(tmp_path / "work")
    for command in site.commands("fit", "fit-geometry", "eval", "render", "csi", "spectra", "info", "validate"):
        assert main(command) == 0, capsys.readouterr()
    assert sorted(item.name for item in site.out.iterdir()) == [
        *("new", "new.field", "new.ply", "paths.csv", "report.html", "report.json", "spectrum.npz"),
    ]
