"""MUSIC, the number of sources, averaging and loading: what they are known to do."""

import math
from dataclasses import replace

import pytest
import torch

from rf3dgs.channel.arrays import planar_array
from rf3dgs.core.angles import angle_between
from rf3dgs.core.errors import InputError
from rf3dgs.core.grids import list_grid, pinhole_grid
from rf3dgs.spectra.beamformers import capon, music
from rf3dgs.spectra.config import ArrayProcessing, Loading
from rf3dgs.spectra.covariance import covariance_of
from rf3dgs.spectra.decorrelation import forward_backward, smoothed
from rf3dgs.spectra.loading import loaded
from rf3dgs.spectra.order import source_count
from rf3dgs.spectra.peaks import find_peaks
from rf3dgs.spectra.scan import array_instrument, spectrum_of
from rf3dgs.spectra.steering import PlanarSteering

ARRAY = planar_array(8, 8, "isotropic")
LINE = planar_array(1, 10, "isotropic")
GRID = pinhole_grid(61, 41, 90)
NOISY = ArrayProcessing(snr_db=20)


def _in_azimuth(*degrees):
    angle = torch.deg2rad(torch.tensor(degrees, dtype=torch.float64))
    return torch.stack((torch.cos(angle), torch.sin(angle), torch.zeros_like(angle)), -1).float()


def _cut(low, high, count):
    return list_grid(_in_azimuth(*torch.linspace(low, high, count).tolist()))


def _dip_db(power):
    """How far the middle of a cut lies below the lower of the two highest points on either side."""
    middle = len(power) // 2
    least = min(float(power[:middle].max()), float(power[middle + 1 :].max()))
    return 10 * math.log10(least / float(power[middle]))


def test_music_resolves_what_bartlett_does_not(paths_from):
    """Two sources a third of the Rayleigh width (2 / 10 rad) apart, at 20 dB."""
    paths = paths_from(_in_azimuth(2.0, -2.0), delays=[3e-8, 4.4e-8])
    cut = _cut(-10, 10, 201)
    shown = {
        method: _dip_db(spectrum_of(paths, LINE, cut, method=method, processing=NOISY).power[0])
        for method in ("bartlett", "music")
    }
    assert shown["bartlett"] < 0.1
    assert shown["music"] > 10


def test_music_finds_as_many_directions_as_there_are_sources(paths_from):
    directions = _in_azimuth(-25.0, -4.0, 12.0, 31.0)
    paths = paths_from(directions, gains=[1.0, 0.3, 0.1, 0.5], delays=[2e-8, 3.1e-8, 4.3e-8, 6.2e-8])
    counted = ArrayProcessing(snr_db=20, sources="mdl")
    spectrum = spectrum_of(paths, ARRAY, GRID, method="music", processing=counted)
    found, _ = find_peaks(spectrum.power[:, :], GRID, count=4, separation=math.radians(6))
    nearest = angle_between(directions[:, None].expand(4, 4, 3), found[None].expand(4, 4, 3)).min(1).values
    assert float(nearest.rad2deg().max()) < 1.0


def test_mdl_counts_independent_sources_and_none_in_noise(paths_from):
    generator = torch.Generator().manual_seed(0)
    noise = torch.randn(20, 64, 400, generator=generator, dtype=torch.complex128)
    R = noise @ noise.mH / 400
    assert source_count(R, 400).tolist() == [0] * 20
    assert int(source_count(R[0], 400, "aic")) <= 2
    for count in (1, 2, 4):
        paths = paths_from(
            _in_azimuth(*(15.0 * torch.arange(count)).tolist()), delays=[2e-8 + 5e-9 * i for i in range(count)]
        )
        R = covariance_of(paths, ARRAY, snapshots=256, snr_db=10)
        assert int(source_count(R, 256)) == count


def test_the_delay_taps_that_are_kept_are_the_snapshots(random_paths):
    """41 taps of 0.5 ns in 20 ns: sources are counted from 41 snapshots, not from 256, which would find more."""
    paths, array, window = random_paths(300), planar_array(4, 4), (2e-8, 4e-8)
    spectrum = spectrum_of(
        paths, array, GRID, method="music", processing=ArrayProcessing(taps=window, snr_db=10, sources="aic")
    )
    R = covariance_of(paths, array, snapshots=256, taps=window, snr_db=10)
    count = int(source_count(R, 41, "aic"))
    assert count < int(source_count(R, 256, "aic"))
    assert torch.equal(spectrum.power, music(R, PlanarSteering(array, GRID.directions), count).float())


