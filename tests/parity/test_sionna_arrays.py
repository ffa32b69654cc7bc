"""Our arrays and patterns against Sionna RT's, computed by it in a process of its own."""

import json
import math
import os
import subprocess
import sys

import pytest
import torch

from rf3dgs.channel.arrays import ofdm, planar_array
from rf3dgs.channel.paths import Paths
from rf3dgs.channel.patterns import field_pattern
from rf3dgs.channel.response import manifold
from rf3dgs.core.angles import direction_of
from rf3dgs.core.frames import Pose
from rf3dgs.core.units import wavelength
from rf3dgs.propagation.llvm import find_llvm

pytestmark = pytest.mark.oracle

SHAPES = ((1, 1), (3, 5), (8, 8))
NAMES = {"iso": "isotropic", "dipole": "dipole", "tr38901": "tr38901"}
FREQUENCY = 60e9
TX = (1.0, 2.0, 3.0)
BOX_FREQUENCY = 1e9  # so low, and delays so short, that single precision gives the carrier's phase to 1e-5
BOX_TX = ((-1.0, -1.5, 3.0), 0.6)
BOX_RX = ((1.0, 2.0, 1.5), -2.3)
RX = (((4.0, 5.0, 2.0), 0.3), ((-3.0, 4.0, 5.0), -0.9), ((6.0, 1.5, 3.0), 3.1))

ORACLE = """
import json, sys
import mitsuba as mi
import numpy as np
import sionna.rt
from sionna.rt import PathSolver, PlanarArray, Receiver, Transmitter, load_scene

asked = json.load(sys.stdin)
zenith, azimuth = (mi.Float(np.float32(asked[name])) for name in ("zenith", "azimuth"))
answer = {"field": {}, "positions": {}, "response": {}}

def planar(pattern, rows, cols):
    return PlanarArray(num_rows=rows, num_cols=cols, vertical_spacing=0.6, horizontal_spacing=0.45,
                       pattern=pattern, polarization="V")

scene = load_scene()
scene.frequency = asked["frequency"]
scene.tx_array = PlanarArray(num_rows=1, num_cols=1, pattern="iso", polarization="V")
scene.add(Transmitter("tx", position=asked["tx"]))
for index, (position, yaw) in enumerate(asked["rx"]):
    scene.add(Receiver(f"rx{index}", position=position, orientation=[yaw, 0.0, 0.0]))
for pattern in asked["patterns"]:
    field = planar(pattern, 1, 1).antenna_pattern.patterns[0](zenith, azimuth)[0]
    answer["field"][pattern] = np.abs(np.asarray(field.numpy())).reshape(-1).tolist()
    for rows, cols in asked["shapes"]:
        array = planar(pattern, rows, cols)
        answer["positions"][f"{rows}x{cols}"] = np.asarray(array.positions(1.0)).T.tolist()
        scene.rx_array = array
        paths = PathSolver()(scene, max_depth=0, los=True, synthetic_array=True)
        real, imaginary = (np.array(part)[:, :, 0, 0, 0].tolist() for part in paths.a)
        answer["response"][f"{pattern} {rows}x{cols}"] = [real, imaginary]

box = load_scene(sionna.rt.scene.box)
box.frequency = asked["box"]["frequency"]
(tx, tx_yaw), (rx, rx_yaw) = asked["box"]["tx"], asked["box"]["rx"]
box.add(Transmitter("tx", position=tx, orientation=[tx_yaw, 0.0, 0.0]))
box.add(Receiver("rx", position=rx, orientation=[rx_yaw, 0.0, 0.0]))

def solved(tx_shape, rx_shape):
    box.tx_array, box.rx_array = planar("iso", *tx_shape), planar("iso", *rx_shape)
    return PathSolver()(box, max_depth=1, los=True, specular_reflection=True, refraction=False, synthetic_array=True)

single = solved((1, 1), (1, 1))
names = ("tau", "theta_r", "phi_r", "theta_t", "phi_t", "valid")
answer["paths"] = {name: np.array(getattr(single, name))[0, 0].tolist() for name in names}
answer["paths"]["a"] = [np.array(part)[0, 0, 0, 0].tolist() for part in single.a]
response = solved((2, 2), (3, 5)).cfr(mi.Float(np.float32(asked["box"]["offsets"])), normalize_delays=False,
                                      out_type="numpy")[0, :, 0, :, 0]
answer["cfr"] = [response.real.tolist(), response.imag.tolist()]
json.dump(answer, sys.stdout)
"""


