import math
from dataclasses import replace

import pytest
import torch

from rf3dgs.channel.binning import bin_diffuse, stack_paths
from rf3dgs.core.angles import angle_between
from rf3dgs.core.errors import InputError
from rf3dgs.core.frames import Pose
from rf3dgs.core.units import db_from_power


def _joined(first, second):
    return stack_paths([first, second])._map(lambda value: value.reshape(-1), rx=first.rx)


def test_binning_keeps_power_mean_delay_and_mean_direction(random_paths):
    paths = random_paths(20_000)
    merged = bin_diffuse(paths, cell=math.radians(5), delay_step=1e-8)
    assert merged.coeff.shape[-1] < 15_000
    assert float(merged.total_gain) == pytest.approx(float(paths.total_gain), rel=1e-5)

    def mean(paths, value):
        return (paths.path_gain.double() * value).sum() / paths.path_gain.double().sum()

    assert float(mean(merged, merged.delay)) == pytest.approx(float(mean(paths, paths.delay)), rel=1e-5)
    assert float(mean(merged, merged.aoa[:, 0])) == pytest.approx(float(mean(paths, paths.aoa[:, 0])), abs=1e-3)


def test_mirrors_and_line_of_sight_stay_exact(random_paths):
    mirrors = random_paths(10, seed=1, diffuse=False)
    merged = bin_diffuse(_joined(mirrors, random_paths(1000)))
    for name in ("coeff", "delay", "aoa_zenith", "aoa_azimuth", "aod_zenith", "aod_azimuth", "order", "kind"):
        assert torch.equal(getattr(merged, name)[:10], getattr(mirrors, name))


def test_merged_paths_lie_within_a_cell_of_their_members(random_paths):
    paths = random_paths(3000)
    merged = bin_diffuse(paths, cell=math.radians(2), delay_step=1.0)
    nearest = angle_between(paths.aoa[:, None], merged.aoa[None].expand(3000, -1, 3)).amin(-1)
    assert float(nearest.max()) < math.radians(2 * 1.5)


def test_a_table_of_bins_and_sorting_give_the_same(random_paths):
    paths = random_paths(2000)
    table = bin_diffuse(paths, cell=math.radians(1), delay_step=1e-9)
    finer = bin_diffuse(paths, cell=math.radians(1), delay_step=1e-13)
    assert finer.coeff.shape[-1] == 2000
    assert float(finer.total_gain) == pytest.approx(float(table.total_gain), rel=1e-5)


def test_receivers_are_padded_and_invalid_paths_vanish(random_paths):
    first, second = random_paths(500), random_paths(40, seed=2)
    paths = stack_paths([first, second])
    merged = bin_diffuse(paths)
    assert merged.coeff.shape[0] == 2
    assert int(merged.count[1]) <= 40
    assert torch.allclose(merged.total_gain, torch.stack((first.total_gain, second.total_gain)), rtol=1e-5)


def test_paths_of_different_sources_are_not_stacked(random_paths):
    first = random_paths(5)
    for other in (replace(first, frequency=28e9), replace(first, tx=Pose([1.0, 0.0, 2.0]))):
        with pytest.raises(InputError, match=r"different frequencies or transmitters .* Keep them apart"):
            stack_paths([first, other])


def test_kinds_are_needed(random_paths):
    with pytest.raises(InputError, match=r"needs paths\.kind"):
        bin_diffuse(replace(random_paths(3), kind=None))
    with pytest.raises(InputError, match="must be positive"):
        bin_diffuse(random_paths(3), cell=0.0)


def test_a_receiver_without_diffuse_paths_is_left_alone(random_paths):
    mirrors = random_paths(4, diffuse=False)
    assert torch.equal(bin_diffuse(mirrors).coeff, mirrors.coeff)


def test_binned_bartlett_and_capon_stay_close_to_all_paths(random_paths):
    """The error of binning, stated: within 0.1 dB of Bartlett and 0.5 dB of Capon for uncorrelated paths."""
    from rf3dgs.channel.arrays import planar_array
    from rf3dgs.core.grids import pinhole_grid
    from rf3dgs.spectra.config import ArrayProcessing
    from rf3dgs.spectra.scan import spectrum_of

    paths = random_paths(20_000)
    merged = bin_diffuse(paths, delay_step=1.0)
    array, grid, uncorrelated = planar_array(8, 8), pinhole_grid(45, 30, 90), ArrayProcessing(snapshots=None)
    for method, limit in (("bartlett", 0.1), ("capon", 0.5)):
        seen = [spectrum_of(p, array, grid, method=method, processing=uncorrelated) for p in (paths, merged)]
        levels = [db_from_power(one.power) for one in seen]
        assert float((levels[0] - levels[1]).abs().max()) < limit
