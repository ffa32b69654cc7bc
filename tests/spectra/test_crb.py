import math
from dataclasses import replace

import pytest
import torch

from rf3dgs.channel.arrays import planar_array
from rf3dgs.channel.paths import Paths
from rf3dgs.channel.sounding import Sounding, sounder_response
from rf3dgs.core.angles import angles_of, direction_of
from rf3dgs.core.errors import InputError
from rf3dgs.core.frames import Pose
from rf3dgs.spectra.crb import UNKNOWNS, cramer_rao

F64 = torch.float64
TILTED = Pose.look_at((3.0, 4.0, 1.0), (1.0, 2.5, 1.6))


def paths_at(arrivals, departures, delays, rx=TILTED, tx=None, frequency=1e9):
    """Paths from device-frame (zenith, azimuth) pairs."""
    tx = Pose.from_yaw((0.0, 0.0, 2.0), 0.8) if tx is None else tx
    ends = []
    for pose, pairs in ((rx, arrivals), (tx, departures)):
        local = direction_of(*torch.tensor(pairs, dtype=F64).unbind(-1))
        ends.append(angles_of(local @ pose.world_from_device.double().mT))
    count = len(delays)
    turn = torch.arange(count, dtype=F64)
    return Paths(
        coeff=torch.polar(1e-4 / (1 + 0.3 * turn), turn),
        delay=torch.tensor(delays, dtype=F64),
        aoa_zenith=ends[0][0],
        aoa_azimuth=ends[0][1],
        aod_zenith=ends[1][0],
        aod_azimuth=ends[1][1],
        valid=torch.ones(count, dtype=torch.bool),
        frequency=frequency,
        tx=tx,
        rx=rx,
    )


def two_paths(**changes):
    arrivals, departures = [[1.3, 0.4], [1.7, -0.3]], [[1.5, -0.6], [1.4, 0.5]]
    return paths_at(arrivals, departures, [3.0e-8, 3.4e-8], **changes)


