"""Coherent responses, delay taps, and the native sums over paths against their specifications."""

import os
import subprocess
import sys

import pytest
import torch

from rf3dgs.channel.arrays import ofdm, planar_array
from rf3dgs.channel.response import coefficients
from rf3dgs.core.errors import InputError
from rf3dgs.core.native import native_core
from rf3dgs.spectra import responses as module
from rf3dgs.spectra.config import ArrayProcessing
from rf3dgs.spectra.covariance import covariance_of, covariance_of_snapshots, delay_taps
from rf3dgs.spectra.deposit import deposit, deposited, values_of
from rf3dgs.spectra.responses import FEW, kernel, kernel_polynomials, kernel_transform, responses
from rf3dgs.spectra.scan import spectrum_of

SHAPES = [(1, 1), (3, 5), (8, 4), (1, 9)]


def _all_ways(paths, array, count, bandwidth, monkeypatch):
    coeff, directions = coefficients(paths), paths.rx.to_device(paths.aoa)
    fast = responses(coeff, paths.delay, directions, array, count, bandwidth)
    with monkeypatch.context() as patch:
        patch.setattr(module, "native_core", lambda: None)
        page = responses(coeff, paths.delay, directions, array, count, bandwidth)
        patch.setattr(module, "FEW", 10**9)
        exact = responses(coeff, paths.delay, directions, array, count, bandwidth)
    return fast, page, exact


@pytest.mark.parametrize("shape", SHAPES, ids=str)
@pytest.mark.parametrize("count", [1, 7, 64])
def test_spread_responses_are_the_direct_sum(shape, count, random_paths, monkeypatch):
    """To the 1e-9 of the largest response that the kernel's width promises; both native and page."""
    assert native_core() is not None
    array = planar_array(*shape, "tr38901", vertical=0.6, horizontal=0.45)
    fast, page, exact = _all_ways(random_paths(FEW + 100), array, count, 5e8, monkeypatch)
    assert fast.shape == (array.count, count)
    assert float((page - exact).abs().max()) < 1e-9 * float(exact.abs().max())
    # the native kernel is a polynomial through the same one, good to 1e-11
    assert float((fast - page).abs().max()) < 1e-9 * float(exact.abs().max())


def test_delays_around_the_ring_are_spread_across_its_end(paths_from, monkeypatch):
    """Delays at, just before and just after a multiple of the period count / bandwidth."""
    period, copies = 64 / 1e9, FEW // 4 + 10
    delays = torch.tensor([0.0, 1e-12, period * (1 - 1e-7), 3 * period, 2.5 * period]).repeat(copies)
    paths = paths_from(torch.tensor([[1.0, 0.2, 0.1]]).repeat(5 * copies, 1), delays=delays)
    fast, page, exact = _all_ways(paths, planar_array(2, 2), 64, 1e9, monkeypatch)
    for found in (fast, page):
        assert float((found - exact).abs().max()) < 1e-9 * float(exact.abs().max())


def test_responses_are_the_channel_frequency_response(random_paths):
    paths, array = random_paths(3000), planar_array(3, 3)
    expected = paths.cfr(array, subcarriers=ofdm(1e9, 32))[:, 0]
    found = responses(coefficients(paths), paths.delay, paths.rx.to_device(paths.aoa), array, 32, 1e9)
    assert torch.allclose(found.to(torch.complex64), expected, rtol=1e-4, atol=1e-5 * float(expected.abs().max()))


def test_the_kernels_transform_and_polynomials_are_those_of_the_kernel():
    distance = torch.linspace(-6, 6, 24001, dtype=torch.float64)
    turn = (torch.arange(10) - 5).double() / 20
    direct = (torch.cos(2 * torch.pi * turn[:, None] * distance) * kernel(distance)).sum(-1) * (12 / 24000)
    assert torch.allclose(kernel_transform(10), direct, rtol=1e-9)
    fraction = torch.linspace(0, 1, 101, dtype=torch.float64)
    value = torch.zeros(101, 16, dtype=torch.float64)
    for row in kernel_polynomials():
        value = value * (2 * fraction - 1)[:, None] + row
    for tap in range(12):
        assert float((value[:, tap] - kernel(tap - 5 - fraction)).abs().max()) < 1e-10
    assert float(value[:, 12:].abs().max()) == 0.0


def test_all_taps_have_the_covariance_of_all_frequencies(random_paths):
    """The transform is unitary."""
    paths, array = random_paths(300), planar_array(3, 4)
    whole = covariance_of(paths, array, snapshots=128, bandwidth=1e9, snr_db=10, seed=2)
    taps = covariance_of(paths, array, snapshots=128, bandwidth=1e9, snr_db=10, seed=2, taps=(0.0, 1.0))
    assert torch.allclose(whole, taps, rtol=1e-9, atol=1e-12 * float(whole.abs().max()))


