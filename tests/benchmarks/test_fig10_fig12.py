"""Figures 10, 11 and 12 at the smallest scale, and the laws of what they show and score."""

import json
import math
from dataclasses import replace

import pytest
import torch
from benchmarks.quality import fig10, fig12
from benchmarks.quality.csi_pictures import PHYSICAL, PUBLISHED, csi_scores
from benchmarks.quality.methods.method import Task
from benchmarks.quality.protocol import compare, study
from benchmarks.quality.protocol.kept import keep_pictures, kept_pictures
from benchmarks.quality.protocol.pictures import pinholes
from benchmarks.quality.protocol.seen import seen, through
from benchmarks.quality.spectra_kinds import OWN_SCORES, PerView, between_kinds, config_behind, scale_of

from rf3dgs.channel.io import PathsWriter
from rf3dgs.core.frames import Pose
from rf3dgs.propagation.room import shoebox
from rf3dgs.spectra.codec import DbWindow, PaperEncoding, PerViewLinear, window_of
from rf3dgs.spectra.spectrum import Instrument, Spectrum
from rf3dgs.splats.ply import write_ply
from rf3dgs.splats.surface import sample_mesh
from rf3dgs.training.config import RadioConfig
from rf3dgs.training.radio import fit_radio

SIZE = (10.0, 9.0, 3.0)
TX = Pose((0.6, 0.8, 2.4))
BOX = torch.tensor([[x, y, z] for x in (0.0, SIZE[0]) for y in (0.0, SIZE[1]) for z in (0.0, SIZE[2])])
SIDES = ((0, 1, 3, 2), (4, 5, 7, 6), (0, 1, 5, 4), (2, 3, 7, 6), (0, 2, 6, 4), (1, 3, 7, 5))
FACES = torch.tensor([face for a, b, c, d in SIDES for face in ((a, b, c), (a, c, d))])
PLACES = torch.tensor([0.8, 0.8, 1.2]) + torch.tensor([8.0, 7.0, 0.5]) * torch.rand(
    40, 3, generator=torch.Generator().manual_seed(3)
)


def walls():
    return sample_mesh(BOX, FACES, count=600)


def pictures(place: int, method="ideal") -> Spectrum:
    """The four pictures of one place."""
    return pinholes(24, 16, method).of(place, shoebox(SIZE, TX, Pose(PLACES[place]), 60e9, order=3))


@pytest.fixture(scope="module")
def given(tmp_path_factory):
    """Options that stand for tracing and geometry: a room whose paths are exact, and Gaussians on its walls."""
    folder = tmp_path_factory.mktemp("room")
    with PathsWriter(folder / "room.h5", 60e9, TX) as writer:
        for place in PLACES:
            writer.append(shoebox(SIZE, TX, Pose(place), 60e9, order=3))
    write_ply(folder / "walls.ply", walls())
    page = folder / "page.md"
    page.write_text("# Figures\n\n<!-- fig10 -->\n<!-- end of fig10 -->\n\n<!-- fig12 -->\n<!-- end of fig12 -->\n")
    paths, geometry = str(folder / "room.h5"), str(folder / "walls.ply")
    out = ["--out", str(folder / "out"), "--page", str(page)]
    return folder, ["--scale", "smoke", "--paths", paths, "--geometry", geometry, *out]


@pytest.fixture
def quick(monkeypatch):
    monkeypatch.setattr(compare, "RESAMPLES", 50)


@pytest.fixture
def no_fit(monkeypatch):
    """Makes every fit an error."""

    def refused(*args, **options):
        raise AssertionError("a cell was made again")

    return lambda: monkeypatch.setattr(study, "make_cells", refused)


