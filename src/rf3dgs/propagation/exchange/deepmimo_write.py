"""Writing DeepMIMO v4 scenario folders; `propagation.deepmimo` describes their layout and reads them."""

import json
import math
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from rf3dgs.channel.paths import Paths
from rf3dgs.core.errors import InputError
from rf3dgs.core.files import atomic_folder
from rf3dgs.core.units import db_from_power
from rf3dgs.propagation.exchange.deepmimo import DIGITS, MATRIX_FILE, NUMBERS

MAX_PATHS = 25
PAIR = "t000_tx000_r001"
SCENE_FILES = ("params.json", "objects.json", "vertices.npz", "faces.npz", "materials.npz")


def write_deepmimo(folder: str | Path, paths: Paths, *, max_paths: int = MAX_PATHS) -> None:
    """Write the strongest `max_paths` paths of each receiver as a DeepMIMO v4 folder, at once or not at all.

    The transmitter is set 0, the receivers are set 1. The phase is that of the whole path, which is what DeepMIMO's
    channels are made from. `inter` tells kinds and number of the interactions but not their sequence, which `Paths`
    does not know: scattering comes last; `inter_pos` is NaN. Without `order` or `kind` both are left out. The scene is
    empty. An older DeepMIMO folder of that name is replaced; a folder with anything else in it is an InputError.
    """
    folder = Path(folder)
    others = [item.name for item in folder.iterdir() if not _ours(item.name)] if folder.is_dir() else []
    if others:
        raise InputError(
            f"{folder} would be replaced, but it holds something else than a DeepMIMO scenario, such as "
            f"{min(others)}; choose another name"
        )
    if max_paths < 1:
        raise InputError(f"max_paths must be at least 1; got {max_paths}")
    paths = paths.flat().strongest(max_paths)
    with atomic_folder(folder) as temporary:
        for name, matrix in _matrices(paths).items():
            _save(temporary / f"{name}_{PAIR}.npz", name, matrix)
        _save(temporary / "vertices.npz", "vertices", np.zeros((0, 3), dtype=np.float32))
        (temporary / "objects.json").write_text("[]\n")
        (temporary / "params.json").write_text(json.dumps(_document(paths), indent=1, allow_nan=False) + "\n")


def _save(path: Path, name: str, matrix: NDArray) -> None:
    arrays: dict[str, Any] = {name: matrix}
    np.savez_compressed(path, **arrays)


def _ours(name: str) -> bool:
    return name in SCENE_FILES or MATRIX_FILE.fullmatch(name) is not None


def _matrices(paths: Paths) -> dict[str, NDArray]:
    """The matrices of `[rx, path]` paths, strongest first."""
    keep = paths.valid & (paths.path_gain > 0)
    longest = max(int(keep.sum(-1).max()), 1)  # the strongest come first, so the paths kept do
    paths, keep = paths._map(lambda value: value[:, :longest]), keep[:, :longest]
    turn = paths.coeff.to(torch.complex128).angle() / (2 * math.pi) - paths.frequency * paths.delay.double()
    degrees = {
        name: torch.rad2deg(getattr(paths, column).double())
        for name, column in zip(NUMBERS[3:], ("aoa_azimuth", "aoa_zenith", "aod_azimuth", "aod_zenith"), strict=True)
    }
    columns = {
        "power": db_from_power(paths.coeff.to(torch.complex128).abs() ** 2),
        "phase": 360 * (torch.remainder(turn + 0.5, 1.0) - 0.5),
        "delay": paths.delay.double(),
        **degrees,
    }
    if paths.order is not None and paths.kind is not None:
        columns["inter"] = torch.from_numpy(_codes(paths.order.numpy(), paths.kind.numpy()))
    matrices = {
        name: np.where(keep.numpy(), column.numpy(), np.nan).astype(np.float32) for name, column in columns.items()
    }
    if "inter" in columns:
        depth = max(len(f"{np.nanmax(matrices['inter'], initial=0.0):.0f}"), 1)
        matrices["inter_pos"] = np.full((*keep.shape, depth, 3), np.nan, dtype=np.float32)
    return matrices | {"rx_pos": paths.rx.position.numpy(), "tx_pos": paths.tx.position[None].numpy()}


def _codes(order: NDArray, kind: NDArray) -> NDArray:
    """The code of each path."""
    pairs, index = np.unique(np.stack((order, kind), -1).reshape(-1, 2), axis=0, return_inverse=True)
    known = np.array([_code(int(number), int(bits)) for number, bits in pairs], dtype=np.float64)
    return known[index.reshape(-1)].reshape(order.shape)


def _code(order: int, kind: int) -> int:
    """Digits for `order` interactions of the kinds in the bit set `kind`: each once, scattering last, mirrors repeated.

    Where there are no mirrors the last kind is repeated; unknown kinds count as mirrors.
    """
    if order == 0:
        return 0
    digits = [digit for digit in (4, 2, 1, 3) if kind & DIGITS[digit]] or [1]
    repeated = 1 if 1 in digits else digits[-1]
    more = max(order - len(digits), 0)
    return int("".join(str(digit) * (1 + more * (digit == repeated)) for digit in digits))


def _document(paths: Paths) -> dict:
    """The content of params.json."""
    deepest = 0 if paths.order is None else int(paths.order[paths.valid].max()) if bool(paths.valid.any()) else 0
    kinds = 0 if paths.kind is None else int(np.bitwise_or.reduce(paths.kind[paths.valid].numpy(), initial=0))
    reflections, diffractions, scattering, transmissions = (
        deepest if kinds & DIGITS[digit] else 0 for digit in (1, 2, 3, 4)
    )
    receivers = len(paths.rx)
    reached = int((paths.path_gain > 0).any(-1).sum())
    return {
        "version": "4.0.0",
        "rt_params": {
            "raytracer_name": "rf3dgs",
            "raytracer_version": version("rf3dgs"),
            "frequency": paths.frequency,
            "max_path_depth": deepest,
            "max_reflections": reflections,
            "max_diffractions": diffractions,
            "max_scattering": scattering,
            "max_transmissions": transmissions,
            "raw_params": {},
        },
        "scene": {"num_scenes": 1, "n_objects": 0, "n_vertices": 0, "n_faces": 0, "n_triangular_faces": 0},
        "materials": {},
        "txrx_sets": {
            "txrx_set_0": _set("tx", 0, 1, 1, transmits=True),
            "txrx_set_1": _set("rx", 1, receivers, reached, transmits=False),
        },
    }


def _set(name: str, number: int, points: int, active: int, *, transmits: bool) -> dict:
    """One set of devices with a single antenna each, as in params.json."""
    return {
        "name": name,
        "id": number,
        "is_tx": transmits,
        "is_rx": not transmits,
        "num_points": points,
        "num_active_points": active,
        "num_ant": 1,
        "dual_pol": False,
        "ant_rel_positions": [[0, 0, 0]],
        "array_orientation": [0, 0, 0],
    }
