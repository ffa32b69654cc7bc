"""The visual stage of the built-in lobby: how well Gaussians show photographs that they were not trained on.

    python -m benchmarks.quality.visual [--set steps=4000 max_count=60000] [--held-out]

Photographs of the walk are trained on but for every seventh, which is rendered with 512 light paths per pixel and read
with `--held-out` only; without it another seventh of the training photographs is left out and judges, which is what
settings are chosen by. Printed while it trains and at the end: PSNR [dB] of the photographs that judge (mean, worst)
and of those trained on, Gaussians, CPU seconds of all threads and seconds.
"""

import argparse
import json
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from rf3dgs.cli.demo import Demo
from rf3dgs.cli.facts import open_dataset
from rf3dgs.core.files import write_whole
from rf3dgs.data.photo import Photo
from rf3dgs.splats.gaussians import Gaussians
from rf3dgs.splats.image_loss import psnr
from rf3dgs.splats.ply import write_ply
from rf3dgs.training.photographs import render_photo
from rf3dgs.training.visual import VisualStage


def decibels(geometry: Gaussians, photos: Sequence[Photo]) -> list[float]:
    """PSNR [dB] of each photograph's rendering."""
    return [float(psnr(render_photo(geometry, photo.camera), photo.load())) for photo in photos]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--set", nargs="*", default=[], metavar="NAME=VALUE", help="settings that replace the demo's")
    parser.add_argument("--held-out", action="store_true", help="judge by the held-out photographs")
    parser.add_argument("--every", type=int, default=1000, help="steps between the lines that are printed")
    parser.add_argument("--ply", type=Path, help="write the Gaussians to this file")
    parser.add_argument("--json", type=Path, help="write the figures to this file")
    options = parser.parse_args()
    dataset = open_dataset("lobby")
    changes = {name: json.loads(value) for name, value in (setting.split("=", 1) for setting in options.set)}
    config = replace(Demo().visual, **changes)
    train = list(dataset.train.photos)
    if options.held_out:
        judges = [photo for photo, role in zip(dataset.photos, dataset.photo_roles, strict=True) if role == "test"]
    else:
        judges = train[2::7]
        train = [photo for photo in train if photo not in judges]
    print(f"{len(train)} photographs to train on, {len(judges)} judge; {config}")
    rows = []
    spent, used = 0.0, 0.0
    wall, cpu = time.perf_counter(), time.process_time()
    stage = VisualStage(train, config)
    for step in range(config.steps):
        stage.step(step)
        if (step + 1) % options.every == 0 or step + 1 == config.steps:
            spent, used = spent + time.perf_counter() - wall, used + time.process_time() - cpu
            now = stage.gaussians()
            found, known = decibels(now, judges), decibels(now, train[::4])
            row = {
                "steps": step + 1,
                "psnr": sum(found) / len(found),
                "worst": min(found),
                "trained": sum(known) / len(known),
                "gaussians": len(now),
                "cpu_s": used,
                "wall_s": spent,
            }
            rows.append(row)
            print(
                "  ".join(
                    f"{name} {value:.2f}" if isinstance(value, float) else f"{name} {value}"
                    for name, value in row.items()
                ),
                flush=True,
            )
            wall, cpu = time.perf_counter(), time.process_time()
    if options.ply is not None:
        write_ply(options.ply, stage.gaussians())
    if options.json is not None:
        write_whole(options.json, (json.dumps(rows, indent=2) + "\n").encode())


if __name__ == "__main__":
    main()
