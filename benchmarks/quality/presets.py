"""What the presets change: paths, gain by kind, and the tracer's CPU time, at a few receivers of the lobby.

    python -m benchmarks.quality.presets [--detail full] [--receivers 3] [--rays 300000]

Each preset is traced once to compile its kernels and once more for the figures, all in one run. Printed per receiver in
the mean: CPU seconds, paths, and the gain [dB] of the line of sight and mirrors, of diffuse paths, of those that pass
something (refraction), and of those that bend round an edge.
"""

import argparse
import time
from dataclasses import replace

import torch

from rf3dgs.core.units import db_from_power
from rf3dgs.propagation.config import TraceConfig
from rf3dgs.propagation.sionna import Tracer
from rf3dgs.propagation.sites.lobby import lobby
from rf3dgs.propagation.sites.presets import PRESETS

KINDS = {"exact": (0, 1), "diffuse": (2, 3), "refracted": (4, 5, 6, 7), "diffracted": tuple(range(8, 16))}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--detail", choices=("plain", "full"), default="full")
    parser.add_argument("--receivers", type=int, default=3)
    parser.add_argument("--rays", type=int, default=300_000)
    options = parser.parse_args()
    print(f"{'preset':12} {'CPU s':>6} {'paths':>8} " + " ".join(f"{name:>10}" for name in KINDS))
    for preset in PRESETS.values():
        scene, config = preset.applied(lobby(options.detail), TraceConfig(rays=options.rays))
        rx = scene.receivers(options.receivers, seed=0)
        tracer = Tracer(scene, preset.frequency, diffraction=config.diffraction)
        tracer.paths(scene.tx, rx[:1], replace(config, seed=99), 99)
        started = time.process_time()
        rows = [tracer.paths(scene.tx, rx[index : index + 1], config, index) for index in range(len(rx))]
        seconds = (time.process_time() - started) / len(rx)
        gains = []
        for kinds in KINDS.values():
            total = torch.stack([row.path_gain[torch.isin(row.kind, torch.tensor(kinds))].sum() for row in rows]).mean()
            gains.append(f"{float(db_from_power(total)):10.1f}" if float(total) > 0 else f"{'-':>10}")
        count = sum(row.coeff.shape[1] for row in rows) // len(rows)
        print(f"{preset.name:12} {seconds:6.2f} {count:8,} " + " ".join(gains), flush=True)


if __name__ == "__main__":
    main()
