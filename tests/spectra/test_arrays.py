import math

import pytest
import torch

from rf3dgs.channel.arrays import planar_array
from rf3dgs.channel.binning import stack_paths
from rf3dgs.channel.response import manifold
from rf3dgs.core.angles import angle_between
from rf3dgs.core.errors import InputError
from rf3dgs.core.frames import Pose
from rf3dgs.core.grids import equirect_grid, list_grid, pinhole_grid
from rf3dgs.spectra.beamformers import bartlett, capon, hann_taper, tapered
from rf3dgs.spectra.config import ArrayProcessing, Loading
from rf3dgs.spectra.covariance import covariance_of, covariance_of_spectrum
from rf3dgs.spectra.scan import array_instrument, spectrum_of

ISOTROPIC = planar_array(8, 8, "isotropic")
PATCH = planar_array(8, 8, "patch")
GRID = pinhole_grid(41, 27, 90)


def _peak(power, grid):
    return grid.directions.reshape(-1, 3)[power.reshape(-1).argmax()]


def _random_covariance(count, rank, seed=0):
    generator = torch.Generator().manual_seed(seed)
    x = torch.randn(count, rank, generator=generator, dtype=torch.complex128)
    return x @ x.mH / rank


@pytest.mark.parametrize("method", ["bartlett", "tapered", "capon"])
def test_the_peak_is_the_true_direction(method, paths_from):
    for direction in ([1.0, 0.0, 0.0], [1.0, 0.5, 0.2], [1.0, -0.4, -0.3]):
        source = torch.nn.functional.normalize(torch.tensor(direction), dim=-1)
        power = spectrum_of(paths_from(source), ISOTROPIC, GRID, method=method).power
        assert float(angle_between(_peak(power, GRID), source)) < 0.8 * GRID.spacing


@pytest.mark.parametrize("method", ["bartlett", "tapered", "capon"])
def test_a_source_to_the_left_lights_the_left_half(method, paths_from):
    rx = Pose.from_yaw([3.0, 4.0, 1.0], 1.0)
    power = spectrum_of(paths_from(rx.to_world(torch.tensor([0.8, 0.6, 0.0])), rx=rx), PATCH, GRID, method=method).power
    assert float(_peak(power, GRID)[1]) > 0.5
    assert float(power[:, :20].sum()) > 1.5 * float(power[:, 21:].sum())


def test_a_unit_path_peaks_at_one(paths_from):
    grid = list_grid(torch.tensor([[1.0, 0.0, 0.0], [0.8, 0.6, 0.0]]))
    for array, expected in ((ISOTROPIC, 1.0), (PATCH, 0.64)):
        for method in ("bartlett", "tapered", "capon"):
            power = spectrum_of(paths_from([0.8, 0.6, 0.0]), array, grid, method=method).power
            assert float(power[0, 1]) == pytest.approx(expected, rel=2e-3), (array.pattern, method)


@pytest.mark.parametrize("array", [ISOTROPIC, PATCH, planar_array(4, 4, "tr38901")], ids=lambda a: a.pattern)
def test_capon_of_white_noise_is_flat(array):
    power = capon(3.0 * torch.eye(array.count), manifold(array, GRID.directions), Loading(0.0))
    assert torch.allclose(power, torch.full_like(power, 3.0 / array.count))


def test_capon_is_the_papers_formula(random_paths):
    R = _random_covariance(16, 40)
    array = planar_array(4, 4, "isotropic")
    A = manifold(array, GRID.directions.double()).reshape(-1, 16)
    expected = 1.0 / (A.conj() * (torch.linalg.inv(R) @ A.mT).mT).sum(-1).real
    assert torch.allclose(capon(R, A, Loading(0.0)), expected)


