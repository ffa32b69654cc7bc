"""Laws of soundings as pictures, and of lists of paths as ideal spectra."""

import math
from dataclasses import replace

import pytest
import torch

from rf3dgs.channel.arrays import ofdm, planar_array
from rf3dgs.channel.sounding import Sounding, sounder_response
from rf3dgs.core.errors import InputError
from rf3dgs.core.frames import Pose
from rf3dgs.core.grids import equirect_grid, pinhole_grid
from rf3dgs.spectra.config import ArrayProcessing, Loading
from rf3dgs.spectra.path_lists import path_targets
from rf3dgs.spectra.scan import spectrum_of
from rf3dgs.spectra.sounded import spectrum_of_sounding
from rf3dgs.spectra.yaws import at_yaws

ARRAY = planar_array(4, 4, "patch")
GRID, SPHERE = pinhole_grid(24, 16, 100), equirect_grid(72, 36)
YAWS = (0.0, math.pi / 2, math.pi, -math.pi / 2)
OFFSETS = ofdm(1e9, 32)


def sounding_of(paths, fov: float = math.pi) -> Sounding:
    response = sounder_response(paths, ARRAY, None, OFFSETS, fov_rx=fov)
    return Sounding(response, OFFSETS, paths.frequency, paths.tx, paths.rx, ARRAY, noise_power=1e-9, fov_rx=fov)


@pytest.fixture
def around(paths_from):
    """A wave from 40 degrees to the left, which two of four sides hear, and one from behind, level."""
    directions = [[math.cos(0.7), math.sin(0.7), 0.1], [-1.0, 0.1, 0.0]]
    paths = paths_from(directions, [1e-6, 1e-7], [30e-9, 40e-9], rx=Pose(torch.zeros(3)))
    return at_yaws(paths, YAWS)


@pytest.mark.parametrize("method", ["bartlett", "tapered", "capon"])
def test_a_sounding_shows_the_picture_of_its_paths(method, around):
    loading = {"loading": Loading(1e-2)} if method == "capon" else {}
    how = ArrayProcessing(snapshots=32, bandwidth=1e9, **loading)
    direct = spectrum_of(around[0], ARRAY, GRID, method=method, processing=how)
    sounded = spectrum_of_sounding(sounding_of(around[0]), GRID, method=method, **loading)
    torch.testing.assert_close(sounded.power, direct.power, rtol=1e-4, atol=1e-14)
    assert direct.noise is not None
    assert float(sounded.noise) == pytest.approx(float(direct.noise) + 1e-9 / ARRAY.peak_gain, rel=1e-3)


def test_a_wave_that_two_sides_hear_counts_once(around):
    targets = path_targets(around, sounding_of(around), SPHERE)
    assert len(targets) == 1
    # The lobes' sum over a sphere of 5 degrees is within hundredths of a decibel of the paths' gains.
    assert float(targets.path_gain) == pytest.approx(1.1e-6, rel=1e-2)
    assert targets.delay is not None
    assert targets.aod is None


def test_a_direction_without_a_path_is_not_dark(around):
    targets = path_targets(around, sounding_of(around), SPHERE)
    assert targets.floor is not None
    empty = (targets.power == 0) & targets.looked
    assert float(empty.float().mean()) > 0.2
    assert float(targets.floor[empty].min()) > 0
    narrow = path_targets(around, sounding_of(around, fov=math.radians(30)), SPHERE)
    assert not bool(narrow.looked[0][SPHERE.directions[..., 2].abs() > math.sin(math.radians(15.1))].any())


def test_what_does_not_fit_is_refused(around):
    sounding = sounding_of(around)
    with pytest.raises(InputError, match="one for each of the 4 receivers of the sounding"):
        path_targets(around[:2], sounding, SPHERE)
    bare = replace(sounding, array_rx=None, response=sounding.response[:, :1])
    for call in (lambda: path_targets(around, bare, SPHERE), lambda: spectrum_of_sounding(bare, GRID)):
        with pytest.raises(InputError, match="sound with an array_rx"):
            call()
    with pytest.raises(InputError, match="method must be one of bartlett"):
        spectrum_of_sounding(sounding, GRID, method="music")
    with pytest.raises(InputError, match="averaging must be one of"):
        spectrum_of_sounding(sounding, GRID, averaging="backward")  # type: ignore[arg-type]
