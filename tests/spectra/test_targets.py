"""Laws of pictures of an array turned back into ideal spectra: at four sides of one place, waves that are known."""

import math
from dataclasses import replace

import pytest
import torch

from rf3dgs.channel.arrays import planar_array
from rf3dgs.core.angles import direction_of
from rf3dgs.core.errors import InputError
from rf3dgs.core.frames import Pose
from rf3dgs.core.grids import equirect_grid, pinhole_grid
from rf3dgs.spectra.beamformers import bartlett, capon, hann_taper, tapered
from rf3dgs.spectra.config import ArrayProcessing, Loading
from rf3dgs.spectra.covariance import plane_waves
from rf3dgs.spectra.inversion import Panel, lags_of
from rf3dgs.spectra.scan import array_instrument, spectrum_of
from rf3dgs.spectra.spectrum import Spectrum
from rf3dgs.spectra.steering import PlanarSteering
from rf3dgs.spectra.targets import Waves, ideal_targets, places_of
from rf3dgs.spectra.yaws import at_yaws

ARRAY = planar_array(8, 8, "patch")
PICTURE = pinhole_grid(40, 32, 110)
SPHERE = equirect_grid(72, 36)
YAWS = (0.0, math.pi / 2, math.pi, -math.pi / 2)
LOBE = math.radians(7.5)
FEW = ArrayProcessing(snapshots=None, snr_db=20.0)


def towards(azimuth: float, elevation: float) -> torch.Tensor:
    return direction_of(torch.tensor(math.radians(90 - elevation)), torch.tensor(math.radians(azimuth)))


POINTS = torch.stack([towards(10, 5), towards(28, -8), towards(-140, 12)])
GAINS = torch.tensor([1.0, 0.03, 0.02])


def room_paths(paths_from, ceiling: float = 1.0):
    """Two points near each other, one behind, and a room that sends more from one side than from the other."""
    directions = SPHERE.directions.reshape(-1, 3)
    diffuse = 0.05 * SPHERE.solid_angle.reshape(-1) / (4 * math.pi) * (1.0 + 2.0 * (directions[:, 1] > 0))
    diffuse = diffuse * torch.where(directions[:, 2] > math.sin(math.radians(50)), ceiling, 1.0)
    rx = Pose(torch.tensor([3.0, 4.0, 1.0]))
    return paths_from(torch.cat((POINTS, directions)), torch.cat((GAINS, diffuse)), rx=rx)


def pictures_of(paths, method: str, processing: ArrayProcessing = FEW) -> Spectrum:
    return spectrum_of(at_yaws(paths, YAWS), ARRAY, PICTURE, method=method, processing=processing)


def level_at(spectrum: Spectrum, direction: torch.Tensor) -> float:
    """Level [dB] of the pixel nearest to a direction."""
    pixel = int((spectrum.grid.directions.reshape(-1, 3) @ direction).argmax())
    return float(spectrum.gain_db.reshape(-1)[pixel])


@pytest.mark.parametrize("method", ["bartlett", "tapered", "capon"])
def test_between_the_pixels_a_picture_is_its_polynomial(method):
    R = plane_waves(GAINS, POINTS, ARRAY) + 1e-3 * torch.eye(ARRAY.count)
    scan = {"bartlett": bartlett, "capon": capon, "tapered": lambda R, A: tapered(R, A, hann_taper(ARRAY))}[method]
    power = (scan(R, PlanarSteering(ARRAY, PICTURE.directions)) / ARRAY.peak_gain).float()
    pose = Pose(torch.zeros(3))
    picture = Spectrum(power, PICTURE, pose, 60e9, array_instrument(ARRAY, method), method)
    level = PlanarSteering(ARRAY, POINTS[:2]).of_sums(lags_of(picture, ARRAY))
    exact = scan(R, PlanarSteering(ARRAY, POINTS[:2]))
    # Pixels are float32, and Capon's peaks are 40 dB above what lies half a pixel beside them.
    assert float((10 * torch.log10((1 / level if method == "capon" else level) / exact)).abs().max()) < 0.2


@pytest.mark.parametrize("method", ["bartlett", "tapered", "capon"])
def test_one_plane_wave_is_predicted_as_spectrum_of_shows_it(method, paths_from):
    paths = paths_from(POINTS[:1], [1e-6], rx=Pose(torch.zeros(3)))
    loading = {"loading": Loading(1e-2)} if method == "capon" else {}
    how = ArrayProcessing(snapshots=None, snr_db=10.0, **loading)
    picture = spectrum_of(paths, ARRAY, PICTURE, method=method, processing=how)
    panel = Panel.of(picture, lags_of(picture, ARRAY), POINTS[:1], torch.ones(1))
    shown = panel.sides(panel.covariance(torch.tensor([1e-6]).double(), picture.noise * ARRAY.peak_gain))[0]
    assert picture.noise is not None
    assert float((10 * torch.log10(shown / panel.level)).abs()) < 0.02


