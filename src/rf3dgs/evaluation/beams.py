"""What a wrong spectrum costs in beam gain: the losses of an array that trusts the prediction.

The receiver carries four panels of the array, turned by 0, 90, 180 and 270 degrees about the device's vertical axis; a
grid that is not the whole sphere has the forward panel only. The true covariance comes from the true spectrum,
`R = sum P dOmega a a^H / beam solid angle`.
"""

import math

import torch
from torch import Tensor

from rf3dgs.channel.arrays import PlanarArray
from rf3dgs.channel.response import manifold
from rf3dgs.core.grids import DirectionGrid
from rf3dgs.core.threads import one_torch_thread
from rf3dgs.evaluation.metrics import peak_direction
from rf3dgs.spectra.spectrum import Spectrum

SMALLEST_SHARE = 1e-12  # losses end at 120 dB


def panel_yaws(grid: DirectionGrid) -> tuple[float, ...]:
    """Yaws [rad] of the panels: four around the sphere, the forward one for any other grid."""
    return (0.0, math.pi / 2, math.pi, 3 * math.pi / 2) if grid.kind == "equirect" else (0.0,)


def panel_covariance(spectrum: Spectrum, array: PlanarArray, *, chunk: int = 16_384) -> Tensor:
    """Covariances `[*batch, panel, M, M]` (complex128) of the panels, as `spectra.covariance.covariance_of_spectrum`.

    All elements share one pattern, so an entry depends only on the difference of two positions; each of those few
    differences is summed once for all spectra.
    """
    grid = spectrum.grid
    position = array.positions.double()
    difference = position[:, None] - position
    lags, entry = torch.unique((difference * 1e6).round().reshape(-1, 3), dim=0, return_inverse=True)
    lags = lags / 1e6
    energy = (spectrum.power * grid.solid_angle / spectrum.instrument.beam_solid_angle).reshape(
        -1, grid.height * grid.width
    )
    energy = energy.double()
    count = len(array.positions)
    panels = []
    for yaw in panel_yaws(grid):
        direction = _turned(grid.directions.reshape(-1, 3), -yaw)
        total = torch.zeros(len(energy), len(lags), dtype=torch.complex128)
        for start in range(0, len(direction), chunk):
            part = direction[start : start + chunk]
            gain = manifold(array, part)[..., 0].abs().double() ** 2
            phase = 2 * math.pi * (part.double() @ lags.mT)
            weighted = energy[:, start : start + chunk] * gain
            total += torch.complex(weighted @ torch.cos(phase), weighted @ torch.sin(phase))
        panels.append(total[:, entry].reshape(-1, count, count))
    return torch.stack(panels, 1).reshape(*spectrum.pose.batch_shape, len(panels), count, count)


def _turned(direction: Tensor, yaw: float) -> Tensor:
    """Vectors `[*batch, 3]` turned by `yaw` [rad] about z."""
    cos, sin = math.cos(yaw), math.sin(yaw)
    x, y, z = direction.unbind(-1)
    return torch.stack((cos * x - sin * y, sin * x + cos * y, z), -1)


def beam_loss_eigen(truth: Tensor, prediction: Tensor) -> Tensor:
    """Loss `[*batch]` [dB] of beamforming with the principal eigenvector of the predicted covariance on the true one.

    Covariances `[*batch, panel, M, M]`. The ideal, the true covariance's own principal eigenvector, loses 0 dB; the
    loss in dB is averaged over the panels whose true covariance is not zero. A prediction of zero counts as an
    arbitrary beam, which collects the mean eigenvalue.
    """
    with one_torch_thread():  # many small eigenproblems: threads would wait for each other
        best = torch.linalg.eigvalsh(truth)[..., -1]
        value, vector = torch.linalg.eigh(prediction)
    beam = vector[..., -1]
    collected = (beam.conj()[..., None, :] @ truth @ beam[..., :, None])[..., 0, 0].real
    blind = truth.diagonal(dim1=-2, dim2=-1).real.mean(-1)
    collected = torch.where(value[..., -1] > 0, collected, blind)
    loss = -10.0 * torch.log10((collected / best.clamp_min(1e-300)).clamp(SMALLEST_SHARE, 1.0))
    lit = best > 0
    return (torch.where(lit, loss, torch.zeros_like(loss)).sum(-1) / lit.sum(-1)).float()


def beam_loss_peak(truth: Spectrum, prediction: Spectrum, covariance: Tensor, array: PlanarArray) -> Tensor:
    """Loss `[*batch]` [dB] of a beam steered to the predicted main peak, on the true covariance `[*batch, panel, M,
    M]`.

    The beam is formed on the panel that faces the direction best. The reference is the beam steered to the true main
    peak; a prediction that happens to collect more than it loses 0 dB.
    """
    wanted = _steered_power(truth, truth, covariance, array)
    got = _steered_power(truth, prediction, covariance, array)
    return -10.0 * torch.log10((got / wanted.clamp_min(1e-300)).clamp(SMALLEST_SHARE, 1.0)).float()


def _steered_power(truth: Spectrum, aimed: Spectrum, covariance: Tensor, array: PlanarArray) -> Tensor:
    """Power `[*batch]` that beams steered to the main peaks of `aimed` collect."""
    yaws = panel_yaws(truth.grid)
    direction = truth.pose.to_device(peak_direction(aimed))
    local = torch.stack([_turned(direction, -yaw) for yaw in yaws], -2)
    panel = local[..., 0].argmax(-1)
    local = local.gather(-2, panel[..., None, None].expand(*panel.shape, 1, 3)).squeeze(-2)
    chosen = panel[..., None, None, None].expand(*panel.shape, 1, *covariance.shape[-2:])
    covariance = covariance.gather(-3, chosen).squeeze(-3)
    beam = manifold(array, local).to(torch.complex128)
    beam = beam / torch.linalg.vector_norm(beam, dim=-1, keepdim=True).clamp_min(1e-30)
    return (beam.conj()[..., None, :] @ covariance @ beam[..., :, None])[..., 0, 0].real
