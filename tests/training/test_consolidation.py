"""Planes made whole and square."""

import math
from dataclasses import replace

import pytest
import torch

from rf3dgs.geometry import Patches, Planes, Surfaces
from rf3dgs.training.consolidation import oblique_planes, squared, walls_whole


@pytest.mark.parametrize(("side", "hole", "closed"), [(4.0, 0.8, True), (4.0, 1.4, False), (2.0, 0.8, False)])
def test_small_holes_of_large_planes_are_closed_and_doors_stay(side: float, hole: float, closed: bool):
    planes = Planes(torch.tensor([[0.0, 1.0, 0.0]]), torch.zeros(1))
    steps = torch.arange(0.05, side, 0.1)
    cells = torch.cartesian_prod(steps, torch.zeros(1), steps)
    gone = ((cells[:, [0, 2]] - side / 2).abs() < hole / 2).all(-1)
    patches = Patches.of(planes, [cells[~gone]])
    after = walls_whole(patches)
    before = float(patches.areas[0])
    expected = side**2 if closed else before
    assert before == pytest.approx(side**2 - hole**2, abs=0.02)
    assert float(after.areas[0]) == pytest.approx(expected, abs=0.02)


def board(angle_deg: float, at: float) -> tuple[torch.Tensor, torch.Tensor]:
    """Normal and points of an upright board of 1 m across at x = `at`, turned out of the plane of a wall."""
    turn = math.radians(angle_deg)
    normal = torch.tensor([math.cos(turn), math.sin(turn), 0.0])
    along = torch.tensor([-math.sin(turn), math.cos(turn), 0.0])
    steps = torch.cartesian_prod(torch.arange(-0.5, 0.5, 0.05), torch.arange(0.0, 1.5, 0.05))
    points = torch.tensor([at, 3.0, 0.5]) + steps[:, :1] * along + steps[:, 1:] * torch.tensor([0.0, 0.0, 1.0])
    return normal, points


def test_small_planes_that_nearly_stand_square_do():
    floor = torch.cartesian_prod(torch.arange(0.0, 9.0, 0.1), torch.arange(0.0, 7.0, 0.1), torch.zeros(1))
    wall = torch.cartesian_prod(torch.zeros(1), torch.arange(0.0, 7.0, 0.1), torch.arange(0.0, 3.2, 0.1))
    square_on = torch.tensor([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0]])
    boards = [board(4.0, 4.0), board(-3.0, 4.05), board(20.0, 6.0)]
    normals = torch.cat((square_on, torch.stack([normal for normal, _ in boards])))
    points = [points for _, points in boards]
    offsets = torch.stack([points.mean(0) @ normal for normal, points in boards])
    planes = Planes(normals, torch.cat((torch.zeros(2), offsets)))
    patches = Patches.of(planes, [floor, wall, *points])
    found = Surfaces(planes, patches, torch.arange(5), torch.arange(5), normals)
    square = squared(found)
    assert torch.equal(square.planes.normals[:2], square_on)
    assert torch.equal(square.planes.normals[2], torch.tensor([1.0, 0.0, 0.0]))
    assert abs(float(square.planes.offsets[2]) - 4.0) < 0.03  # the middle, and half a cell of 5 cm
    assert torch.equal(square.planes.normals[4], planes.normals[4])  # too far turned to be an error
    assert int(square.plane_of[2]) == int(square.plane_of[3])  # 5 cm apart and facing one way: one thing
    assert sorted(square.patches.areas[2:4].tolist())[0] == 0.0
    assert oblique_planes(planes, patches).tolist() == [False] * 4 + [True]
    alone = Planes(normals[2:], offsets)
    unknown = replace(found, planes=alone, patches=Patches.of(alone, points))
    assert squared(unknown) is unknown  # no wall says what is square
    assert not bool(oblique_planes(unknown.planes, unknown.patches).any())
