"""What a surface sends to a receiver: the mirror model's surface part, in linear power.

Each Gaussian scatters what reaches it straight from the transmitter into a lobe about the mirror direction, adds an
ambient part that came by other ways, and corrects both by a residual in dB. With w = (p - mu) / d, d = |p - mu| towards
the transmitter p, cos_i = max(n . w, 0.01), r = 2 (n . w) n - w and v = (q - mu) / |q - mu| towards the receiver q:

    lit     = V 10^(R/10) d^-2 exp(b cos_i) ((1 + r . v) / 2)^alpha         V: visibility of p from the Gaussian
    ambient = 10^((A + e 10 log10(d / 5 m)) / 10)
    L       = (lit + ambient) 10^(E(v) / 10),  E in -12..12 dB

R, b, alpha, A and e belong to the Gaussian's segment (a moved field shifts A cell by cell, `field.bounced`); E is the
sum of harmonics of its segment and of its cell and of a level of its own. Delay and departure are means of both parts
weighted by power, plus a residual F(v) that is made up in the same way. Powers are blended through the Gaussians with a
depth gate and divided by the accumulated weight, so that gaps between Gaussians neither leak nor darken, and averaged
over the instrument's lobe (`field.beam`). A picture of a surface has the channels

    0      power over `unit`
    1      accumulated weight sum T alpha
    2..    power over `unit` times delay [ns] and times the departure vector
"""

import math
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal

import torch
from torch import Tensor
from torch.nn.functional import embedding

from rf3dgs.core.errors import InputError
from rf3dgs.core.grids import View
from rf3dgs.core.units import SPEED_OF_LIGHT
from rf3dgs.field.beam import through_lobe
from rf3dgs.field.radiance import NANOSECOND, Radiance, bounce
from rf3dgs.spectra.codec import DbWindow
from rf3dgs.splats.compositing import Compositing
from rf3dgs.splats.harmonics import evaluate, view_directions
from rf3dgs.splats.raster import Raster
from rf3dgs.splats.rasterize import Backend, rasterize

Part = Literal["sources", "lit", "ambient"]
PARTS: tuple[Part, ...] = ("sources", "lit", "ambient")
SILENT_DB = -300.0  # of an ambient level that is to be nothing
HARMONICS = 16
CSI_DEGREE = 2
CSI_HARMONICS = (CSI_DEGREE + 1) ** 2
LAW = ("level_db", "incidence", "lobe", "ambient_db", "falloff")
"""Columns of `LitSurface.laws`: R [dB at 1 m], b, alpha, A [dB at 5 m], e."""
OF_EACH = (
    *("means", "quats", "log_scales", "logit_opacities", "normals", "visibility"),
    *("segment_of", "cell_of", "level", "ambient", "own_csi"),
)
"""What a `LitSurface` has one row of for each Gaussian."""
LARGEST_RESIDUAL_DB = 12.0
AMBIENT_DISTANCE = 5.0  # [m], where the ambient level is stated
LEAST_COSINE = 0.01
BLENDING = Compositing(depth_gate=0.3, normalise=True, blur=0.005)
"""The lobe averages over pixels already, and blur would widen what hides a bright surface by a pixel on either side."""


