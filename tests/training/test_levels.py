"""What planes reflect, fitted to a room of slabs, whose truth is the shoebox tracer's."""

import math
from dataclasses import replace

import pytest
import torch

from rf3dgs.core.frames import Pose
from rf3dgs.core.grids import equirect_grid
from rf3dgs.field.images import sequences
from rf3dgs.field.sources import PointSources
from rf3dgs.geometry import Patches, Planes
from rf3dgs.propagation.room import Slab, shoebox
from rf3dgs.spectra.scan import spectrum_of
from rf3dgs.spectra.spectrum import Spectrum
from rf3dgs.splats.obstacles import Obstacles
from rf3dgs.training.levels import fit_levels, fit_slabs, slab_levels
from rf3dgs.training.reflection import Glints, expected_db, fit_reflection, glints

SIZE = torch.tensor([9.0, 7.0, 3.2])
TX = torch.tensor([2.1, 1.7, 2.6])
FREQUENCY = 60e9
BOARD, CEILING = Slab(6.8, 0.25, 0.012), Slab(1.5, 0.1, 0.02)
WALLS = (Slab(2.5, 1.2, 0.1), Slab(2.5, 1.2, 0.1), Slab(3.7, 1.1, 0.03), Slab(3.7, 1.1, 0.03), BOARD, CEILING)
FREE = Obstacles(torch.zeros(0, 3), torch.zeros(0, 4), torch.zeros(0, 3), torch.zeros(0))


def measured(count: int, seed: int) -> Spectrum:
    generator = torch.Generator().manual_seed(seed)
    pose = Pose(0.7 + (SIZE - 1.4) * torch.rand(count, 3, generator=generator))
    paths = shoebox(SIZE.tolist(), Pose(TX), pose, FREQUENCY, 2, WALLS)
    spectrum = spectrum_of(paths, None, equirect_grid(180, 90), lobe=math.radians(4.0))
    return replace(spectrum, power=spectrum.power + 1e-6 * spectrum.power.amax((-2, -1), keepdim=True))


def looked(spectra: Spectrum) -> tuple[PointSources, Glints]:
    """The room's mirrors, which know nothing yet, and what was measured in their directions."""
    normals = torch.cat([torch.stack((row, -row)) for row in torch.eye(3)])
    planes = Planes(normals, torch.stack([value for size in SIZE for value in (torch.tensor(0.0), -size)]))
    generator = torch.Generator().manual_seed(2)
    spots = [torch.rand(20_000, 3, generator=generator) * SIZE for _ in range(6)]
    for plane, where in enumerate(spots):
        where[:, plane // 2] = SIZE[plane // 2] * (plane % 2)
    patches, law = Patches.of(planes, spots), torch.tensor([-9.0, 0.0, 0.0]).expand(6, 3)
    sources = PointSources(TX, FREQUENCY, planes, patches, sequences(6, 2), law)
    return sources, glints(sources, sources.rays_each(spectra.pose.position, FREE), spectra)


@pytest.fixture(scope="module")
def learned() -> tuple[PointSources, Glints]:
    return looked(measured(24, 0))


def test_levels_of_slabs_are_told_at_other_places(learned):
    """Of two reflections too, which parabolas of unpolarised power miss by over a decibel; three of four errors."""
    sources = fit_levels(*learned)
    assert sources.slabs is not None
    _, other = looked(measured(16, 5))
    other = other.only(other.alone & other.seen)
    plain = replace(sources, reflection=fit_reflection(learned[1], 6), slabs=None, ripple=None, marks=None)
    for order, good, bad in ((1, 0.15, 0.8), (2, 0.5, 1.5)):
        mine = other.only(other.order == order)
        assert len(mine) > 40
        errors_db = [(mine.level_db - expected_db(mine, one)).abs().quantile(0.75) for one in (sources, plain)]
        assert float(errors_db[0]) < good
        assert float(errors_db[1]) > bad


def test_a_ceiling_of_thin_board_is_found_to_be_one(learned):
    sources, found = learned
    slabs, _ = fit_slabs(found, fit_reflection(found, 6), FREQUENCY)
    assert slabs is not None
    permittivity, _, thickness = slabs[5].tolist()
    assert permittivity == pytest.approx(CEILING.permittivity, rel=0.1)
    assert thickness == pytest.approx(CEILING.thickness, rel=0.1)
    assert len(sources.planes) == 6


def test_a_wall_of_two_materials_is_no_slab(learned):
    """Half of it 15 dB louder than the other."""
    sources, found = learned
    louder = (found.plane[:, 0] == 3) & (found.point[:, 0, 0] > 4.5) & (found.order == 1)
    mixed = replace(found, level_db=found.level_db + 15.0 * louder)
    slabs, ripple = fit_slabs(mixed, fit_reflection(mixed, 6), FREQUENCY)
    assert slabs is not None
    assert ripple is not None
    assert float(slabs[3, 1]) > 1e6
    assert not ripple[3].any()
    assert float(slabs[5, 1]) < 1e6
    assert len(sources.planes) == 6


def test_planes_without_peaks_stay_as_they_are(learned):
    _, found = learned
    assert fit_slabs(found.only(found.order > 5), torch.zeros(6, 3), FREQUENCY) == (None, None)


def test_a_smooth_slab_loses_what_it_does_not_reflect():
    levels = slab_levels(torch.tensor([4.0, 0.0, 1.0]).double(), torch.linspace(0, 1, 50).double(), FREQUENCY)
    assert float(levels.max()) <= 0.0
    assert float(levels[0]) > -0.5
