"""What a field knows of its errors, in the field's files: numbers for the description, tensors, and back."""

from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

from rf3dgs.core.errors import DataError
from rf3dgs.field.uncertainty import NUMBERS, SHARES, Uncertainty

PREFIX = "doubt_"
TENSORS = ("spread_db", "source_db", "receivers", "seen", "weights", "widths")


def doubt_record(doubt: Uncertainty | None) -> dict[str, Any] | None:
    """The numbers as JSON takes them; None for a field that does not know its errors."""
    if doubt is None:
        return None
    sizes = {"receivers": len(doubt.receivers), "planes": len(doubt.source_db) - 1}
    return sizes | {"spacing": doubt.spacing, "numbers": list(NUMBERS), "shares": list(SHARES)}


def doubt_tensors(doubt: Uncertainty | None) -> dict[str, Tensor]:
    """The tensors by name."""
    if doubt is None:
        return {}
    return {PREFIX + name: getattr(doubt, name).contiguous() for name in TENSORS}


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
    return {PREFIX + name: (shape, torch.bool if name == "seen" else torch.float32) for name, shape in shapes.items()}


def doubt_of(tensors: Mapping[str, Tensor], record: Mapping[str, Any] | None) -> Uncertainty | None:
    """What was learned, out of checked tensors."""
    if record is None:
        return None
    return Uncertainty(spacing=float(record["spacing"]), **{name: tensors[PREFIX + name] for name in TENSORS})
