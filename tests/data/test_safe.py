import signal
import struct
import subprocess
import sys
import textwrap
import time
import zlib

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from PIL import Image

from rf3dgs.core.errors import DataError, InputError, RfError
from rf3dgs.core.frames import Pose
from rf3dgs.core.grids import Camera, pinhole_grid
from rf3dgs.data.dataset import Dataset
from rf3dgs.data.photo import Photo
from rf3dgs.data.safe import inside, picture_size, read_json, read_picture


def _png(width: int, height: int) -> bytes:
    header = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    chunk = b"IHDR" + header
    return b"\x89PNG\r\n\x1a\n" + struct.pack(">I", 13) + chunk + struct.pack(">I", zlib.crc32(chunk))


@pytest.mark.parametrize(("width", "height"), [(9000, 9000), (20_000, 20_000), (2**31 - 1, 2**31 - 1)])
def test_picture_bombs_are_refused_from_their_header(tmp_path, width, height):
    path = tmp_path / "bomb.png"
    path.write_bytes(_png(width, height) + b"\0" * 100)
    with pytest.raises(DataError, match=r"bomb\.png: (more than 64 megapixels|expected a JPEG or PNG)"):
        read_picture(path)


@pytest.mark.parametrize("suffix", ["png", "jpg"])
def test_truncated_pictures_are_refused_by_name(tmp_path, suffix):
    path = tmp_path / f"picture.{suffix}"
    random = np.random.default_rng(0)
    Image.fromarray(random.integers(0, 256, (40, 50, 3), dtype=np.uint8)).save(path)
    assert picture_size(path) == (50, 40)
    whole = path.read_bytes()
    for share in (0.0, 0.01, 0.3, 0.7, 0.95):
        path.write_bytes(whole[: int(share * len(whole))])
        with pytest.raises(DataError, match=rf"picture\.{suffix}"):
            read_picture(path)


def test_other_formats_and_depths_are_refused(tmp_path):
    Image.new("RGB", (4, 4)).save(tmp_path / "a.png", format="GIF")
    with pytest.raises(DataError, match=r"a\.png: expected a JPEG or PNG"):
        read_picture(tmp_path / "a.png")
    Image.fromarray(np.zeros((4, 4), dtype=np.uint16)).save(tmp_path / "b.png")
    with pytest.raises(DataError, match=r"b\.png: expected 8 bits a channel"):
        read_picture(tmp_path / "b.png")
    with pytest.raises(DataError, match=r"c\.png: there is no such picture"):
        read_picture(tmp_path / "c.png")


def test_transparent_pixels_lie_over_black(tmp_path):
    Image.new("RGBA", (2, 2), (200, 100, 50, 0)).save(tmp_path / "a.png")
    assert read_picture(tmp_path / "a.png").max() == 0
    Image.new("L", (2, 2), 77).save(tmp_path / "b.png")
    assert read_picture(tmp_path / "b.png").tolist() == [[[77] * 3] * 2] * 2


def test_photos_check_their_size(tmp_path):
    camera = Camera.of(Pose((0, 0, 0)), pinhole_grid(8, 6, 60))
    Image.new("RGB", (8, 5)).save(tmp_path / "a.png")
    with pytest.raises(DataError, match=r"a\.png: expected 8x6 pixels; got 8x5"):
        Photo("a", camera, tmp_path / "a.png").load()
    with pytest.raises(InputError, match="neither a file nor pixels"):
        Photo("a", camera).load()


@pytest.mark.parametrize(
    "name", ["/etc/passwd", "../x", "a/../../x", "..\\x", "C:\\x", "", None, 5, "a\0b", "x" * 2000]
)
def test_names_that_lead_out_of_the_folder_are_refused(tmp_path, name):
    with pytest.raises(DataError, match=r"list\.json"):
        inside(tmp_path, name, named_in=tmp_path / "list.json")


def test_a_link_out_of_the_folder_is_refused(tmp_path):
    (tmp_path / "site").mkdir()
    (tmp_path / "secret.png").write_bytes(b"x")
    (tmp_path / "site" / "a.png").symlink_to(tmp_path / "secret.png")
    with pytest.raises(DataError, match="leads outside"):
        inside(tmp_path / "site", "a.png", named_in=tmp_path)
    assert inside(tmp_path / "site", "./b/../c.png", named_in=tmp_path).name == "c.png"


def test_brackets_in_texts_are_no_nesting(tmp_path):
    (tmp_path / "a.json").write_text('{"a": "' + "[" * 1000 + '\\"[", "b": [1, {"c": "\\\\"}]}')
    assert read_json(tmp_path / "a.json")["b"] == [1, {"c": "\\"}]


@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    place=st.floats(0, 1, exclude_max=True), bit=st.integers(0, 7), name=st.sampled_from(["spectra.h5", "dataset.json"])
)
def test_a_flipped_bit_never_ends_in_another_error_than_ours(saved, place, bit, name):
    file = saved / name
    whole = file.read_bytes()
    raw = bytearray(whole)
    raw[int(place * len(raw))] ^= 1 << bit
    file.write_bytes(raw)
    message = ""
    try:
        Dataset.load(saved)
    except RfError as error:
        message = str(error)
    finally:
        file.write_bytes(whole)
    assert message.startswith(str(saved)) or (message == "" and name == "dataset.json")


WRITER = """
import sys, torch
torch.set_num_threads(1)
from rf3dgs.core.frames import Pose
from rf3dgs.core.grids import equirect_grid
from rf3dgs.data.dataset import Dataset
from rf3dgs.spectra.spectrum import Instrument, Spectrum
pose = Pose.scatter(((0, 0, 0), (9, 9, 2)), 30, seed=0)
power = torch.rand(30, 60, 120) + 0.01
spectra = Spectrum(power, equirect_grid(120, 60), pose, 6e10, Instrument.gaussian(0.1), delay=power * 1e-7)
dataset = Dataset((), spectra)
print("ready", flush=True)
while True:
    dataset.save(sys.argv[1])
"""


def test_a_killed_writer_leaves_a_whole_dataset_or_none(tmp_path):
    target = tmp_path / "site"
    whole = 0
    with subprocess.Popen(
        [sys.executable, "-c", textwrap.dedent(WRITER), str(target)], stdout=subprocess.PIPE, text=True
    ) as writer:
        assert writer.stdout is not None
        assert writer.stdout.readline() == "ready\n"
        deadline = time.monotonic() + 0.9
        while time.monotonic() < deadline:
            writer.send_signal(signal.SIGSTOP)
            whole += _is_whole_or_none(target)
            writer.send_signal(signal.SIGCONT)
            time.sleep(0.03)
        writer.kill()
    _is_whole_or_none(target)
    assert whole > 0


def _is_whole_or_none(target) -> bool:
    """True for a dataset that loads; a folder without its manifest says that saving was interrupted."""
    if (target / "dataset.json").exists():
        return len(Dataset.load(target)._spectra) == 30
    with pytest.raises(DataError, match=r"expected dataset\.json in it"):
        Dataset.load(target)
    return False
