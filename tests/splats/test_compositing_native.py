"""Finishing of pictures in the core against `splats.compositing`, at the edges of its range."""

import math

import pytest
import torch

from rf3dgs.core.frames import Pose
from rf3dgs.core.grids import Camera, pinhole_grid
from rf3dgs.splats.compositing import Compositing, finish
from rf3dgs.splats.rates import Rates
from rf3dgs.splats.trainer import Trainer

CAMERA = Camera.of(Pose(torch.zeros(3)), pinhole_grid(7, 5, 60))
BEHIND = {"means": torch.tensor([[-9.0, 0.0, 0.0]]), "quats": torch.tensor([[1.0, 0.0, 0.0, 0.0]])}


def nothing(channels: int) -> Trainer:
    """A Gaussian that is not seen, so that the added picture is all there is."""
    shape = BEHIND | {"log_scales": torch.full((1, 3), -3.0), "logit_opacities": torch.zeros(1)}
    return Trainer(**shape, sh=torch.zeros(1, 1, channels), offset=0.0, clamp=False)


@pytest.mark.parametrize("channels", [1, 3, 16])
def test_the_window_is_exact_over_120_db(channels: int):
    how = Compositing(transfer="db_window", floor_db=-120.0, ceil_db=-35.0)
    power = 10 ** torch.linspace(-16, 2, 35 * channels).reshape(5, 7, channels)
    power[0, 0], power[1, 1] = 0.0, -1e-3
    found = nothing(channels).draw(CAMERA, compositing=how, added=power).values.double()
    exact = finish(torch.zeros_like(power).double(), torch.zeros(5, 7).double(), how, power.double())
    assert (found - exact).abs().max() < 1e-6
    assert float(found[0, 0].abs().max()) == 0
    assert float(found[1, 1].abs().max()) == 0


def test_more_channels_than_the_core_finishes_are_refused():
    with pytest.raises(ValueError, match="too many channels"):
        nothing(17).draw(CAMERA, compositing=Compositing(normalise=True))


def test_pixels_without_weight_are_zero_and_take_no_gradient():
    trainer = nothing(2)
    raster = trainer.draw(CAMERA, compositing=Compositing(normalise=True))
    assert float(raster.values.abs().max()) == 0
    assert trainer.update(torch.ones(5, 7, 2), Rates(logit_opacities=1.0, level=1.0)) == 0
    assert all(bool(torch.isfinite(tensor).all()) for tensor in trainer.tensors().values())


def test_nan_in_an_added_picture_stays_where_it_is():
    added = torch.ones(5, 7, 1)
    added[2, 3] = math.nan
    how = Compositing(transfer="db_window", floor_db=-10.0, ceil_db=10.0)
    found = nothing(1).draw(CAMERA, compositing=how, added=added).values
    assert int(torch.isnan(found).sum()) == 1
