"""A field on disk: the folder NAME.field with `field.json` (what it is) and `tensors.safetensors` (the numbers).

Nothing in it is code: no pickle. The JSON file carries the sha256 of the tensors' file and one of its own body, since
safetensors has no checksum; harmonics, scales, rotations and opacities are float16, positions float32: about 95 bytes a
Gaussian. Saving builds the whole folder beside its name first, so that a reader never meets half of one.
"""

import hashlib
import json
import math
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError
from safetensors.torch import load as tensors_of_bytes
from safetensors.torch import save as bytes_of_tensors
from torch import Tensor

from rf3dgs.core.errors import DataError, InputError, RfError
from rf3dgs.core.files import atomic_folder
from rf3dgs.core.frames import Pose
from rf3dgs.data.safe import read_bytes, read_json
from rf3dgs.field.radio_field import RadioField
from rf3dgs.field.source_files import source_record, source_tensors, sources_of
from rf3dgs.field.surface_files import surface_kinds, surface_of, surface_record, surface_tensors
from rf3dgs.field.uncertainty_files import doubt_kinds, doubt_of, doubt_record, doubt_tensors
from rf3dgs.spectra.codec import DbWindow
from rf3dgs.spectra.spectrum import Instrument

SCHEMA = 2
READABLE = (1, 2)
DESCRIPTION, TENSORS = "field.json", "tensors.safetensors"
MAX_TENSOR_BYTES = 4 * 2**30
CONVENTIONS = {
    "units": "m, s, Hz, rad, linear power; names ending in _db are dB",
    "world": "right-handed, z up",
    "device": "x forward, y left, z up",
    "quaternions": "wxyz, world_from_device",
    "gain": "window value 0.5 + SH(direction from receiver to Gaussian), 3DGS order and signs",
    "residual": "mirror model: E in dB, the same harmonics; laws R, b, alpha, A, e per segment",
    "uncertainty": "log std [dB] = weights . numbers; widths of shares in std",
    "csi": "vector: delay residual [ns], departure residual x, y, z; paper: azimuth, zenith, delay as 0.5 + SH",
}


def save_field(field: RadioField, path: str | Path) -> None:
    """Write `field` to the folder `path`, replacing an older field there; InputError when a tensor is not finite.

    A folder of that name that is not a field is not replaced.
    """
    path = Path(path)
    if path.is_dir() and any(path.iterdir()) and not (path / DESCRIPTION).exists():
        raise InputError(f"{path} is a folder that holds something else than a field; choose another name")
    tensors = _tensors(field)
    for name, tensor in tensors.items():
        if not bool(torch.isfinite(tensor).all()):
            raise InputError(f"{name} has NaN or infinite values (or does not fit float16); this field cannot be saved")
    data = bytes_of_tensors(tensors)
    body = _description(field) | {
        "tensors": {"file": TENSORS, "bytes": len(data), "sha256": hashlib.sha256(data).hexdigest()}
    }
    text = json.dumps({"body": body, "sha256": _digest(body)}, indent=1, allow_nan=False)
    with atomic_folder(path) as folder:
        (folder / TENSORS).write_bytes(data)
        (folder / DESCRIPTION).write_text(text + "\n", encoding="utf-8")


def load_field(path: str | Path) -> RadioField:
    """Read a folder written by `save_field`; DataError names the file that is missing, damaged or of another schema."""
    folder = Path(path)
    if not folder.is_dir():
        raise DataError(f"{folder}: there is no such field; a field is a folder with {DESCRIPTION} and {TENSORS}")
    record = read_json(folder / DESCRIPTION)
    source = folder / DESCRIPTION
    body = record.get("body")
    if not isinstance(body, dict) or record.get("sha256") != _digest(body):
        raise DataError(f"{source}: does not match its checksum; copy or train the field again")
    if body.get("schema") not in READABLE:
        raise DataError(f"{source}: expected a field of schema 1 or 2; got {body.get('schema')!r}. Train it again")
    try:
        expected = body["tensors"]
        data = read_bytes(folder / TENSORS, limit=min(MAX_TENSOR_BYTES, int(expected["bytes"])))
        if len(data) != int(expected["bytes"]) or hashlib.sha256(data).hexdigest() != expected["sha256"]:
            raise DataError(f"{folder / TENSORS}: does not match its checksum; copy or train the field again")
        tensors = tensors_of_bytes(data)
        _check(tensors, body, folder / TENSORS)
        return _assemble(tensors, body)
    except DataError as error:
        if str(folder) in str(error) or str(error).startswith(DESCRIPTION):
            raise
        raise DataError(f"{folder / TENSORS}: {error}; train the field again") from error
    except (KeyError, TypeError, ValueError, OverflowError, RfError, SafetensorError) as error:
        raise DataError(f"{source}: is not a field this version can read ({error!r}); train it again") from error


