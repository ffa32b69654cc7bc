"""Point sources in a field's files: numbers for the description, tensors for the rest, and back."""

import math
from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

from rf3dgs.core.errors import DataError
from rf3dgs.field.reflections import RIPPLE, Marks
from rf3dgs.field.sources import PointSources
from rf3dgs.geometry import Patches, Planes

KINDS = {
    "plane_normals": torch.float32,
    "plane_offsets": torch.float32,
    "reflection": torch.float32,
    "sequence": torch.int16,
    "patch_axes": torch.float32,
    "patch_low": torch.float32,
    "patch_shape": torch.int64,
    "patch_cells": torch.bool,
    "patch_cell": torch.float64,
    "mark_points": torch.float32,
    "mark_plane": torch.int16,
    "mark_level_db": torch.float32,
    "mirrors": torch.bool,
    "ripple": torch.float32,
    "slabs": torch.float32,
}
PREFIX = "source_"


def source_record(sources: PointSources | None) -> dict[str, Any] | None:
    """The numbers of the sources as JSON takes them."""
    if sources is None:
        return None
    return {
        "tx": sources.tx.tolist(),
        "level_db": sources.level_db,
        "open_above": sources.open_above,
        "planes": len(sources.planes),
        "count": len(sources),
        "marks": 0 if sources.marks is None else len(sources.marks.points),
        "mark_width": 0.0 if sources.marks is None else sources.marks.width,
        "patches": sources.patches is not None,
        "mirrors": sources.mirrors is not None,
        "ripple": sources.ripple is not None,
        "slabs": sources.slabs is not None,
    }


def source_tensors(sources: PointSources | None) -> dict[str, Tensor]:
    """The tensors of the sources by name; none for the line of sight alone."""
    if sources is None or not len(sources.planes):
        return {}
    tensors = {
        "plane_normals": sources.planes.normals,
        "plane_offsets": sources.planes.offsets,
        "reflection": sources.reflection,
        "sequence": sources.sequence,
    }
    if sources.patches is not None:
        tensors |= {f"patch_{name}": tensor for name, tensor in sources.patches.tensors().items()}
    if sources.mirrors is not None:
        tensors["mirrors"] = sources.mirrors
    if sources.ripple is not None:
        tensors["ripple"] = sources.ripple
    if sources.slabs is not None:
        tensors["slabs"] = sources.slabs
    if sources.marks is not None:
        marks = sources.marks
        tensors |= {"mark_points": marks.points, "mark_plane": marks.plane, "mark_level_db": marks.level_db}
    return {PREFIX + name: tensor.detach().to(KINDS[name]).contiguous() for name, tensor in tensors.items()}


def sources_of(record: Any, tensors: Mapping[str, Tensor], frequency: float) -> PointSources | None:
    """The sources of a record and tensors; DataError or the errors of `PointSources` where they do not fit together.

    A list is the record of fields of schema 1, which have the line of sight alone.
    """
    if record is None or record == []:
        return None
    if isinstance(record, list):
        first = record[0]
        return PointSources.line_of_sight(
            _vector(first["position"]),
            frequency,
            level_db=float(first["gain_db"]),
            open_above=float(first["open_above"]),
        )
    tx, level_db, open_above = _vector(record["tx"]), float(record["level_db"]), float(record["open_above"])
    planes, count, marked = int(record["planes"]), int(record["count"]), int(record["marks"])
    if planes == 0:
        return PointSources.line_of_sight(tx, frequency, level_db=level_db, open_above=open_above)
    shapes = {
        "plane_normals": (planes, 3),
        "plane_offsets": (planes,),
        "reflection": (planes, 3),
        "sequence": (count, 3),
    }
    if record["patches"]:
        shapes |= {
            "patch_axes": (planes, 2, 3),
            "patch_low": (planes, 2),
            "patch_shape": (planes, 2),
            "patch_cells": None,
        }
        if PREFIX + "patch_cell" in tensors:  # of before cells had other widths than 10 cm, fields have none
            shapes |= {"patch_cell": (1,)}
    if marked:
        shapes |= {"mark_points": (marked, 3), "mark_plane": (marked,), "mark_level_db": (marked,)}
    if record.get("mirrors", False):  # of before transmitters could move, fields have none
        shapes |= {"mirrors": (planes,)}
    if record.get("ripple", False):  # of before reflections could depend on more than a parabola, fields have none
        shapes |= {"ripple": (planes, RIPPLE)}
    if record.get("slabs", False):  # of before ways could keep polarisation, fields have none
        shapes |= {"slabs": (planes, 3)}
    found = {name: _tensor(tensors, name, shape) for name, shape in shapes.items()}
    patches = None
    if record["patches"]:
        parts = {name.removeprefix("patch_"): tensor for name, tensor in found.items() if name.startswith("patch_")}
        patches = Patches.from_tensors(parts)
        sizes = patches.shape
        if bool((sizes < 1).any()) or int(sizes.double().prod(-1).sum()) != len(patches.cells):
            raise DataError(f"patches of {sizes.tolist()} cells do not fit {len(patches.cells)} cells")
        if not 0 < patches.cell < math.inf:
            raise DataError(f"cells of patches must have a width in metres; got {patches.cell}")
    marks = None
    if marked:
        plane = found["mark_plane"].long()
        marks = Marks(found["mark_points"], plane, found["mark_level_db"], float(record["mark_width"]))
        if not marks.width > 0:
            raise DataError(f"mark_width must be positive; got {marks.width}")
    return PointSources(
        tx,
        frequency,
        Planes(found["plane_normals"], found["plane_offsets"]),
        patches,
        found["sequence"].long(),
        found["reflection"],
        level_db,
        open_above,
        marks,
        found.get("mirrors"),
        found.get("ripple"),
        found.get("slabs"),
    )


def _tensor(tensors: Mapping[str, Tensor], name: str, shape: tuple[int, ...] | None) -> Tensor:
    tensor = tensors.get(PREFIX + name)
    if tensor is None:
        raise DataError(f"lacks the tensor {PREFIX + name}")
    fits = tensor.dim() == 1 if shape is None else tuple(tensor.shape) == shape
    if not fits or tensor.dtype != KINDS[name]:
        raise DataError(f"{PREFIX + name} must be {shape} {KINDS[name]}; got {list(tensor.shape)} {tensor.dtype}")
    if not bool(torch.isfinite(tensor).all()):
        raise DataError(f"{PREFIX + name} has NaN or infinite values")
    return tensor


def _vector(value: Any) -> Tensor:
    vector = torch.tensor([float(item) for item in value])
    if vector.shape != (3,) or not bool(torch.isfinite(vector).all()):
        raise DataError(f"a position must be three finite numbers; got {value!r}")
    return vector
