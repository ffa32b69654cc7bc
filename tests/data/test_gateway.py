"""Reading measured spectra of a gateway: what the layout means, and one clear sentence for every damage."""

import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from rf3dgs.core.errors import DataError, InputError
from rf3dgs.data.formats.gateway import GatewaySpectra, hemisphere_grid, read_gateway

INFO = f"""dataset_name: made up
gateway1:
  position: [5.0, 0.25, 0]
  orientation:  [ {0.5}, {-0.5}, {-0.5}, {0.5} ]  # quaternion
"""


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "spectrum").mkdir()
    (tmp_path / "gateway_info.yml").write_text(INFO)
    (tmp_path / "tx_pos.csv").write_text("name,x,y,z\n00001.png,0.1,0.2,1.0\n00002.png,0.3,-0.1,1.1\n")
    for index, name in enumerate(("00001.png", "00002.png")):
        grey = np.zeros((90, 360), dtype=np.uint8)
        grey[80, 90 + index] = 255
        grey[10, 20] = 51
        Image.fromarray(grey).save(tmp_path / "spectrum" / name)
    return tmp_path


def test_pictures_places_and_pose_are_those_of_the_files(folder: Path) -> None:
    spectra = read_gateway(folder)
    assert spectra.names == ("00001.png", "00002.png")
    assert spectra.places.tolist() == [[0.1, 0.2, 1.0], [0.3, -0.1, 1.1]]
    assert spectra.amplitude.shape == (2, 90, 360)
    assert float(spectra.amplitude[1, 80, 91]) == 1.0
    assert float(spectra.amplitude[0, 10, 20]) == pytest.approx(0.2)
    assert spectra.pose.position.tolist() == [5.0, 0.25, 0.0]


def test_the_quaternion_is_xyzw_from_axes_left_up_ahead(folder: Path) -> None:
    matrix = read_gateway(folder).pose.world_from_device
    # an upright array that looks along -x: ahead -x, left -y, up z
    assert torch.allclose(matrix, torch.tensor([[-1.0, 0, 0], [0, -1.0, 0], [0, 0, 1.0]]), atol=1e-6)


def test_rows_are_elevations_over_the_array_and_columns_azimuths_from_left_to_up() -> None:
    grid = hemisphere_grid()
    assert grid.shape == (90, 360)
    assert torch.allclose(grid.directions[0, 0], torch.tensor([0.0, 1.0, 0.0]), atol=1e-6)  # left
    assert torch.allclose(grid.directions[0, 90], torch.tensor([0.0, 0.0, 1.0]), atol=1e-6)  # up
    ahead = torch.tensor([math.sin(math.radians(89)), math.cos(math.radians(89)), 0.0])
    assert torch.allclose(grid.directions[89, 0], ahead, atol=1e-6)
    # the rectangle rule over elevation misses half a step of the rim, 1 / 115
    assert float(grid.solid_angle.sum()) == pytest.approx(2 * math.pi, rel=0.01)


def test_some_places_keep_their_pictures_and_names(folder: Path) -> None:
    spectra = read_gateway(folder)[[1]]
    assert len(spectra) == 1
    assert spectra.names == ("00002.png",)
    assert float(spectra.amplitude[0, 80, 91]) == 1.0


def test_amplitudes_and_places_must_fit(folder: Path) -> None:
    spectra = read_gateway(folder)
    with pytest.raises(InputError, match=r"amplitude must be \[2, 90, 360\]"):
        GatewaySpectra(
            spectra.amplitude[:1], spectra.grid, spectra.places, spectra.pose, spectra.array, spectra.frequency
        )


def test_a_folder_that_is_not_there_is_named(tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"nowhere: expected a folder with gateway_info\.yml"):
        read_gateway(tmp_path / "nowhere")


def _write(name: str, text: str) -> Callable[[Path], None]:
    return lambda folder: (folder / name).write_text(text) and None


def _picture(mode: str, size: tuple[int, int], colour: object) -> Callable[[Path], None]:
    def damage(folder: Path) -> None:
        Image.new(mode, size, colour).save(folder / "spectrum" / "00002.png")  # type: ignore[arg-type]

    return damage


DAMAGES = {
    "no info": (lambda folder: (folder / "gateway_info.yml").unlink(), "gateway_info.yml: there is no such file"),
    "no places": (lambda folder: (folder / "tx_pos.csv").unlink(), "tx_pos.csv: there is no such file"),
    "no picture": (lambda folder: (folder / "spectrum" / "00002.png").unlink(), "00002.png: there is no such picture"),
    "cut picture": (
        lambda folder: (folder / "spectrum" / "00002.png").write_bytes(
            (folder / "spectrum" / "00002.png").read_bytes()[:60]
        ),
        "truncated",
    ),
    "no PNG": (_write("spectrum/00002.png", "no picture"), "expected a JPEG or PNG picture"),
    "small": (_picture("L", (36, 9), 7), "expected 360 x 90 pixels, a degree each; got 36 x 9"),
    "colours": (_picture("RGB", (360, 90), (9, 8, 7)), "expected a grey picture"),
    "black": (_picture("L", (360, 90), 0), "the picture is black"),
    "16 bits": (_picture("I;16", (360, 90), 300), "expected 8 bits"),
    "two gateways": (_write("gateway_info.yml", INFO + "gateway2:\n  position: [1, 2, 3]\n"), "expected one gateway"),
    "no gateway": (_write("gateway_info.yml", "dataset_name: s23\n"), "expected one gateway"),
    "short position": (_write("gateway_info.yml", INFO.replace("5.0, ", "")), "'position: .*' with 3 finite numbers"),
    "no number": (_write("gateway_info.yml", INFO.replace("0.25", "left")), "'position: .*' with 3 finite numbers"),
    "infinite": (_write("gateway_info.yml", INFO.replace("0.25", ".inf")), "'position: .*' with 3 finite numbers"),
    "no rotation": (_write("gateway_info.yml", INFO.replace("-0.5", "3")), "expected a unit quaternion"),
    "header": (_write("tx_pos.csv", "x,y,z\n1,2,3\n"), "expected the first line 'name,x,y,z'; got 'x,y,z'"),
    "empty": (_write("tx_pos.csv", ""), "expected the first line 'name,x,y,z'; the file is empty"),
    "no line": (_write("tx_pos.csv", "name,x,y,z\n"), "expected 1 to 100000 pictures; got 0"),
    "bad line": (_write("tx_pos.csv", "name,x,y,z\n00001.png,1,2\n"), "line 2 must be a name and three finite"),
    "NaN": (_write("tx_pos.csv", "name,x,y,z\n00001.png,1,2,nan\n"), "line 2 must be a name and three finite"),
    "twice": (
        _write("tx_pos.csv", "name,x,y,z\n00001.png,1,2,3\n00001.png,1,2,3\n"),
        "line 3 names '00001.png' a second",
    ),
    "outside": (_write("tx_pos.csv", "name,x,y,z\n../../a.png,1,2,3\n"), "leads outside"),
    "binary": (lambda folder: (folder / "tx_pos.csv").write_bytes(b"\xff\xfe\x00"), "expected UTF-8"),
}


@pytest.mark.parametrize("name", DAMAGES)
def test_what_is_missing_damaged_or_odd_is_refused_in_one_sentence(folder: Path, name: str) -> None:
    damage, sentence = DAMAGES[name]
    damage(folder)
    with pytest.raises(DataError, match=sentence) as caught:
        read_gateway(folder)
    assert "\n" not in str(caught.value)
