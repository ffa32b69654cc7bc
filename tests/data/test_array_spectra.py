"""What spectra of arrays, and spectra that do not look everywhere, keep when they are written."""

import math
from dataclasses import replace

import h5py
import pytest
import torch

from rf3dgs.channel.arrays import planar_array
from rf3dgs.core.errors import DataError, InputError
from rf3dgs.data.formats.spectra_h5 import read_spectra, write_spectra
from rf3dgs.spectra.scan import array_instrument
from rf3dgs.spectra.spectrum import Spectrum, stack_spectra


@pytest.fixture
def pictures(spectra) -> Spectrum:
    instrument = array_instrument(planar_array(8, 4, "dipole", 0.45), "capon", fov=math.radians(50))
    noise = torch.linspace(1e-12, 1e-10, len(spectra), dtype=torch.float64)
    return replace(spectra, instrument=instrument, method="capon", delay=None, aod=None, noise=noise)


def test_the_array_and_the_noise_stay_with_the_pictures(pictures, tmp_path):
    write_spectra(tmp_path / "pictures.h5", pictures)
    stored = read_spectra(tmp_path / "pictures.h5")[0]
    assert stored.instrument == pictures.instrument
    assert torch.equal(stored.noise, pictures.noise)
    assert torch.equal(stored[3].noise, pictures.noise[3])
    assert torch.equal(stored[2:5].noise, pictures.noise[2:5])
    assert torch.equal(replace(stored).noise, pictures.noise)


def test_the_floor_stays_with_the_spectra(spectra, tmp_path):
    floor = torch.full_like(spectra.power, 1e-13)
    floor[:, -2:] = torch.inf
    write_spectra(tmp_path / "spectra.h5", replace(spectra, floor=floor))
    stored = read_spectra(tmp_path / "spectra.h5")[0]
    # Stored to 0.005 dB.
    torch.testing.assert_close(stored.floor, floor, rtol=2e-3, atol=0.0)
    torch.testing.assert_close(stored[1].floor, floor[1], rtol=2e-3, atol=0.0)
    assert torch.equal(stored.looked, replace(spectra, floor=floor).looked)


def test_spectra_without_either_are_written_as_before(spectra, tmp_path):
    write_spectra(tmp_path / "spectra.h5", spectra)
    stored = read_spectra(tmp_path / "spectra.h5")[0]
    assert stored.floor is None
    assert stored.noise is None
    assert stored.instrument.array is None


@pytest.mark.parametrize(
    ("name", "value"), [("array_spacing", [0.5]), ("array_pattern", b"horn"), ("array_rows", 0), ("array_fov", -1.0)]
)
def test_an_array_that_is_none_is_refused(name, value, pictures, tmp_path):
    write_spectra(tmp_path / "pictures.h5", pictures)
    with h5py.File(tmp_path / "pictures.h5", "r+") as file:
        file["spectra"].attrs[name] = value
    with pytest.raises(DataError):
        read_spectra(tmp_path / "pictures.h5")


def test_floors_and_noise_are_one_for_each(spectra):
    with pytest.raises(InputError, match="floor must be"):
        replace(spectra, floor=torch.zeros(3))
    with pytest.raises(InputError, match="noise must be"):
        replace(spectra, noise=torch.zeros(3))
    with pytest.raises(InputError, match="some of the spectra have a floor"):
        stack_spectra([spectra[0], replace(spectra[1], floor=torch.zeros_like(spectra.power[1]))])
