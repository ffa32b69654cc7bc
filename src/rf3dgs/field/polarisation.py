"""Polarisation: what ways of several reflections keep of it, in decibels.

Formula (5a) of docs/theory/radiance.md. Everything is float64. The native core does it in one call; without the core
the specification, which is NumPy, answers itself.
"""

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import torch
from torch import Tensor

from rf3dgs.core.native import Held, native_core
from rf3dgs.core.threads import thread_count
from rf3dgs.core.units import VACUUM_PERMITTIVITY, wavelength
from rf3dgs.propagation.fresnel import slab_coefficients

METAL = (1.0, 1e7, 0.01)
GRAZING = 1e-3  # of a cosine
HEAD_ON = 1e-6  # sine below which the plane of incidence is any
LEAST_KEPT = 1e-6
FEW = 256  # ways that are answered sooner than other threads wake


@dataclass(frozen=True, eq=False)
class Slabs(Held):
    """What P planes are made of: normals `[P, 3]`; numbers `[P, 3]`, relative permittivity, conductivity [S/m] and
    thickness [m]; frequency [Hz]."""

    normals: np.ndarray
    numbers: np.ndarray
    frequency: float

    @classmethod
    def of(cls, normals: Tensor, numbers: Tensor, frequency: float) -> "Slabs":
        """The slabs of planes with unit normals `[P, 3]`."""
        rows, values = (each.detach().double().contiguous().numpy() for each in (normals, numbers))
        return cls(rows, values, frequency)

    @cached_property
    def held(self) -> Any | None:
        """The same in the native core, or None without it."""
        core = native_core()
        if core is None:
            return None
        loss = 1 / (2 * math.pi * self.frequency * VACUUM_PERMITTIVITY)
        return core.Slabs(self.normals, self.numbers * [1.0, loss, 2 * math.pi / wavelength(self.frequency)])


def kept_db(of: Slabs, planes: np.ndarray, cosine: np.ndarray, departure: np.ndarray) -> np.ndarray:
    """10 log10 K `[w]` of ways over `planes` `[w, 3]`, -1 for none, at `cosine` `[w, 3]` of incidence, which leave the
    transmitter along unit vectors `departure` `[w, 3]`; 0 for those of one reflection or none."""
    if of.held is None:
        return kept_reference(of, planes, cosine, departure)
    kept = np.empty(len(planes))
    of.held.kept_db(planes, cosine, departure, kept, 1 if len(planes) < FEW else thread_count())
    return kept


def kept_reference(of: Slabs, planes: np.ndarray, cosine: np.ndarray, departure: np.ndarray) -> np.ndarray:
    """The specification of `kept_db`."""
    jones = np.broadcast_to(np.eye(2, dtype=complex), (len(planes), 2, 2)).copy()
    way = departure.copy()
    te_before, tm_before = np.zeros_like(way), np.zeros_like(way)
    for step in range(planes.shape[1]):
        met = np.flatnonzero(planes[:, step] >= 0)
        plane, along = planes[met, step], way[met]
        normal = of.normals[plane]
        te = _across(along, normal)
        tm = np.cross(te, along)
        if step:
            turn = np.stack([[_dot(a, b) for b in (te_before[met], tm_before[met])] for a in (te, tm)])
            jones[met] = np.einsum("ijw,wjk->wik", turn, jones[met])
        jones[met] *= _coefficients(of, plane, cosine[met, step])[..., None]
        way[met] = along - 2.0 * _dot(along, normal)[:, None] * normal
        te_before[met], tm_before[met] = te, np.cross(te, way[met])
    power = 0.5 * (np.abs(jones) ** 2).sum((-2, -1))
    return np.where(planes[:, 1] >= 0, 10.0 * np.log10(np.maximum(power, LEAST_KEPT)), 0.0)


def _across(way: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """Unit vectors `[n, 3]` across the planes of incidence of waves along unit vectors `[n, 3]`."""
    te, any_axis = np.cross(way, normal), np.where(np.abs(way[:, :1]) < 0.9, [1.0, 0.0, 0.0], [0.0, 1.0, 0.0])
    te = np.where(np.sqrt(_dot(te, te))[:, None] > HEAD_ON, te, np.cross(way, any_axis))
    return te / np.maximum(np.sqrt(_dot(te, te)), HEAD_ON)[:, None]


def _coefficients(of: Slabs, plane: np.ndarray, cosine: np.ndarray) -> np.ndarray:
    """What slabs reflect `[n, 2]` of TE and TM, over the root of the mean of both powers."""
    angles = torch.from_numpy(cosine).clamp_min(GRAZING)
    pair = slab_coefficients(torch.from_numpy(of.numbers[plane]), angles, of.frequency)
    both = torch.stack(pair, -1).numpy()
    size = np.sqrt(0.5 * (np.abs(both) ** 2).sum(-1, keepdims=True))
    return np.where(size > 0.0, both / np.where(size > 0.0, size, 1.0), [-1.0, 1.0])


def _dot(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    return np.einsum("ni,ni->n", first, second)
