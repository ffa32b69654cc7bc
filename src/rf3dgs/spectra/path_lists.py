"""Ideal spectra out of lists of estimated paths, such as SAGE's."""

from dataclasses import replace

import torch
from torch import Tensor

from rf3dgs.channel.paths import Paths
from rf3dgs.channel.patterns import power_pattern
from rf3dgs.channel.sounding import DEAF, Sounding, seen
from rf3dgs.core.errors import InputError
from rf3dgs.core.frames import Pose
from rf3dgs.core.grids import DirectionGrid, equirect_grid
from rf3dgs.spectra.crb import told_by
from rf3dgs.spectra.spectrum import Spectrum, stack_spectra
from rf3dgs.spectra.synthesis import ideal_spectrum
from rf3dgs.spectra.targets import places_of


def path_targets(
    paths: Paths, sounding: Sounding, grid: DirectionGrid | None = None, *, lobe: float | None = None
) -> Spectrum:
    """The ideal spectra `[place, row, col]` of `paths` `[receiver, path]` that were estimated from a `sounding`.

    Receivers within a millimetre are one place; a path counts at the one that faces it best, since its neighbours hear
    the same wave. `grid`: whole spheres, 120x60 unless given. A direction without a path is not dark: `floor` is the
    power of a path there that would be heard as strongly as the weakest one that its receiver found, infinite where
    none looks or where it found nothing. Departures are there where the transmitting array tells them. InputError where
    paths and sounding differ.
    """
    array = sounding.array_rx
    if array is None:
        raise InputError("one element tells no arrivals; sound with an array_rx, such as planar_array(8, 8)")
    if paths.coeff.dim() != 2 or len(paths.rx) != len(sounding.flat().rx):
        raise InputError(
            f"paths must be [receiver, path], one for each of the {len(sounding.flat().rx)} receivers of the sounding; "
            f"got {list(paths.coeff.shape)}"
        )
    grid = equirect_grid(120, 60) if grid is None else grid
    spectra = []
    for group in places_of(paths.rx.position):
        here = paths[group]
        forward = here.rx.world_from_device[:, :, 0]
        facing = torch.einsum("rpk,sk->rps", here.aoa, forward)
        own = torch.arange(len(group))[:, None]
        mine = here.valid & (facing.argmax(-1) == own)
        heard = here.path_gain * power_pattern(array.pattern, torch.stack([_local(here, i) for i in range(len(group))]))
        weakest = torch.where(here.valid & (heard > 0), heard, torch.inf).amin(-1)
        floor = torch.full(grid.shape, torch.inf)
        for number in range(len(group)):
            local = here.rx[number].to_device(grid.directions)
            gain = power_pattern(array.pattern, local)
            looked = seen(array, sounding.fov_rx, local) & (gain > DEAF * array.peak_gain)
            floor = torch.where(looked, torch.minimum(floor, weakest[number] / gain), floor)
        listed = here._map(lambda value, mine=mine: value[mine][None], rx=Pose(here.rx.position[:1]))
        spectrum = ideal_spectrum(listed, grid, lobe=lobe)
        spectra.append(_with_floor(spectrum, floor, told_by(sounding.array_tx) == (True, True)))
    return stack_spectra(spectra)


def _local(paths: Paths, number: int) -> Tensor:
    return paths.rx[number].to_device(paths.aoa[number])


def _with_floor(spectrum: Spectrum, floor: Tensor, departures: bool) -> Spectrum:
    power = torch.where(torch.isfinite(floor), spectrum.power, torch.zeros(()))
    return replace(spectrum, power=power, floor=floor[None], aod=spectrum.aod if departures else None)