def test_aic_never_finds_fewer_than_mdl(random_paths):
    for seed in range(5):
        R = covariance_of(random_paths(6, seed=seed), ARRAY, snapshots=256, snr_db=20, seed=seed)
        assert int(source_count(R, 256, "aic")) >= int(source_count(R, 256, "mdl"))


def test_coherent_sources_are_lost_without_smoothing_and_found_with_it(paths_from):
    """Two copies of one wave with the same delay: rank one, until subarrays are averaged."""
    directions = _in_azimuth(14.0, -10.0)
    paths = paths_from(directions, delays=[3e-8, 3e-8])
    R = covariance_of(paths, LINE, snapshots=64)
    assert int(torch.linalg.matrix_rank(R, hermitian=True, rtol=1e-9)) == 1
    averaged, part = smoothed(R, LINE, 1, 6)
    assert int(torch.linalg.matrix_rank(averaged, hermitian=True, rtol=1e-9)) == 2
    cut = _cut(-40, 40, 801)
    at = [int((angle + 40) * 10) for angle in (14.0, -10.0)]
    plain = music(R, PlanarSteering(LINE, cut.directions[0]), 2)
    smooth = music(averaged, PlanarSteering(part, cut.directions[0]), 2)
    assert float(plain[at].max()) < 1e3
    assert float(smooth[at].min()) > 1e6
    how = ArrayProcessing(snapshots=64, subarray=(1, 6), sources=2)
    spectrum = spectrum_of(paths, LINE, cut, method="music", processing=how)
    assert torch.allclose(spectrum.power[0, at].log10(), smooth[at].log10().float(), atol=1.0)
    assert spectrum.instrument == array_instrument(part, "music")


def test_forward_backward_alone_separates_two_coherent_sources(paths_from):
    """In quadrature at the middle of the array: their conjugates then differ from them by more than a phase."""
    paths = paths_from(_in_azimuth(14.0, -10.0), delays=[3e-8, 3e-8])
    paths.coeff[1] *= 1j
    R = forward_backward(covariance_of(paths, LINE, snapshots=64))
    assert int(torch.linalg.matrix_rank(R, hermitian=True, rtol=1e-9)) == 2


def test_forward_backward_is_hermitian_and_persymmetric_and_keeps_power(random_paths):
    R = covariance_of(random_paths(50), planar_array(3, 5, "patch"), snapshots=8)
    both = forward_backward(R)
    assert torch.allclose(both, both.mH)
    assert torch.allclose(both.conj().flip(-1, -2), both)
    assert float(both.diagonal().real.sum()) == pytest.approx(float(R.diagonal().real.sum()), rel=1e-12)
    assert torch.equal(forward_backward(both), both)
    assert not torch.allclose(R, both)


def test_forward_backward_and_smoothing_leave_uncorrelated_waves_as_they_are(random_paths):
    paths, array = random_paths(200), planar_array(6, 5, "patch")
    R = covariance_of(paths, array)
    scale = float(R.abs().max())
    assert float((forward_backward(R) - R).abs().max()) < 1e-12 * scale
    averaged, part = smoothed(R, array, 4, 3)
    assert part.label == "4x3 patch"
    assert float((averaged - covariance_of(paths, part)).abs().max()) < 1e-12 * scale


def test_loading_rules_add_what_they_say(random_paths):
    R = covariance_of(random_paths(30), planar_array(3, 3)).expand(2, 9, 9) * torch.tensor([1.0, 4.0])[:, None, None]
    mean = R.diagonal(dim1=-2, dim2=-1).real.mean(-1)
    for rule, expected in (
        (Loading(), 0.001 * mean),
        (Loading(0.01), 0.01 * mean),
        (Loading(3e-9, "absolute"), torch.full_like(mean, 3e-9)),
        (Loading(20.0, "snr"), 0.01 * mean),
    ):
        added = (loaded(R, rule) - R).diagonal(dim1=-2, dim2=-1)
        assert torch.allclose(added.real, expected[:, None].expand(2, 9), rtol=1e-6)


