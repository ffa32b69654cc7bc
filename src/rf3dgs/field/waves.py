"""A field as plane waves at a place, and so as any array there sees it."""

import math

import torch

from rf3dgs.channel.arrays import PlanarArray
from rf3dgs.channel.sounding import seen
from rf3dgs.core.errors import InputError
from rf3dgs.core.frames import Pose
from rf3dgs.core.grids import DirectionGrid, equirect_grid
from rf3dgs.field.radio_field import RadioField
from rf3dgs.spectra.config import Loading
from rf3dgs.spectra.covariance import plane_waves
from rf3dgs.spectra.loading import loading_power
from rf3dgs.spectra.scan import ALIASES, array_instrument, beamform
from rf3dgs.spectra.spectrum import Spectrum
from rf3dgs.spectra.steering import PlanarSteering
from rf3dgs.spectra.targets import INVERTED, Waves

SPHERE = (180, 90)  # pixels that the surface is taken from


def waves_of(field: RadioField, pose: Pose, grid: DirectionGrid) -> Waves:
    """What `field` sends to one pose, as waves: its surface from each pixel of `grid`, a whole sphere, then its rays.

    The rays arrive from their exact directions, not through a lobe.
    """
    surface = field.without_sources().render(pose, grid, csi=False)
    power = (surface.power * grid.solid_angle).double().reshape(-1) / surface.instrument.beam_solid_angle
    directions = surface.directions.reshape(-1, 3)
    if field.sources is None:
        return Waves(directions, power)
    rays = field.sources.rays(pose.position, field.obstacles)
    return Waves(torch.cat((directions, rays.arrival)), torch.cat((power, rays.power.double())))


def seen_by_array(
    field: RadioField,
    pose: Pose,
    array: PlanarArray,
    grid: DirectionGrid,
    *,
    method: str = "bartlett",
    loading: Loading | None = None,
    noise: float = 0.0,
    fov: float = math.pi,
) -> Spectrum:
    """The pictures `[*batch, row, col]` that `array` makes of `field` at one pose or a batch.

    `method`: "bartlett", "tapered" or "capon". `noise`: mean power of the noise in an element over its peak gain;
    `loading` is Capon's; `fov` [rad] the elements' vertical field of view. Levels are those of `spectrum_of` with
    uncorrelated paths. InputError for another method.
    """
    name = ALIASES.get(method, method)
    if name not in INVERTED:
        raise InputError(f"method must be one of {', '.join((*INVERTED, *ALIASES))}; got {method!r}")
    if not noise >= 0.0:
        raise InputError(f"noise must be a power of at least 0, linear; got {noise}")
    loading = Loading() if loading is None else loading
    sphere, steering, flat = equirect_grid(*SPHERE), PlanarSteering(array, grid.directions), pose.flat()
    powers, noises = [], []
    for number in range(len(flat)):
        one = flat[number]
        waves = waves_of(field, Pose(one.position), sphere)
        local = one.to_device(waves.directions)
        heard = seen(None, fov, local)
        R = plane_waves(waves.power[heard], local[heard], array)
        R = R + noise * array.peak_gain * torch.eye(array.count, dtype=R.dtype)
        powers.append((beamform(name, R, steering, array, loading=loading) / array.peak_gain).float())
        loaded = float(loading_power(R, loading)) / array.peak_gain if name == "capon" else 0.0
        noises.append(noise + loaded)
    batch = pose.batch_shape
    return Spectrum(
        power=torch.stack(powers).reshape(*batch, *grid.shape),
        grid=grid,
        pose=pose,
        frequency=field.frequency,
        instrument=array_instrument(array, name, fov=fov),
        method=name,
        tx=field.tx,
        noise=torch.tensor(noises, dtype=torch.float64).reshape(batch),
    )
