"""Energy of diffuse scattering: one plate traced by Sionna against the integral over its surface.

Effective roughness (Degli-Esposti et al., 2007), as Sionna documents it: of the power that a plate reflects, the share
S^2 leaves diffusely with the Lambertian pattern cos / pi. Between isotropic antennas at the distances r_i and r_s from
a piece dA of the plate, the power is

    (lambda / 4 pi)^2  S^2  R(theta_i)  cos theta_i cos theta_s / (pi r_i^2 r_s^2)  dA

with R the mean of the TE and TM reflectances: the mean over two orthogonal transmit polarisations is the same in every
basis, and the sum over receive polarisations loses nothing.
"""

import math
from dataclasses import replace

import pytest
import torch

from rf3dgs.core.frames import Pose
from rf3dgs.core.units import friis_gain, wavelength
from rf3dgs.propagation.config import TraceConfig
from rf3dgs.propagation.llvm import find_llvm
from rf3dgs.propagation.room import THICKNESS, Slab, slab_reflection
from rf3dgs.propagation.sites import shapes
from rf3dgs.propagation.sites.materials import permittivity
from rf3dgs.propagation.sites.scene import Scene, SceneObject

pytestmark = pytest.mark.oracle

FREQUENCY = 28e9
TX, RX = Pose((-1.0, -0.5, 2.0)), Pose([[1.2, 0.8, 1.5]])
MATERIAL, SIDE, ROUGHNESS = "concrete", 6.0, 0.6
SEEDS = 16
SPECULAR, DIFFUSE = 1, 2  # bits of Paths.kind
# With mirrors enabled a ray draws its fate, so that each seed is a sample; without, every ray scatters.
DRAWN = TraceConfig(rays=50_000, depth=1, line_of_sight=False)


def plate(roughness: float) -> Scene:
    mesh = shapes.quad((-SIDE / 2, -SIDE / 2, 0), (SIDE, 0, 0), (0, SIDE, 0))
    around = ((-9, -9, -1), (9, 9, 9))
    objects = (SceneObject("plate", *mesh[:2], MATERIAL, roughness),)
    return Scene("plate", objects, TX, around, around, around, FREQUENCY)


def integral(roughness: float, *, steps: int = 1000, lambertian: bool = True) -> float:
    """The formula above by the midpoint rule; at 1,000 steps it is exact to 2e-7."""
    axis = (torch.arange(steps, dtype=torch.float64) + 0.5) / steps * SIDE - SIDE / 2
    piece = torch.stack((*torch.meshgrid(axis, axis, indexing="ij"), torch.zeros(steps, steps)), -1)
    to_tx, to_rx = TX.position.double() - piece, RX.position[0].double() - piece
    r_i, r_s = to_tx.norm(dim=-1), to_rx.norm(dim=-1)
    cos_i, cos_s = to_tx[..., 2] / r_i, to_rx[..., 2] / r_s
    te, tm = slab_reflection(Slab(*permittivity(MATERIAL, FREQUENCY), THICKNESS), cos_i, FREQUENCY)
    pattern = cos_s / math.pi if lambertian else torch.full_like(cos_s, 1 / (2 * math.pi))
    density = 0.5 * (te.abs() ** 2 + tm.abs() ** 2) * cos_i * pattern / (r_i * r_s) ** 2
    return (wavelength(FREQUENCY) / (4 * math.pi) * roughness) ** 2 * float(density.sum()) * (SIDE / steps) ** 2


@pytest.fixture(scope="module")
def diffuse_power():
    assert find_llvm().path is not None, f"this test needs sionna-rt and LLVM: {find_llvm().reason}"
    from rf3dgs.propagation.sionna import trace_each

    def power(config: TraceConfig, roughness: float = ROUGHNESS) -> float:
        (row,) = trace_each(plate(roughness), TX, RX, config)
        assert row.kind is not None
        return float(row.path_gain[row.kind == DIFFUSE].double().sum())

    return power


def test_diffuse_power_is_the_integral_within_monte_carlo_error(diffuse_power):
    """A z-test: with 16 seeds, which are fixed, Student's t of a sound tracer exceeds 4 once in 900 choices of them.

    The standard error is about 0.4 %, so that the models next to the right one (power spread evenly over the
    hemisphere, S for S^2, polarisations added instead of averaged) are far outside.
    """
    drawn = torch.tensor([diffuse_power(replace(DRAWN, seed=7919 * seed)) for seed in range(SEEDS)])
    error = float(drawn.std()) / math.sqrt(SEEDS)
    assert error < 0.01 * float(drawn.mean())
    assert abs(float(drawn.mean()) - integral(ROUGHNESS)) / error < 4
    for wrong in (integral(ROUGHNESS, lambertian=False), integral(ROUGHNESS) / ROUGHNESS, 2 * integral(ROUGHNESS)):
        assert abs(float(drawn.mean()) - wrong) / error > 10


def test_without_chance_the_rays_lattice_integrates_the_plate(diffuse_power):
    """Every ray scatters: what is left is the error of a lattice of 12,000 points on the plate, below 1e-3."""
    power = diffuse_power(replace(DRAWN, specular=False))
    assert power == pytest.approx(integral(ROUGHNESS), rel=1e-3)
    assert diffuse_power(replace(DRAWN, specular=False, seed=99)) == power


@pytest.mark.parametrize("roughness", [0.2, 1.0])
def test_diffuse_power_grows_with_the_square_of_the_scattering_amplitude(diffuse_power, roughness):
    power = diffuse_power(replace(DRAWN, specular=False), roughness)
    assert power == pytest.approx(integral(roughness), rel=1e-3)


def test_the_mirror_keeps_what_is_not_scattered(diffuse_power):
    """Friis over the distance of the image times R (1 - S^2): with what scatters, all of R is accounted for."""
    from rf3dgs.propagation.sionna import trace_each

    (row,) = trace_each(plate(ROUGHNESS), TX, RX, DRAWN)
    image = TX.position.double() * torch.tensor([1.0, 1.0, -1.0])
    line = RX.position[0].double() - image
    te, tm = slab_reflection(Slab(*permittivity(MATERIAL, FREQUENCY), THICKNESS), line[2] / line.norm(), FREQUENCY)
    reflectance = 0.5 * float(te.abs() ** 2 + tm.abs() ** 2)
    expected = float(friis_gain(line.norm(), FREQUENCY)) * reflectance * (1 - ROUGHNESS**2)
    assert row.kind is not None
    assert float(row.path_gain[row.kind == SPECULAR]) == pytest.approx(expected, rel=1e-4)
