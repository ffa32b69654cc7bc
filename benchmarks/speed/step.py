"""One training step, native against reference, in the same run.

    python -m benchmarks.speed.step [--gaussians 2000] [--width 96] [--height 64] [--json FILE]

A step is: harmonics, forward, L1 + D-SSIM, backward, Adam. Both run on one thread unless told otherwise, and CPU time
is compared (the median of the repetitions), so that a machine shared with others gives the same answer. Exits with 1
when the native step is not at least 20 times faster.
"""

import argparse
import json
import statistics
import sys
import time
from collections.abc import Callable
from pathlib import Path

import torch

from benchmarks.speed.scenes import room, view
from rf3dgs.core.files import write_whole
from rf3dgs.splats.harmonics import basis, evaluate, view_directions
from rf3dgs.splats.image_loss import l1_ssim, l1_ssim_reference
from rf3dgs.splats.rasterize import pick_backend, rasterize

GOAL = 20.0


def make_step(backend: str, gaussians: int, width: int, height: int, *, frozen: bool) -> Callable[[], float]:
    """A function that does one training step and returns its loss."""
    scene, camera = room(gaussians), view(width, height)
    target = torch.rand(height, width, 3, generator=torch.Generator().manual_seed(1))
    means, quats, scales = (scene[name].requires_grad_(not frozen) for name in ("means", "quats", "scales"))
    logit = torch.logit(scene["opacities"]).requires_grad_()
    sh = scene["sh"].requires_grad_()
    trained = [logit, sh] if frozen else [means, quats, scales, logit, sh]
    optimiser = torch.optim.Adam(trained, lr=1e-3)
    directions = view_directions(means.detach(), camera.position)

    def step() -> float:
        optimiser.zero_grad(set_to_none=True)
        native = backend == "native"
        values = evaluate(sh, directions) if native else torch.einsum("gk,gkc->gc", basis(directions, 3), sh)
        raster = rasterize(means, quats, scales, torch.sigmoid(logit), values + 0.5, camera, backend=backend)  # type: ignore[arg-type]
        loss = (l1_ssim if native else l1_ssim_reference)(raster.values, target)
        loss.backward()
        optimiser.step()
        return float(loss.detach())

    return step


def measure(step: Callable[[], float], repetitions: int) -> dict[str, float]:
    """Median CPU and least wall-clock time of a step [ms] and the last loss."""
    step()
    cpu, wall, loss = [], [], 0.0
    for _ in range(repetitions):
        started, started_cpu = time.perf_counter(), time.process_time()
        loss = step()
        wall.append(1e3 * (time.perf_counter() - started))
        cpu.append(1e3 * (time.process_time() - started_cpu))
    return {"cpu_ms": statistics.median(cpu), "wall_ms": min(wall), "loss": loss}


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--gaussians", type=int, default=2000)
    parser.add_argument("--width", type=int, default=96)
    parser.add_argument("--height", type=int, default=64)
    parser.add_argument("--large", type=int, default=100_000, help="Gaussians of a native step at 300x200, or 0")
    parser.add_argument("--json", type=Path, help="write the figures to this file")
    parser.add_argument("--threads", type=int, default=1, help="threads of torch and of the core")
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    name, reason = pick_backend()
    print(f"backend: {name} ({reason})")
    if name != "native":
        return 1
    size = (options.gaussians, options.width, options.height)
    result: dict[str, object] = {"backend": reason, "gaussians": size[0], "width": size[1], "height": size[2]}
    worst = float("inf")
    for kind, frozen in (("frozen geometry", True), ("all parameters", False)):
        reference = measure(make_step("reference", *size, frozen=frozen), 3)
        native = measure(make_step("native", *size, frozen=frozen), 30)
        ratio = reference["cpu_ms"] / native["cpu_ms"]
        worst = min(worst, ratio)
        result[kind] = {"reference": reference, "native": native, "ratio": ratio}
        print(
            f"{kind}, {size[0]} Gaussians, {size[1]}x{size[2]}: reference {reference['cpu_ms']:.1f} ms CPU, "
            f"native {native['cpu_ms']:.2f} ms CPU, ratio {ratio:.0f}"
        )
    if options.large:
        for kind, frozen in (("frozen geometry", True), ("all parameters", False)):
            native = measure(make_step("native", options.large, 300, 200, frozen=frozen), 10)
            result[f"{kind}, large"] = {"gaussians": options.large, **native}
            print(
                f"{kind}, {options.large} Gaussians, 300x200: native {native['cpu_ms']:.1f} ms CPU, "
                f"{native['wall_ms']:.1f} ms wall (best)"
            )
    print(f"{'at least' if worst >= GOAL else 'NOT'} {GOAL:.0f} times faster than the reference: {worst:.0f}")
    if options.json is not None:
        write_whole(options.json, (json.dumps(result, indent=2) + "\n").encode())
    return 0 if worst >= GOAL else 1


if __name__ == "__main__":
    sys.exit(main())
