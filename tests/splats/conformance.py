"""The laws that every backend obeys: pictures and gradients of the float64 reference.

`check(case, backend)` raises AssertionError. As a program, `python -m tests.splats.conformance` checks the native core
on the cases whose names are given, in whatever instruction set the environment asks for, and prints its name.
"""

import sys
from dataclasses import dataclass, field, replace
from functools import cache

import torch
from torch import Tensor

from rf3dgs.core.frames import Pose
from rf3dgs.core.grids import Camera, Panorama, View, equirect_grid, pinhole_grid
from rf3dgs.core.native import native_core
from rf3dgs.splats.compositing import Compositing
from rf3dgs.splats.raster import Raster
from rf3dgs.splats.rasterize import Backend, rasterize

NAMES = ("means", "quats", "scales", "opacities", "values", "background", "added", "screen_offset")
POSE = Pose.look_at(position=(-1.5, 0.5, 0.3), target=(0.0, 0.0, 0.0))
WINDOW = {"floor_db": -110.0, "ceil_db": -60.0}
FLIP = 1e-4


@dataclass(frozen=True)
class Case:
    """A scene, a view and what is done to the channels. `fuzzed` replaces half the Gaussians by unsound ones."""

    view: str = "pinhole"
    channels: int = 3
    compositing: Compositing = field(default_factory=Compositing)
    background: bool = False
    added: bool = False
    count: int = 250
    size: float = 0.15
    seed: int = 1
    fuzzed: bool = False


VIEWS: dict[str, View] = {
    "pinhole": Camera.of(POSE, pinhole_grid(52, 36, 90.0)),
    "panorama": Panorama.of(POSE, equirect_grid(54, 27)),
}
OPTIONS = {
    "background": Case(background=True),
    "gate": Case(compositing=Compositing(depth_gate=0.3), background=True),
    "little blur": Case(compositing=Compositing(blur=0.02), background=True),
    "much blur": Case(compositing=Compositing(blur=4.0), background=True),
    "normalise": Case(compositing=Compositing(normalise=True)),
    "added": Case(added=True),
    "db_window": Case(compositing=Compositing(transfer="db_window", **WINDOW)),
    "db_window, two of three": Case(
        compositing=Compositing(transfer=("db_window", "identity", "db_window"), **WINDOW), added=True
    ),
    "all": Case(compositing=Compositing(0.5, True, "db_window", **WINDOW), added=True),
    "dense": Case(size=0.4, count=400),
    "all, dense": Case(compositing=Compositing(0.3, True, "db_window", **WINDOW), added=True, size=0.4, count=400),
}
CASES = {f"{view}, {n} channels": Case(view, n) for view in VIEWS for n in (1, 2, 3, 4, 5, 8, 11)}
CASES |= {f"{view}, {name}": replace(case, view=view) for view in VIEWS for name, case in OPTIONS.items()}
CASES |= {f"{view}, fuzzed {seed}": Case(view, seed=seed, fuzzed=True) for view in VIEWS for seed in range(4)}


def tensors_of(case: Case) -> tuple[dict[str, Tensor], Tensor]:
    """What is given to `rasterize`, by name, in float32; and which Gaussians are not to be drawn."""
    generator = torch.Generator().manual_seed(case.seed)

    def uniform(*shape: int) -> Tensor:
        return torch.rand(*shape, generator=generator)

    view = VIEWS[case.view]
    linear = case.compositing.transfer != "identity"
    shown = 10 ** (-5 * uniform(case.count, case.channels) - 6) if linear else uniform(case.count, case.channels)
    tensors = {
        "means": (uniform(case.count, 3) - 0.5) * torch.tensor([8.0, 6.0, 3.0]),
        "quats": torch.randn(case.count, 4, generator=generator),
        "scales": case.size * torch.exp(0.7 * torch.randn(case.count, 3, generator=generator)),
        "opacities": uniform(case.count) ** (0.3 if case.size > 0.2 else 1.0),
        "values": shown,
    }
    if case.background:
        tensors["background"] = uniform(case.channels)
    if case.added:
        tensors["added"] = (1e-7 if linear else 1.0) * uniform(view.height, view.width, case.channels)
    if isinstance(view, Camera):
        tensors["screen_offset"] = torch.zeros(case.count, 2)
    refused = _spoil(tensors, view, generator) if case.fuzzed else torch.zeros(case.count, dtype=torch.bool)
    return tensors, refused


