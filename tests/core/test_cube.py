"""Laws of the sphere on the faces of a cube."""

import torch

from rf3dgs.core.cube import device_from_faces, face_cameras, face_grid, sample_faces
from rf3dgs.core.frames import Pose
from rf3dgs.core.grids import equirect_grid

LEFT = torch.tensor([0.0, 1.0, 0.0])
UP = torch.tensor([0.0, 0.0, 1.0])


def test_six_faces_cover_the_sphere_without_a_seam() -> None:
    grid, face = equirect_grid(90, 45), face_grid(32)
    faces = torch.stack([face.directions @ rotation.mT for rotation in device_from_faces()])
    torch.testing.assert_close(sample_faces(faces, 32, grid.directions), grid.directions, atol=2e-3, rtol=0)
    rotations = device_from_faces()
    torch.testing.assert_close(torch.linalg.det(rotations), torch.ones(6))


def test_face_cameras_turn_with_the_pose() -> None:
    pose = Pose.look_at((0.0, 0.0, 1.0), (1.0, 2.0, 1.5))
    forward = torch.tensor([1.0, 0.0, 0.0])
    cameras = face_cameras(pose, 16)
    torch.testing.assert_close(cameras[1].pose.to_world(forward), pose.to_world(LEFT), atol=1e-5, rtol=0)
    torch.testing.assert_close(cameras[4].pose.to_world(forward), pose.to_world(UP), atol=1e-5, rtol=0)
