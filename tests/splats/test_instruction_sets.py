"""The core forced to each instruction set, in a process of its own that runs this file as a script."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

from rf3dgs.core.frames import Pose
from rf3dgs.core.grids import Camera, pinhole_grid
from rf3dgs.core.native import native_core
from rf3dgs.splats.harmonics import evaluate, view_directions
from rf3dgs.splats.image_loss import l1_ssim
from rf3dgs.splats.obstacles import Obstacles
from rf3dgs.splats.rasterize import rasterize
from rf3dgs.splats.rates import Rates
from rf3dgs.splats.target import Target
from rf3dgs.splats.trainer import Trainer

SETS = ("avx512", "avx2", "portable")
GRADIENTS = ("means", "quats", "scales", "opacities", "sh")


def results() -> dict[str, np.ndarray]:
    """A picture, its loss and gradients, and Gaussians after twenty training steps."""
    generator = torch.Generator().manual_seed(5)
    count, channels = 3000, 3
    scene = {
        "means": torch.randn(count, 3, generator=generator) * torch.tensor([1.5, 1.5, 1.0]) + torch.tensor([4.0, 0, 0]),
        "quats": torch.randn(count, 4, generator=generator),
        "scales": torch.exp(0.7 * torch.randn(count, 3, generator=generator) - 3.0),
        "opacities": 0.05 + 0.9 * torch.rand(count, generator=generator),
        "sh": 0.3 * torch.randn(count, 16, channels, generator=generator),
    }
    target = torch.rand(60, 90, channels, generator=generator)
    camera = Camera.of(Pose.look_at(position=(0.0, 0.0, 0.0), target=(1.0, 0.1, 0.0)), pinhole_grid(90, 60, 80.0))
    leaves = {name: tensor.clone().requires_grad_() for name, tensor in scene.items()}
    values = evaluate(leaves["sh"], view_directions(scene["means"], camera.position), offset=0.5)
    raster = rasterize(*(leaves[name] for name in GRADIENTS[:4]), values, camera, backend="native")
    loss = l1_ssim(raster.values, target)
    loss.backward()
    trainer = Trainer(
        *(scene["means"], scene["quats"], scene["scales"].log(), torch.logit(scene["opacities"]), scene["sh"]),
        train=("geometry", "opacity", "sh"),
        backend="native",
    )
    rates = Rates(means=1e-3, quats=1e-3, log_scales=5e-3, logit_opacities=1e-2, level=1e-2, bands=1e-3)
    steps = [trainer.step(camera, Target(target), rates) for _ in range(20)]
    gradients = {name: leaf.grad for name, leaf in leaves.items()}
    obstacles = Obstacles(scene["means"], scene["quats"], scene["scales"], scene["opacities"])
    start = torch.randn(400, 3, generator=generator) * 2 + torch.tensor([4.0, 0, 0])
    end = torch.randn(400, 3, generator=generator) * 2 + torch.tensor([4.0, 0, 0])
    passed = obstacles.transmittance(start, end)
    arrays = {
        "passed": passed,
        "picture": raster.values,
        "weight": raster.weight,
        "radii": raster.radii,
        "loss": loss,
        **gradients,
    }
    kept = {name: tensor.detach().numpy() for name, tensor in arrays.items() if tensor is not None}
    core = native_core()
    assert core is not None
    return kept | {"steps": np.array(steps), "name": np.array(core.info()["instruction_set"])}


def on_threads(threads: int) -> dict[str, np.ndarray]:
    os.environ["RF3DGS_THREADS"] = str(threads)
    return results()


def run(instruction_set: str, folder: Path) -> dict[str, np.ndarray]:
    """`results` of a process that asks for an instruction set; `again.` before the names of those on two threads."""
    out = folder / f"{instruction_set}.npz"
    environment = os.environ | {"RF3DGS_ISA": instruction_set}
    subprocess.run([sys.executable, __file__, str(out)], env=environment, check=True, timeout=300)
    with np.load(out) as arrays:
        return dict(arrays)


@pytest.fixture(scope="module")
def by_set(tmp_path_factory: pytest.TempPathFactory) -> dict[str, dict[str, np.ndarray]]:
    """`run` by the instruction sets that this machine has."""
    if native_core() is None:
        pytest.skip("the native core is not built")
    folder = tmp_path_factory.mktemp("sets")
    found = {name: run(name, folder) for name in SETS}
    return {name: arrays for name, arrays in found.items() if str(arrays["name"]) == name}


def relative(got: np.ndarray, expected: np.ndarray) -> float:
    return float(np.linalg.norm(got - expected) / np.linalg.norm(expected))


def test_the_portable_set_can_always_be_asked_for(by_set: dict[str, dict[str, np.ndarray]]) -> None:
    assert "portable" in by_set


def test_pictures_agree_across_instruction_sets(by_set: dict[str, dict[str, np.ndarray]]) -> None:
    """A contribution at the 1/255 cut may fall on either side of it."""
    expected = by_set["portable"]
    for name, got in by_set.items():
        for field in ("picture", "weight"):
            difference = np.abs(got[field] - expected[field])
            assert difference.mean() < 1e-6, (name, field)
            assert (difference > 1e-4).sum() <= 8, (name, field)
            assert difference.max() < 2e-2, (name, field)
        assert abs(got["loss"] - expected["loss"]) < 1e-6, name
        assert np.allclose(got["radii"], expected["radii"], rtol=1e-5), name


def test_gradients_agree_across_instruction_sets(by_set: dict[str, dict[str, np.ndarray]]) -> None:
    expected = by_set["portable"]
    for name, got in by_set.items():
        for field in GRADIENTS:
            assert relative(got[field], expected[field]) < 3e-5, (name, field)


def test_training_agrees_across_instruction_sets(by_set: dict[str, dict[str, np.ndarray]]) -> None:
    expected = by_set["portable"]["steps"]
    assert expected[-1] < 0.98 * expected[0]
    for name, got in by_set.items():
        assert np.abs(got["steps"] - expected).max() < 1e-5, name


def test_what_passes_agrees_across_instruction_sets(by_set: dict[str, dict[str, np.ndarray]]) -> None:
    """Positions differ by rounding: 2e-6 m of Gaussians down to 4 mm; below 1e-4 a segment may stop."""
    expected = by_set["portable"]["passed"]
    assert 0.05 < (expected > 0.5).mean() < 0.95
    for name, got in by_set.items():
        assert np.abs(got["passed"] - expected).max() < 5e-4, name


def test_each_instruction_set_gives_the_same_bits_on_one_and_two_threads(
    by_set: dict[str, dict[str, np.ndarray]],
) -> None:
    for name, arrays in by_set.items():
        for field in (field for field in arrays if f"again.{field}" in arrays):
            assert arrays[field].tobytes() == arrays[f"again.{field}"].tobytes(), (name, field)


def test_another_process_gives_the_same_bits(by_set: dict[str, dict[str, np.ndarray]], tmp_path: Path) -> None:
    name = next(iter(by_set))
    again = run(name, tmp_path)
    for field, expected in by_set[name].items():
        assert again[field].tobytes() == expected.tobytes(), field


if __name__ == "__main__":
    twice = {f"again.{name}": array for name, array in on_threads(2).items()}
    np.savez(Path(sys.argv[1]), **on_threads(1), **twice)  # pyright: ignore[reportArgumentType]
