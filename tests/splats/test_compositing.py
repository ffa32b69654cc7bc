"""Laws of what is done to blended channels, and of the depth gate."""

import math

import pytest
import torch

from rf3dgs.core.errors import InputError
from rf3dgs.core.frames import Pose
from rf3dgs.core.grids import Camera, Panorama, View, equirect_grid, pinhole_grid
from rf3dgs.splats.compositing import Compositing, db_window, db_window_inverse, finish, normalise
from rf3dgs.splats.rasterize import rasterize

F64 = torch.float64
VIEWS = [
    Camera.of(Pose((0.0, 0.0, 0.0)), pinhole_grid(33, 25, 60)),
    Panorama.of(Pose((0.0, 0.0, 0.0)), equirect_grid(33, 17)),
]


def test_the_window_is_zero_without_power_and_one_at_the_ceiling():
    assert float(db_window(torch.tensor(0.0), -120.0, -70.0)) == 0.0
    assert float(db_window(torch.tensor(-1.0), -120.0, -70.0)) == 0.0
    assert float(db_window(torch.tensor(1e-7), -120.0, -70.0)) == pytest.approx(1.0, abs=1e-5)
    assert float(db_window(torch.tensor(1e-12), -120.0, -70.0)) == pytest.approx(10 * math.log10(2) / 50, rel=1e-6)


def test_the_window_and_its_inverse_undo_each_other():
    power = 10 ** torch.linspace(-13, -5, 50, dtype=F64)
    torch.testing.assert_close(
        db_window_inverse(db_window(power, -120.0, -70.0), -120.0, -70.0), power, rtol=1e-9, atol=0
    )


def test_a_dark_pixel_still_has_a_slope():
    power = torch.zeros(3, requires_grad=True)
    db_window(power, -120.0, -70.0).sum().backward()
    assert power.grad is not None
    torch.testing.assert_close(power.grad, torch.full((3,), 10 / math.log(10) / 50 * 1e12))


def test_normalised_channels_are_means_of_what_was_hit_and_zero_where_nothing_was():
    weight = torch.tensor([[0.5, 0.0], [0.01, 1.0]], requires_grad=True)
    found = normalise(3.0 * weight[..., None], weight)
    torch.testing.assert_close(found[..., 0], torch.tensor([[3.0, 0.0], [3.0, 3.0]]))
    found.sum().backward()
    assert weight.grad is not None
    assert bool(torch.isfinite(weight.grad).all())


def test_the_order_is_divide_then_add_then_transfer():
    blended, weight = torch.full((1, 1, 2), 2e-9), torch.full((1, 1), 0.5)
    compositing = Compositing(None, True, ("db_window", "identity"), -120.0, -70.0)
    found = finish(blended, weight, compositing, torch.full((1, 1, 2), 6e-9))[0, 0]
    assert float(found[0]) == pytest.approx(float(db_window(torch.tensor(1e-8), -120.0, -70.0)))
    assert float(found[1]) == pytest.approx(1e-8)


def lamp_behind_a_thin_wall(view: View, backend: str, gate: float | None) -> torch.Tensor:
    """A lamp of 60 dB more than the two layers before it, which let two thirds of the light through."""
    means = torch.tensor([[2.0, 0.0, 0.0], [2.1, 0.0, 0.0], [4.0, 0.0, 0.0]], dtype=F64)
    opacities = torch.tensor([0.6, 0.6, 0.9], dtype=F64)
    quats = torch.tensor([[1.0, 0.0, 0.0, 0.0]] * 3, dtype=F64)
    values = torch.tensor([[1.0], [1.0], [1e6]], dtype=F64)
    arguments = [means, quats, torch.full((3, 3), 0.4, dtype=F64), opacities, values]
    if backend == "native":
        arguments = [tensor.float() for tensor in arguments]
    compositing = Compositing(depth_gate=gate, normalise=True)
    return rasterize(*arguments, view, compositing=compositing, backend=backend).values[..., 0]  # type: ignore[arg-type]


@pytest.mark.parametrize("view", VIEWS)
def test_behind_the_gate_a_lamp_leaves_no_ghost(view: View):
    row, col = view.height // 2, view.width // 2
    shining = lamp_behind_a_thin_wall(view, "reference", None)[row, col]
    gated = lamp_behind_a_thin_wall(view, "reference", 0.3)[row, col]
    assert float(shining) > 1e5
    assert float(gated) == pytest.approx(1.0)
    through = lamp_behind_a_thin_wall(view, "reference", 2.5)[row, col]
    assert float(through) == pytest.approx(float(shining))


def test_bad_options_are_named():
    with pytest.raises(InputError, match="depth_gate must be a length of 0 m or more, or None; got -1"):
        Compositing(depth_gate=-1.0)
    with pytest.raises(InputError, match=r"blur must be a positive number of square pixels; got 0\.0"):
        Compositing(blur=0.0)
    with pytest.raises(InputError, match='transfer must be "identity" or "db_window"'):
        Compositing(transfer="log")  # type: ignore[arg-type]
    with pytest.raises(InputError, match="db_window needs floor_db < ceil_db in dB; got None and None"):
        Compositing(transfer="db_window")
    with pytest.raises(InputError, match=r"floor_db < ceil_db in dB; got -60\.0 and -90\.0"):
        Compositing(transfer=("identity", "db_window"), floor_db=-60.0, ceil_db=-90.0)
    with pytest.raises(InputError, match="this compositing has no dB window"):
        _ = Compositing().window
