"""The surface part in a field's files, the paper's or the mirror model's: tensors, numbers, and back."""

from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

from rf3dgs.core.errors import DataError
from rf3dgs.field.lit import CSI_HARMONICS, HARMONICS, LAW, LitSurface
from rf3dgs.field.radiance import CSI_CHANNELS, CSI_DEGREE, Surface
from rf3dgs.spectra.codec import DbWindow

MIRROR, PAPER = "mirror", "paper"
SHAPE = ("quats", "log_scales", "logit_opacities")
CSI = ("segment_csi", "cell_csi", "own_csi")
HALF = {
    MIRROR: (*SHAPE, "normals", "segment_sh", "cell_sh", "level", "ambient", *CSI),
    PAPER: (*SHAPE, "gain_sh", "csi_sh"),
}
"""What is stored in float16, by model."""
NUMBERS = ("segment_of", "cell_of")
SHIFT = "ambient_shift"
LARGEST_LOGIT = 30.0


def model_of(surface: Surface | LitSurface) -> str:
    """The name of the surface's model in files."""
    return MIRROR if isinstance(surface, LitSurface) else PAPER


def surface_tensors(surface: Surface | LitSurface) -> dict[str, Tensor]:
    """The tensors of the surface by name, in the types in which they are stored."""
    model = model_of(surface)
    values = {name: getattr(surface, name).detach() for name in HALF[model]}
    values["quats"] = torch.nn.functional.normalize(values["quats"], dim=-1)
    values["logit_opacities"] = values["logit_opacities"].clamp(-LARGEST_LOGIT, LARGEST_LOGIT)
    stored = {name: tensor.half().contiguous() for name, tensor in values.items()}
    stored["means"] = surface.means.detach().contiguous()
    if isinstance(surface, LitSurface):
        stored["visibility"] = (surface.visibility.clamp(0, 1) * 255).round().to(torch.uint8)
        stored["laws"] = surface.laws.contiguous()
        stored |= {name: getattr(surface, name).to(torch.int32).contiguous() for name in NUMBERS}
        if surface.ambient_shift is not None:
            stored[SHIFT] = surface.ambient_shift.contiguous()
    return stored


def surface_record(surface: Surface | LitSurface) -> dict[str, Any]:
    """The numbers of the surface as JSON takes them."""
    record: dict[str, Any] = {
        "model": model_of(surface),
        "gaussians": len(surface),
        "encoding": surface.encoding,
        "window_db": [surface.window.floor_db, surface.window.ceil_db],
        "prior_tx": surface.tx.tolist(),
    }
    if isinstance(surface, LitSurface):
        counts = {"segments": len(surface.laws), "cells": len(surface.cell_sh)}
        shifted = {} if surface.ambient_shift is None else {SHIFT: True}
        return record | counts | shifted | {"csi_coefficients": surface.cell_csi.shape[1], "lobe": surface.lobe}
    return record | {"gain_coefficients": surface.gain_sh.shape[1], "delay_span": surface.delay_span}


def surface_kinds(body: Mapping[str, Any]) -> dict[str, tuple[tuple[int, ...], torch.dtype]]:
    """Shape and type of every tensor of the surface that the description `body` promises.

    Descriptions of before there were two models name none; theirs is the paper's. Those of before delay and departure
    had a residual name no coefficients of it, those of before surfaces were seen through a lobe no lobe.
    """
    count, model = int(body["gaussians"]), body.get("model", PAPER)
    if model not in HALF:
        raise DataError(f"field.json: model must be one of {', '.join(HALF)}; got {model!r}. Use a newer version")
    half = torch.float16
    shape = {
        "means": ((count, 3), torch.float32),
        "quats": ((count, 4), half),
        "log_scales": ((count, 3), half),
        "logit_opacities": ((count,), half),
    }
    if model == PAPER:
        encoding = body["encoding"]
        return shape | {
            "gain_sh": ((count, int(body["gain_coefficients"])), half),
            "csi_sh": ((count, (CSI_DEGREE[encoding] + 1) ** 2, CSI_CHANNELS[encoding]), half),
        }
    segments, cells = int(body["segments"]), int(body["cells"])
    coefficients = int(body.get("csi_coefficients", 0))
    if coefficients not in (0, CSI_HARMONICS):
        raise DataError(
            f"field.json: csi_coefficients must be {CSI_HARMONICS}, or left out where delay and departure have no "
            f"residual; got {coefficients}. Use a newer version"
        )
    csi = {
        "segment_csi": ((segments, coefficients, 4), half),
        "cell_csi": ((cells, coefficients, 4), half),
        "own_csi": ((count, 4), half),
    }
    mirror = {
        "normals": ((count, 3), half),
        "visibility": ((count,), torch.uint8),
        "segment_of": ((count,), torch.int32),
        "cell_of": ((count,), torch.int32),
        "laws": ((segments, len(LAW)), torch.float32),
        "segment_sh": ((segments, HARMONICS), half),
        "cell_sh": ((cells, HARMONICS), half),
        "level": ((count,), half),
        "ambient": ((count, 4), half),
    }
    shift = {SHIFT: ((cells,), torch.float32)} if body.get(SHIFT) else {}
    return shape | mirror | shift | (csi if coefficients else {})


def surface_of(
    tensors: Mapping[str, Tensor], body: Mapping[str, Any], tx: Tensor, window: DbWindow, delay_span: float
) -> Surface | LitSurface:
    """The surface of checked tensors."""
    model = body.get("model", PAPER)
    values = {name: tensors[name].float() for name in HALF[model] if name in surface_kinds(body)}
    if model == PAPER:
        means, encoding = tensors["means"], body["encoding"]
        return Surface(means=means, **values, tx=tx, window=window, encoding=encoding, delay_span=delay_span)
    if not set(CSI) <= set(values):
        groups = (len(values["segment_sh"]), len(values["cell_sh"]))
        none = [torch.zeros(group, CSI_HARMONICS, 4) for group in groups]
        values |= dict(zip(CSI, (*none, torch.zeros(len(values["level"]), 4)), strict=True))
    return LitSurface(
        means=tensors["means"],
        **values,
        visibility=tensors["visibility"].float() / 255,
        laws=tensors["laws"],
        segment_of=tensors["segment_of"].long(),
        cell_of=tensors["cell_of"].long(),
        tx=tx,
        window=window,
        lobe=float(body.get("lobe", 0.0)),
        ambient_shift=tensors[SHIFT] if body.get(SHIFT) else None,
    )
