"""What the level of detail costs and saves: a million Gaussians against their merged version.

    python -m benchmarks.quality.detail [--gaussians 1000000] [--held-out 4] [--pixel 1.0] [--train 1000] [--json FILE]

Three scenes: the built-in lobby sampled from its mesh, the room of the speed benchmarks with walls closed (Gaussians
of twice the size), and that room as it is, which one sees through. All carry a smooth gain: harmonics of degree 3 that
vary over metres, another level for each direction of a wall and, in the lobby, for each colour. One version leaves out
what spheres of 180x90 at 80 known positions do not show; another merges for those positions and carries the mean
harmonics, as nothing is trained on it. Pictures are taken at positions that were not known: pinholes of 300x200 over
90 degrees and spheres of 360x180. Errors are shares of the dB window (harmonics give window units);
depths are means over the weight. Times are CPU times of all threads, the mean over the pinholes of each one's least: a
picture of one channel, harmonics included, and a training step with frozen geometry.

With --train, the radio stage then learns the shipped lobby's spectra in so many steps on 300,000 Gaussians of its mesh,
whole and merged, and is compared with the validation spectra.
"""

import argparse
import json
import math
import time
from collections.abc import Sequence
from pathlib import Path

import torch
from torch import Tensor

from benchmarks.speed.scenes import room
from benchmarks.speed.timing import measure
from rf3dgs.cli.facts import open_dataset, open_scene
from rf3dgs.core.files import write_whole
from rf3dgs.core.frames import Pose
from rf3dgs.core.grids import View, equirect_grid, pinhole_grid, view_of
from rf3dgs.splats.detail import level_of_detail, prune_unseen
from rf3dgs.splats.gaussians import Gaussians
from rf3dgs.splats.harmonics import view_values
from rf3dgs.splats.rasterize import rasterize
from rf3dgs.splats.rates import Rates
from rf3dgs.splats.surface import normals, sample_mesh
from rf3dgs.splats.target import Target
from rf3dgs.splats.trainer import Trainer
from rf3dgs.training.config import RadioConfig
from rf3dgs.training.radio import fit_radio

POSITIONS = 80  # that merging knows


def smooth_gain(gaussians: Gaussians, seed: int = 3) -> Tensor:
    """Degree-3 harmonics `[gaussian, 16, 1]` that vary over 1 to 4 m, with another level for each normal and colour."""
    generator = torch.Generator().manual_seed(seed)
    means, result = gaussians.means, torch.zeros(len(gaussians), 16, 1)
    for k in range(16):
        wave = torch.zeros(len(means))
        for _ in range(4):
            along = torch.nn.functional.normalize(torch.randn(3, generator=generator), dim=0)
            length, phase = 1 + 3 * torch.rand((), generator=generator), torch.rand((), generator=generator)
            wave += 0.5 * torch.sin(2 * math.pi * ((means @ along) / length + phase))
        result[:, k, 0] = wave * (0.35 if k == 0 else 0.12 / (1 + math.isqrt(k)))
    result[:, 0, 0] += 0.17 * (normals(gaussians) @ torch.tensor([1.0, 0.6, 0.3]))
    result[:, 0, 0] += 0.3 * gaussians.sh[:, 0].mean(-1)
    return result


def scenes(count: int) -> dict[str, Gaussians]:
    """The three scenes with their gain."""
    vertices, faces, colours = open_scene("lobby").mesh()
    lobby = sample_mesh(vertices, faces, count=count, colours=colours)
    speed = room(count, channels=1)
    tensors = {name: speed[name] for name in ("means", "quats")} | {
        "log_scales": speed["scales"].log(),
        "logit_opacities": torch.logit(speed["opacities"]),
        "sh": torch.zeros(count, 1, 1),
    }
    porous = Gaussians(**tensors)
    closed = Gaussians(**(tensors | {"log_scales": tensors["log_scales"] + math.log(2.0)}))
    found = {"lobby": lobby, "room, closed": closed, "room, porous": porous}
    return {name: Gaussians(**(one.tensors() | {"sh": smooth_gain(one)})) for name, one in found.items()}


def draw(gaussians: Gaussians, view: View) -> Tensor:
    """Gain, depth over the weight [m] and weight `[row, col, 3]`."""
    gain = view_values(gaussians.sh, gaussians.means, view.position, offset=0.5)
    depth = torch.linalg.vector_norm(gaussians.means - view.position, dim=-1, keepdim=True)
    shape = gaussians.means, gaussians.quats, gaussians.scales, gaussians.opacities
    raster = rasterize(*shape, torch.cat((gain, depth), -1), view)
    weight = raster.weight[..., None]
    return torch.cat((raster.values[..., :1], raster.values[..., 1:] / weight.clamp_min(1e-3), weight), -1)


def compare(whole: Gaussians, merged: Gaussians, views: Sequence[View]) -> dict[str, float]:
    """Errors over all pixels of all views, a pixel weighing its solid angle."""
    error, weight = [], []
    for view in views:
        error.append((draw(merged, view) - draw(whole, view)).flatten(0, 1))
        weight.append(view.grid.solid_angle.flatten())
    difference, share = torch.cat(error).double(), torch.cat(weight).double()
    share /= share.sum()
    gain, depth, blended = difference.unbind(-1)
    return {
        "mean_percent": 100 * float((share * gain.abs()).sum()),
        "rmse_percent": 100 * float((share * gain.square()).sum().sqrt()),
        "weight": float((share * blended).sum()),
        "depth_cm": 100 * float((share * depth.abs()).sum()),
    }