def test_a_tap_holds_the_path_of_its_delay(paths_from):
    """Delays on the taps do not leak: each tap is one path."""
    paths = paths_from([[1.0, 0.3, 0.0], [1.0, -0.4, 0.2]], gains=[1.0, 0.25], delays=[20e-9, 35e-9])
    array = planar_array(4, 4, "isotropic")
    x = responses(coefficients(paths), paths.delay, paths.aoa, array, 64, 1e9)
    power = delay_taps(x, 1e9).abs().square().mean(0)
    # float32 delays: 1e-7 of a tap; leakage follows
    assert torch.allclose(power[[20, 35]], torch.tensor([64.0, 16.0], dtype=torch.float64), rtol=1e-5)
    assert float(power.sum()) == pytest.approx(80.0, rel=1e-6)
    late = covariance_of(paths, array, snapshots=64, bandwidth=1e9, taps=(30e-9, 40e-9))
    assert torch.allclose(late, covariance_of(paths._map(lambda v: v[1:]), array), atol=1e-5)


def test_taps_show_one_reflection_without_the_others(paths_from):
    from rf3dgs.core.angles import angle_between
    from rf3dgs.core.grids import pinhole_grid

    directions = torch.nn.functional.normalize(torch.tensor([[1.0, 0.5, 0.0], [1.0, -0.4, 0.2]]), dim=-1)
    paths = paths_from(directions, gains=[1.0, 0.01], delays=[20e-9, 35e-9])
    grid = pinhole_grid(41, 27, 90)
    power = spectrum_of(
        paths, planar_array(8, 8), grid, method="bartlett", processing=ArrayProcessing(taps=(30e-9, 40e-9))
    ).power
    peak = grid.directions.reshape(-1, 3)[power.argmax()]
    assert float(angle_between(peak, directions[1])) < grid.spacing


def test_measured_snapshots_have_their_mean_outer_product():
    generator = torch.Generator().manual_seed(0)
    x = torch.randn(2, 3, 50, generator=generator, dtype=torch.complex64)
    expected = torch.einsum("bms,bns->bmn", x.to(torch.complex128), x.to(torch.complex128).conj()) / 50
    assert torch.allclose(covariance_of_snapshots(x), expected)
    x[0, 0, 0] = complex("nan")
    with pytest.raises(InputError, match="remove those snapshots"):
        covariance_of_snapshots(x)
    with pytest.raises(InputError, match=r"\[\*batch, element, snapshot\]"):
        covariance_of_snapshots(x[..., :0])


@pytest.mark.parametrize("sphere", [(90, 180, 3), (17, 34, 2), (2, 6, 1), (8, 8, 0)], ids=str)
def test_the_native_deposit_is_its_specification(sphere, random_paths):
    """Angles in single precision may differ by a rounding, 1e-4 of a node; sums are kept exactly."""
    assert native_core() is not None
    paths = random_paths(20_000)
    poles = torch.tensor([[0.0, 0.0, 1.0], [0.0, 0.0, -1.0], [-1.0, 0.0, 0.0], [-1.0, -1e-9, 0.0]])
    directions = torch.cat((paths.aoa[:-4], poles))
    found = deposited(directions, paths.path_gain, paths.delay, paths.aod, sphere)
    expected = deposit(directions, values_of(paths.path_gain, paths.delay, paths.aod), sphere)
    for channel in range(5):
        scale = float(expected[channel].abs().max())
        assert float((found - expected)[channel].abs().max()) < 2e-4 * scale
    assert torch.allclose(found.sum((1, 2)), expected.sum((1, 2)), rtol=1e-10)


def test_directions_that_are_none_do_not_write_past_the_sphere(random_paths):
    paths = random_paths(10)
    directions = paths.aoa.clone()
    directions[0] = float("nan")
    directions[1] = 0.0
    found = deposited(directions, paths.path_gain, paths.delay, paths.aod, (6, 12, 1))
    assert float(found[0].sum()) == pytest.approx(float(paths.path_gain.double().sum()), rel=1e-9)


THREADS = """
import hashlib, sys, torch
from rf3dgs.channel.arrays import planar_array
from rf3dgs.spectra import deposit, responses
generator = torch.Generator().manual_seed(0)
count = 60_000
directions = torch.nn.functional.normalize(torch.randn(count, 3, generator=generator), dim=-1)
gain, delay = torch.rand(count, generator=generator), 1e-7 * torch.rand(count, generator=generator)
core = responses.native_core
for threads in (1, 2, 5):
    responses.thread_count = deposit.thread_count = lambda threads=threads: threads
    x = responses.responses(gain.to(torch.complex128), delay, directions, planar_array(3, 3), 64, 1e9)
    y = deposit.deposited(directions, gain, delay, directions, (60, 120, 3))
    responses.native_core = lambda: None
    page = responses.responses(gain.to(torch.complex128), delay, directions, planar_array(3, 3), 64, 1e9)
    responses.native_core = core
    assert float((x - page).abs().max()) < 1e-9 * float(page.abs().max())
    print(hashlib.sha256(torch.view_as_real(x).numpy().tobytes() + y.numpy().tobytes()).hexdigest())
"""


@pytest.mark.parametrize("instructions", ["portable", "avx2", "avx512"])
def test_sums_over_paths_are_the_pages_and_the_same_bits_on_any_number_of_threads(instructions):
    environment = {**os.environ, "RF3DGS_ISA": instructions, "OMP_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}
    done = subprocess.run(
        [sys.executable, "-c", THREADS], capture_output=True, text=True, check=False, env=environment, timeout=120
    )
    assert done.returncode == 0, done.stderr[-2000:]
    digests = done.stdout.split()
    assert len(digests) == 3
    assert len(set(digests)) == 1
