import math

import pytest
import torch

from rf3dgs.channel.arrays import ofdm, planar_array
from rf3dgs.channel.patterns import power_pattern
from rf3dgs.channel.response import manifold, manifold_factors
from rf3dgs.core.angles import direction_of
from rf3dgs.core.errors import InputError
from rf3dgs.core.grids import equirect_grid


@pytest.mark.parametrize("name", ["isotropic", "dipole", "patch"])
def test_lossless_patterns_average_to_one_over_the_sphere(name):
    grid = equirect_grid(360, 180)
    mean = (power_pattern(name, grid.directions) * grid.solid_angle).sum() / (4 * math.pi)
    assert float(mean) == pytest.approx(1.0, abs=1e-3)


def test_tr38901_has_eight_dbi_ahead_and_thirty_db_less_behind():
    ahead, behind = power_pattern("tr38901", torch.tensor([[1.0, 0.0, 0.0], [-1.0, 0.0, 0.0]]))
    assert 10 * math.log10(ahead) == pytest.approx(8.0, abs=1e-4)
    assert 10 * math.log10(behind) == pytest.approx(-22.0, abs=1e-4)


def test_iso_is_an_alias_and_an_unknown_pattern_lists_the_known():
    assert planar_array(2, 2, "iso").pattern == "isotropic"
    with pytest.raises(InputError, match="isotropic, dipole, patch, tr38901; got 'horn'"):
        planar_array(2, 2, "horn")


def test_elements_run_down_the_columns_from_top_left_for_someone_facing_the_panel():
    array = planar_array(3, 2, "isotropic")
    expected = [[0, -0.25, 0.5], [0, -0.25, 0.0], [0, -0.25, -0.5], [0, 0.25, 0.5], [0, 0.25, 0.0], [0, 0.25, -0.5]]
    assert torch.equal(array.positions, torch.tensor(expected, dtype=torch.float64))


def test_manifold_leads_at_the_element_nearer_to_the_source():
    array = planar_array(1, 2, "isotropic")
    left = torch.tensor([0.6, 0.8, 0.0])
    response = manifold(array, left)
    assert response.dtype == torch.complex64
    assert float(torch.angle(response[1] / response[0])) == pytest.approx(2 * math.pi * 0.5 * 0.8, abs=1e-5)


def test_spacing_may_differ_between_rows_and_columns():
    array = planar_array(2, 2, vertical=0.7, horizontal=0.4)
    assert float(array.positions[0, 2] - array.positions[1, 2]) == pytest.approx(0.7)
    assert float(array.positions[2, 1] - array.positions[0, 1]) == pytest.approx(0.4)


@pytest.mark.parametrize(("rows", "spacing"), [(0, 0.5), (2, 0.0), (2, float("nan"))])
def test_impossible_arrays_are_refused(rows, spacing):
    with pytest.raises(InputError, match=r"an array needs|spacing must be positive"):
        planar_array(rows, 2, spacing=spacing)


def test_subcarriers_have_equal_spacing_and_hold_the_carrier():
    offsets = ofdm(400e6, 64)
    assert float(offsets[32]) == 0.0
    assert torch.allclose(offsets.diff(), torch.full((63,), 400e6 / 64, dtype=torch.float64))
    with pytest.raises(InputError, match="positive bandwidth"):
        ofdm(-1.0, 4)


def test_patterns_are_their_published_formulas():
    """Angle by angle, in degrees: 3GPP TR 38.901 table 7.3-1, the short dipole, and 6 cos^2 for the patch."""
    for zenith in range(5, 180, 25):
        for azimuth in range(-175, 180, 35):
            direction = direction_of(*(torch.deg2rad(torch.tensor(float(angle))) for angle in (zenith, azimuth)))
            vertical = -min(12 * ((zenith - 90) / 65) ** 2, 30)
            horizontal = -min(12 * (azimuth / 65) ** 2, 30)
            boresight = math.sin(math.radians(zenith)) * math.cos(math.radians(azimuth))
            expected = {
                "isotropic": 1.0,
                "dipole": 1.5 * math.sin(math.radians(zenith)) ** 2,
                "patch": 6 * boresight**2 if boresight > 0 else 0.0,
                "tr38901": 10 ** ((8 - min(-(vertical + horizontal), 30)) / 10),
            }
            for name, gain in expected.items():
                assert float(power_pattern(name, direction)) == pytest.approx(gain, rel=1e-4, abs=1e-9), name


def test_a_patch_has_half_its_power_at_forty_five_degrees_and_seven_point_eight_dbi():
    ahead, off = power_pattern("patch", torch.tensor([[1.0, 0.0, 0.0], [math.sqrt(0.5), 0.0, math.sqrt(0.5)]]))
    assert 10 * math.log10(ahead) == pytest.approx(7.78, abs=0.01)
    assert float(off / ahead) == pytest.approx(0.5, abs=1e-6)


@pytest.mark.parametrize("shape", [(1, 1), (4, 3), (16, 16)], ids=str)
def test_the_manifold_is_the_product_of_its_factors(shape):
    array = planar_array(*shape, "tr38901", vertical=0.7, horizontal=0.4)
    directions = equirect_grid(20, 10).directions.reshape(-1, 3).double()
    columns, rows = manifold_factors(array, directions)
    product = (columns[:, None] * rows).reshape(array.count, -1).mT
    gain = power_pattern(array.pattern, directions).sqrt()
    # one rounding a step of at most sixteen
    assert torch.allclose(product * gain[:, None], manifold(array, directions), rtol=0, atol=1e-13)
