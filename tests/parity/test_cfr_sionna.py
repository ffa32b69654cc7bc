"""Channel frequency responses between arrays against Sionna's own, over all paths of a small room."""

import math

import numpy as np
import pytest
import torch

from rf3dgs.channel.arrays import ofdm, planar_array
from rf3dgs.channel.paths import Paths
from rf3dgs.channel.response import cfr
from rf3dgs.core.frames import Pose
from rf3dgs.propagation.llvm import find_llvm, mitsuba_variant
from rf3dgs.propagation.sites import shapes
from rf3dgs.propagation.sites.scene import Scene, SceneObject
from rf3dgs.propagation.sites.scene_files import write_radio_scene

pytestmark = pytest.mark.oracle

FREQUENCY, BANDWIDTH, SUBCARRIERS = 1e9, 100e6, 48
TX, YAW_TX = (0.3, 0.4, 0.6), -0.4
RX = (((0.9, 0.7, 0.35), 0.3), ((0.7, 0.25, 0.7), 2.6))
RECEIVE, TRANSMIT = (2, 3), (3, 1)
SPACING = {"vertical": 0.6, "horizontal": 0.45}


@pytest.fixture(scope="module")
def solve(tmp_path_factory):
    """A function (receive shape, transmit shape) -> Sionna's paths in a concrete box of 1.2 x 1.0 x 0.9 m."""
    assert find_llvm().path is not None, f"this test needs sionna-rt and LLVM: {find_llvm().reason}"
    from rf3dgs.propagation.sionna import VARIANT, import_sionna

    rt = import_sionna()
    vertices, faces, _ = shapes.box((0, 0, 0), (1.2, 1.0, 0.9))
    bounds = ((0, 0, 0), (1.2, 1.0, 0.9))
    box = SceneObject("box", vertices, faces[:, [0, 2, 1]], "concrete", 0.0)
    site = Scene("box", (box,), Pose(TX), bounds, bounds, bounds, FREQUENCY)
    path = write_radio_scene(site, tmp_path_factory.mktemp("box"))

    def array(shape):
        rows, cols = shape
        spacing = {f"{name}_spacing": value for name, value in SPACING.items()}
        return rt.PlanarArray(num_rows=rows, num_cols=cols, **spacing, pattern="iso", polarization="V")

    def run(receive, transmit):
        with mitsuba_variant(VARIANT):
            scene = rt.load_scene(str(path), merge_shapes=False)
            scene.frequency = FREQUENCY
            scene.rx_array, scene.tx_array = array(receive), array(transmit)
            scene.add(rt.Transmitter("tx", position=TX, orientation=[YAW_TX, 0.0, 0.0]))
            for index, (position, yaw) in enumerate(RX):
                scene.add(rt.Receiver(f"rx{index}", position=position, orientation=[yaw, 0.0, 0.0]))
            found = rt.PathSolver(deterministic=True)(
                scene, max_depth=2, samples_per_src=20_000, synthetic_array=True, refraction=False
            )
            offsets = ofdm(BANDWIDTH, SUBCARRIERS).numpy().astype(np.float32)
            response = found.cfr(frequencies=offsets, normalize=False, normalize_delays=False, out_type="numpy")
            return paths_of(found), torch.from_numpy(response[:, :, 0, :, 0, :])

    return run


def paths_of(found) -> Paths:
    """Vertical to vertical, between the first elements."""
    real, imaginary = (torch.from_numpy(np.array(part)[:, 0, 0, 0]) for part in found.a)
    names = {"aoa_zenith": "theta_r", "aoa_azimuth": "phi_r", "aod_zenith": "theta_t", "aod_azimuth": "phi_t"}
    columns = {name: torch.from_numpy(np.array(getattr(found, theirs))[:, 0]) for name, theirs in names.items()}
    rx = Pose.from_yaw([position for position, _ in RX], torch.tensor([yaw for _, yaw in RX]))
    return Paths(
        coeff=torch.complex(real, imaginary),
        delay=torch.from_numpy(np.array(found.tau)[:, 0]),
        valid=torch.from_numpy(np.array(found.valid)[:, 0]),
        frequency=FREQUENCY,
        tx=Pose.from_yaw(TX, YAW_TX),
        rx=rx,
        **columns,
    )


def test_channel_frequency_response_between_arrays_is_sionnas(solve):
    """1e-5 of the largest entry: Sionna's float32 phase of 10 wavelengths is exact to 4e-6 rad.

    Its reference paths come from one element each, so that every array phase in ours is our own.
    """
    paths, _ = solve((1, 1), (1, 1))
    assert int(paths.count.min()) >= 25, "the line of sight and all reflections of first and second order"
    assert float(paths.delay[paths.valid].max()) * FREQUENCY < 12
    _, theirs = solve(RECEIVE, TRANSMIT)
    ours = cfr(
        paths,
        planar_array(*RECEIVE, "isotropic", **SPACING),
        planar_array(*TRANSMIT, "isotropic", **SPACING),
        ofdm(BANDWIDTH, SUBCARRIERS),
    )
    assert ours.shape == theirs.shape == (2, 6, 3, SUBCARRIERS)
    assert float((ours - theirs).abs().max()) < 1e-5 * float(theirs.abs().max())
    mean_db = 20 * math.log10(float(theirs.abs().mean()))
    assert -60 < mean_db < -20, "there is something to compare"
