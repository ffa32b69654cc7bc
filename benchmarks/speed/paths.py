"""How long `field.paths` takes for point sources alone: the lobby's mesh with mirrors of order 2.

    python -m benchmarks.speed.paths [--count 100000] [--poses 200]

Printed: Gaussians, planes, sources, and milliseconds a pose (CPU time and wall time, best and median of seven rounds).
"""

import argparse
import time

import torch

from rf3dgs.cli.chain import geometry_of_mesh
from rf3dgs.cli.facts import open_dataset, open_scene
from rf3dgs.core.frames import Pose
from rf3dgs.training.config import RadioConfig
from rf3dgs.training.radio import fit_radio

ROUNDS = 7


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=100_000, help="Gaussians on the mesh")
    parser.add_argument("--poses", type=int, default=200)
    options = parser.parse_args()
    train = open_dataset("lobby").train.spectra
    assert train is not None
    geometry = geometry_of_mesh(open_scene("lobby"), options.count, 0)
    config = RadioConfig(steps=0, start="grey", detail="keep", mirror_order=2, csi_every=0)
    started = time.process_time()
    field = fit_radio(geometry, train, config)
    print(f"fit of the sources, with the views: {time.process_time() - started:.1f} s CPU")
    assert field.sources is not None
    poses = Pose.scatter(((1.0, 1.0, 1.0), (13.0, 14.0, 2.0)), options.poses, 0)
    field.paths(poses[0], parts="sources")
    rounds = []
    for _ in range(ROUNDS):
        wall, cpu = time.perf_counter(), time.process_time()
        for index in range(len(poses)):
            field.paths(poses[index], parts="sources")
        rounds.append(((time.process_time() - cpu) / len(poses), (time.perf_counter() - wall) / len(poses)))
    cpu, wall = (sorted(1e3 * value for value in column) for column in zip(*rounds, strict=True))
    paths = field.paths(poses, parts="sources", strongest=32)
    print(f"{len(geometry):,} Gaussians, {len(field.sources.planes)} planes, {len(field.sources)} sources")
    print(f"{float(paths.valid.sum(-1).double().mean()):.1f} paths a pose")
    middle = ROUNDS // 2
    print(f"CPU {cpu[0]:.2f} best, {cpu[middle]:.2f} median; wall {wall[0]:.2f} best, {wall[middle]:.2f} median [ms]")


if __name__ == "__main__":
    torch.set_grad_enabled(False)
    main()
