import math
from dataclasses import replace

import pytest
import torch

from rf3dgs.channel.arrays import planar_array
from rf3dgs.core.frames import Pose
from rf3dgs.core.grids import pinhole_grid
from rf3dgs.evaluation import beams
from rf3dgs.spectra.covariance import covariance_of_spectrum
from rf3dgs.spectra.spectrum import Instrument, Spectrum

ARRAY = planar_array(8, 8, pattern="patch")


def test_panel_covariance_is_that_of_the_spectrum_in_the_panels_own_frame(room):
    pose = room.receivers(2)
    array = planar_array(3, 2, pattern="patch")
    panels = beams.panel_covariance(room.spectra_at(pose), array)
    assert panels.shape == (2, 4, 6, 6)
    first = covariance_of_spectrum(room.spectra_at(pose), array)
    torch.testing.assert_close(panels[:, 0], first, rtol=1e-5, atol=1e-18)
    turned = room.spectra_at(Pose.from_yaw(pose.position, math.pi / 2))
    second = covariance_of_spectrum(turned, array)
    torch.testing.assert_close(panels[:, 1], second, rtol=1e-4, atol=1e-16)


def test_beam_losses_are_zero_for_the_truth_and_blind_to_a_gain_offset(room):
    truth = room.spectra_at(room.receivers(3))
    covariance = beams.panel_covariance(truth, ARRAY)
    louder = replace(truth, power=2.0 * truth.power)
    for prediction in (truth, louder):
        eigen = beams.beam_loss_eigen(covariance, beams.panel_covariance(prediction, ARRAY))
        torch.testing.assert_close(eigen, torch.zeros(3), atol=1e-6, rtol=0)
        peak = beams.beam_loss_peak(truth, prediction, covariance, ARRAY)
        torch.testing.assert_close(peak, torch.zeros(3), atol=1e-4, rtol=0)


def test_a_beam_towards_the_wrong_side_loses_its_gain(room):
    truth = room.spectra_at(room.receivers(3))
    covariance = beams.panel_covariance(truth, ARRAY)
    mirrored = replace(truth, power=truth.power.roll(16, -1))
    assert bool((beams.beam_loss_peak(truth, mirrored, covariance, ARRAY) > 6).all())
    assert bool((beams.beam_loss_eigen(covariance, beams.panel_covariance(mirrored, ARRAY)) > 3).all())


def test_the_loss_of_a_beam_beside_a_single_wave_is_the_array_factor():
    """8x8 isotropic elements half a wavelength apart: 20 log10 of sin(4 pi u) / (8 sin(pi u / 2)), across and up."""
    grid = pinhole_grid(40, 30, fov_deg=90)
    array = planar_array(8, 8, pattern="isotropic")
    power = torch.zeros(2, *grid.shape)
    power[0, 15, 20] = power[1, 13, 22] = 1e-9
    lobe = Instrument.gaussian(math.radians(3))
    truth, prediction = (Spectrum(one, grid, Pose((0.0, 0, 0)), 60e9, lobe) for one in power)
    covariance = beams.panel_covariance(truth, array)
    u = (grid.directions[13, 22] - grid.directions[15, 20])[1:].double()
    factor = torch.sin(4 * math.pi * u) / (8 * torch.sin(math.pi * u / 2))
    expected = float(-20 * torch.log10(factor.abs()).sum())
    assert 1 < expected < 6
    assert float(beams.beam_loss_peak(truth, prediction, covariance, array)) == pytest.approx(expected, abs=1e-4)
    eigen = beams.beam_loss_eigen(covariance, beams.panel_covariance(prediction, array))
    assert float(eigen) == pytest.approx(expected, abs=1e-4)


def test_a_slightly_shifted_peak_loses_little_and_more_when_shifted_more(room):
    truth = room.spectra_at(room.receivers(2))
    covariance = beams.panel_covariance(truth, ARRAY)
    losses = [
        beams.beam_loss_peak(truth, replace(truth, power=truth.power.roll(step, -1)), covariance, ARRAY).mean()
        for step in (0, 1, 2)
    ]
    assert losses[0] < losses[1] < losses[2]


def test_a_dark_prediction_collects_what_an_arbitrary_beam_would(room):
    truth = room.spectra_at(room.receivers(1))
    covariance = beams.panel_covariance(truth, ARRAY)
    loss = beams.beam_loss_eigen(covariance, torch.zeros_like(covariance))
    largest = torch.linalg.eigvalsh(covariance)[..., -1]
    mean = covariance.diagonal(dim1=-2, dim2=-1).real.mean(-1)
    torch.testing.assert_close(loss, (10 * torch.log10(largest / mean)).mean(-1).float())


def test_pictures_have_one_panel(room):
    grid = pinhole_grid(24, 16, fov_deg=90)
    spectrum = room.spectrum_at(room.receivers(1)[0], grid)
    assert beams.panel_covariance(spectrum, ARRAY).shape == (1, 64, 64)
