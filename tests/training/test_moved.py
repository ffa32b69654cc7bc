"""A mirror model fitted at one place of the transmitter, asked about another: the shoebox tracer is the truth."""

import math
from dataclasses import replace

import pytest
import torch

from rf3dgs.channel.paths import Paths
from rf3dgs.core.angles import angle_between
from rf3dgs.core.errors import InputError
from rf3dgs.core.frames import Pose
from rf3dgs.core.grids import equirect_grid
from rf3dgs.field.radiance import Surface
from rf3dgs.field.radio_field import RadioField
from rf3dgs.propagation.room import shoebox
from rf3dgs.spectra.scan import spectrum_of
from rf3dgs.spectra.spectrum import Spectrum
from rf3dgs.splats.gaussians import Gaussians
from rf3dgs.splats.surface import sample_mesh
from rf3dgs.training.config import RadioConfig
from rf3dgs.training.radio import fit_radio
from rf3dgs.training.refine import refine_field

SIZE = (9.0, 7.0, 3.2)
HERE, THERE = Pose([2.1, 1.7, 2.6]), Pose([6.9, 4.8, 2.2])
GAMMA_DB = (-6.0, -9.0, -12.0, -7.0, -10.0, -8.0)
LOW, HIGH = (0.7, 0.7, 0.8), (8.3, 6.3, 2.2)


def traced(tx: Pose, pose: Pose) -> Paths:
    return shoebox(SIZE, tx, pose, 60e9, 2, [-(10 ** (level / 20)) for level in GAMMA_DB])


def measured(tx: Pose, pose: Pose) -> Spectrum:
    """Paths of at most two reflections through a lobe of 4 degrees, over a haze of power from everywhere."""
    spectrum = spectrum_of(traced(tx, pose), None, equirect_grid(180, 90), lobe=math.radians(4.0))
    return replace(spectrum, power=spectrum.power + 3e-5 * spectrum.power.amax((-2, -1), keepdim=True))


def room() -> Gaussians:
    corner = [[SIZE[axis] if i >> axis & 1 else 0.0 for axis in range(3)] for i in range(8)]
    quads = ((0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3))
    faces = [triangle for a, b, c, d in quads for triangle in ((a, b, c), (a, c, d))]
    return sample_mesh(torch.tensor(corner), torch.tensor(faces), spacing=0.3, thickness=0.01)


@pytest.fixture(scope="module")
def field() -> RadioField:
    return fit_radio(room(), measured(HERE, Pose.scatter((LOW, HIGH), 16, 0)), RadioConfig(model="mirror"))


@pytest.fixture(scope="module")
def moved(field) -> RadioField:
    return field.moved_to(THERE)


def compared(field: RadioField, tx: Pose, pose: Pose) -> tuple[float, float, float, float]:
    """Share of the paths within 25 dB of the strongest that no ray is within 1 degree and 1 ns of; of the others the
    median errors of angle [deg], delay [ps] and level [dB]."""
    truth, found = traced(tx, pose), field.paths(pose, strongest=60, parts="sources")
    lost, errors = 0, []
    for number in range(len(pose)):
        gain = truth.path_gain[number]
        for path in torch.nonzero(gain > 3e-3 * gain.max()).squeeze(-1).tolist():
            angle = angle_between(found.aoa[number], truth.aoa[number, path].expand_as(found.aoa[number]))
            late = (found.delay[number] - truth.delay[number, path]).abs()
            good = found.valid[number] & (angle < math.radians(1.0)) & (late < 1e-9)
            if not bool(good.any()):
                lost += 1
                continue
            best = int(torch.where(good, angle, torch.inf).argmin())
            level_db = 10 * torch.log10(found.path_gain[number, best] / gain[path])
            errors.append((math.degrees(float(angle[best])), 1e12 * float(late[best]), abs(float(level_db))))
    median = torch.tensor(errors).median(0).values.tolist()
    return lost / (lost + len(errors)), *median


def test_mirror_paths_at_the_new_place_are_as_right_as_where_it_was_fitted(field, moved):
    pose = Pose.scatter((LOW, HIGH), 10, 9)
    lost, angle, delay, level_db = compared(moved, THERE, pose)
    # Planes are refined on peaks of pixels of 2 degrees; none of them lies nearer than a tenth of that.
    assert lost < 0.02
    assert angle < 0.2
    assert delay < 100.0
    assert level_db < 1.0
    home = compared(field, HERE, pose)
    assert angle < 2 * home[1] + 0.05


def test_moving_back_finds_the_sources_of_the_fit(field, moved):
    back = moved.moved_to(HERE)
    pose = Pose.scatter((LOW, HIGH), 6, 3)
    trained, again = (one.paths(pose, strongest=12, parts="sources") for one in (field, back))
    torch.testing.assert_close(again.delay, trained.delay)
    torch.testing.assert_close(again.path_gain, trained.path_gain)
    # Labels of planes are made whole during the fit, after its shadows were baked.
    assert float((back.surface.visibility - field.surface.visibility).abs().mean()) < 0.02


def test_a_moved_field_shows_the_new_spectrum_better_than_it_did_before(field, moved):
    truth = measured(THERE, Pose.scatter((LOW, HIGH), 4, 5))
    shown, before = moved.render(truth.pose, truth.grid, csi=False), field.render(truth.pose, truth.grid, csi=False)
    error, stale = ((one.path_gain / truth.path_gain).log10().abs().mean() * 10 for one in (shown, before))
    assert float(error) < 0.7
    assert float(error) < 0.5 * float(stale)
    peak = angle_between(
        *(
            one.directions.reshape(4, -1, 3)[torch.arange(4), one.power.reshape(4, -1).argmax(-1)]
            for one in (shown, truth)
        )
    )
    assert math.degrees(float(peak.max())) < 2.0


def test_measurements_at_the_new_place_make_the_moved_field_better_elsewhere(moved):
    learned, truth = (measured(THERE, Pose.scatter((LOW, HIGH), count, seed)) for count, seed in ((8, 1), (4, 5)))
    better = refine_field(moved, learned)

    def error_db(field: RadioField) -> float:
        shown = field.render(truth.pose, truth.grid, csi=False)
        return float((shown.gain_db - truth.gain_db).square().mean().sqrt())

    # The moved field is 2.5 dB off (4.5 with one ambient level for all surfaces).
    assert error_db(moved) < 3.0
    assert error_db(better) < min(2.3, 0.9 * error_db(moved))
    assert better.sources is moved.sources
    assert torch.equal(better.surface.laws, moved.surface.laws)
    assert float(moved.surface.level.abs().max()) == 0.0
    assert better.meta["refined by positions"] == 8


def test_refining_with_strange_spectra_is_refused(field, moved):
    spectra = measured(THERE, Pose.scatter((LOW, HIGH), 2, 1))
    with pytest.raises(InputError, match=r"transmitter stands 5.73 m from the field's; use field.moved_to"):
        refine_field(field, spectra)
    paper = replace(moved, surface=Surface.bare(room(), tx=THERE.position, window=moved.window))
    with pytest.raises(InputError, match="refining needs a field of the mirror model"):
        refine_field(paper, spectra)
    with pytest.raises(InputError, match="must be of the field's frequency, 60 GHz; got 28 GHz"):
        refine_field(moved, replace(spectra, frequency=28e9))
