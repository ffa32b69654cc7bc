"""DeepMIMO v4 scenario folders, read and written without the package deepmimo.

Layout (DeepMIMO's specification of version 4). One file for each matrix and each pair of a transmitter and a set of
receivers, `NAME_tSSS_txIII_rRRR.npz` with the set SSS and the number III of the transmitter and the set RRR of the
receivers; the array in it has the name NAME. N receivers, P paths:

    rx_pos, tx_pos                  N x 3, 1 x 3   metres
    power                           N x P          dB: the path gain, as for 0 dB of transmit power
    phase                           N x P          degrees
    delay                           N x P          seconds
    aoa_az, aoa_el, aod_az, aod_el  N x P          degrees; despite its name `el` is the angle from +z (0 to 180)
    inter                           N x P          one decimal digit per interaction, from the transmitter on:
                                                   1 reflection, 2 diffraction, 3 scattering, 4 transmission; 0 is
                                                   the line of sight
    inter_pos                       N x P x I x 3  metres, where the interactions are

A path that does not exist is NaN in every matrix. `params.json` has the carrier frequency [Hz] in `rt_params`, and the
sets in `txrx_sets`; `objects.json` and `vertices.npz` are the scene. A folder whose `rt_params.raytracer_name` is
"Sionna Ray Tracing" has the phase of the coefficient alone, all others that of the whole path, carrier included.
"""

import json
import math
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from rf3dgs.channel.paths import Paths
from rf3dgs.core.errors import DataError, InputError
from rf3dgs.core.frames import Pose
from rf3dgs.core.npz import read_npz_array
from rf3dgs.core.units import LONGEST_DELAY, shortest_delay

PhaseOf = Literal["auto", "path", "coefficient"]
NUMBERS = ("power", "phase", "delay", "aoa_az", "aoa_el", "aod_az", "aod_el")
MATRICES = (*NUMBERS, "inter", "inter_pos", "rx_pos", "tx_pos")
HIGHEST_POWER_DB = 30.0
DIGITS = {1: 1, 2: 8, 3: 2, 4: 4}  # of `inter`, as bits of `Paths.kind`
EXACT_DIGITS = 7  # of a float32
SIONNA = "Sionna Ray Tracing"
MATRIX_FILE = re.compile(rf"({'|'.join(MATRICES)})_(t\d+_tx\d+_r\d+)\.npz")
_MAX_JSON = 64 * 2**20


class Pair(NamedTuple):
    """One transmitter and one set of receivers of a folder; `code` as in the file names: "t001_tx000_r000"."""

    code: str
    receivers: int


def deepmimo_pairs(folder: str | Path) -> list[Pair]:
    """The pairs of transmitter and receiver set in a folder, in the order of their codes.

    DataError when it is no DeepMIMO v4 folder, or one of several scenes, or one with .mat files instead of .npz.
    """
    folder = Path(folder)
    if not (folder / "params.json").is_file():
        raise DataError(f"{folder}: expected a DeepMIMO v4 scenario folder; it has no params.json")
    codes = sorted({match[2] for item in folder.iterdir() if (match := MATRIX_FILE.fullmatch(item.name))})
    codes = [code for code in codes if (folder / f"power_{code}.npz").is_file()]
    if not codes:
        found = "matrices as .mat" if any(folder.glob("power_t*.mat")) else "no power_t*_tx*_r*.npz"
        if any(item.is_dir() for item in folder.iterdir()):
            found += " but folders, as a scenario of several scenes has"
        raise DataError(
            f"{folder}: expected matrices power_tSSS_txIII_rRRR.npz and others; it has {found}. Save it with DeepMIMO "
            "4.0 or later, one scene at a time"
        )
    return [Pair(code, len(read_npz_array(folder / f"rx_pos_{code}.npz", "rx_pos"))) for code in codes]


