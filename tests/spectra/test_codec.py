import math
from dataclasses import replace

import pytest
import torch

from rf3dgs.channel.binning import stack_paths
from rf3dgs.core.angles import angle_between
from rf3dgs.core.errors import InputError
from rf3dgs.core.grids import equirect_grid
from rf3dgs.spectra.codec import DbWindow, PaperEncoding, PerViewLinear, first_arrival, paper_scale, window_of
from rf3dgs.spectra.scan import spectrum_of

SPHERE = equirect_grid(120, 60)


@pytest.fixture
def spectra(random_paths):
    return spectrum_of(stack_paths([random_paths(40, seed=seed) for seed in range(3)]), grid=SPHERE)


def test_the_window_encodes_linearly_in_db_and_clips():
    window = DbWindow(-140.0, -100.0)
    value = window.encode(torch.tensor([1e-15, 1e-14, 1e-12, 1e-10, 1e-9, 0.0]))
    assert torch.allclose(value, torch.tensor([0.0, 0.0, 0.5, 1.0, 1.0, 0.0]), atol=1e-6)
    assert torch.allclose(window.decode(torch.tensor([0.25])), torch.tensor([1e-13]), rtol=1e-4)
    assert float(window.decode_db(torch.tensor(1.0))) == -100.0


def test_the_window_is_differentiable_inside():
    power = torch.tensor([1e-12], requires_grad=True)
    DbWindow(-140.0, -100.0).encode(power).sum().backward()
    assert power.grad is not None
    assert float(power.grad) == pytest.approx(10 / math.log(10) / 1e-12 / 40, rel=1e-4)


def test_no_peak_of_the_set_is_clipped(spectra):
    window = window_of(spectra)
    largest = float(spectra.gain_db.max())
    assert largest + 1 <= window.ceil_db <= largest + 2.01
    assert float(window.encode(spectra.power).max()) < 1.0
    lit = spectra.gain_db[spectra.power > 0]
    assert float((lit < window.floor_db).float().mean()) < 0.011


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (torch.zeros_like, "no power anywhere"),
        (torch.ones_like, "same power everywhere"),
        (lambda power: power * float("nan"), "NaN or infinite"),
    ],
)
def test_spectra_without_content_have_no_window(spectra, change, message):
    with pytest.raises(InputError, match=message):
        window_of(replace(spectra, power=change(spectra.power)))


def test_a_window_upside_down_is_refused():
    with pytest.raises(InputError, match="floor_db below ceil_db"):
        DbWindow(-100.0, -140.0)


def test_the_papers_encoding_decodes_where_there_is_gain(spectra):
    encoding = PaperEncoding.of(spectra)
    channels = encoding.encode(spectra)
    assert channels.shape == (3, 60, 120, 4)
    assert float(channels.min()) >= 0.0
    assert float(channels.max()) <= 1.0
    power, delay, aod = encoding.decode(channels, first_arrival(spectra))
    strong = channels[..., 0] > 0.3
    assert torch.allclose(10 * torch.log10(power[strong]), spectra.gain_db[strong], atol=0.01)
    assert torch.allclose(delay[strong], spectra.delay[strong], atol=1e-12)
    assert float(angle_between(aod, spectra.aod)[strong].max()) < 1e-3
    assert encoding.name == "paper"


def test_the_papers_angles_are_scaled_by_the_normalised_gain(spectra):
    encoding = PaperEncoding.of(spectra)
    channels = encoding.encode(spectra)
    dark = spectra.power == 0
    assert float(channels[dark].abs().max()) == 0.0
    assert bool((channels[..., 1] <= channels[..., 0] + 1e-6).all())


def test_the_papers_encoding_needs_delay_and_aod(spectra):
    with pytest.raises(InputError, match="needs spectra with delay"):
        PaperEncoding.of(replace(spectra, delay=None))
    with pytest.raises(InputError, match="needs spectra with aod"):
        PaperEncoding(DbWindow(-150, -80), 1e-7).encode(replace(spectra, aod=None))


def test_each_view_is_linear_below_its_own_peak(spectra):
    value = PerViewLinear().encode(spectra.power)
    assert torch.equal(value.amax((-2, -1)), torch.ones(3))
    assert torch.allclose(PerViewLinear().decode(value, spectra.power.amax((-2, -1))), spectra.power, rtol=1e-6)
    louder = PerViewLinear().encode(1000.0 * spectra.power)
    assert torch.allclose(louder, value, rtol=1e-6)
    assert float(PerViewLinear().encode(torch.zeros(2, 4, 5)).abs().max()) == 0.0


def test_the_papers_scale_depends_on_the_method(spectra):
    for method in ("bartlett", "tapered"):
        assert isinstance(paper_scale(replace(spectra, method=method)), PerViewLinear)
    for method in ("ideal", "capon", "music"):
        assert isinstance(paper_scale(replace(spectra, method=method)), DbWindow)
