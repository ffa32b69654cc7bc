"""What a field knows of its errors, in the field's files: numbers for the description, tensors, and back."""

from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

from rf3dgs.core.errors import DataError
from rf3dgs.field.path_uncertainty import PathDoubt
from rf3dgs.field.uncertainty import NUMBERS, SHARES, Uncertainty

PREFIX = "doubt_"
PATHS = PREFIX + "paths_"
TENSORS = ("spread_db", "source_db", "receivers", "seen", "weights", "widths")
PATH_TENSORS = ("points", "plane", "off", "wrong", "levels")


def doubt_record(doubt: Uncertainty | None) -> dict[str, Any] | None:
    """The numbers as JSON takes them; None for a field that does not know its errors."""
    if doubt is None:
        return None
    points = None if doubt.paths is None else len(doubt.paths.plane)
    sizes = {"receivers": len(doubt.receivers), "planes": len(doubt.source_db) - 1, "path_points": points}
    return sizes | {"spacing": doubt.spacing, "numbers": list(NUMBERS), "shares": list(SHARES)}


def doubt_tensors(doubt: Uncertainty | None) -> dict[str, Tensor]:
    """The tensors by name."""
    if doubt is None:
        return {}
    found = {PREFIX + name: getattr(doubt, name).contiguous() for name in TENSORS}
    if doubt.paths is not None:
        found |= {PATHS + name: getattr(doubt.paths, name).contiguous() for name in PATH_TENSORS}
    return found


def doubt_kinds(body: Mapping[str, Any]) -> dict[str, tuple[tuple[int, ...], torch.dtype]]:
    """Shape and type of the tensors that the description `body` promises; none for fields of before there were any."""
    record = body.get("uncertainty")
    if record is None:
        return {}
    if record["numbers"] != list(NUMBERS) or record["shares"] != list(SHARES):
        raise DataError("field.json: this version counts other numbers of uncertainty; learn it again")
    cells, receivers, planes = int(body["cells"]), int(record["receivers"]), int(record["planes"])
    shapes = {
        "spread_db": (cells,),
        "source_db": (planes + 1,),
        "receivers": (receivers, 3),
        "seen": (cells, receivers),
        "weights": (len(NUMBERS),),
        "widths": (len(SHARES),),
    }
    kinds = {PREFIX + name: (shape, torch.bool if name == "seen" else torch.float32) for name, shape in shapes.items()}
    points = record.get("path_points")
    if points is not None:
        count = int(points)
        of_paths = {"points": (count, 3), "plane": (count,), "off": (2,), "wrong": (3,), "levels": (len(SHARES),)}
        for name, shape in of_paths.items():
            kinds[PATHS + name] = (shape, torch.int64 if name == "plane" else torch.float32)
    return kinds


def doubt_of(tensors: Mapping[str, Tensor], record: Mapping[str, Any] | None) -> Uncertainty | None:
    """What was learned, out of checked tensors."""
    if record is None:
        return None
    paths = None
    if record.get("path_points") is not None:
        paths = PathDoubt(**{name: tensors[PATHS + name] for name in PATH_TENSORS})
    known = {name: tensors[PREFIX + name] for name in TENSORS}
    return Uncertainty(spacing=float(record["spacing"]), paths=paths, **known)