@pytest.fixture(scope="module")
def directions():
    generator = torch.Generator().manual_seed(0)
    zenith = torch.acos(2 * torch.rand(200, generator=generator) - 1)
    azimuth = (2 * torch.rand(200, generator=generator) - 1) * 3.1415
    return zenith, azimuth


@pytest.fixture(scope="module")
def sionna(directions):
    llvm = find_llvm()
    assert llvm.path is not None, f"this test needs sionna-rt and LLVM: {llvm.reason}"
    zenith, azimuth = directions
    asked = {
        "zenith": zenith.tolist(),
        "azimuth": azimuth.tolist(),
        "patterns": list(NAMES),
        "shapes": SHAPES,
        "frequency": FREQUENCY,
        "tx": TX,
        "rx": RX,
        "box": {"frequency": BOX_FREQUENCY, "tx": BOX_TX, "rx": BOX_RX, "offsets": ofdm(1e8, 16).tolist()},
    }
    done = subprocess.run(
        [sys.executable, "-W", "ignore", "-c", ORACLE],
        input=json.dumps(asked),
        capture_output=True,
        text=True,
        timeout=300,
        env={**os.environ, "DRJIT_LIBLLVM_PATH": str(llvm.path)},
        check=False,
    )
    assert done.returncode == 0, done.stderr[-2000:]
    return json.loads(done.stdout)


@pytest.mark.parametrize("name", NAMES)
def test_element_patterns_equal_sionnas(name, directions, sionna):
    ours = field_pattern(NAMES[name], direction_of(*directions))
    assert torch.allclose(ours, torch.tensor(sionna["field"][name]), rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("shape", SHAPES, ids=lambda shape: f"{shape[0]}x{shape[1]}")
def test_element_positions_equal_sionnas(shape, sionna):
    array = planar_array(*shape, vertical=0.6, horizontal=0.45)
    expected = torch.tensor(sionna["positions"][f"{shape[0]}x{shape[1]}"])
    assert torch.allclose(array.positions.float(), expected, atol=1e-6)


@pytest.mark.parametrize("shape", SHAPES, ids=lambda shape: f"{shape[0]}x{shape[1]}")
@pytest.mark.parametrize("name", NAMES)
def test_array_response_to_the_line_of_sight_equals_sionnas(name, shape, sionna):
    """Level devices, so that both vertical polarisations agree; relative to Friis and up to one common phase."""
    real, imaginary = (torch.tensor(part) for part in sionna["response"][f"{name} {shape[0]}x{shape[1]}"])
    array = planar_array(*shape, NAMES[name], vertical=0.6, horizontal=0.45)
    for index, (position, yaw) in enumerate(RX):
        towards = torch.tensor(TX) - torch.tensor(position)
        distance = float(torch.linalg.vector_norm(towards))
        friis = wavelength(FREQUENCY) / (4 * math.pi * distance)
        theirs = torch.complex(real[index], imaginary[index]) / friis
        ours = manifold(array, Pose.from_yaw(position, yaw).to_device(towards / distance))
        common = (theirs * ours.conj()).sum()
        theirs = theirs * (common.conj() / common.abs())
        assert float((ours - theirs).abs().max()) < 1e-5 * max(1.0, float(ours.abs().max()))


def test_frequency_response_of_a_room_equals_sionnas(sionna):
    """Line of sight and six mirrors of a room, both arrays, sixteen subcarriers, from paths between single antennas."""
    found = {name: torch.tensor(value) for name, value in sionna["paths"].items()}
    paths = Paths(
        coeff=torch.complex(*found["a"]),
        delay=found["tau"],
        aoa_zenith=found["theta_r"],
        aoa_azimuth=found["phi_r"],
        aod_zenith=found["theta_t"],
        aod_azimuth=found["phi_t"],
        valid=found["valid"],
        frequency=BOX_FREQUENCY,
        tx=Pose.from_yaw(*BOX_TX),
        rx=Pose.from_yaw(*BOX_RX),
    )
    assert int(paths.count) == 7
    spaced = {"vertical": 0.6, "horizontal": 0.45}
    rx, tx = planar_array(3, 5, "isotropic", **spaced), planar_array(2, 2, "isotropic", **spaced)
    ours = paths.cfr(rx, tx, ofdm(1e8, 16))
    theirs = torch.complex(*(torch.tensor(part) for part in sionna["cfr"]))
    assert ours.shape == theirs.shape == (15, 4, 16)
    assert float((ours - theirs).abs().max()) < 1e-5 * float(theirs.abs().max())