def _tensors(field: RadioField) -> dict[str, Tensor]:
    stored = surface_tensors(field.surface)
    stored["solidity"] = (field.solidity.detach().clamp(0, 1) * 255).round().to(torch.uint8)
    stored["colour"] = field.colour.to(torch.uint8).contiguous()
    if field.plane_of is not None:
        stored["plane_of"] = field.plane_of.to(torch.int16).contiguous()
    return stored | source_tensors(field.sources) | doubt_tensors(field.doubt)


def _description(field: RadioField) -> dict[str, Any]:
    return {
        "schema": SCHEMA,
        "kind": "rf3dgs radio field",
        "conventions": CONVENTIONS,
        **surface_record(field.surface),
        "frequency": field.frequency,
        "instrument": {
            "name": field.instrument.name,
            "lobe": field.instrument.lobe,
            "beam_solid_angle": field.instrument.beam_solid_angle,
        },
        "tx": {"position": field.tx.position.tolist(), "orientation": field.tx.orientation.tolist()},
        "bounds": field.bounds.tolist(),
        "sources": source_record(field.sources),
        "labelled": field.plane_of is not None,
        "uncertainty": doubt_record(field.doubt),
        "versions": {"torch": torch.__version__, "python": sys.version.split()[0]},
        "meta": field.meta,
    }


def _check(tensors: Mapping[str, Tensor], body: Mapping[str, Any], source: Path) -> None:
    """Refuse tensors that are missing, have another shape or type than the description says, or are not finite."""
    count = int(body["gaussians"])
    expected = (
        surface_kinds(body)
        | doubt_kinds(body)
        | {"solidity": ((count,), torch.uint8), "colour": ((count, 3), torch.uint8)}
    )
    if body.get("labelled", False):
        expected["plane_of"] = ((count,), torch.int16)
    for name, (shape, kind) in expected.items():
        if name not in tensors:
            raise DataError(f"{source}: lacks the tensor {name}; train the field again")
        tensor = tensors[name]
        if tuple(tensor.shape) != shape or tensor.dtype != kind:
            raise DataError(
                f"{source}: {name} must be {list(shape)} {kind}; got {list(tensor.shape)} {tensor.dtype}. "
                "Train the field again"
            )
        if not bool(torch.isfinite(tensor).all()):
            raise DataError(f"{source}: {name} has NaN or infinite values; train the field again")


def _assemble(tensors: Mapping[str, Tensor], body: Mapping[str, Any]) -> RadioField:
    floor_db, ceil_db = (_number(value, "window_db") for value in body["window_db"])
    span = _number(body.get("delay_span", 0.0), "delay_span")
    window = DbWindow(floor_db, ceil_db)
    surface = surface_of(tensors, body, _vector(body["prior_tx"], "prior_tx"), window, span)
    frequency = _number(body["frequency"], "frequency")
    instrument = body["instrument"]
    low, high = (_vector(corner, "bounds") for corner in body["bounds"])
    return RadioField(
        surface=surface,
        sources=sources_of(body["sources"], tensors, frequency),
        solidity=tensors["solidity"].float() / 255,
        frequency=frequency,
        instrument=Instrument(
            str(instrument["name"]),
            _number(instrument["lobe"], "lobe"),
            _number(instrument["beam_solid_angle"], "beam_solid_angle"),
        ),
        tx=Pose(body["tx"]["position"], body["tx"]["orientation"]),
        bounds=torch.stack((low, high)),
        colour=tensors["colour"],
        meta=dict(body["meta"]),
        plane_of=tensors["plane_of"].long() if body.get("labelled", False) else None,
        doubt=doubt_of(tensors, body.get("uncertainty")),
    )


def _number(value: object, name: str) -> float:
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not math.isfinite(value):
        raise DataError(f"{DESCRIPTION}: {name} must be a finite number; got {value!r}")
    return float(value)


def _vector(value: Any, name: str) -> Tensor:
    vector = torch.tensor([_number(item, name) for item in value])
    if vector.shape != (3,):
        raise DataError(f"{DESCRIPTION}: {name} must be three numbers; got {value!r}")
    return vector


def _digest(body: object) -> str:
    return hashlib.sha256(json.dumps(body, sort_keys=True).encode()).hexdigest()
