"""Laws of jet colours: there and back, and how much faster than the level they change."""

import torch

from rf3dgs.spectra.jet import jet_level, jet_picture, jet_steepness

LEVELS = torch.arange(256) / 255.0


def test_a_level_comes_back_from_its_colour():
    picture = jet_picture(LEVELS)
    assert torch.equal(picture, (picture * 255).round() / 255)
    # of five neighbours that have one colour in 8 bits the middle one comes back
    assert float((jet_level(picture) - LEVELS).abs().max()) <= 2.001 / 255
    assert len(picture.unique(dim=0)) >= 250


def test_a_colour_off_the_map_is_read_as_the_nearest():
    levels = torch.linspace(0.05, 0.95, 40)
    noise = 0.01 * torch.randn(40, 3, generator=torch.Generator().manual_seed(0))
    # three of the noise's deviations, at 1.1 and more of colour for 1 of level, and half a step of 8 bits
    assert float((jet_level(jet_picture(levels) + noise) - levels).abs().max()) < 0.03 / 1.1 + 0.5 / 255


def test_levels_beyond_the_scale_are_clipped():
    assert torch.equal(jet_picture(torch.tensor([-1.0, 2.0])), jet_picture(torch.tensor([0.0, 1.0])))


def test_small_errors_grow_by_the_steepness():
    level, step = torch.linspace(0.0, 0.98, 200), 4 / 255
    grown = (jet_picture(level + step) - jet_picture(level)).square().mean()
    expected = step**2 * jet_steepness(level + step / 2).mean()
    assert abs(float(grown / expected) - 1) < 0.05  # what corners of the map and 8 bits leave
