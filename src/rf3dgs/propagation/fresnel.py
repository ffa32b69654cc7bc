"""What smooth slabs reflect of either polarisation."""

import math

import torch
from torch import Tensor

from rf3dgs.core.units import VACUUM_PERMITTIVITY, wavelength


def slab_coefficients(slab: Tensor, cosine: Tensor, frequency: float) -> tuple[Tensor, Tensor]:
    """Reflection coefficients (TE, TM), complex128 `[*batch]`, at `cosine` of the angle of incidence `[*batch]`.

    slab `[*batch, 3]`: relative permittivity, conductivity [S/m] and thickness [m], which may be infinite; air is on
    both sides; batches broadcast. frequency [Hz]. Rec. ITU-R P.2040-3, eqs. 37, 43 and 44: the faces of the slab
    reflect to and fro. The TM field is counted along (TE direction) x (propagation) before and after, so that a perfect
    conductor has -1 (TE) and +1 (TM).
    """
    permittivity, conductivity, thickness = slab.double().unbind(-1)
    loss = conductivity / (2 * math.pi * frequency * VACUUM_PERMITTIVITY)
    eta = torch.complex(permittivity, -loss)
    cosine = cosine.to(torch.complex128)
    root = torch.sqrt(eta - (1 - cosine**2))
    faces = (cosine - root) / (cosine + root), (eta * cosine - root) / (eta * cosine + root)
    deep = torch.isinf(thickness)
    across = torch.where(deep, 0.0, thickness) * (2 * math.pi / wavelength(frequency))
    turn = torch.where(deep, 0.0, torch.exp(-2j * across * root))
    te, tm = (face * (1 - turn) / (1 - face**2 * turn) for face in faces)
    return te, tm
