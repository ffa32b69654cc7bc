"""The radio stage on several pictures of each place."""

from dataclasses import replace

import pytest
import torch

from rf3dgs.core.frames import Pose
from rf3dgs.core.grids import pinhole_grid
from rf3dgs.data.dataset import Dataset
from rf3dgs.evaluation.protocol import evaluate
from rf3dgs.spectra.scan import spectrum_of
from rf3dgs.spectra.spectrum import stack_spectra
from rf3dgs.spectra.yaws import at_yaws
from rf3dgs.splats.gaussians import Gaussians
from rf3dgs.training.config import RadioConfig
from rf3dgs.training.radio import fit_radio

TX = Pose((0.0, 0.0, 2.0))
COLUMNS = ("coeff", "delay", "aoa_zenith", "aoa_azimuth", "aod_zenith", "aod_azimuth", "valid", "order", "kind")


@pytest.fixture
def dataset(line_of_sight, random_paths) -> Dataset:
    """Four pinholes at each of ten places: the line of sight over weak paths from everywhere."""
    places = Pose.scatter(((2, 2, 1), (4, 4, 1.6)), 10, seed=4)
    made = []
    for number in range(10):
        sight = line_of_sight(TX, places[number])
        weak = random_paths(400, seed=number, rx=places[number])
        weak = replace(weak, coeff=1e-3 * sight.coeff.abs() * weak.coeff / weak.coeff.abs())
        both = {name: torch.cat((getattr(sight, name), getattr(weak, name))) for name in COLUMNS}
        made.append(
            spectrum_of(at_yaws(replace(weak, **both), (0.0, 1.5708, 3.1416, 4.7124)), None, pinhole_grid(24, 16, 92))
        )
    return Dataset((), stack_spectra(made)).protocol(seed=1)


def test_the_radio_stage_learns_from_four_pictures_of_each_place(dataset, tmp_path):
    stored = dataset.save(tmp_path / "site").with_fraction(0.75)
    train = stored.train
    assert len(train.spectra) == 24
    assert len(set(stored.places[train.index].tolist())) == 6
    geometry = Gaussians.random(200, (-1, -1, 0), (6, 6, 3), degree=0, seed=3)
    field = fit_radio(geometry, train.spectra, RadioConfig(model="paper", steps=20))
    test = stored.open_test("a test of the test")
    assert len(test.spectra) == 8
    assert abs(field.sources.level_db) < 1.0, "the level of the line of sight out of the pictures that see it [dB]"
    scores = evaluate(field, test.spectra, train=train.spectra)
    facing = scores.values["field"]["peak_deg"].min()
    assert float(facing) < 0.5, "the picture that faces the transmitter shows it where it is"
    assert set(scores.values) == {"field", "nearest", "inverse distance"}