def costs(gaussians: Gaussians, views: Sequence[View]) -> dict[str, float]:
    """CPU times [ms] of a picture and of a training step with frozen geometry, one channel, mean over the views."""
    trainer = Trainer(*gaussians.tensors().values())
    targets = [Target(torch.full((view.height, view.width, 1), 0.5)) for view in views]
    rates = Rates(logit_opacities=1e-4, level=1e-4, bands=1e-4)
    drawing = measure(lambda view: trainer.draw(views[view]), len(views), rounds=8)
    training = measure(lambda view: trainer.step(views[view], targets[view], rates), len(views), rounds=8)
    return {"render_ms": drawing.cpu_min, "step_ms": training.cpu_min}


def report(name: str, whole: Gaussians, reduced: Gaussians, views: dict[str, Sequence[View]]) -> dict[str, object]:
    """Print and return the errors of a reduced version."""
    print(f"{name}: {len(whole):,} -> {len(reduced):,} Gaussians")
    row: dict[str, object] = {"gaussians": len(reduced)}
    for kind, some in views.items():
        row[kind] = error = compare(whole, reduced, some)
        print(
            f"  {kind}: gain error mean {error['mean_percent']:.2f} %, RMSE {error['rmse_percent']:.2f} % of the "
            f"window; weight {error['weight']:+.4f}; depth {error['depth_cm']:.1f} cm"
        )
    return row


def trained(steps: int) -> dict[str, dict[str, float]]:
    """RMSE [share of the window] of fields trained on the shipped lobby, on its mesh whole and merged."""
    dataset = open_dataset("lobby")
    train, validation = dataset.train.spectra, dataset.validation.spectra
    assert train is not None
    assert validation is not None
    vertices, faces, colours = open_scene("lobby").mesh()
    geometry = sample_mesh(vertices, faces, count=300_000, colours=colours)
    result = {}
    for detail in ("keep", "merge"):
        started = time.process_time()
        field = fit_radio(geometry, train, RadioConfig(model="paper", steps=steps, detail=detail))
        seconds = time.process_time() - started
        drawn = field.render(validation.pose, validation.grid, csi=False).power
        error = field.window.encode(drawn) - field.window.encode(validation.power)
        rmse = 100 * float(error.square().mean().sqrt())
        result[detail] = {"gaussians": len(field.surface), "rmse_percent": rmse, "cpu_s": seconds}
        print(f"{detail}: {len(field.surface):,} Gaussians, {seconds:.0f} s CPU, validation RMSE {rmse:.2f} %")
    return result


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--gaussians", type=int, default=1_000_000)
    parser.add_argument("--held-out", type=int, default=4, help="positions at which pictures are compared")
    parser.add_argument("--pixel", type=float, default=1.0, help="[deg]")
    parser.add_argument("--train", type=int, default=0, help="steps of the radio stage; 0 leaves it out")
    parser.add_argument("--json", type=Path, help="write the figures to this file")
    options = parser.parse_args()
    torch.set_num_threads(1)
    places = open_scene("lobby").receivers(POSITIONS + options.held_out, 0).position
    known = places[:POSITIONS]
    poses = [
        Pose.look_at(tuple(here), (here[0] + math.cos(aim), here[1] + math.sin(aim), here[2] - 0.1))
        for here, aim in zip(places[POSITIONS:].tolist(), [2.4 * n for n in range(options.held_out)], strict=True)
    ]
    views: dict[str, Sequence[View]] = {
        "pinhole": [view_of(pose, pinhole_grid(300, 200, 90.0)) for pose in poses],
        "sphere": [view_of(pose, equirect_grid(360, 180)) for pose in poses],
    }
    surroundings = [view_of(Pose(place), equirect_grid(180, 90)) for place in known]
    result: dict[str, object] = {"pixel_deg": options.pixel, "positions": POSITIONS, "held_out": options.held_out}
    for name, whole in scenes(options.gaussians).items():
        started = time.process_time()
        seen = prune_unseen(whole, surroundings).gaussians
        pruned_at = time.process_time()
        merged = level_of_detail(whole, known, pixel=math.radians(options.pixel)).gaussians
        seconds = {"prune_s": pruned_at - started, "merge_s": time.process_time() - pruned_at}
        row: dict[str, object] = {"gaussians": len(whole), **seconds}
        row["pruned"] = report(f"{name}, pruned in {seconds['prune_s']:.1f} s CPU", whole, seen, views)
        row["merged"] = report(f"{name}, merged in {seconds['merge_s']:.1f} s CPU", whole, merged, views)
        for kind, gaussians in (("whole", whole), ("merged", merged)):
            row[f"{kind} cost"] = cost = costs(gaussians, views["pinhole"])
            print(f"  {kind}: render {cost['render_ms']:.1f} ms CPU, frozen step {cost['step_ms']:.1f} ms CPU")
        result[name] = row
    if options.train:
        result["trained"] = trained(options.train)
    if options.json is not None:
        write_whole(options.json, (json.dumps(result, indent=2) + "\n").encode())


if __name__ == "__main__":
    main()