def test_absolute_loading_is_added_noise(random_paths):
    paths, array = random_paths(30), planar_array(3, 3)
    steering = PlanarSteering(array, GRID.directions)
    level = float(covariance_of(paths, array).diagonal().real.mean()) * 0.01
    loaded_clean = capon(covariance_of(paths, array), steering, Loading(level, "absolute"))
    noisy = capon(covariance_of(paths, array, snr_db=20), steering, Loading(0.0))
    assert torch.allclose(loaded_clean, noisy, rtol=1e-6)


def test_more_loading_lets_capon_approach_bartlett(paths_from):
    """Without end the weights become those of the delay-and-sum beam; the picture is then flat at the loading / M."""
    paths = paths_from(_in_azimuth(5.0, -20.0), delays=[3e-8, 5e-8])
    R, steering = covariance_of(paths, LINE, snapshots=64), PlanarSteering(LINE, _cut(-60, 60, 121).directions[0])
    power = capon(R, steering, Loading(1e6))
    assert torch.allclose(power, power.mean().expand_as(power), rtol=1e-4)


@pytest.mark.parametrize(
    ("method", "choices", "message"),
    [
        ("capon", {"sources": 2}, "sources belong to method \"music\"; 'capon'"),
        ("bartlett", {"loading": Loading(0.1)}, "loading belongs to method \"capon\"; 'bartlett' inverts nothing"),
        ("music", {"snapshots": None}, "to count sources takes snapshots"),
        ("music", {"snapshots": 64}, "more snapshots than the 64 elements; got 64"),
        ("music", {"taps": (0.0, 1e-8)}, "more snapshots than the 64 elements; got 21"),
        ("music", {"sources": 64}, "between 0 and 63"),
        ("music", {"sources": "bic"}, "sources must be a number, .mdl. or .aic.; got .bic."),
        ("capon", {"averaging": "backward"}, "averaging must be one of forward, forward-backward"),
        ("capon", {"loading": 1e-3}, r"loading must be a Loading, such as Loading\(1e-3\); got 0.001"),
        ("capon", {"bandwidth": 0.0}, "bandwidth must be a positive number of Hz; got 0.0"),
        ("capon", {"subarray": (9, 2)}, "1 to 8 rows and 1 to 8 columns of the 8x8 isotropic array; got 9x2"),
        ("capon", {"taps": (1e-3, 2e-3)}, "no delay tap lies between 0.001 and 0.002 s"),
        ("capon", {"taps": (0.0, 1e-8), "snapshots": None}, "taps are made of coherent responses"),
    ],
)
def test_wrong_choices_are_told(random_paths, method, choices, message):
    with pytest.raises(InputError, match=message):
        spectrum_of(random_paths(3), ARRAY, GRID, method=method, processing=ArrayProcessing(**choices))


@pytest.mark.parametrize(
    ("amount", "rule", "message"),
    [(1.0, "median", "rule must be one of relative, absolute, snr"), (-1.0, "relative", "not negative"),
     (float("nan"), "snr", "must be finite")],
)  # fmt: skip
def test_impossible_loadings_are_refused(amount, rule, message):
    with pytest.raises(InputError, match=message):
        Loading(amount, rule)


@pytest.mark.parametrize("method", ["bartlett", "tapered", "capon", "music"])
def test_louder_paths_give_a_louder_picture_and_music_the_same(method, random_paths):
    paths = random_paths(40)
    louder = paths._map(lambda value: 10.0 * value if value.is_complex() else value)
    how = replace(NOISY, sources=9 if method == "music" else None)
    first, second = (
        spectrum_of(one, ARRAY, GRID, method=method, processing=how).power.double() for one in (paths, louder)
    )
    assert torch.allclose(second, first * (1.0 if method == "music" else 100.0), rtol=1e-4)


def test_delaying_every_path_changes_no_spectrum(random_paths):
    """A common phase per frequency cancels in the covariance."""
    paths = random_paths(40)
    late = paths._map(lambda value: value)
    late.delay.add_(2.0**-25)  # exact in single precision beside the delays of these paths, to a few 1e-15 s
    for method in ("bartlett", "capon"):
        first, second = (spectrum_of(one, ARRAY, GRID, method=method).gain_db for one in (random_paths(40), late))
        # 4e-15 s turn a carrier of 60 GHz by 1.5e-3 rad, which shows most in the valleys
        assert float((first - second).abs().median()) < 0.05
