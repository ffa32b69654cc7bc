"""Laws of poses and of the frame conversions."""

import numpy as np
import pytest
import torch

from rf3dgs.core.angles import angle_between, angles_of, direction_of
from rf3dgs.core.errors import InputError
from rf3dgs.core.frames import (
    Pose,
    matrix_from_quaternion,
    opengl_from_viewmat,
    quaternion_from_matrix,
    viewmat_from_opengl,
)


def random_quaternions(count: int, seed: int = 0) -> torch.Tensor:
    quaternion = torch.randn(count, 4, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    quaternion = torch.nn.functional.normalize(quaternion, dim=-1)
    return torch.where(quaternion[:, :1] < 0, -quaternion, quaternion)


def test_quaternion_and_matrix_are_inverse() -> None:
    quaternion = random_quaternions(500)
    torch.testing.assert_close(quaternion_from_matrix(matrix_from_quaternion(quaternion)), quaternion)


def test_half_turns_keep_their_axis() -> None:
    for axis in ([0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0]):
        quaternion = torch.tensor(axis, dtype=torch.float64)
        torch.testing.assert_close(quaternion_from_matrix(matrix_from_quaternion(quaternion)).abs(), quaternion)


def test_look_at_points_forward_and_keeps_left_level() -> None:
    pose = Pose.look_at((1.0, 2.0, 1.5), (4.0, -1.0, 0.5))
    forward = torch.nn.functional.normalize(torch.tensor([3.0, -3.0, -1.0]), dim=0)
    torch.testing.assert_close(pose.world_from_device[:, 0], forward, atol=1e-6, rtol=0)
    assert abs(float(pose.world_from_device[2, 1])) < 1e-6
    assert float(pose.world_from_device[2, 2]) > 0


def test_looking_straight_up_is_a_rotation() -> None:
    pose = Pose.look_at((0.0, 0.0, 0.0), (0.0, 0.0, 1.0))
    torch.testing.assert_close(pose.world_from_device[:, 0], torch.tensor([0.0, 0.0, 1.0]))
    assert float(torch.linalg.det(pose.world_from_device)) == pytest.approx(1.0, abs=1e-6)


def test_viewmat_maps_forward_left_up_to_depth_minus_x_minus_y() -> None:
    pose = Pose((1.0, 2.0, 3.0))
    point = torch.tensor([1.0 + 5.0, 2.0 + 2.0, 3.0 + 1.0, 1.0])
    torch.testing.assert_close(pose.viewmat @ point, torch.tensor([-2.0, -1.0, 5.0, 1.0]))
    back = Pose.from_viewmat(pose.viewmat)
    torch.testing.assert_close(back.position, pose.position)


def test_opengl_and_opencv_cameras_round_trip() -> None:
    viewmat = Pose(torch.randn(20, 3), random_quaternions(20)).viewmat
    torch.testing.assert_close(viewmat_from_opengl(opengl_from_viewmat(viewmat)), viewmat, atol=1e-5, rtol=0)
    backward = opengl_from_viewmat(Pose((0.0, 0.0, 0.0)).viewmat)[:3, 2]
    torch.testing.assert_close(backward, torch.tensor([-1.0, 0.0, 0.0]))


def test_turning_the_world_turns_positions_and_directions_alike() -> None:
    pose = Pose.look_at((2.0, 1.0, 1.0), (5.0, 5.0, 1.0))
    turned = pose.turned(0.7)
    seen = pose.to_device(torch.tensor([0.0, 3.0, 1.0]) - pose.position)
    point = Pose.from_yaw((0.0, 0.0, 0.0), 0.7).to_world(torch.tensor([0.0, 3.0, 1.0]))
    torch.testing.assert_close(turned.to_device(point - turned.position), seen, atol=1e-5, rtol=0)


def test_angles_round_trip_and_small_angles_keep_their_digits() -> None:
    zenith, azimuth = torch.tensor([0.1, 1.5, 3.0]), torch.tensor([-3.0, 0.2, 2.0])
    back = angles_of(direction_of(zenith, azimuth))
    torch.testing.assert_close(back[0], zenith)
    torch.testing.assert_close(back[1], azimuth)
    first = direction_of(torch.tensor(1.0), torch.tensor(0.0))
    second = direction_of(torch.tensor(1.0 + 1e-4), torch.tensor(0.0))
    assert float(angle_between(first, second)) == pytest.approx(1e-4, rel=2e-3)


def test_bad_poses_are_refused_with_a_remedy() -> None:
    with pytest.raises(InputError, match="position has NaN or infinite values; remove those poses"):
        Pose((float("nan"), 0.0, 0.0))
    with pytest.raises(InputError, match=r"zero or non-finite quaternion; use \(1, 0, 0, 0\)"):
        Pose((0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 0.0))
    with pytest.raises(InputError, match=r"position must be \[\*batch, 3\] in metres; got shape \[2\]"):
        Pose((0.0, 0.0))
    with pytest.raises(InputError, match="orthonormal with determinant"):
        Pose.from_matrix((0.0, 0.0, 0.0), torch.diag(torch.tensor([1.0, 1.0, -1.0])))
    with pytest.raises(InputError, match="both are the same point"):
        Pose.look_at((1.0, 1.0, 1.0), (1.0, 1.0, 1.0))


def test_batches_that_do_not_fit_are_refused() -> None:
    with pytest.raises(InputError, match=r"fit together; got \[5, 3\] and \[4, 4\]. Give one orientation"):
        Pose(torch.zeros(5, 3), torch.ones(4, 4))


def test_a_pose_keeps_its_place_when_the_callers_array_changes() -> None:
    place = np.array([1.0, 2.0, 3.0], dtype=np.float32)
    pose = Pose(place)
    place[:] = 9.0
    assert pose.position.tolist() == [1.0, 2.0, 3.0]


def test_flat_poses_are_the_same_poses_in_one_row() -> None:
    pose = Pose(torch.randn(2, 3, 3), random_quaternions(3))
    assert torch.equal(pose.flat()[4].position, pose.position[1, 1])
    assert torch.equal(pose.flat()[4].orientation, pose.orientation[1, 1])
    assert len(Pose((1.0, 2.0, 3.0)).flat()) == 1


def test_scatter_is_seeded_and_stays_inside() -> None:
    first = Pose.scatter(((1, 1, 1), (14, 13, 2)), count=100, seed=3)
    again = Pose.scatter(((1, 1, 1), (14, 13, 2)), count=100, seed=3)
    assert torch.equal(first.position, again.position)
    assert bool((first.position >= torch.tensor([1.0, 1.0, 1.0])).all())
    assert bool((first.position <= torch.tensor([14.0, 13.0, 2.0])).all())
