"""Spectra of a receiver that stands still while the transmitter moves, in the folder layout of published RFID data.

    DIR/gateway_info.yml   position [x, y, z] and orientation (a quaternion, x y z w) of one gateway
    DIR/tx_pos.csv         a line `name,x,y,z`, then a picture's name and where the transmitter stood [m], a line each
    DIR/spectrum/NAME      the pictures: 360 x 90 pixels, 8 bits of grey

A picture shows amplitude, divided by its own largest. Column c is the azimuth of c degrees from the array's left to its
up axis, row r the elevation of r degrees over the array's plane: row 89 looks ahead, row 0 sideways.
"""

import csv
import io
import math
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from rf3dgs.channel.arrays import PlanarArray, planar_array
from rf3dgs.core.errors import DataError, InputError
from rf3dgs.core.frames import Pose, matrix_from_quaternion
from rf3dgs.core.grids import DirectionGrid
from rf3dgs.data.safe import inside, picture_size, read_picture, read_text

ROWS, COLUMNS = 90, 360
FREQUENCY = 915e6  # [Hz], as published
SPACING = 0.49  # [wavelengths], what makes the pictures a sum of plane waves over 4 x 4 elements: see the how-to
MAX_PICTURES = 100_000
MAX_TEXT = 16 * 2**20
INFO, PLACES, PICTURES = "gateway_info.yml", "tx_pos.csv", "spectrum"
_NUMBERS = r"\[([^\]\n]{1,200})\]"


@dataclass(frozen=True, eq=False)
class GatewaySpectra:
    """Bartlett spectra of one array that stands still, one for each place of the transmitter.

    amplitude `[place, row, col]`: sqrt of power, its unit unknown and another in each picture. grid: its directions,
    device frame. places `[place, 3]`: the transmitter [m], world frame. pose: the array's. names: of the pictures.
    """

    amplitude: Tensor
    grid: DirectionGrid
    places: Tensor
    pose: Pose
    array: PlanarArray
    frequency: float
    names: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        expected = (len(self.places), *self.grid.shape)
        if tuple(self.amplitude.shape) != expected:
            raise InputError(f"amplitude must be {list(expected)} (places, grid); got {list(self.amplitude.shape)}")

    def __len__(self) -> int:
        return len(self.places)

    def __getitem__(self, index: Sequence[int] | Tensor) -> "GatewaySpectra":
        """The spectra of some places `[n]`."""
        chosen = torch.as_tensor(index, dtype=torch.long)
        names = tuple(self.names[int(one)] for one in chosen) if self.names else ()
        return replace(self, amplitude=self.amplitude[chosen], places=self.places[chosen], names=names)