def test_capon_resolves_two_sources_that_bartlett_does_not(paths_from):
    half = math.radians(4.0)
    sources = [[math.cos(half), math.sin(half), 0.0], [math.cos(half), -math.sin(half), 0.0]]
    angle = torch.linspace(-0.2, 0.2, 201)
    grid = list_grid(torch.stack((torch.cos(angle), torch.sin(angle), torch.zeros(201)), -1))
    paths = paths_from(sources, delays=[3e-8, 3.7e-8])

    def dip(method):
        power = spectrum_of(paths, ISOTROPIC, grid, method=method).power[0]
        return 10 * math.log10(float(power.max() / power[100]))

    assert dip("bartlett") < 1.0
    assert dip("capon") > 10.0


def test_tapering_lowers_the_side_lobes_and_widens_the_main_lobe(paths_from):
    angle = torch.linspace(0.0, 1.2, 400)
    grid = list_grid(torch.stack((torch.cos(angle), torch.sin(angle), torch.zeros(400)), -1))
    R = covariance_of(paths_from([1.0, 0.0, 0.0]), ISOTROPIC)
    A = manifold(ISOTROPIC, grid.directions[0])
    plain, hann = bartlett(R, A), tapered(R, A, hann_taper(ISOTROPIC))
    assert 10 * math.log10(float(plain[angle > math.radians(15)].max())) > -14.0
    assert 10 * math.log10(float(hann[angle > math.radians(27)].max())) < -28.0
    assert array_instrument(ISOTROPIC, "tapered").lobe > 1.3 * array_instrument(ISOTROPIC, "bartlett").lobe


def test_half_power_width_of_eight_elements_is_thirteen_degrees():
    instrument = array_instrument(ISOTROPIC, "bartlett")
    assert math.degrees(instrument.lobe) == pytest.approx(12.8, abs=0.2)
    assert instrument.name == "8x8 isotropic bartlett"


def test_aliases_name_the_same_spectra(random_paths):
    paths = random_paths(20)
    for alias, method in (("cbf", "bartlett"), ("tcbf", "tapered"), ("mvdr", "capon")):
        first, second = (spectrum_of(paths, PATCH, GRID, method=name) for name in (alias, method))
        assert torch.equal(first.power, second.power)
        assert first.method == method
        assert first.delay is None


def test_turning_the_world_turns_the_array_spectrum(random_paths):
    paths = random_paths(30, rx=Pose.look_at([1.0, 2.0, 1.0], [4.0, 1.0, 2.0]))
    yaw = 1.1
    turned = paths._map(lambda value: value.clone(), rx=paths.rx.turned(yaw))
    turned.aoa_azimuth.add_(yaw)
    how = ArrayProcessing(snapshots=None)
    first, second = (spectrum_of(p, PATCH, GRID, method="capon", processing=how).gain_db for p in (paths, turned))
    assert torch.allclose(first, second, atol=0.01)


def test_capon_is_stable_at_a_condition_of_1e11():
    count = 64
    A = manifold(ISOTROPIC, GRID.directions.double()).reshape(-1, count)
    source = manifold(ISOTROPIC, torch.tensor([0.8, 0.6, 0.0], dtype=torch.float64))
    noise = count * 1e-11
    R = source[:, None] * source.conj() + noise * torch.eye(count)
    overlap = (A.conj() @ source).abs().square()
    expected = noise / (count - overlap / (noise + count))
    assert float(torch.linalg.cond(R)) > 5e10
    power = capon(R, A, Loading(0.0))
    assert torch.allclose(10 * torch.log10(power), 10 * torch.log10(expected), atol=0.05)


def test_uncorrelated_and_coherent_covariance_agree_for_resolved_delays(paths_from):
    paths = paths_from([[1.0, 0.2, 0.0], [1.0, -0.3, 0.3]], gains=[1.0, 0.5], delays=[2e-8, 9e-8])
    incoherent = covariance_of(paths, PATCH)
    coherent = covariance_of(paths, PATCH, snapshots=280, bandwidth=2e9)
    assert torch.allclose(incoherent, coherent, atol=1e-3 * float(incoherent.abs().max()))