def read_deepmimo(folder: str | Path, pair: str | None = None, *, phase: PhaseOf = "auto") -> Paths:
    """Read the paths `[rx, path]` of one pair of a DeepMIMO v4 folder.

    pair: its code, such as "t001_tx000_r000"; not needed when there is one. phase: whether the folder's phases are
    those of whole "path"s or of their "coefficient"s alone; "auto" goes by the ray tracer that params.json names.
    InputError for an unknown pair or when there are several; DataError names the file that is missing, damaged or has
    impossible values, such as elevations from the horizon or delays that light does not have.
    """
    folder = Path(folder)
    known = deepmimo_pairs(folder)
    codes = ", ".join(f"{item.code} ({item.receivers} receivers)" for item in known)
    if pair is None and len(known) > 1:
        raise InputError(f"{folder} has several pairs of transmitter and receivers; choose one of {codes}")
    if pair is not None and pair not in [item.code for item in known]:
        raise InputError(f"{folder} has no pair {pair!r}; it has {codes}")
    code = known[0].code if pair is None else pair
    frequency, tracer = _parameters(folder / "params.json")
    if phase not in ("auto", "path", "coefficient"):
        raise InputError(f'phase must be "auto", "path" or "coefficient"; got {phase!r}')
    alone = tracer == SIONNA if phase == "auto" else phase == "coefficient"
    tx, rx = _positions(folder, code)
    columns = _columns(folder, code, len(rx))
    valid = _valid(folder, code, columns)
    _check(folder, code, columns, valid, rx.position - tx.position)
    turn = np.radians(columns["phase"])
    if not alone:
        turn = turn + 2 * np.pi * np.mod(frequency * columns["delay"].astype(np.float32).astype(np.float64), 1.0)
    value = np.where(valid, 10 ** (columns["power"] / 20) * np.exp(1j * turn), 0)
    angles = {name: np.radians(columns[name]) for name in NUMBERS[3:]}

    def tensor(array: NDArray) -> torch.Tensor:
        return torch.from_numpy(np.where(valid, array, 0).astype(np.float32))

    order, kind = _interactions(folder, code, valid)
    return Paths(
        coeff=torch.from_numpy(value.astype(np.complex64)),
        delay=tensor(columns["delay"]),
        aoa_zenith=tensor(angles["aoa_el"]),
        aoa_azimuth=tensor(_wrapped(angles["aoa_az"])),
        aod_zenith=tensor(angles["aod_el"]),
        aod_azimuth=tensor(_wrapped(angles["aod_az"])),
        valid=torch.from_numpy(valid),
        frequency=frequency,
        tx=tx,
        rx=rx,
        order=order,
        kind=kind,
    )


def _parameters(path: Path) -> tuple[float, str]:
    """Carrier frequency [Hz] and the ray tracer's name."""
    if path.stat().st_size > _MAX_JSON:
        raise DataError(f"{path}: has {path.stat().st_size} bytes; expected at most {_MAX_JSON}")
    try:
        document = json.loads(path.read_text(encoding="utf-8"))
        tracing = document["rt_params"]
        frequency, tracer = float(tracing["frequency"]), str(tracing.get("raytracer_name", ""))
    except (ValueError, TypeError, KeyError, AttributeError, RecursionError) as error:
        raise DataError(f"{path}: expected JSON with the carrier in rt_params.frequency; {error!r}") from error
    if not 1e8 <= frequency <= 1e12:
        raise DataError(f"{path}: rt_params.frequency must be in hertz, 100 MHz to 1 THz; got {frequency:g}")
    return frequency, tracer


def _wrapped(angle: NDArray) -> NDArray:
    """Azimuth [rad] in (-pi, pi]."""
    return np.pi - np.mod(np.pi - angle, 2 * np.pi)


def _matrix(folder: Path, code: str, name: str) -> NDArray:
    return read_npz_array(folder / f"{name}_{code}.npz", name).astype(np.float64)


def _positions(folder: Path, code: str) -> tuple[Pose, Pose]:
    """The transmitter and the receivers `[rx]`, not turned."""
    tx, rx = _matrix(folder, code, "tx_pos"), _matrix(folder, code, "rx_pos")
    for name, value, shape in (("tx_pos", tx.reshape(-1), (3,)), ("rx_pos", rx, (len(rx), 3))):
        if value.shape != shape or not len(rx) or not np.isfinite(value).all():
            raise DataError(
                f"{folder / f'{name}_{code}.npz'}: expected finite positions x y z in metres, one transmitter and at "
                f"least one receiver; got shape {list(value.shape)}"
            )
    return Pose(torch.from_numpy(tx.reshape(3))), Pose(torch.from_numpy(rx))


