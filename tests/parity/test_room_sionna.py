"""The image method against Sionna RT in the same room: every path of up to three reflections."""

import math
from dataclasses import replace

import pytest
import torch

from rf3dgs.channel.paths import Paths
from rf3dgs.core.angles import angle_between
from rf3dgs.core.frames import Pose
from rf3dgs.core.units import SPEED_OF_LIGHT, db_from_power, friis_gain
from rf3dgs.propagation.config import TraceConfig
from rf3dgs.propagation.llvm import find_llvm
from rf3dgs.propagation.room import shoebox
from rf3dgs.propagation.sites import shapes
from rf3dgs.propagation.sites.scene import Scene, SceneObject

pytestmark = pytest.mark.oracle

SIZE = (6.0, 5.0, 3.0)
# No path is reflected within 11 cm of an edge of the room; Sionna loses some of those that come within 5 mm.
TX, RX = Pose((1.13, 1.77, 2.21)), Pose([[5.19, 3.65, 2.43], [3.96, 1.91, 1.85], [2.07, 2.04, 0.71]])
FREQUENCY = 28e9
MATERIALS = ("concrete", "glass", "wood", "plasterboard", "concrete", "ceiling_board")
ONLY_MIRRORS = TraceConfig(rays=100_000, diffuse=False, seed=3)


def room(materials):
    """Six single quads that face the room, in the order of `room.WALLS`."""
    x, y, z = SIZE
    quads = (
        shapes.quad((0, 0, 0), (0, y, 0), (0, 0, z)),
        shapes.quad((x, 0, 0), (0, 0, z), (0, y, 0)),
        shapes.quad((0, 0, 0), (0, 0, z), (x, 0, 0)),
        shapes.quad((0, y, 0), (x, 0, 0), (0, 0, z)),
        shapes.quad((0, 0, 0), (x, 0, 0), (0, y, 0)),
        shapes.quad((0, 0, z), (0, y, 0), (x, 0, 0)),
    )
    objects = [
        SceneObject(f"wall-{index}", *quad[:2], material, 0.0)
        for index, (quad, material) in enumerate(zip(quads, materials, strict=True))
    ]
    inside = ((0.5, 0.5, 0.5), (5.5, 4.5, 2.5))
    bounds = ((-0.01, -0.01, -0.01), tuple(edge + 0.01 for edge in SIZE))
    return Scene("room", tuple(objects), TX, bounds, inside, inside, FREQUENCY)


@pytest.fixture(scope="module")
def trace():
    assert find_llvm().path is not None, f"this test needs sionna-rt and LLVM: {find_llvm().reason}"
    from rf3dgs.propagation.sionna import trace_each

    def rows(materials, depth: int) -> list[Paths]:
        return list(trace_each(room(materials), TX, RX, replace(ONLY_MIRRORS, depth=depth)))

    return rows


def pairs(some: Paths, others: Paths) -> torch.Tensor:
    """Index `[path]` of the other that is nearest to each of some in arrival and delay (1 ns counts as 1 rad)."""
    return (torch.cdist(some.aoa, others.aoa) + 1e9 * (some.delay[:, None] - others.delay).abs()).argmin(-1)


@pytest.mark.parametrize("materials", [("metal",) * 6, MATERIALS], ids=["metal", "six materials"])
@pytest.mark.parametrize("order", [0, 1, 2, 3])
def test_every_path_of_the_room_is_sionnas(trace, order, materials):
    """Gain 0.1 dB, delay 1 ps, angles 1e-4 rad.

    Sionna computes in float32: 30 m is exact to 2e-6 m (0.006 ps) and an angle to some 1e-6 rad at each of the
    path's points, so that the bounds leave room for several times its rounding (0.006 dB, 0.008 ps and 1.5e-5 rad
    were seen). Paths are paired by their delay and arrival; images at one distance differ in direction.
    """
    ours = shoebox(SIZE, TX, RX, FREQUENCY, order, materials)
    for index, theirs in enumerate(trace(materials, order)):
        mine = ours[index]
        theirs = theirs[0]
        assert theirs.coeff.shape == mine.coeff.shape, "each image is one path"
        pair = pairs(theirs, mine)
        assert len(set(pair.tolist())) == len(pair), "no image is paired twice"
        mine = mine._map(lambda value, kept=pair: value[kept])
        gain_db = db_from_power(mine.path_gain) - db_from_power(theirs.path_gain)
        assert float(gain_db.abs().max()) < 0.1
        assert float((mine.delay - theirs.delay).abs().max()) < 1e-12
        assert float(angle_between(mine.aoa, theirs.aoa).max()) < 1e-4
        assert float(angle_between(mine.aod, theirs.aod).max()) < 1e-4
        assert mine.order is not None
        assert torch.equal(mine.order.long(), theirs.order)
        assert torch.equal(mine.kind.long(), theirs.kind)


def test_phases_are_sionnas(trace):
    """Vertical to vertical: half within 1e-5 rad; 0.01 rad next to Brewster's angle, where little is left of it."""
    ours = shoebox(SIZE, TX, RX, FREQUENCY, 2, MATERIALS)
    for index, theirs in enumerate(trace(MATERIALS, 2)):
        theirs = theirs[0]
        turn = (ours[index].coeff[pairs(theirs, ours[index])] * theirs.coeff.conj()).angle().abs()
        assert float(turn.max()) < 0.01
        assert float(turn.median()) < 1e-5


def test_sionnas_line_of_sight_is_friis(trace):
    for index, row in enumerate(trace(MATERIALS, 0)):
        distance = (RX.position[index] - TX.position).norm()
        level = db_from_power(row.path_gain[0, 0]) - db_from_power(friis_gain(distance, FREQUENCY))
        assert abs(float(level)) < 1e-4
        assert float(row.delay[0, 0]) == pytest.approx(float(distance) / SPEED_OF_LIGHT, rel=1e-6)
        assert math.isclose(float(row.total_gain[0]), float(friis_gain(distance, FREQUENCY)), rel_tol=1e-4)
