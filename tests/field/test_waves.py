"""Laws of a field as an array sees it."""

import pytest
import torch

from rf3dgs.channel.arrays import planar_array
from rf3dgs.core.errors import InputError
from rf3dgs.core.frames import Pose
from rf3dgs.core.grids import pinhole_grid
from rf3dgs.field.waves import seen_by_array, waves_of
from rf3dgs.spectra.config import ArrayProcessing
from rf3dgs.spectra.scan import spectrum_of

ARRAY = planar_array(4, 4, "patch")
GRID = pinhole_grid(24, 16, 100)
POSE = Pose.look_at((4.0, 3.0, 1.5), (1.0, 1.2, 2.4))


def test_what_rays_add_is_the_picture_of_their_paths(field):
    whole, surface = (seen_by_array(one, POSE, ARRAY, GRID) for one in (field, field.without_sources()))
    paths = field.paths(POSE, strongest=1, parts="sources")
    alone = spectrum_of(paths, ARRAY, GRID, method="bartlett", processing=ArrayProcessing(snapshots=None))
    assert float(alone.power.max()) > 0
    # Bartlett is linear in the covariance; float32 pictures.
    torch.testing.assert_close(
        whole.power - surface.power, alone.power, rtol=1e-3, atol=1e-5 * float(whole.power.max())
    )


def test_the_waves_carry_the_power_of_the_field(field, sphere):
    waves = waves_of(field.without_sources(), Pose(POSE.position), sphere)
    shown = field.without_sources().render(Pose(POSE.position), sphere, csi=False)
    assert float(waves.power.sum()) == pytest.approx(float(shown.path_gain), rel=1e-5)


def test_noise_lies_evenly_under_the_picture(field):
    noise = 1e-8
    quiet, loud = (seen_by_array(field, POSE, ARRAY, GRID, noise=level) for level in (0.0, noise))
    added = (loud.power - quiet.power)[quiet.power > 0]
    torch.testing.assert_close(added, torch.full_like(added, noise / ARRAY.count), rtol=1e-2, atol=0.0)
    assert float(loud.noise) == pytest.approx(noise)


def test_a_batch_is_each_pose(field):
    poses = Pose(torch.stack((POSE.position, POSE.position)), torch.stack((POSE.orientation, POSE.orientation)))
    both = seen_by_array(field, poses, ARRAY, GRID, method="mvdr")
    assert both.method == "capon"
    assert both.instrument.array == ARRAY
    assert torch.equal(both.power[0], both.power[1])


def test_what_is_no_picture_is_refused(field):
    with pytest.raises(InputError, match="method must be one of bartlett, tapered, capon"):
        seen_by_array(field, POSE, ARRAY, GRID, method="music")
    with pytest.raises(InputError, match="noise must be a power of at least 0"):
        seen_by_array(field, POSE, ARRAY, GRID, noise=-1.0)