@pytest.mark.parametrize(("method", "limit_db"), [("capon", 1.0), ("bartlett", 2.0), ("tapered", 3.0)])
def test_the_powers_of_sources_and_of_the_room_come_back(method, limit_db, paths_from):
    paths = room_paths(paths_from)
    truth = spectrum_of(paths, None, SPHERE, lobe=LOBE)
    found = ideal_targets(pictures_of(paths, method), SPHERE, lobe=LOBE)
    assert found.method == "ideal"
    assert found.instrument.array is None
    # The taper's lobe is 18 degrees: what stands that far beside a source 15 dB stronger is lost in it.
    for point in POINTS if method != "tapered" else POINTS[::2]:
        # Six steps leave a little of the weaker of two neighbours to the smooth part, the more the wider the lobe.
        assert abs(level_at(found, point) - level_at(truth, point)) < limit_db
    beside = found.looked[0] & (torch.stack([SPHERE.directions @ point for point in POINTS]).amax(0) < 0.9)
    error = (found.gain_db[0] - truth.gain_db)[beside]
    assert float(error.mean().abs()) < 0.5
    assert float(error.std()) < 2.0


def test_levels_do_not_depend_on_what_capon_loads(paths_from):
    paths = room_paths(paths_from)
    found = []
    for amount in (1e-3, 3e-2):
        how = replace(FEW, loading=Loading(amount))
        found.append(ideal_targets(pictures_of(paths, "capon", how), SPHERE, lobe=LOBE))
    for point in POINTS:
        assert abs(level_at(found[0], point) - level_at(found[1], point)) < 0.3


def test_noise_that_is_not_known_is_found(paths_from):
    paths = room_paths(paths_from)
    pictures = pictures_of(paths, "capon")
    known, unknown = (ideal_targets(one, SPHERE, lobe=LOBE) for one in (pictures, replace(pictures, noise=None)))
    for point in POINTS:
        assert abs(level_at(known, point) - level_at(unknown, point)) < 0.5


def test_what_no_picture_shows_is_not_told(paths_from):
    pictures = pictures_of(room_paths(paths_from), "capon")
    whole = ideal_targets(pictures, SPHERE, lobe=LOBE)
    ahead = ideal_targets(pictures[:1], SPHERE, lobe=LOBE)
    up = SPHERE.directions[..., 2] > math.sin(math.radians(60))
    assert whole.floor is not None
    assert bool(torch.isinf(whole.floor[0][up]).all())
    assert float(whole.power[0][up].sum()) == 0.0
    behind = SPHERE.directions[..., 0] < 0
    assert not bool(ahead.looked[0][behind].any())
    assert float(whole.looked[0][behind].float().mean()) > 0.3


def test_a_narrow_field_of_view_hides_what_is_beyond(paths_from):
    pictures = pictures_of(room_paths(paths_from), "capon")
    narrow = replace(pictures, instrument=array_instrument(ARRAY, "capon", fov=math.radians(40)))
    looked = ideal_targets(narrow, SPHERE, lobe=LOBE).looked[0]
    high = SPHERE.directions[..., 2].abs() > math.sin(math.radians(20.1))
    assert not bool(looked[high].any())
    assert bool(looked[~high].any())


def test_a_good_start_stays(paths_from):
    paths = room_paths(paths_from)
    pictures = pictures_of(paths, "capon")
    directions = torch.cat((SPHERE.directions.reshape(-1, 3), POINTS))
    start = Waves(directions, torch.cat((paths.path_gain[len(POINTS) :], GAINS)).double())
    found = ideal_targets(pictures, SPHERE, lobe=LOBE, start=[start])
    for point in POINTS:
        assert abs(level_at(found, point) - level_at(spectrum_of(paths, None, SPHERE, lobe=LOBE), point)) < 0.2


def test_positions_within_a_millimetre_are_one_place():
    positions = torch.tensor([[0.0, 0, 0], [1, 0, 0], [0, 0.0005, 0], [1, 0, 0], [2, 0, 0]])
    assert [group.tolist() for group in places_of(positions)] == [[0, 2], [1, 3], [4]]


def test_what_cannot_be_inverted_is_refused(paths_from):
    paths = room_paths(paths_from)
    pictures = pictures_of(paths, "capon")
    ideal = spectrum_of(at_yaws(paths, YAWS), None, SPHERE, lobe=LOBE)
    with pytest.raises(InputError, match="say nothing of their array"):
        ideal_targets(ideal)
    with pytest.raises(InputError, match="must be by one of bartlett, tapered, capon; got 'music'"):
        ideal_targets(replace(pictures, method="music"))
    with pytest.raises(InputError, match="targets are whole spheres"):
        ideal_targets(pictures, PICTURE)
    with pytest.raises(InputError, match="waves for each of the 1 places; got 0"):
        ideal_targets(pictures, SPHERE, start=[])
