import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from rf3dgs.core.errors import InputError
from rf3dgs.core.frames import Pose
from rf3dgs.core.grids import Camera, pinhole_grid
from rf3dgs.data.align import align
from rf3dgs.data.photo import Photo, PhotoSet


@settings(max_examples=40, deadline=None)
@given(seed=st.integers(0, 10_000), scale=st.floats(0.01, 100), count=st.integers(3, 12))
def test_a_similarity_is_found_again(seed, scale, count):
    generator = torch.Generator().manual_seed(seed)
    source = torch.randn(count, 3, generator=generator, dtype=torch.float64)
    extent = torch.linalg.svdvals(source - source.mean(0))
    if extent[1] < 0.05 * extent[0]:
        return
    rotation = Pose((0, 0, 0), torch.randn(4, generator=generator)).world_from_device.double()
    shift = 10 * torch.randn(3, generator=generator, dtype=torch.float64)
    found = align(source, scale * source @ rotation.mT + shift)
    assert found.scale == pytest.approx(scale, rel=1e-5)
    torch.testing.assert_close(found.rotation, rotation, atol=1e-5, rtol=0)
    assert float(torch.linalg.det(found.rotation)) == pytest.approx(1.0)
    assert float(found.residuals.max()) < 1e-4 * scale


def test_aligned_cameras_see_aligned_points_at_the_same_pixels():
    generator = torch.Generator().manual_seed(0)
    points = torch.randn(20, 3, generator=generator)
    camera = Camera.of(Pose.look_at((4, 3, 2), (0, 0, 0)), pinhole_grid(40, 30, 60))
    rotation = Pose((0, 0, 0), (0.9, 0.1, -0.3, 0.2)).world_from_device
    found = align(points, 2.5 * points @ rotation.mT + torch.tensor([1.0, 2, 3]))
    moved = found.photos(PhotoSet((Photo("a", camera),), "colmap", points=points))

    def pixels(camera, points):
        ray = points @ camera.viewmat[:3, :3].mT + camera.viewmat[:3, 3]
        flat = ray @ camera.K.mT
        return flat[:, :2] / flat[:, 2:]

    torch.testing.assert_close(pixels(moved[0].camera, moved.points), pixels(camera, points), atol=1e-3, rtol=1e-4)
    assert "aligned: scale 2.5" in moved.notes[-1]


def test_the_report_names_the_worst_anchor():
    source = torch.tensor([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 1]])
    target = source.clone()
    target[3, 2] += 0.5
    report = align(source, target).report()
    assert "5 anchors" in report
    assert "at anchor 3" in report


@pytest.mark.parametrize(
    ("source", "target", "message"),
    [
        (torch.eye(3)[:2], torch.eye(3)[:2], "at least 3 anchors"),
        (torch.arange(4.0)[:, None] * torch.ones(3), torch.randn(4, 3), "source anchors lie on one line"),
        (torch.eye(3), torch.ones(3, 3), "target anchors lie on one line or point"),
        (torch.eye(3), torch.eye(4), r"two \[n, 3\] of one length"),
        (torch.eye(3) * float("nan"), torch.eye(3), "NaN or infinity"),
    ],
)
def test_degenerate_anchors_are_refused(source, target, message):
    with pytest.raises(InputError, match=message):
        align(source, target)
