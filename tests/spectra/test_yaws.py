"""The pictures of one place are pictures of one set of paths."""

import math

import pytest
import torch

from rf3dgs.channel.arrays import planar_array
from rf3dgs.core.errors import InputError
from rf3dgs.core.frames import Pose
from rf3dgs.core.grids import pinhole_grid, sample_grid
from rf3dgs.spectra.config import ArrayProcessing
from rf3dgs.spectra.scan import spectrum_of
from rf3dgs.spectra.yaws import at_yaws

YAWS = (0.0, math.pi / 2, math.pi, -math.pi / 2)


def column_at_45_degrees() -> tuple[torch.Tensor, int, int]:
    """A pinhole's K, and its columns that look 45 degrees to the right and to the left."""
    K = torch.tensor([[24.5, 0.0, 32.0], [0.0, 24.5, 20.0], [0.0, 0.0, 1.0]])
    return K, 56, 7


@pytest.mark.parametrize("count", [40, 3000])
def test_four_yaws_agree_where_they_overlap(random_paths, count):
    K, right, left = column_at_45_degrees()
    grid = pinhole_grid(64, 40, K=K)
    seen = spectrum_of(at_yaws(random_paths(count, rx=Pose.from_yaw((3, 4, 1), 0.3)), YAWS), None, grid)
    for yaw in range(4):
        after, before = seen[yaw], seen[(yaw + 1) % 4]  # the next one is turned to the left by 90 degrees
        world = after.directions[:, left], before.directions[:, right]
        torch.testing.assert_close(*world, atol=1e-6, rtol=0)
        power = after.power[:, left], before.power[:, right]
        # Few paths are summed exactly, over directions that float32 rounds differently. Many are deposited on nodes a
        # sixth of a lobe apart that turn with the receiver: the variance of a lobe depends on its place between them
        # by 2.6 %, its power two standard deviations off by twice that.
        bound = 1e-3 if count <= 1024 else 0.08
        torch.testing.assert_close(*power, rtol=bound, atol=1e-3 * bound * float(power[0].max()))
        some = power[0] > 1e-3 * power[0].max()
        torch.testing.assert_close(after.delay[:, left][some], before.delay[:, right][some], rtol=bound, atol=0)
        # Departures are random here: about ten paths of a lobe cancel to a third of their length.
        torch.testing.assert_close(after.aod[:, left][some], before.aod[:, right][some], rtol=0, atol=3 * bound)


def test_overlapping_pictures_agree_everywhere_they_overlap(random_paths):
    grid = pinhole_grid(160, 100, 120)
    first, second = spectrum_of(at_yaws(random_paths(60), (0.0, math.pi / 4)), None, grid, lobe=math.radians(12))
    local = second.pose.to_device(first.directions)
    _, inside = grid.pixel_of(local)
    looked = sample_grid(second.power[..., None], grid, local)[..., 0]
    error = (10 * torch.log10(looked / first.power)).abs()[inside & (first.power > 1e-2 * first.power.max())]
    # A bilinear look-up misses h^2 f'' / 8 along each axis: where a 12 degree lobe has fallen by 20 dB, 0.26 dB for
    # pixels of 1.2 degrees.
    assert float(error.max()) < 0.3
    assert int(inside.sum()) > 5000


def test_arrays_turn_with_the_receiver(random_paths):
    paths, grid, array = random_paths(50), pinhole_grid(30, 20, 90), planar_array(4, 4)
    how = ArrayProcessing(snapshots=None)
    seen = spectrum_of(at_yaws(paths, YAWS), array, grid, method="bartlett", processing=how)
    for number, yaw in enumerate(YAWS):
        pose = Pose.from_yaw(paths.rx.position, yaw)
        alone = spectrum_of(paths, array, grid, method="bartlett", processing=how, pose=pose)
        torch.testing.assert_close(seen.power[number], alone.power, rtol=1e-5, atol=1e-12 * float(alone.power.max()))


def test_wrong_yaws_are_refused(random_paths):
    paths = random_paths(5)
    with pytest.raises(InputError, match="one or more finite angles in radians"):
        at_yaws(paths, ())
    with pytest.raises(InputError, match="one or more finite angles in radians"):
        at_yaws(paths, (math.nan,))
    with pytest.raises(InputError, match=r"the paths of one receiver; got \[2\]"):
        at_yaws(at_yaws(paths, (0.0, 1.0)), (0.0,))
