"""Learning rates of the radio stage: error of the gain against iterations, on the lobby's validation positions.

    python -m benchmarks.quality.radio_presets [--presets fast paper best] [--steps 0 300 1000] [--geometry FILE]

Geometry is sampled from the lobby's mesh, or read from a .ply such as the one that `rf3dgs demo` writes. Every preset
is trained once for each number of steps, because its schedule ends with the run. Printed: root mean square and median
of the gain's error [dB] over all directions, both gains cut to the field's window, at the validation positions, and
seconds of training (CPU time). The sealed test is not read.
"""

import argparse
import json
import time
from dataclasses import replace
from pathlib import Path

import torch

from rf3dgs.cli.chain import geometry_of_mesh
from rf3dgs.cli.facts import open_dataset, open_scene
from rf3dgs.core.files import write_whole
from rf3dgs.field.radio_field import RadioField
from rf3dgs.spectra.spectrum import Spectrum
from rf3dgs.splats.ply import read_ply
from rf3dgs.training.config import RadioConfig
from rf3dgs.training.radio import fit_radio


def gain_error(field: RadioField, truth: Spectrum) -> dict[str, float]:
    """Errors [dB] of the rendered gain where the truth lies in the field's window, both clipped to it."""
    window = field.surface.window
    rendered = field.render(truth.pose, truth.grid, csi=False)
    low, high = window.floor_db, window.ceil_db
    error = rendered.gain_db.clamp(low, high) - truth.gain_db.clamp(low, high)
    return {"rmse": float(error.square().mean().sqrt()), "median": float(error.abs().median())}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--presets", nargs="+", default=["fast", "paper", "best"])
    parser.add_argument("--steps", nargs="*", type=int, help="numbers of steps; a preset's own when missing")
    parser.add_argument("--geometry", type=Path, help="Gaussians to train on; the mesh's when missing")
    parser.add_argument("--count", type=int, default=40_000, help="Gaussians on the mesh")
    parser.add_argument("--set", nargs="*", default=[], metavar="NAME=VALUE", help="settings that replace a preset's")
    parser.add_argument("--json", type=Path, help="write the figures to this file")
    options = parser.parse_args()
    dataset = open_dataset("lobby")
    train, validation = dataset.train.spectra, dataset.validation.spectra
    assert train is not None
    assert validation is not None
    geometry = (
        geometry_of_mesh(open_scene("lobby"), options.count, 0)
        if options.geometry is None
        else read_ply(options.geometry)
    )
    changes = {name: json.loads(value) for name, value in (setting.split("=", 1) for setting in options.set)}
    print(f"{len(geometry):,} Gaussians, {len(train)} training positions, {len(validation)} validation positions")
    rows = []
    for name in options.presets:
        for steps in options.steps or [RadioConfig.preset(name).steps]:
            config = replace(RadioConfig.preset(name, steps=steps), **changes)
            started = time.process_time()
            field = fit_radio(geometry, train, config)
            seconds = time.process_time() - started
            rows.append({"preset": name, "steps": steps, "seconds": seconds, **gain_error(field, validation)})
            print(
                f"{name:8} {steps:6} steps  rmse {rows[-1]['rmse']:.3f} dB  median {rows[-1]['median']:.3f} dB  "
                f"{seconds:6.1f} s",
                flush=True,
            )
    if options.json is not None:
        write_whole(options.json, (json.dumps(rows, indent=2) + "\n").encode())


if __name__ == "__main__":
    torch.set_grad_enabled(False)
    main()