def test_fig10_judges_one_fit_by_its_kind_and_by_ideal_spectra_and_goes_on_where_it_was(given, quick, no_fit):
    folder, words = given
    words = [*words, "--kinds", "bartlett", "capon"]
    fig10.main(words)
    numbers = json.loads((folder / "out" / "fig10.json").read_text())
    rows = {(row["trained on"], row["model"], row["judged by"]): row["scores"] for row in numbers["rows"]}
    both = {(kind, model) for kind, model, truth in rows if truth == "random"}
    models = {"nearest", "published", "mirror"}
    wanted = {(kind, model) for kind in ("ideal", "bartlett", "capon") for model in models}
    assert both == wanted | {("bartlett", "published-per-view")}
    assert {(kind, model, "random-ideal") for kind, model in both} < set(rows)
    for kind in ("bartlett", "capon"):
        scores = rows[kind, "instrument", "random-ideal"]
        assert scores["peak_median"][0] < 5.0  # degrees, about a pixel of 4.8
        assert all(math.isfinite(value) for numbers in scores.values() for value in numbers)
    # Capon's peaks are thinner than these pixels, so that nothing is asked of the waves behind its pictures.
    assert rows["bartlett", "mirror", "random"]["rmse_db"][0] < rows["bartlett", "nearest", "random"]["rmse_db"][0]
    assert rows["bartlett", "mirror", "random-ideal"]["peak_median"][0] < 5.0
    page = (folder / "page.md").read_text()
    assert "| CBF | instrument |" in page
    assert "walls.ply" in page
    assert str(folder) not in page
    for name in ("fig10.png", "fig11.png"):
        assert 3_000 < (folder / "out" / name).stat().st_size < 300_000
    no_fit()
    fig10.main(words)
    assert (folder / "page.md").read_text() == page


def test_fig12_scores_delay_and_departure_and_goes_on_where_it_was(given, quick, no_fit):
    folder, words = given
    fig12.main(words)
    numbers = json.loads((folder / "out" / "fig12.json").read_text())["scores"]
    assert set(numbers) == {"random", "region"}
    for of in numbers.values():
        assert set(of) == {"mirror", "published", "vector", "nearest", "idw4"}
        assert all(of[model]["delay_median"][0] < 60.0 for model in of)  # nanoseconds, 18 m of way
        assert of["mirror"]["departure_median"][0] < of["published"]["departure_median"][0]
    page = (folder / "page.md").read_text()
    assert "| vector |" in page
    assert "0.395" in page
    assert 3_000 < (folder / "out" / "fig12.png").stat().st_size < 300_000
    no_fit()
    fig12.main(words)
    assert (folder / "page.md").read_text() == page


def test_a_picture_of_the_same_kind_is_perfect_on_every_scale():
    for method in ("ideal", "bartlett"):
        shown = pictures(2, method)
        window = window_of(shown)
        values = between_kinds(shown, shown, window, scales={shown.instrument.name: scale_of(shown, window)})
        assert {score.column for score in OWN_SCORES} == set(values)
        assert bool((values["psnr_paper_db"] == 100.0).all())
        assert bool((values["rmse_sr_db"] == 0.0).all())


def test_the_papers_scales_hide_a_level_of_cbf_and_show_one_of_ideal_spectra():
    for method, hidden in (("bartlett", True), ("ideal", False)):
        shown = pictures(2, method)
        window = window_of(shown)
        louder = replace(shown, power=0.1 * shown.power)
        values = between_kinds(shown, louder, window, scales={shown.instrument.name: scale_of(shown, window)})
        assert bool((values["psnr_paper_db"] > 90.0).all()) == hidden  # float32 rounding alone


def test_power_per_solid_angle_does_not_depend_on_the_lobe_that_sees_a_surface():
    shown = pictures(2)
    wide = Instrument.gaussian(2.0 * shown.instrument.lobe)
    share = wide.beam_solid_angle / shown.instrument.beam_solid_angle
    other = replace(shown, power=share * shown.power, instrument=wide)
    window = window_of(shown)
    scales = {shown.instrument.name: window, wide.name: window}
    values = between_kinds(shown, other, window, scales=scales)
    assert bool((values["rmse_sr_db"] < 1e-3).all())  # float32 decibels
    assert share == pytest.approx(4.0)


def field_of(positions=(0, 1, 2)):
    spectra = [pictures(place) for place in positions]
    joined = replace(
        spectra[0],
        power=torch.cat([one.power for one in spectra]),
        delay=None,
        aod=None,
        pose=Pose(
            torch.cat([one.pose.position for one in spectra]), torch.cat([one.pose.orientation for one in spectra])
        ),
    )
    return fit_radio(walls(), joined, RadioConfig(model="mirror", geometry="given", floor_db=-130.0)), joined


