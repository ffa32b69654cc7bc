from pathlib import Path

import numpy as np
import pytest
import torch

from rf3dgs.core.errors import DataError, InputError
from rf3dgs.splats.gaussians import Gaussians
from rf3dgs.splats.ply import read_ply, read_point_cloud, write_ply


def some_gaussians(count: int = 37, channels: int = 3, degree: int = 3) -> Gaussians:
    cloud = Gaussians.random(count, (-1, -2, -3), (4, 5, 6), channels=channels, degree=degree, seed=3)
    tensors = cloud.tensors()
    tensors["sh"] = torch.randn(cloud.sh.shape, generator=torch.Generator().manual_seed(4))
    return Gaussians.from_tensors(tensors)


@pytest.mark.parametrize(("channels", "degree"), [(3, 3), (3, 0), (3, 1), (1, 2), (4, 3)])
def test_gaussians_survive_the_file_bit_by_bit(tmp_path: Path, channels: int, degree: int) -> None:
    written = some_gaussians(channels=channels, degree=degree)
    write_ply(tmp_path / "scene.ply", written)
    read = read_ply(tmp_path / "scene.ply")
    for name, tensor in written.tensors().items():
        assert torch.equal(tensor, read.tensors()[name]), name


def test_properties_are_named_and_ordered_as_3dgs_viewers_expect(tmp_path: Path) -> None:
    write_ply(tmp_path / "scene.ply", some_gaussians(5))
    header, body = (tmp_path / "scene.ply").read_bytes().split(b"end_header\n", 1)
    names = [line.split()[2] for line in header.decode().splitlines() if line.startswith("property float ")]
    expected = ["x", "y", "z", "nx", "ny", "nz", *(f"f_dc_{i}" for i in range(3)), *(f"f_rest_{i}" for i in range(45))]
    assert names == [*expected, "opacity", *(f"scale_{i}" for i in range(3)), *(f"rot_{i}" for i in range(4))]
    assert header.startswith(b"ply\nformat binary_little_endian 1.0\nelement vertex 5\n")
    assert len(body) == 5 * 62 * 4


def test_higher_harmonics_are_stored_channel_by_channel(tmp_path: Path) -> None:
    written = some_gaussians(2)
    write_ply(tmp_path / "scene.ply", written)
    body = (tmp_path / "scene.ply").read_bytes().split(b"end_header\n", 1)[1]
    rest = np.frombuffer(body, "<f4").reshape(2, 62)[:, 9:54]
    assert np.array_equal(rest[1, :15], written.sh[1, 1:, 0].numpy())
    assert np.array_equal(rest[1, 15:30], written.sh[1, 1:, 1].numpy())


def test_a_file_without_higher_harmonics_has_no_f_rest(tmp_path: Path) -> None:
    write_ply(tmp_path / "scene.ply", some_gaussians(degree=0))
    assert b"f_rest" not in (tmp_path / "scene.ply").read_bytes()


def test_big_endian_and_ascii_files_read_the_same(tmp_path: Path) -> None:
    written = some_gaussians(6, degree=1)
    write_ply(tmp_path / "little.ply", written)
    header, body = (tmp_path / "little.ply").read_bytes().split(b"end_header\n", 1)
    rows = np.frombuffer(body, "<f4").reshape(6, -1)
    big = header.replace(b"little", b"big") + b"end_header\n" + rows.astype(">f4").tobytes()
    (tmp_path / "big.ply").write_bytes(big)
    text = "\n".join(" ".join(repr(float(value)) for value in row) for row in rows)
    ascii_header = header.replace(b"binary_little_endian", b"ascii").replace(b"\n", b"\r\n")
    (tmp_path / "ascii.ply").write_bytes(ascii_header + b"end_header\r\n" + text.encode())
    for name in ("big.ply", "ascii.ply"):
        assert torch.equal(read_ply(tmp_path / name).sh, written.sh)
        assert torch.equal(read_ply(tmp_path / name).quats, written.quats)


def test_every_truncation_is_refused_with_the_name_of_the_file(tmp_path: Path) -> None:
    write_ply(tmp_path / "scene.ply", some_gaussians(3, degree=0))
    whole = (tmp_path / "scene.ply").read_bytes()
    cut = tmp_path / "cut.ply"
    for length in range(0, len(whole), 7):
        cut.write_bytes(whole[:length])
        with pytest.raises(DataError, match=r"cut\.ply"):
            read_ply(cut)


def test_flipped_bytes_of_the_header_never_crash_the_reader(tmp_path: Path) -> None:
    write_ply(tmp_path / "scene.ply", some_gaussians(3, degree=0))
    whole = (tmp_path / "scene.ply").read_bytes()
    rng, refused = np.random.default_rng(0), 0
    for _ in range(300):
        damaged = bytearray(whole)
        damaged[int(rng.integers(whole.index(b"end_header") + 11))] = int(rng.integers(256))
        (tmp_path / "bad.ply").write_bytes(bytes(damaged))
        try:
            read_ply(tmp_path / "bad.ply").check()
        except DataError:
            refused += 1
    assert 200 < refused < 300