@dataclass(frozen=True, eq=False)
class LitSurface:
    """Gaussians that scatter radio power by the laws of their segments.

    means `[N, 3]` [m], quats `[N, 4]`, log_scales `[N, 3]`, logit_opacities `[N]`: as in `Gaussians`, without colour.
    normals `[N, 3]`: unit vectors to the free side. visibility `[N]`: transmittance to the transmitter, baked.
    segment_of, cell_of `[N]` long: the segment 0..S-1 and the cell 0..C-1 of each Gaussian; a cell is in one segment.
    laws `[S, 5]`: R, b, alpha, A, e of each segment (`LAW`).
    segment_sh `[S, 16]`, cell_sh `[C, 16]`, level `[N]`: the residual E [dB], harmonics of the direction from the
        receiver to the Gaussian and a level.
    ambient `[N, 4]`: delay [ns] of the ambient part from the transmitter to the Gaussian, and its departure vector.
    segment_csi `[S, 9, 4]`, cell_csi `[C, 9, 4]`, own_csi `[N, 4]`: the residual F of delay [ns] and departure vector,
        coefficients of degree 2 (middle axis) of the same direction, and a constant.
    tx `[3]`: the transmitter's position [m]. window: in which pictures of the field are drawn; decides nothing else.
    lobe: half-power width [rad] of the beam through which it is seen; 0 shows each pixel by itself.
    ambient_shift `[C]`: what is added to A [dB] in each cell, or None for nothing (`field.bounced`).
    """

    means: Tensor
    quats: Tensor
    log_scales: Tensor
    logit_opacities: Tensor
    normals: Tensor
    visibility: Tensor
    segment_of: Tensor
    cell_of: Tensor
    laws: Tensor
    segment_sh: Tensor
    cell_sh: Tensor
    level: Tensor
    ambient: Tensor
    segment_csi: Tensor
    cell_csi: Tensor
    own_csi: Tensor
    tx: Tensor
    window: DbWindow
    lobe: float = 0.0
    ambient_shift: Tensor | None = None

    def __post_init__(self) -> None:
        count, segments, cells = len(self.means), len(self.laws), len(self.cell_sh)
        shapes = {
            "quats": (count, 4),
            "log_scales": (count, 3),
            "logit_opacities": (count,),
            "normals": (count, 3),
            "visibility": (count,),
            "segment_of": (count,),
            "cell_of": (count,),
            "laws": (segments, len(LAW)),
            "segment_sh": (segments, HARMONICS),
            "cell_sh": (cells, HARMONICS),
            "level": (count,),
            "ambient": (count, 4),
            "segment_csi": (segments, CSI_HARMONICS, 4),
            "cell_csi": (cells, CSI_HARMONICS, 4),
            "own_csi": (count, 4),
            "tx": (3,),
        }
        if self.ambient_shift is not None:
            shapes["ambient_shift"] = (cells,)
        for name, shape in shapes.items():
            got = tuple(getattr(self, name).shape)
            if got != shape:
                raise InputError(
                    f"{name} must be {list(shape)} for {count} Gaussians, {segments} segments and {cells} cells; "
                    f"got {list(got)}"
                )
        for name, number, most in (("segment_of", self.segment_of, segments), ("cell_of", self.cell_of, cells)):
            if count and (int(number.min()) < 0 or int(number.max()) >= most):
                raise InputError(
                    f"{name} must number 0..{most - 1}; got {int(number.min())} to {int(number.max())}: every Gaussian "
                    "belongs to one"
                )
        astray = self.segment_of_cell[self.cell_of] != self.segment_of
        if bool(astray.any()):
            raise InputError(
                f"a cell must lie in one segment; cell {int(self.cell_of[astray][0])} has Gaussians of several. Number "
                "cells anew in each segment"
            )

    def __len__(self) -> int:
        return len(self.means)

    @property
    def encoding(self) -> str:
        """Delay and departure are blended as vectors, as in the paper model's encoding of that name."""
        return "vector"

    @property
    def scales(self) -> Tensor:
        """Standard deviations `[N, 3]` [m]."""
        return self.log_scales.exp()

    @property
    def opacities(self) -> Tensor:
        """Opacities `[N]` in 0..1."""
        return torch.sigmoid(self.logit_opacities)

    @property
    def unit(self) -> float:
        """The linear power that counts as 1 in a picture's channels: the window's ceiling."""
        return 10.0 ** (self.window.ceil_db / 10)

    @cached_property
    def segment_of_cell(self) -> Tensor:
        """The segment `[C]` of each cell; 0 where it has no Gaussian."""
        segment = torch.zeros(len(self.cell_sh), dtype=torch.long, device=self.cell_of.device)
        return segment.index_put((self.cell_of,), self.segment_of)

    def subset(self, chosen: Tensor) -> "LitSurface":
        """The surface of the Gaussians that a mask `[N]` or an index `chosen` keeps; groups keep their numbers."""
        index = chosen.nonzero().squeeze(-1) if chosen.dtype == torch.bool else chosen
        return replace(self, **{name: getattr(self, name).index_select(0, index) for name in OF_EACH})

    def hit_in(self, view: View, backend: Backend = "auto") -> Tensor:
        """True `[N]` for the Gaussians that a pixel of `view` shows; a `subset` of these has the same picture."""
        values = torch.ones(len(self), 1).requires_grad_()
        with torch.enable_grad():
            shown = self._raster(values, view, backend).values
            return torch.autograd.grad(shown.sum(), values)[0].squeeze(-1) > 0

    def picture(self, view: View, *, csi: bool = True, backend: Backend = "auto") -> Tensor:
        """The channels `[row, col, 2 (+ 4)]` described above, without gradients; `csi=False` gives the first two."""
        with torch.no_grad():
            raster = self._raster(self.values(view.position, csi=csi), view, backend)
            shown = through_lobe(raster.values, view, self.lobe)
        return torch.cat((shown[..., :1], raster.weight[..., None], shown[..., 1:]), -1)

    def seen(self, values: Tensor, view: View, backend: Backend = "auto") -> Tensor:
        """What the instrument sees `[row, col, channel]` if the Gaussians send `values` `[N, channel]`; differentiable
        in these."""
        return through_lobe(self._raster(values, view, backend).values, view, self.lobe)

    def _raster(self, values: Tensor, view: View, backend: Backend) -> Raster:
        shape = (self.means, self.quats, self._scales, self._opacities)
        return rasterize(*shape, values, view, compositing=BLENDING, backend=backend)

    def radiance(self, channels: Tensor, receiver: Tensor) -> Radiance:
        """Physical values of composited channels `[row, col, 2 (+ 4)]`; zero where no Gaussian is hit."""
        power = channels[..., 0].clamp_min(0.0) * self.unit
        if channels.shape[-1] == 2:
            return Radiance(power)
        hit = channels[..., 0] > 0
        delay = channels[..., 2] / torch.where(hit, channels[..., 0], 1.0) * NANOSECOND * hit
        aod = torch.nn.functional.normalize(channels[..., 3:6], dim=-1, eps=1e-30) * hit[..., None]
        return Radiance(power, delay, aod)

    def values(self, receiver: Tensor, *, csi: bool = True) -> Tensor:
        """What each Gaussian sends to a receiver at `[3]`: power over `unit` and, with `csi`, that times delay [ns] and
        departure vector, `[N, 1 (+ 4)]`."""
        directions = view_directions(self.means, receiver)
        lit, ambient = self.parts(directions)
        factor = power_factor(evaluate(self._harmonics, directions)[:, 0] + self.level) / self.unit
        lit, ambient = lit * factor, ambient * factor
        power = (lit + ambient)[:, None]
        if not csi:
            return power
        late = torch.linalg.vector_norm(self.means - receiver, dim=-1) / (SPEED_OF_LIGHT * NANOSECOND)
        weighted = lit[:, None] * self._bounce + ambient[:, None] * self.ambient
        weighted += power * (evaluate(self._csi, directions) + self.own_csi)
        weighted[:, 0] += power[:, 0] * late
        return torch.cat((power, weighted), -1)

    def parts(self, directions: Tensor) -> tuple[Tensor, Tensor]:
        """The lit and the ambient power `[N]` towards receivers in `directions` `[N, 3]` (receiver to Gaussian), before
        the residual."""
        cosine = -(self._mirrored * directions).sum(-1)
        lobe = (0.5 + 0.5 * cosine).clamp_min(1e-6).pow(self._lobe)
        return self._arriving * lobe, self._ambient_power

    def only(self, part: Part) -> "LitSurface":
        """The lit or the ambient part, or neither for "sources"; each with the residual, so that they add up."""
        silent = self.laws.clone()
        silent[:, 3], silent[:, 4] = SILENT_DB, 0.0
        dark = torch.zeros_like(self.visibility)
        laws = self.laws if part == "ambient" else silent
        return replace(self, laws=laws, visibility=self.visibility if part == "lit" else dark)

    def without_residual(self) -> "LitSurface":
        """The laws alone: lit and ambient, E = 0."""
        zero = torch.zeros_like
        names = ("segment_sh", "cell_sh", "level", "segment_csi", "cell_csi", "own_csi")
        return replace(self, **{name: zero(getattr(self, name)) for name in names})

    @cached_property
    def _geometry(self) -> tuple[Tensor, Tensor, Tensor]:
        return incidence(self.means, self.normals, self.tx)

    @cached_property
    def _law(self) -> Tensor:
        """The law `[N, 5]` of each Gaussian's segment."""
        return _each(self.laws, self.segment_of)

    @cached_property
    def _arriving(self) -> Tensor:
        """The lit power `[N]` where the lobe is 1."""
        distance, cosine, _ = self._geometry
        law = self._law
        return self.visibility * 10 ** (law[:, 0] / 10) * torch.exp(law[:, 1] * cosine) / distance**2

    @cached_property
    def _mirrored(self) -> Tensor:
        return self._geometry[2]

    @cached_property
    def _lobe(self) -> Tensor:
        return self._law[:, 2]

    @cached_property
    def _ambient_power(self) -> Tensor:
        law = self._law
        level_db = law[:, 3] + law[:, 4] * 10 * torch.log10(self._geometry[0] / AMBIENT_DISTANCE)
        if self.ambient_shift is not None:
            level_db = level_db + self.ambient_shift[self.cell_of]
        return 10 ** (level_db / 10)

    @cached_property
    def _harmonics(self) -> Tensor:
        """The coefficients `[N, 16, 1]` of the residual's harmonics, of segments and cells together."""
        return _each(self.cell_sh + _each(self.segment_sh, self.segment_of_cell), self.cell_of)[..., None]

    @cached_property
    def _csi(self) -> Tensor:
        """The coefficients `[N, 9, 4]` of the residual of delay and departure, of segments and cells together."""
        return _each(self.cell_csi + _each(self.segment_csi, self.segment_of_cell), self.cell_of)

    @cached_property
    def _bounce(self) -> Tensor:
        return bounce(self.means, self.tx)

    @cached_property
    def _scales(self) -> Tensor:
        return self.scales

    @cached_property
    def _opacities(self) -> Tensor:
        return self.opacities


def incidence(means: Tensor, normals: Tensor, tx: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Distance d `[N]` [m] to the transmitter, cos_i `[N]` and the mirrored direction r `[N, 3]`."""
    towards = tx - means
    distance = torch.linalg.vector_norm(towards, dim=-1).clamp_min(1e-2)
    towards = towards / distance[:, None]
    cosine = (normals * towards).sum(-1)
    mirrored = 2 * cosine[:, None] * normals - towards
    return distance, cosine.clamp_min(LEAST_COSINE), mirrored


def _each(groups: Tensor, group_of: Tensor) -> Tensor:
    """The row `[N, ...]` of `groups` `[G, ...]` to which each Gaussian, or each cell, belongs.

    Gradients are summed over groups by `embedding`, which adds in the same order every time.
    """
    return embedding(group_of, groups.flatten(1)).unflatten(1, groups.shape[1:])


def power_factor(residual_db: Tensor) -> Tensor:
    """10^(E/10) of residuals `[N]` [dB], which are cut at 12 dB."""
    return torch.exp(residual_db.clamp(-LARGEST_RESIDUAL_DB, LARGEST_RESIDUAL_DB) * (math.log(10) / 10))