def test_one_snapshot_has_rank_one_and_many_have_more(random_paths):
    paths = random_paths(100)
    assert int(torch.linalg.matrix_rank(covariance_of(paths, PATCH, snapshots=1), hermitian=True)) == 1
    assert int(torch.linalg.matrix_rank(covariance_of(paths, PATCH, snapshots=256), hermitian=True)) > 30


def test_noise_has_the_stated_level_and_repeats_with_its_seed(random_paths):
    paths = random_paths(50)
    clean = covariance_of(paths, PATCH)
    noisy = covariance_of(paths, PATCH, snr_db=10)
    level = float((noisy - clean).diagonal().real.mean() / clean.diagonal().real.mean())
    assert level == pytest.approx(0.1)
    draws = [covariance_of(paths, PATCH, snapshots=4000, snr_db=0, seed=seed) for seed in (1, 1, 2)]
    quiet = covariance_of(paths, PATCH, snapshots=4000)
    assert torch.equal(draws[0], draws[1])
    assert not torch.equal(draws[0], draws[2])
    added = float((draws[0] - quiet).diagonal().real.mean() / quiet.diagonal().real.mean())
    assert added == pytest.approx(1.0, abs=0.05)


def test_a_spectrums_covariance_is_that_of_its_paths(random_paths):
    paths = random_paths(2000)
    sphere = equirect_grid(180, 90)
    implied = covariance_of_spectrum(spectrum_of(paths, grid=sphere), PATCH)
    true = covariance_of(paths, PATCH)
    assert float((implied - true).norm() / true.norm()) < 0.03


def test_receivers_are_batched(random_paths):
    paths = stack_paths([random_paths(30, seed=seed) for seed in (0, 1)])
    spectrum = spectrum_of(paths, PATCH, GRID, method="mvdr")
    assert spectrum.power.shape == (2, 27, 41)
    assert torch.equal(spectrum.power[0], spectrum_of(random_paths(30), PATCH, GRID, method="mvdr").power)
    assert covariance_of(paths, PATCH).shape == (2, 64, 64)


def test_no_paths_give_no_power(random_paths):
    for method in ("bartlett", "tapered", "capon"):
        assert float(spectrum_of(random_paths(0), PATCH, GRID, method=method).power.abs().sum()) == 0.0


def test_a_patch_sees_nothing_behind_itself(paths_from):
    sphere = equirect_grid(36, 18)
    power = spectrum_of(paths_from([1.0, 0.3, 0.0]), PATCH, sphere, method="capon").power
    assert float(power[sphere.directions[..., 0] < -1e-6].abs().max()) == 0.0


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"method": "bartlett"}, "needs an array"),
        ({"array": PATCH, "method": "esprit"}, "method must be one of ideal, bartlett, tapered, capon, music"),
        ({"array": PATCH, "method": "capon", "lobe": 0.1}, "lobe belongs to"),
        (
            {"array": PATCH, "method": "capon", "processing": ArrayProcessing(snapshots=0)},
            "snapshots must be at least 1",
        ),
        ({"array": PATCH, "grid": None}, "needs a grid"),
    ],
)
def test_wrong_arguments_are_told(random_paths, arguments, message):
    with pytest.raises(InputError, match=message):
        spectrum_of(random_paths(2), **{"grid": GRID, **arguments})


def test_a_singular_covariance_without_loading_is_refused(paths_from):
    R = covariance_of(paths_from([1.0, 0.0, 0.0]), PATCH)
    with pytest.raises(
        InputError, match=r"with Loading\(amount=0.0, rule='relative'\); use a larger one, such as Loading\(1e-3\)"
    ):
        capon(R, manifold(PATCH, GRID.directions), Loading(0.0))
    with pytest.raises(InputError, match="R must be"):
        bartlett(R[:3], manifold(PATCH, GRID.directions))
    with pytest.raises(InputError, match="NaN or infinite"):
        bartlett(R * float("nan"), manifold(PATCH, GRID.directions))
