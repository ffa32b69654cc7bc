import sys

import numpy as np
import pytest
from PIL import Image

from rf3dgs.core.errors import DataError, InputError, MissingDependencyError
from rf3dgs.data.safe import read_picture
from rf3dgs.data.video import photos_of_video, sharpness

av = pytest.importorskip("av")


def texture(seed=0):
    generator = np.random.default_rng(seed)
    return np.kron(generator.integers(0, 255, (12, 16, 3)), np.ones((8, 8, 1))).astype(np.uint8)


def blurred(picture):
    small = Image.fromarray(picture).resize((8, 6))
    return np.array(small.resize((picture.shape[1], picture.shape[0])))


def write_video(path, pictures, codec="mpeg4"):
    with av.open(str(path), "w") as container:
        stream = container.add_stream(codec, rate=30)
        stream.height, stream.width = pictures[0].shape[:2]
        stream.pix_fmt = "yuv420p"
        stream.bit_rate = 4_000_000
        for picture in pictures:
            for packet in stream.encode(av.VideoFrame.from_ndarray(picture, format="rgb24")):
                container.mux(packet)
        for packet in stream.encode():
            container.mux(packet)


@pytest.mark.parametrize("ending", [".mp4", ".mkv", ".avi"])
def test_the_sharpest_frame_of_each_window_becomes_a_photograph(tmp_path, ending):
    sharp = [texture(seed) for seed in range(3)]
    frames = [blurred(picture) if number != 3 else picture for picture in sharp for number in range(6)]
    path = tmp_path / f"walk{ending}"
    write_video(path, frames)
    found = photos_of_video(path, tmp_path / "photos", every=6)
    assert [item.name for item in found] == ["00000.jpg", "00001.jpg", "00002.jpg"]
    for item, picture in zip(found, sharp, strict=True):
        mine = read_picture(item).astype(float)
        assert mine.shape == picture.shape
        # Lossy codecs change noise blocks by a few levels; a blurred frame is 40 and more away.
        assert np.abs(mine - picture).mean() < 20 < np.abs(blurred(picture).astype(float) - picture).mean()


def test_large_frames_are_made_smaller_and_a_last_half_window_counts(tmp_path):
    write_video(tmp_path / "a.mp4", [texture(seed) for seed in range(7)])
    found = photos_of_video(tmp_path / "a.mp4", tmp_path / "photos", every=4, longest=64)
    assert [read_picture(item).shape for item in found] == [(48, 64, 3)] * 2


def test_sharpness_falls_with_blur():
    assert sharpness(blurred(texture())) < 0.5 * sharpness(texture())


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("a.mp4", b"", "damaged or of another kind"),
        ("a.mp4", b"\x00" * 5000, "damaged or of another kind"),
        ("a.mkv", b"#EXTM3U\n#EXTINF:1\nfile:///etc/passwd\n", "damaged or of another kind"),
        ("a.avi", b"ffconcat version 1.0\nfile /etc/passwd\n", "damaged or of another kind"),
        ("a.m3u8", b"#EXTM3U\n", "expected a video ending in .mp4"),
        ("missing.mp4", None, "there is no such video"),
    ],
)
def test_broken_videos_are_one_error_with_their_name(tmp_path, name, content, message):
    if content is not None:
        (tmp_path / name).write_bytes(content)
    with pytest.raises(DataError, match=message) as caught:
        photos_of_video(tmp_path / name, tmp_path / "photos")
    assert name in str(caught.value)
    assert not (tmp_path / "photos").exists()


def test_a_truncated_video_leaves_no_half_folder(tmp_path):
    write_video(tmp_path / "a.mp4", [texture(seed) for seed in range(20)])
    whole = (tmp_path / "a.mp4").read_bytes()
    (tmp_path / "b.mp4").write_bytes(whole[: len(whole) // 2])
    with pytest.raises(DataError, match=r"b\.mp4"):
        photos_of_video(tmp_path / "b.mp4", tmp_path / "photos", every=2)
    assert not (tmp_path / "photos").exists()


def test_a_folder_with_something_in_it_is_kept(tmp_path):
    (tmp_path / "mine.txt").write_text("keep")
    with pytest.raises(InputError, match="not empty; choose another folder"):
        photos_of_video(tmp_path / "a.mp4", tmp_path)
    with pytest.raises(InputError, match="every must be at least 1 frame"):
        photos_of_video(tmp_path / "a.mp4", tmp_path / "photos", every=0)


def test_without_pyav_the_error_says_what_to_install(tmp_path, monkeypatch):
    (tmp_path / "a.mp4").write_bytes(b"")
    monkeypatch.setitem(sys.modules, "av", None)
    with pytest.raises(MissingDependencyError, match="pip install av"):
        photos_of_video(tmp_path / "a.mp4", tmp_path / "photos")