def _spoil(tensors: dict[str, Tensor], view: View, generator: torch.Generator) -> Tensor:
    """Make every second Gaussian extreme in one respect or another; returns who is not to be drawn `[gaussian]`."""
    centre, ahead = view.position, view.viewmat[2, :3]
    unsound = [
        ("means", [torch.nan] * 3), ("means", [1.0, torch.inf, 0.0]), ("means", [0.0, 1e30, 0.0]),
        ("means", centre), ("means", centre + 0.03 * ahead), ("quats", [0.0] * 4), ("quats", [1e-30] * 4),
        ("quats", [1.0, 0.0, torch.inf, 0.0]), ("scales", [0.1, -0.1, 0.1]), ("scales", [0.1, 0.1, 1e25]),
        ("scales", [torch.nan, 0.1, 0.1]), ("opacities", 1e-41), ("opacities", torch.nan), ("opacities", -1.0),
        ("values", torch.nan), ("values", -torch.inf),
    ]  # fmt: skip
    sound = [
        ("means", centre - 0.5 * ahead), ("means", centre + 500.0 * ahead), ("scales", [0.5, 1e-6, 1e-6]),
        ("scales", [0.4, 0.4, 1e-7]), ("scales", [1e-40, 1e-42, 1e-3]), ("scales", [0.0] * 3), ("opacities", 1.0),
        ("values", 1e-42),
    ]  # fmt: skip
    refused = torch.zeros(len(tensors["means"]), dtype=torch.bool)
    for index in range(0, len(refused), 2):
        kind = int(torch.randint(len(unsound) + len(sound), (1,), generator=generator))
        name, value = (unsound + sound)[kind]
        tensors[name][index] = torch.as_tensor(value)
        refused[index] = kind < len(unsound)
    return refused


def drawn(
    case: Case, backend: Backend, tensors: dict[str, Tensor], device: str = "cpu"
) -> tuple[Raster, dict[str, Tensor]]:
    """The picture and the leaves that its gradients go to."""
    leaves = {name: tensor.clone().to(device).requires_grad_() for name, tensor in tensors.items()}
    options = {name: leaf for name, leaf in leaves.items() if name not in NAMES[:5]}
    arguments = [leaves[name] for name in NAMES[:5]]
    raster = rasterize(*arguments, VIEWS[case.view], **options, compositing=case.compositing, backend=backend)  # type: ignore[arg-type]
    return raster, leaves


@cache
def _expected(case: Case) -> tuple[Raster, dict[str, Tensor]]:
    tensors, refused = tensors_of(case)
    precise = {name: tensor.double() for name, tensor in tensors.items()}
    precise["opacities"][refused] = 0.0
    return drawn(case, "reference", precise)


def check(case: Case, backend: Backend, *, device: str = "cpu", tolerance: float = 3e-4) -> None:
    """Assert that a backend draws a case as the float64 reference does, and that its gradients agree.

    Where a cut-off falls the other way a pixel jumps; few may, and the loss whose gradients are compared leaves them
    out.
    `tolerance` is of every parameter's gradient, relative in the L2 norm.
    """
    found, leaves = drawn(case, backend, tensors_of(case)[0], device)
    expected, precise = _expected(case)
    with torch.no_grad():
        of_values, of_weight = found.values.cpu() - expected.values, found.weight.cpu() - expected.weight
        difference = torch.cat((of_values, of_weight[..., None]), -1).abs()
    assert bool(torch.isfinite(difference).all())
    jumps = (difference > FLIP).any(-1)
    assert int(jumps.sum()) <= 2 + 0.002 * jumps.numel(), f"{int(jumps.sum())} pixels differ, by {difference.max():.1e}"
    assert float(difference[~jumps].mean()) < 1e-6
    sizes = torch.isclose(found.radii.cpu().double(), expected.radii, rtol=1e-3, atol=1e-2)
    assert bool(sizes.all()), "radii differ"
    generator = torch.Generator().manual_seed(5)
    of_values = torch.randn(expected.values.shape, generator=generator) * ~jumps[..., None]
    of_weight = torch.randn(expected.weight.shape, generator=generator) * ~jumps
    for raster, inputs in ((found, leaves), (expected, precise)):
        for leaf in inputs.values():
            leaf.grad = None
        loss = (raster.values.cpu() * of_values).sum() + (raster.weight.cpu() * of_weight).sum()
        loss.backward(retain_graph=raster is expected)
    for name, leaf in leaves.items():
        mine, theirs = leaf.grad, precise[name].grad
        assert mine is not None, name
        assert theirs is not None, name
        assert bool(torch.isfinite(mine).all()), name
        away = float((mine.cpu().double() - theirs).norm() / theirs.norm().clamp_min(1e-12))
        assert away < tolerance, f"gradient of {name} is {away:.1e} away"


def check_resampled(case: Case, backend: Backend, *, device: str = "cpu") -> None:
    """Assert that a backend that interpolates a panorama draws about the same, and that its gradients point alike."""
    found, leaves = drawn(case, backend, tensors_of(case)[0], device)
    expected, precise = _expected(case)
    assert bool(torch.isfinite(found.values).all())
    assert float((found.weight.cpu() - expected.weight).abs().mean()) < 0.03
    for raster, inputs in ((found, leaves), (expected, precise)):
        for leaf in inputs.values():
            leaf.grad = None
        raster.weight.sum().backward(retain_graph=raster is expected)
    mine, theirs = leaves["opacities"].grad, precise["opacities"].grad
    assert mine is not None
    assert theirs is not None
    assert float(torch.nn.functional.cosine_similarity(mine.cpu().double(), theirs, dim=0)) > 0.95


if __name__ == "__main__":
    core = native_core()
    assert core is not None
    for name in sys.argv[1:]:
        check(CASES[name], "native")
    sys.stdout.write(core.info()["instruction_set"])