def _columns(folder: Path, code: str, receivers: int) -> dict[str, NDArray]:
    columns = {name: _matrix(folder, code, name) for name in NUMBERS}
    shape = columns["power"].shape
    for name, value in columns.items():
        if value.shape != shape or len(shape) != 2 or shape[0] != receivers:
            raise DataError(
                f"{folder / f'{name}_{code}.npz'}: expected a row for each of the {receivers} receivers and as many "
                f"columns as in power; got shape {list(value.shape)}"
            )
    return columns


def _valid(folder: Path, code: str, columns: Mapping[str, NDArray]) -> NDArray:
    """Which paths exist: all numbers finite; a path of which only some are NaN is a fault."""
    valid = ~np.stack([np.isnan(columns[name]) for name in NUMBERS]).all(0)
    for name in NUMBERS:
        wrong = valid & ~np.isfinite(columns[name])
        if wrong.any():
            row, column = (int(index) for index in np.argwhere(wrong)[0])
            raise DataError(
                f"{folder / f'{name}_{code}.npz'}: path {column} of receiver {row} is {columns[name][row, column]} but "
                "its other matrices are not all NaN; a path has finite numbers or is NaN throughout"
            )
    return np.asarray(valid)


def _check(folder: Path, code: str, columns: Mapping[str, NDArray], valid: NDArray, offset: torch.Tensor) -> None:
    """Refuse angles, delays and powers that cannot be what the layout says."""
    least = shortest_delay(offset.norm(dim=-1).double().numpy())[:, None]
    rounding = 1e-3  # [deg]
    limits = {
        "delay": (least, LONGEST_DELAY, "seconds, no earlier than light; convert them (and positions to metres)"),
        "aoa_el": (
            -rounding,
            180 + rounding,
            "degrees from +z; an elevation from the horizon is 90 minus it, convert it",
        ),
        "aod_el": (
            -rounding,
            180 + rounding,
            "degrees from +z; an elevation from the horizon is 90 minus it, convert it",
        ),
        "aoa_az": (-360 - rounding, 360 + rounding, "degrees"),
        "aod_az": (-360 - rounding, 360 + rounding, "degrees"),
        "power": (-math.inf, HIGHEST_POWER_DB, "dB of path gain"),
    }
    for name, (low, high, unit) in limits.items():
        value = columns[name]
        wrong = valid & ((value < low) | (value > high))
        if wrong.any():
            row, column = (int(index) for index in np.argwhere(wrong)[0])
            raise DataError(
                f"{folder / f'{name}_{code}.npz'}: path {column} of receiver {row} has {value[row, column]:.4g}, which "
                f"cannot be {unit}"
            )


def _interactions(folder: Path, code: str, valid: NDArray) -> tuple[torch.Tensor | None, torch.Tensor | None]:
    """Order and kind `[rx, path]` of the digits of `inter`, or None when there is no such file."""
    path = folder / f"inter_{code}.npz"
    if not path.is_file():
        return None, None
    given = read_npz_array(path, "inter").astype(np.float64)
    if given.shape != valid.shape or not ((given >= 0) & (given < 1e18))[valid].all():
        raise DataError(f"{path}: expected interaction codes of every path, in the shape of power; it has others")
    rest = np.where(valid, given, 0).astype(np.int64)
    order = np.zeros(valid.shape, dtype=np.int8)
    kind = np.zeros(valid.shape, dtype=np.int8)
    place = 0
    while rest.any():
        here = rest > 0
        exact = here & (given < 10.0 ** (EXACT_DIGITS + place))  # what follows these digits is rounded in float32
        bits = np.select([rest % 10 == digit for digit in DIGITS], list(DIGITS.values()), default=0).astype(np.int8)
        if (exact & (bits == 0)).any():
            wrong = given[exact & (bits == 0)][0]
            raise DataError(
                f"{path}: the interaction code {wrong:.0f} has digits other than 1 to 4; it is damaged or was "
                "converted before DeepMIMO 4.0.5, convert it again"
            )
        order += here
        kind |= np.where(exact, bits, 0).astype(np.int8)
        rest //= 10
        place += 1
    return torch.from_numpy(order), torch.from_numpy(kind)
