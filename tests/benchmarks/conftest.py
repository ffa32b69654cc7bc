"""A room whose paths are exact, and a few Gaussians on its walls: what figures are tried on."""

import pytest
import torch

from rf3dgs.channel.io import PathsWriter
from rf3dgs.core.frames import Pose
from rf3dgs.propagation.room import shoebox
from rf3dgs.propagation.sites.shapes import box
from rf3dgs.splats.ply import write_ply
from rf3dgs.splats.surface import sample_mesh

RECEIVERS = 40
SIZE = (10.0, 9.0, 3.0)
TX = Pose((0.6, 0.8, 2.4))


@pytest.fixture(scope="session")
def room_places() -> torch.Tensor:
    """Where receivers stand `[40, 3]` [m]."""
    generator = torch.Generator().manual_seed(3)
    return torch.tensor([0.8, 0.8, 1.2]) + torch.tensor([8.0, 7.0, 0.5]) * torch.rand(RECEIVERS, 3, generator=generator)


@pytest.fixture(scope="session")
def room_paths(tmp_path_factory, room_places):
    """The folder of their paths."""
    folder = tmp_path_factory.mktemp("room") / "room.h5"
    with PathsWriter(folder, 60e9, TX) as writer:
        for place in room_places:
            writer.append(shoebox(SIZE, TX, Pose(place), 60e9, order=2))
    return folder


@pytest.fixture(scope="session")
def room_geometry(tmp_path_factory):
    """A file of Gaussians on the walls."""
    vertices, faces, _ = box((0.0, 0.0, 0.0), SIZE)
    file = tmp_path_factory.mktemp("geometry") / "room.ply"
    write_ply(file, sample_mesh(vertices, faces.flip(1), count=1500))
    return file
