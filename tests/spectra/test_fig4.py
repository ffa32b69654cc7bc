"""The figure of beams and spectra, without tracing."""

import io
import math

import pytest
import torch
from benchmarks.quality.fig4 import METHODS, beam, draw, spectra
from PIL import Image

from rf3dgs.channel.arrays import planar_array
from rf3dgs.core.grids import pinhole_grid

ARRAY = planar_array(8, 8, "patch")


def _cut(method, azimuth_deg=0.0):
    angle = torch.deg2rad(torch.linspace(-90.0, 90.0, 3601, dtype=torch.float64))
    directions = torch.stack((torch.cos(angle), torch.sin(angle), torch.zeros_like(angle)), -1)
    return angle, 10 * torch.log10(beam(ARRAY, directions, method, azimuth_deg).clamp_min(1e-9))


@pytest.mark.parametrize(("method", "null_deg", "side_lobe_db"), [("bartlett", 15.0, -12.8), ("tapered", 27.0, -31.0)])
def test_beams_have_the_side_lobes_of_their_tapers(method, null_deg, side_lobe_db):
    """Eight uniform elements: -12.8 dB; Hann: below -31 dB beyond a main lobe of twice the width."""
    angle, level = _cut(method)
    assert float(level.max()) == pytest.approx(0.0, abs=1e-6)
    beyond = angle > math.radians(null_deg)
    assert float(level[beyond].max()) < side_lobe_db
    assert float(level[~beyond & (angle > 0)].min()) < side_lobe_db


def test_a_steered_beam_peaks_where_it_is_steered():
    angle, level = _cut("bartlett", 35.0)
    # the element is weaker there, and pulls the peak towards boresight by part of a degree
    assert float(angle[level.argmax()].rad2deg()) == pytest.approx(35.0, abs=1.5)
    assert float(level[(angle - math.radians(35)).abs().argmin()]) == pytest.approx(
        20 * math.log10(math.cos(math.radians(35))), abs=1e-3
    )


def test_the_figure_is_one_small_png(random_paths):
    grid = pinhole_grid(60, 40, 90)
    paths = random_paths(200)
    seen = spectra(paths, paths.rx, ARRAY, grid, snr_db=20.0)
    assert list(seen) == list(METHODS)
    assert [spectrum.method for spectrum in seen.values()] == list(METHODS)
    picture = draw(ARRAY, grid, seen)
    assert len(picture) < 200_000
    with Image.open(io.BytesIO(picture)) as image:
        assert image.size[0] > 1000
        assert len(image.convert("RGB").getcolors(2**24)) > 30
