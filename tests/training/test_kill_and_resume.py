"""A run killed with SIGKILL and started again ends bitwise where a run that was never killed ends."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import torch
from safetensors.torch import load_file

SLOW = """
import time

class Slow:
    def start(self, label, total, done=0): print("from", done, flush=True)
    def update(self, done, note=""): time.sleep(0.01)
    def finish(self, note=""): pass
"""

VISUAL = """
import math, sys
from safetensors.torch import save_file
from rf3dgs.core.frames import Pose
from rf3dgs.core.grids import Camera, pinhole_grid
from rf3dgs.data.photo import Photo
from rf3dgs.splats.gaussians import Gaussians
from rf3dgs.training.config import VisualConfig
from rf3dgs.training.photographs import render_photo
from rf3dgs.training.visual import fit_geometry

out, checkpoints = sys.argv[1:]
truth = Gaussians.random(30, (-1, -1, -1), (1, 1, 1), degree=0, seed=3)
grid = pinhole_grid(32, 24, 60)
cameras = [Camera.of(Pose.look_at((3 * math.cos(a), 3 * math.sin(a), 0.5), (0.0, 0.0, 0.0)), grid) for a in (0, 2, 4)]
photos = [Photo(str(i), camera, pixels=render_photo(truth, camera)) for i, camera in enumerate(cameras)]
config = VisualConfig(
    steps=150, start_count=60, max_count=120, degree=1, bounds=((-1, -1, -1), (1, 1, 1)), checkpoint_every=10,
    grow_gradient=1e-5, reset_every=50,
)

geometry = fit_geometry(photos, config, progress=Slow(), checkpoint_dir=None if checkpoints == "none" else checkpoints)
save_file(geometry.tensors(), out)
"""


RADIO = """
import sys
import torch
from safetensors.torch import save_file
from rf3dgs.core.frames import Pose
from rf3dgs.core.grids import equirect_grid
from rf3dgs.spectra.spectrum import Instrument, Spectrum
from rf3dgs.splats.gaussians import Gaussians
from rf3dgs.training.config import RadioConfig
from rf3dgs.training.radio import fit_radio

out, checkpoints = sys.argv[1:]
generator = torch.Generator().manual_seed(5)
geometry = Gaussians.random(60, (-2, -2, 0), (2, 2, 2), degree=0, seed=4)
pose = Pose(torch.rand(3, 3, generator=generator) - 0.5 + torch.tensor([0.0, 0.0, 1.0]))
tx = Pose((1.5, 1.5, 1.8))
grid = equirect_grid(24, 12)
aod = torch.nn.functional.normalize(torch.randn(3, 12, 24, 3, generator=generator), dim=-1)
spectra = Spectrum(
    10 ** (-8 - 4 * torch.rand(3, 12, 24, generator=generator)), grid, pose, 60e9, Instrument.gaussian(0.4),
    delay=1e-8 * (1 + torch.rand(3, 12, 24, generator=generator)), aod=aod, tx=tx,
)
config = RadioConfig(model="paper", steps=150, checkpoint_every=10)
folder = None if checkpoints == "none" else checkpoints
field = fit_radio(geometry, spectra, config, progress=Slow(), checkpoint_dir=folder)
seen = field.render(pose, grid)
save_file({"power": seen.power, "delay": seen.delay, "aod": seen.aod}, out)
"""


def run(script: str, out: Path, checkpoints: Path | str) -> subprocess.Popen:
    command = [sys.executable, "-c", SLOW + script, str(out), str(checkpoints)]
    return subprocess.Popen(command, stdout=subprocess.PIPE, text=True)


def kill_after_a_checkpoint(process: subprocess.Popen, folder: Path, beyond: int) -> None:
    """SIGKILL as soon as a checkpoint later than iteration `beyond` exists."""
    deadline = time.monotonic() + 120
    while time.monotonic() < deadline and process.poll() is None:
        newest = max((int(path.stem.removeprefix("step-")) for path in folder.glob("step-*.json")), default=0)
        if newest > beyond:
            os.kill(process.pid, signal.SIGKILL)
            process.communicate()
            return
        time.sleep(0.005)
    process.kill()
    process.communicate()
    raise AssertionError(f"the run ended by itself (exit {process.poll()}) before it could be killed")


def assert_killed_equals_uninterrupted(script: str, tmp_path: Path, kills: tuple[int, ...]) -> None:
    calm = run(script, tmp_path / "calm.safetensors", "none")
    assert calm.communicate(timeout=300)[0].strip() == "from 0"
    checkpoints = tmp_path / "checkpoints"
    for beyond in kills:
        kill_after_a_checkpoint(run(script, tmp_path / "killed.safetensors", checkpoints), checkpoints, beyond)
        assert not (tmp_path / "killed.safetensors").exists()
    resumed = run(script, tmp_path / "killed.safetensors", checkpoints)
    first_line = resumed.communicate(timeout=300)[0].strip()
    assert resumed.returncode == 0
    assert int(first_line.removeprefix("from ")) > kills[-1]
    calm_tensors, killed_tensors = (load_file(tmp_path / f"{name}.safetensors") for name in ("calm", "killed"))
    assert calm_tensors.keys() == killed_tensors.keys()
    for name, tensor in calm_tensors.items():
        assert torch.equal(tensor, killed_tensors[name]), name


def test_the_visual_stage_survives_sigkill_bit_by_bit(tmp_path):
    assert_killed_equals_uninterrupted(VISUAL, tmp_path, (20, 70))


def test_the_radio_stage_survives_sigkill_bit_by_bit(tmp_path):
    assert_killed_equals_uninterrupted(RADIO, tmp_path, (40,))