def test_a_field_is_seen_by_the_instrument_of_the_truth():
    field, _ = field_of()
    ideal, array = pictures(5)[0], pictures(5, "bartlett")[0]
    as_lobe, as_array = seen(field, ideal), seen(field, array)
    assert torch.equal(as_lobe.power, field.render(ideal.pose, ideal.grid).power)
    assert as_array.instrument.array == array.instrument.array
    half = replace(ideal, instrument=Instrument.gaussian(0.5 * ideal.instrument.lobe))
    bare = field.without_sources()
    narrow = through(bare, half)
    torch.testing.assert_close(narrow.power, 0.25 * bare.render(ideal.pose, ideal.grid).power, rtol=1e-5, atol=0.0)
    peak = through(field, half).power.max() / as_lobe.power.max()
    assert 0.25 < float(peak) <= 1.001  # a point source keeps its level, up to where in the pixel it stands


def test_linear_pictures_over_their_peaks_come_back_at_the_mean_peak():
    shown = pictures(4)
    window = DbWindow(-120.0, -60.0)
    coded = replace(shown, power=window.decode(PerViewLinear().encode(shown.power)))

    class Perfect:
        def render(self, pose, grid):
            return coded[0]

    found = PerView(Perfect(), window, 3e-7).render(shown.pose[0], shown.grid)
    expected = 3e-7 * shown.power[0] / shown.power[0].max()
    torch.testing.assert_close(found.power, expected, rtol=1e-3, atol=1e-12)  # float32 in 60 dB
    assert found.delay is None


def test_the_floor_behind_an_arrays_pictures_is_lower_by_the_ratio_of_solid_angles():
    shown = pictures(4, "bartlett")
    floor = config_behind(Task(shown, DbWindow(-120.0, -60.0))).floor_db
    lobe = Instrument.gaussian(math.radians(4.5)).beam_solid_angle
    assert floor == pytest.approx(-120.0 + 10 * math.log10(lobe / shown.instrument.beam_solid_angle), abs=1e-3)


def test_kept_pictures_come_back(tmp_path):
    shown = pictures(4)
    keep_pictures(tmp_path / "kept.npz", shown[:2])
    found = kept_pictures(tmp_path / "kept.npz", shown)
    assert len(found) == 2
    assert torch.equal(found.power, shown.power[:2])
    assert shown.aod is not None
    assert torch.equal(found.aod, shown.aod[:2])
    keep_pictures(tmp_path / "kept.npz", replace(shown, delay=None, aod=None))
    assert kept_pictures(tmp_path / "kept.npz", shown).delay is None


def test_delay_and_departure_scores_are_perfect_bad_and_not_there():
    shown = pictures(4)
    window, encoding = window_of(shown), PaperEncoding.of(shown)
    assert shown.delay is not None
    assert shown.aod is not None
    perfect = csi_scores(shown, shown, window, encoding=encoding)
    assert set(perfect) == {score.column for score in (*PUBLISHED, *PHYSICAL)}
    assert bool((perfect["delay_psnr_db"] == 100.0).all())
    assert float(perfect["departure_p90_deg"].max()) < 0.05  # float32 directions
    late = replace(shown, delay=shown.delay + 5e-9, aod=-shown.aod)
    found = csi_scores(shown, late, window, encoding=encoding)
    torch.testing.assert_close(found["delay_median_ns"], torch.full((4,), 5.0), rtol=1e-3, atol=0.0)
    torch.testing.assert_close(found["departure_median_deg"], torch.full((4,), 180.0), rtol=1e-3, atol=0.0)
    # The paper's delays count from the first arrival, so that its picture cannot see that all are late.
    assert bool((found["delay_psnr_db"] > 60.0).all())
    assert bool((found["azimuth_psnr_db"] < 40.0).all())
    turned = replace(shown, aod=None)
    assert all(bool(value.isnan().all()) for value in csi_scores(shown, turned, window, encoding=encoding).values())