def read_gateway(folder: str | Path, *, frequency: float = FREQUENCY, spacing: float = SPACING) -> GatewaySpectra:
    """The measured spectra in a folder of this layout, for a 4 x 4 array of `spacing` [wavelengths].

    DataError, naming the file, for what is missing, damaged, of another size, or leads out of the folder.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise DataError(f"{folder}: expected a folder with {INFO}, {PLACES} and {PICTURES}/; there is none")
    pose = _pose(folder / INFO)
    names, places = _places(folder / PLACES)
    pictures = np.empty((len(names), ROWS, COLUMNS), dtype=np.uint8)
    for index, name in enumerate(names):
        path = inside(folder / PICTURES, name, named_in=folder / PLACES)
        size = picture_size(path)
        if size != (COLUMNS, ROWS):
            raise DataError(f"{path}: expected {COLUMNS} x {ROWS} pixels, a degree each; got {size[0]} x {size[1]}")
        colours = read_picture(path)
        if (colours != colours[..., :1]).any():
            raise DataError(f"{path}: expected a grey picture of amplitudes; got colours. Use the raw spectrum")
        pictures[index] = colours[..., 0]
        if pictures[index].max() == 0:
            raise DataError(f"{path}: the picture is black, there is no spectrum in it; remove its line from {PLACES}")
    array = planar_array(4, 4, "isotropic", spacing)
    amplitude = torch.from_numpy(pictures).float() / 255.0
    return GatewaySpectra(amplitude, hemisphere_grid(), places, pose, array, frequency, names)


def hemisphere_grid(rows: int = ROWS, columns: int = COLUMNS) -> DirectionGrid:
    """Directions `[row, col]` of the hemisphere before an array, device frame: row = elevation, column = azimuth.

    Elevation is over the array's plane, from 0 in steps of 90 degrees / rows; azimuth runs from left (+y) over up (+z).
    """
    elevation = torch.arange(rows, dtype=torch.float64) * (0.5 * math.pi / rows)
    azimuth = torch.arange(columns, dtype=torch.float64) * (2 * math.pi / columns)
    height, turn = torch.meshgrid(elevation, azimuth, indexing="ij")
    flat = torch.cos(height)
    directions = torch.stack((torch.sin(height), flat * torch.cos(turn), flat * torch.sin(turn)), -1)
    solid_angle = flat * (0.5 * math.pi / rows) * (2 * math.pi / columns)
    return DirectionGrid("list", directions.float(), solid_angle.float())


def _pose(path: Path) -> Pose:
    """The gateway's pose: the file's own axes are left, up, ahead (x, y, z), its quaternion is x y z w."""
    text = read_text(path, limit=MAX_TEXT)
    if len(re.findall(r"^\s*gateway\w*\s*:", text, re.MULTILINE)) != 1:
        raise DataError(f"{path}: expected one gateway; a folder with several, or none, cannot be read as one array")
    position = _numbers(path, text, "position", 3)
    x, y, z, w = _numbers(path, text, "orientation", 4)
    length = math.sqrt(x * x + y * y + z * z + w * w)
    if not abs(length - 1.0) < 0.01:
        raise DataError(f"{path}: expected a unit quaternion x, y, z, w as orientation; its length is {length:.3g}")
    left, up, ahead = matrix_from_quaternion(torch.tensor((w, x, y, z), dtype=torch.float64)).unbind(-1)
    return Pose.from_matrix(position, torch.stack((ahead, left, up), -1))


def _numbers(path: Path, text: str, key: str, count: int) -> list[float]:
    """The finite numbers of the line `key: [a, b, ...]`."""
    found = re.findall(rf"^\s*{key}\s*:\s*{_NUMBERS}", text, re.MULTILINE)
    values = [_number(word) for word in found[0].split(",")] if len(found) == 1 else []
    if len(values) != count or not all(math.isfinite(value) for value in values):
        raise DataError(f"{path}: expected one line '{key}: [...]' with {count} finite numbers; mend or replace it")
    return values


def _places(path: Path) -> tuple[tuple[str, ...], Tensor]:
    """The pictures' names and the transmitter's places `[n, 3]` [m]."""
    try:
        lines = list(csv.reader(io.StringIO(read_text(path, limit=MAX_TEXT)), strict=True))
    except csv.Error as error:
        raise DataError(f"{path}: expected comma-separated values ({error}); copy it again") from error
    if not lines or [word.strip() for word in lines[0]] != ["name", "x", "y", "z"]:
        raise DataError(
            f"{path}: expected the first line 'name,x,y,z'; got {','.join(lines[0])[:80]!r}"
            if lines
            else f"{path}: expected the first line 'name,x,y,z'; the file is empty"
        )
    if not 1 < len(lines) <= MAX_PICTURES + 1:
        raise DataError(f"{path}: expected 1 to {MAX_PICTURES} pictures; got {len(lines) - 1}")
    names: dict[str, list[float]] = {}
    for number, words in enumerate(lines[1:], 2):
        values = [_number(word) for word in words[1:]]
        if len(values) != 3 or not all(math.isfinite(value) for value in values):
            raise DataError(
                f"{path}: line {number} must be a name and three finite numbers; got {','.join(words)[:80]!r}"
            )
        if words[0] in names:
            raise DataError(f"{path}: line {number} names {words[0]!r} a second time; keep one of the two")
        names[words[0]] = values
    return tuple(names), torch.tensor(list(names.values()), dtype=torch.float64)


def _number(word: str) -> float:
    try:
        return float(word)
    except ValueError:
        return math.nan