def sounding_for(paths, array_rx, array_tx, points=16, bandwidth=2e8, noise=1e-12, **changes):
    offsets = (torch.arange(points, dtype=F64) - points // 2 + 0.3) * bandwidth / points
    shape = (1 if array_rx is None else array_rx.count, 1 if array_tx is None else array_tx.count, points)
    response = torch.zeros(*paths.coeff.shape[:-1], *shape)
    known = {"array_rx": array_rx, "array_tx": array_tx, "noise_power": noise}
    return Sounding(response, offsets, paths.frequency, paths.tx, paths.rx, **{**known, **changes})


def deviations(bound):
    return torch.stack([getattr(bound, name) for name in UNKNOWNS])


def shifted(paths, name, index, step):
    """The paths after one unknown of one path moves; the gain at the carrier stays what it was when the delay moves."""
    one = torch.zeros(paths.coeff.shape, dtype=F64)
    one[index] = step
    if name == "log_amplitude":
        return replace(paths, coeff=paths.coeff * torch.exp(one))
    if name == "phase":
        return replace(paths, coeff=paths.coeff * torch.exp(1j * one))
    moved = replace(paths, **{name: getattr(paths, name) + one})
    if name == "delay":
        moved = replace(moved, coeff=paths.coeff * torch.exp(2j * math.pi * paths.frequency * one))
    return moved


@pytest.mark.parametrize("pattern", ["isotropic", "dipole", "patch", "tr38901"])
def test_the_bound_is_that_of_finite_differences(pattern):
    paths = two_paths()
    sounding = sounding_for(paths, planar_array(3, 2, pattern), planar_array(2, 3, pattern))
    steps = {"log_amplitude": 1e-5, "phase": 1e-5, "delay": 1e-13}
    columns = []
    for index in range(2):
        for name in UNKNOWNS:
            step = steps.get(name, 1e-5)
            sides = [
                sounder_response(shifted(paths, name, index, s), sounding.array_rx, sounding.array_tx, sounding.offsets)
                for s in (step, -step)
            ]
            columns.append((sides[0] - sides[1]).reshape(-1) / (2 * step))
    jacobian = torch.stack(columns, -1)
    information = 2 / 1e-12 * (jacobian.mH @ jacobian).real
    scale = information.diagonal().rsqrt()
    expected = (torch.linalg.inv(information * scale[:, None] * scale).diagonal().sqrt() * scale).reshape(2, 7).mT
    # Central differences of step 1e-5 err by 1e-10; poses are float32, so rotations are orthonormal to 1e-7.
    assert torch.allclose(deviations(cramer_rao(paths, sounding)), expected, rtol=1e-5)


def test_one_path_has_the_closed_form():
    paths = paths_at(
        [[math.pi / 2, 0.0]], [[math.pi / 2, 0.0]], [3e-8], rx=Pose((3.0, 4.0, 1.0)), tx=Pose((0.0, 0.0, 2.0))
    )
    array = planar_array(4, 3, "isotropic")
    sounding = sounding_for(paths, array, planar_array(2, 2, "isotropic"), noise=1e-10)
    bound = cramer_rao(paths, sounding)
    snr = 1e-8 / 1e-10 * 12 * 4 * 16  # of the whole sounding

    def closed(points):
        return 1 / math.sqrt(2 * snr * float((2 * math.pi * (points - points.mean())).square().mean()))

    assert float(bound.delay) == pytest.approx(closed(sounding.offsets), rel=1e-9)
    assert float(bound.aoa_zenith) == pytest.approx(closed(array.positions[:, 2]), rel=1e-9)
    assert float(bound.aoa_azimuth) == pytest.approx(closed(array.positions[:, 1]), rel=1e-9)
    assert float(bound.log_amplitude) == pytest.approx(1 / math.sqrt(2 * snr), rel=1e-9)


def test_the_bound_scales_with_the_noise_and_adds_nothing_for_receivers():
    paths = two_paths()
    sounding = sounding_for(paths, planar_array(3, 2), planar_array(2, 2))
    quiet = deviations(cramer_rao(paths, sounding))
    loud = deviations(cramer_rao(paths, replace(sounding, noise_power=4e-12)))
    assert torch.allclose(loud, 2 * quiet, rtol=1e-9)
    rx = Pose(paths.rx.position.expand(2, 3), paths.rx.orientation.expand(2, 4))
    both = paths._map(lambda value: torch.stack((value, value)), rx=rx)
    batch = deviations(cramer_rao(both, sounding_for(both, planar_array(3, 2), planar_array(2, 2))))
    assert torch.allclose(batch[:, 1], quiet, rtol=1e-9)


def test_another_path_never_helps():
    paths = two_paths()
    sounding = sounding_for(paths, planar_array(3, 2), planar_array(2, 2))
    alone = deviations(cramer_rao(paths._map(lambda value: value[:1]), sounding))
    together = deviations(cramer_rao(paths, sounding))[:, :1]
    assert bool((together >= alone * (1 - 1e-9)).all())


def test_turning_both_devices_with_the_world_keeps_the_bound():
    level = two_paths(rx=Pose((3.0, 4.0, 1.0)), tx=Pose((0.0, 0.0, 2.0)))
    turned = two_paths(rx=Pose.from_yaw((3.0, 4.0, 1.0), 2.0), tx=Pose.from_yaw((0.0, 0.0, 2.0), -1.0))
    array = planar_array(3, 2)
    first, second = (deviations(cramer_rao(paths, sounding_for(paths, array, array))) for paths in (level, turned))
    assert torch.allclose(first, second, rtol=1e-5)  # float32 rotations


def test_what_an_array_does_not_tell_has_an_infinite_bound():
    paths = two_paths(rx=Pose.from_yaw((3.0, 4.0, 1.0), 0.5))
    row = cramer_rao(paths, sounding_for(paths, planar_array(1, 4), planar_array(4, 1)))
    assert bool(torch.isinf(row.aoa_zenith).all())
    assert bool(torch.isfinite(row.aoa_azimuth).all())
    assert bool(torch.isfinite(row.aod_zenith).all())
    assert bool(torch.isinf(row.aod_azimuth).all())
    assert bool(torch.isfinite(row.delay).all())
    # A tilted row mixes both angles of the world: neither is told.
    tilted = Pose.look_at((3.0, 4.0, 1.0), (1.0, 2.5, 3.6))
    mixed = two_paths(rx=tilted)
    bound = cramer_rao(mixed, sounding_for(mixed, planar_array(1, 4), planar_array(2, 2)))
    assert bool(torch.isinf(bound.aoa_zenith).all())
    assert bool(torch.isinf(bound.aoa_azimuth).all())
    tone = cramer_rao(paths, sounding_for(paths, planar_array(2, 4), planar_array(4, 2), points=1))
    assert bool(torch.isinf(tone.delay).all())
    assert bool(torch.isfinite(tone.aoa_zenith).all())


def test_paths_out_of_view_have_no_bound_and_disturb_nobody():
    paths = paths_at([[1.3, 0.4], [1.0, -0.3]], [[1.5, -0.6], [1.4, 0.5]], [3.0e-8, 3.1e-8])
    sounding = sounding_for(paths, planar_array(3, 2), planar_array(2, 2), fov_rx=math.radians(50.0))
    bound = deviations(cramer_rao(paths, sounding))
    alone = deviations(cramer_rao(paths._map(lambda value: value[:1]), sounding))
    assert torch.allclose(bound[:, :1], alone, rtol=1e-12)
    assert bool(torch.isinf(bound[:, 1]).all())


def test_paths_that_coincide_cannot_be_told_apart():
    paths = paths_at([[1.3, 0.4]] * 2, [[1.5, -0.6]] * 2, [3.0e-8] * 2)
    bound = cramer_rao(paths, sounding_for(paths, planar_array(3, 2), planar_array(2, 2)))
    # Infinite where the inverse fails, or as large as rounding makes it.
    assert float(bound.delay.min()) > 1e-3


def test_the_bound_needs_noise_and_the_same_receivers():
    paths = two_paths()
    with pytest.raises(InputError, match="needs the noise power"):
        cramer_rao(paths, sounding_for(paths, planar_array(2, 2), planar_array(2, 2), noise=None))
    sounding = sounding_for(paths, planar_array(2, 2), planar_array(2, 2))
    with pytest.raises(InputError, match="the same receivers"):
        cramer_rao(paths._map(lambda value: value[None], rx=paths.rx.flat()), sounding)
