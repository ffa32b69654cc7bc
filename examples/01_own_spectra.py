"""# Spectra of your own, and a field from a mesh

Whatever measures power per direction can train a field. Here the "measurement" is made by hand: a room with one bright
wall, seen from 20 places. Its geometry comes from a mesh, so no photographs are needed.

    python examples/01_own_spectra.py
"""

import math

import torch

import rf3dgs
from rf3dgs.core.grids import equirect_grid
from rf3dgs.core.units import friis_gain
from rf3dgs.spectra.spectrum import Instrument
from rf3dgs.splats.surface import sample_mesh
from rf3dgs.training.config import RadioConfig

# A box of 6 x 5 x 3 m as 12 triangles, and a transmitter in one corner.
corners = torch.cartesian_prod(torch.tensor([0.0, 6.0]), torch.tensor([0.0, 5.0]), torch.tensor([0.0, 3.0]))
quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
faces = torch.tensor([triangle for a, b, c, d in quads for triangle in ((a, b, c), (a, c, d))])
tx = rf3dgs.Pose((0.5, 0.5, 2.5))

# What the instrument saw: a lobe of 6 degrees, the line of sight, and a wall at x = 6 m that scatters.
grid, instrument, frequency = equirect_grid(90, 45), Instrument.gaussian(math.radians(6.0)), 28e9
rx = rf3dgs.Pose.scatter(((1.0, 1.0, 1.0), (5.0, 4.0, 2.0)), count=20, seed=0)
directions = grid.directions
power = torch.full((20, *grid.shape), 1e-12)
for index in range(20):
    offset = tx.position - rx.position[index]
    angle = torch.acos((directions @ (offset / offset.norm())).clamp(-1, 1))
    power[index] += friis_gain(offset.norm(), frequency) * instrument.kernel(angle)
    hits_wall = directions[..., 0] * 5.0 > directions[..., 1:].abs().amax(-1) * (6.0 - rx.position[index, 0])
    power[index] += 1e-9 * hits_wall
spectra = rf3dgs.Spectrum(power, grid, rx, frequency, instrument, tx=tx)

dataset = rf3dgs.Dataset(spectra=spectra).split(test=0.2, region=0.0, seed=0, unseal_test=True)
geometry = sample_mesh(corners, faces, count=3000)
assert dataset.train.spectra is not None
assert dataset.test.spectra is not None
field = rf3dgs.fit_radio(geometry, dataset.train.spectra, RadioConfig(seed=0))
print(rf3dgs.evaluate(field, dataset.test.spectra, train=dataset.train.spectra))