@pytest.mark.parametrize("count", ["1000000000000", "-1", "99999999999999999999", "3.5", "1e9"])
@pytest.mark.parametrize("kind", ["ascii", "binary_little_endian"])
def test_counts_beyond_the_file_are_refused_before_memory_is_taken(tmp_path: Path, count: str, kind: str) -> None:
    path = tmp_path / "huge.ply"
    names = "".join(f"property float {name}\n" for name in "xyz")
    path.write_text(f"ply\nformat {kind} 1.0\nelement vertex {count}\n{names}end_header\n1 2 3\n")
    with pytest.raises(DataError, match=r"huge\.ply.*(promises|bad header line).*again"):
        read_point_cloud(path)


def test_rows_without_properties_do_not_keep_the_reader_busy(tmp_path: Path) -> None:
    path = tmp_path / "empty.ply"
    path.write_text(
        "ply\nformat ascii 1.0\nelement junk 999999999999\nelement vertex 0\nproperty float x\nend_header\n"
    )
    with pytest.raises(DataError, match=r"empty\.ply.*rows without properties"):
        read_point_cloud(path)


def test_a_missing_property_is_named(tmp_path: Path) -> None:
    write_ply(tmp_path / "scene.ply", some_gaussians(3))
    whole = (tmp_path / "scene.ply").read_bytes()
    (tmp_path / "odd.ply").write_bytes(whole.replace(b"float opacity", b"float opacitx"))
    with pytest.raises(DataError, match=r"odd\.ply.*lack the property opacity"):
        read_ply(tmp_path / "odd.ply")
    (tmp_path / "cloud.ply").write_bytes(whole.replace(b"f_dc_0", b"g_dc_0"))
    with pytest.raises(DataError, match=r"cloud\.ply.*read_point_cloud"):
        read_ply(tmp_path / "cloud.ply")


def test_values_that_are_not_finite_are_refused_both_ways(tmp_path: Path) -> None:
    cloud = some_gaussians(3)
    write_ply(tmp_path / "scene.ply", cloud)
    whole = bytearray((tmp_path / "scene.ply").read_bytes())
    whole[-4:] = np.array([np.nan], "<f4").tobytes()
    (tmp_path / "nan.ply").write_bytes(bytes(whole))
    with pytest.raises(DataError, match=r"nan\.ply.*quats must be finite; 1 of 3"):
        read_ply(tmp_path / "nan.ply")
    cloud.means[0, 0] = torch.nan
    with pytest.raises(InputError, match="means must be finite"):
        write_ply(tmp_path / "scene.ply", cloud)
    assert len(read_ply(tmp_path / "scene.ply")) == 3
    assert sorted(item.name for item in tmp_path.iterdir()) == ["nan.ply", "scene.ply"]


@pytest.mark.parametrize(
    "content", [b"", b"\x00" * 100, b"ply\n", b"solid x\n", b"ply\nformat ascii 2.0\nend_header\n"]
)
def test_other_files_are_refused(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "other.ply").write_bytes(content)
    with pytest.raises(DataError, match=r"other\.ply"):
        read_ply(tmp_path / "other.ply")


def test_a_missing_file_and_a_folder_are_refused(tmp_path: Path) -> None:
    for path in (tmp_path / "nothing.ply", tmp_path):
        with pytest.raises(DataError, match="cannot be read"):
            read_ply(path)


def test_point_clouds_keep_points_and_colours(tmp_path: Path) -> None:
    names = "".join(f"property float {name}\n" for name in "xyz")
    colours = "".join(f"property uchar {name}\n" for name in ("red", "green", "blue"))
    head = f"element vertex 2\n{names}{colours}element face 0\nproperty list uchar int vertex_indices\nend_header\n"
    text = "ply\nformat ascii 1.0\ncomment made by hand\n" + head + "1 2 3 255 0 51\n-1 0.5 1e-3 0 255 0\n"
    (tmp_path / "ascii.ply").write_text(text)
    row = np.dtype([*((name, "<f4") for name in "xyz"), *((name, "u1") for name in "rgb")])
    body = np.array([(1, 2, 3, 255, 0, 51), (-1, 0.5, 1e-3, 0, 255, 0)], row).tobytes()
    (tmp_path / "binary.ply").write_bytes(b"ply\nformat binary_little_endian 1.0\n" + head.encode() + body)
    for name in ("ascii.ply", "binary.ply"):
        points, shade = read_point_cloud(tmp_path / name)
        assert torch.equal(points, torch.tensor([[1, 2, 3], [-1, 0.5, 1e-3]]))
        assert shade is not None
        assert torch.allclose(shade, torch.tensor([[1, 0, 0.2], [0, 1, 0]]))


def test_point_clouds_may_have_no_colour(tmp_path: Path) -> None:
    write_ply(tmp_path / "scene.ply", some_gaussians(3))
    points, colours = read_point_cloud(tmp_path / "scene.ply")
    assert torch.equal(points, some_gaussians(3).means)
    assert colours is None
