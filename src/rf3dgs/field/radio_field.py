"""`RadioField`: the learned model of which power arrives from where, how late, and how it left the transmitter.

A field is a sum of parts in linear power: what the surface sends (`field.radiance`) and point sources
(`field.sources`).
"""

import math
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from torch import Tensor

from rf3dgs.channel.paths import Paths
from rf3dgs.core.angles import angles_of
from rf3dgs.core.errors import InputError
from rf3dgs.core.frames import Pose
from rf3dgs.core.grids import DirectionGrid, equirect_grid, sample_grid, view_of
from rf3dgs.field.lit import PARTS, LitSurface, Part
from rf3dgs.field.radiance import Radiance, Surface
from rf3dgs.field.rays import FARTHEST_LOBES, Rays
from rf3dgs.field.sources import PointSources
from rf3dgs.field.uncertainty import Uncertainty, numbers_of, sizes_of
from rf3dgs.spectra.codec import DbWindow
from rf3dgs.spectra.peaks import find_peaks
from rf3dgs.spectra.spectrum import Instrument, Spectrum
from rf3dgs.splats.obstacles import Obstacles
from rf3dgs.splats.rasterize import Backend

COLUMNS = 10  # of a table of paths


@dataclass(frozen=True, eq=False)
class RadioField:
    """A radio radiance field of one transmitter at one frequency.

    surface: the Gaussians that scatter, by the mirror model's laws (`LitSurface`) or the paper's harmonics (`Surface`).
    solidity `[N]`: their opacity to rays as the geometry has it, 0..1, which decides what hides a point source.
    sources: the point sources, the line of sight first, or None.
    plane_of `[N]`: the plane of the sources that a Gaussian belongs to, -1 for none; None when there are no planes.
    frequency [Hz]; instrument: what its training spectra were taken with, and so what it renders.
    tx: the transmitter's pose, given or estimated. bounds `[2, 3]`: low and high corner of the training positions [m].
    colour `[N, 3]` uint8: how a viewer paints the Gaussians. meta: free text about the run (seed, versions, steps).
    doubt: what is known of its errors (`training.fit_uncertainty`), or None.
    """

    surface: Surface | LitSurface
    sources: PointSources | None
    solidity: Tensor
    frequency: float
    instrument: Instrument
    tx: Pose
    bounds: Tensor
    colour: Tensor
    meta: dict[str, str | int | float | bool] = field(default_factory=dict)
    backend: Backend = "auto"
    plane_of: Tensor | None = None
    doubt: Uncertainty | None = None

    @property
    def window(self) -> DbWindow:
        """The dB window in which pictures of this field are drawn; the paper's surface was trained in it, too."""
        return self.surface.window

    @cached_property
    def obstacles(self) -> Obstacles:
        """The Gaussians as obstacles, labelled by the plane they belong to."""
        surface = self.surface
        return Obstacles(surface.means, surface.quats, surface.scales, self.solidity, self.plane_of)

    def covers(self, pose: Pose, *, margin: float = 0.5) -> Tensor:
        """True `[*batch]` for receivers in the box of the training positions, widened by `margin` [m]."""
        inside = (pose.position >= self.bounds[0] - margin) & (pose.position <= self.bounds[1] + margin)
        return inside.all(-1)

    def sees_transmitter(self, pose: Pose) -> Tensor:
        """True `[*batch]` where the line of sight is a part of this field and open."""
        if self.sources is None:
            return torch.zeros(pose.batch_shape, dtype=torch.bool)
        return self.sources.sees(pose.position, self.obstacles)

    def render(self, pose: Pose, grid: DirectionGrid, *, csi: bool = True) -> Spectrum:
        """The spectrum at one pose or a batch `[*batch]`: linear power, and delay [s] and departure per direction.

        Pinhole and equirectangular grids are rasterized as they are; a list of directions is interpolated from a sphere
        whose pixels are half a lobe wide.
        `csi=False` leaves delay and departure out, which is faster.
        """
        batch = pose.batch_shape
        flat = pose.flat()
        if len(flat) == 0:
            raise InputError("render needs at least one pose; got an empty batch")
        parts = [self._render_one(flat[index], grid, csi) for index in range(len(flat))]
        power = torch.stack([part.power for part in parts]).reshape(*batch, *grid.shape)
        delay = aod = None
        if csi:
            delay = torch.stack([part.delay for part in parts if part.delay is not None]).reshape(power.shape)
            aod = torch.stack([part.aod for part in parts if part.aod is not None]).reshape(*power.shape, 3)
        return Spectrum(power, grid, pose, self.frequency, self.instrument, "field", delay, aod, self.tx)

    def paths(self, pose: Pose, *, strongest: int = 8, parts: Literal["all", "sources"] = "all") -> Paths:
        """The strongest paths `[*batch, strongest]` at one pose or a batch, strongest first.

        A point source that reaches the receiver gives its exact arrival, departure and delay D / c, and its gain; these
        come first. Places that are left are filled with peaks of the surface's spectrum: the gain of such a path is the
        power in the beam there, its delay and departure are those of the pixel. `parts="sources"` leaves the peaks out,
        which takes about a millisecond a pose. `coeff` is real and positive: the carrier's phase is the caller's
        choice in `cfr` and `cir`. `order` is the number of reflections of a point source and 1 for a peak of the
        surface, whose number of bounces a field does not know; `kind` tells them apart: 0 the line of sight, 1
        mirrors, 2 the surface.
        """
        if strongest < 1:
            raise InputError(f"strongest must be at least 1; got {strongest}")
        if parts not in ("all", "sources"):
            raise InputError(f'parts must be "all" or "sources"; got "{parts}"')
        positions = pose.position.reshape(-1, 3)
        if len(positions) == 0:
            raise InputError("paths needs at least one pose; got an empty batch")
        rows = self._strongest_rays(positions, strongest)
        if parts == "all":
            flat = pose.flat()
            rows = torch.stack([self._with_peaks(row, flat[index]) for index, row in enumerate(rows)])
        table = rows.reshape(*pose.batch_shape, strongest, COLUMNS)
        zenith, azimuth = angles_of(table[..., 2:8].unflatten(-1, (2, 3)))
        return Paths(
            coeff=table[..., 0].sqrt().to(torch.complex64),
            delay=table[..., 1],
            aoa_zenith=zenith[..., 0],
            aoa_azimuth=azimuth[..., 0],
            aod_zenith=zenith[..., 1],
            aod_azimuth=azimuth[..., 1],
            valid=table[..., 0] > 0,
            frequency=self.frequency,
            tx=self.tx,
            rx=pose,
            order=table[..., 8].long(),
            kind=table[..., 9].long(),
        )

    def uncertainty(self, pose: Pose, grid: DirectionGrid, *, share: float | None = None) -> Tensor:
        """How far `gain_db` may be off `[*batch, row, col]` [dB] at one pose or a batch: half the interval about it
        that holds 68.3 % of the errors where nobody measured, or `share` of them.

        Raises InputError for a field that was not asked to learn it.
        """
        doubt = self._known_doubt()
        width = doubt.width(share)
        flat = pose.flat()
        if len(flat) == 0:
            raise InputError("uncertainty needs at least one pose; got an empty batch")
        rows = [width * doubt.std_db(numbers_of(self, doubt, flat[index], grid)) for index in range(len(flat))]
        return torch.stack(rows).reshape(*pose.batch_shape, *grid.shape)

    def uncertainty_of(self, paths: Paths, *, share: float | None = None) -> Tensor:
        """How far the levels of this field's `paths` `[*batch, path]` may be off [dB]: half the interval that holds
        68.3 % of such errors, or `share` of them; 0 where a path is not valid."""
        doubt, flat = self._known_doubt(), paths.rx.flat()
        aoa, delay = paths.aoa.reshape(len(flat), -1, 3), paths.delay.reshape(len(flat), -1)
        rows = [sizes_of(self, doubt, flat[index], aoa[index], delay[index], share) for index in range(len(flat))]
        return torch.stack(rows).reshape(paths.valid.shape) * paths.valid

    def _known_doubt(self) -> Uncertainty:
        if self.doubt is None:
            raise InputError(
                "this field does not know its uncertainty; fit_uncertainty(field, spectra) learns it, for the mirror "
                "model"
            )
        return self.doubt

    def without_sources(self) -> "RadioField":
        """The surface alone."""
        return replace(self, sources=None)

    def only(self, part: Part) -> "RadioField":
        """One part of a field of the mirror model: "sources", the "lit" surfaces, or what is "ambient".

        Their powers add up to the whole field's; a part that is silent is 300 dB down.
        """
        surface = self.surface
        if part not in PARTS:
            raise InputError(f"part must be one of {', '.join(PARTS)}; got {part!r}")
        if not isinstance(surface, LitSurface):
            raise InputError(
                "parts belong to the mirror model; this field is of the paper's. Train it with "
                'RadioConfig(model="mirror")'
            )
        sources = self.sources if part == "sources" else None
        return replace(self, surface=surface.only(part), sources=sources, doubt=None)

    def moved_to(self, tx: Pose, *, order: int = 2) -> "RadioField":
        """The field with its transmitter at `tx`, one pose, without any new measurement; mirror model only.

        Shadows, the lit part's geometry, ambient light and mirror images up to `order` reflections are computed anew;
        lit laws, reflections and the gate's threshold are kept; the residual is dropped. What becomes of each part
        is said in docs/how-to/moving-transmitter.md. Raises InputError for a field of the paper's model, and for a
        place from which no surface is lit.
        """
        from rf3dgs.field.moving import moved

        return moved(self, tx, order=order)

    def save(self, path: str | Path) -> None:
        """Write the folder `path` (NAME.field); see `field.io.save_field`."""
        from rf3dgs.field.io import save_field

        save_field(self, path)

    @classmethod
    def load(cls, path: str | Path) -> "RadioField":
        """Read a folder written by `save`; raises DataError naming the file that is wrong."""
        from rf3dgs.field.io import load_field

        return load_field(path)

    def _render_one(self, pose: Pose, grid: DirectionGrid, csi: bool) -> Radiance:
        surface = self.surface.radiance(self._channels(pose, grid, csi), pose.position)
        if self.sources is None:
            return surface
        rays = self.sources.rays(pose.position, self.obstacles, within=_seen(pose, grid, self.instrument))
        add_rays(surface, rays, pose, grid, self.instrument)
        return surface

    def _channels(self, pose: Pose, grid: DirectionGrid, csi: bool) -> Tensor:
        if grid.kind != "list":
            return self.surface.picture(view_of(pose, grid), csi=csi, backend=self.backend)
        rows = max(8, math.ceil(2 * math.pi / self.instrument.lobe))
        sphere = equirect_grid(2 * rows, rows)
        picture = self.surface.picture(view_of(pose, sphere), csi=csi, backend=self.backend)
        return sample_grid(picture, sphere, grid.directions)

    def _strongest_rays(self, positions: Tensor, strongest: int) -> Tensor:
        """Rows `[n, strongest, COLUMNS]` of what point sources send to receivers `[n, 3]`, the strongest first.

        Columns: gain, delay, arrival (3), departure (3), order, kind; zero gain is padding.
        """
        table = np.zeros((len(positions), strongest, COLUMNS), dtype=np.float32)
        if self.sources is None:
            return torch.from_numpy(table)
        place, rays = self.sources.arrivals(positions, self.obstacles)
        here, power, order = place.numpy(), rays.power.numpy(), rays.order.numpy()
        chosen = np.lexsort((-power, here))
        begin = np.searchsorted(here, np.arange(len(positions)))
        rank = np.arange(len(here)) - begin[here]
        first = np.flatnonzero(rank < strongest)
        row, rank, chosen = here[first], rank[first], chosen[first]
        table[row, rank, 0], table[row, rank, 1] = power[chosen], rays.delay.numpy()[chosen]
        table[row, rank, 2:5] = rays.arrival.numpy()[chosen]
        table[row, rank, 5:8] = rays.departure.numpy()[chosen]
        table[row, rank, 8], table[row, rank, 9] = order[chosen], np.minimum(order[chosen], 1)
        return torch.from_numpy(table)

    def _with_peaks(self, row: Tensor, pose: Pose) -> Tensor:
        """Rows `[strongest, COLUMNS]` as above with the places that are left filled by peaks of the surface."""
        count = int((row[:, 0] > 0).sum())
        if count == len(row):
            return row
        peaks = self._peaks(pose, len(row))[: len(row) - count]
        row = torch.cat((row[:count], peaks, row.new_zeros(len(row) - count - len(peaks), COLUMNS)))
        return row[row[:, 0].argsort(descending=True, stable=True)]

    def _peaks(self, pose: Pose, count: int) -> Tensor:
        """At most `count` rows `[n, COLUMNS]` as above, of peaks of the surface's spectrum."""
        lobe = self.instrument.lobe
        width = min(360, max(72, 4 * math.ceil(0.5 * math.pi / (lobe / 1.5))))
        grid = equirect_grid(width, width // 2)
        surface = self.without_sources()._render_one(pose, grid, True)
        assert surface.delay is not None
        assert surface.aod is not None
        directions, gains = find_peaks(surface.power, grid, count=count, separation=lobe)
        x, y = grid.pixel_of(directions)[0].unbind(-1)
        row, col = y.long().clamp(0, grid.height - 1), x.long().clamp(0, grid.width - 1)
        head = torch.stack((gains, surface.delay[row, col]), -1)
        numbers = torch.tensor([1.0, 2.0]).expand(len(gains), 2)
        return torch.cat((head, pose.to_world(directions), surface.aod[row, col], numbers), -1)


def _seen(pose: Pose, grid: DirectionGrid, instrument: Instrument) -> tuple[Tensor, float] | None:
    """A direction `[3]` of the world and the angle [rad] about it in which rays touch the grid; None for all around."""
    middle, radius = grid.cone
    reach = radius + FARTHEST_LOBES * instrument.lobe
    return None if reach >= math.pi else (pose.to_world(middle), reach)


def add_rays(surface: Radiance, rays: Rays, pose: Pose, grid: DirectionGrid, instrument: Instrument) -> None:
    """Add what arrives at `pose` from point sources to the radiance of a surface, in linear power, in place.

    Delay and departure, where the surface has them, become means weighted by power.
    """
    place, ray, share = (part.numpy() for part in rays.shares(pose, grid, instrument))
    power = surface.power.view(-1).numpy()
    if surface.delay is None or surface.aod is None:
        np.add.at(power, place, share)
        return
    touched = np.zeros(len(power), dtype=bool)
    touched[place] = True
    pixels, row = np.flatnonzero(touched), (np.cumsum(touched) - 1)[place]

    def summed(what: np.ndarray) -> np.ndarray:
        return np.bincount(row, share * what[ray], len(pixels)).astype(np.float32)

    before = power[pixels]
    np.add.at(power, place, share)
    whole = np.maximum(power[pixels], np.finfo(np.float32).tiny)
    delay, aod = surface.delay.view(-1).numpy(), surface.aod.view(-1, 3).numpy()
    delay[pixels] = (before * delay[pixels] + summed(rays.delay.numpy())) / whole
    departure = np.stack([summed(axis) for axis in rays.departure.numpy().T], -1)
    departure = (before[:, None] * aod[pixels] + departure) / whole[:, None]
    aod[pixels] = departure / np.maximum(np.linalg.norm(departure, axis=-1, keepdims=True), 1e-9)
