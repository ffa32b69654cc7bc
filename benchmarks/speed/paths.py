"""How long point sources take: `field.paths` for them alone, and `field.render` with and without them.

    python -m benchmarks.speed.paths [--page docs/performance.md] [--count 100000] [--poses 200]

The field is the lobby's mesh with mirrors of order 3. Pictures of 300x200 are drawn of the surface alone and with the
sources in turn, so that both meet the same load.
"""

import argparse
import os
import statistics
import time
from itertools import chain
from pathlib import Path

import torch

from benchmarks.speed.page import between_marks
from benchmarks.speed.table import circumstances
from benchmarks.speed.timing import measure
from rf3dgs.cli.chain import geometry_of_mesh
from rf3dgs.cli.facts import open_dataset, open_scene
from rf3dgs.core.files import write_whole
from rf3dgs.core.frames import Pose
from rf3dgs.core.grids import pinhole_grid
from rf3dgs.field.radio_field import RadioField
from rf3dgs.training.config import RadioConfig
from rf3dgs.training.radio import fit_radio

ROOM = ((1.0, 1.0, 1.0), (13.0, 14.0, 2.0))
MANY = 10_000  # poses of a coverage map
MUST_MS = 1.0  # one pose
MUST_RATIO = 1.3  # a picture with the sources over one without
PICTURES = 12
HEADER = "| point sources | CPU ms | median | must | |\n|---|---|---|---|---|"


def lobby_field(count: int) -> RadioField:
    """Point sources as they are fitted to the shipped spectra, among `count` Gaussians on the lobby's meshes."""
    train = open_dataset("lobby").train.spectra
    assert train is not None
    geometry = geometry_of_mesh(open_scene("lobby"), count, 0)
    return fit_radio(
        geometry, train, RadioConfig(model="paper", steps=0, start="grey", detail="keep", mirror_order=3, csi_every=0)
    )


def verdict(value: float, must: float) -> str:
    return "met" if value <= must else "missed"


def path_rows(field: RadioField, poses: Pose, seconds: float) -> list[str]:
    """Milliseconds a pose, asked one by one and all at once."""
    each = [poses[index] for index in range(len(poses))]
    one = measure(lambda view: field.paths(each[view], parts="sources"), len(each), seconds)
    many = Pose.scatter(ROOM, MANY, 1)
    all_at_once = measure(lambda _: field.paths(many, parts="sources"), 1, seconds)
    least, middle = (value / MANY for value in (all_at_once.cpu_min, all_at_once.cpu_median))
    return [
        f"| paths of one pose | {one.cpu_min:.2f} | {one.cpu_median:.2f} | {MUST_MS:.0f} | "
        f"{verdict(one.cpu_min, MUST_MS)} |",
        f"| paths of {MANY} poses in one call, a pose | {least:.3f} | {middle:.3f} | | |",
    ]


def picture_rows(field: RadioField, poses: Pose, seconds: float) -> list[str]:
    """Milliseconds a picture of 300x200 with the sources, and how that compares with the surface alone."""
    bare, grid, rows = field.without_sources(), pinhole_grid(300, 200, 90.0), []
    for label, csi in (("gain", False), ("gain, delay and departure", True)):
        times: dict[str, list[list[float]]] = {"bare": [], "whole": []}
        begin = time.perf_counter()
        while len(times["bare"]) < 4 or time.perf_counter() - begin < seconds:
            for name, drawn in (("bare", bare), ("whole", field)):
                turn = []
                for index in range(PICTURES):
                    started = time.process_time()
                    drawn.render(poses[index], grid, csi=csi)
                    turn.append(1e3 * (time.process_time() - started))
                times[name].append(turn)
        least = {name: statistics.fmean(map(min, zip(*turns[1:], strict=True))) for name, turns in times.items()}
        middle = {name: statistics.median(chain.from_iterable(turns[1:])) for name, turns in times.items()}
        ratio = least["whole"] / least["bare"]
        rows += [
            f"| picture, {label}: surface alone | {least['bare']:.2f} | {middle['bare']:.2f} | | |",
            f"| picture, {label}: with sources | {least['whole']:.2f} | {middle['whole']:.2f} | "
            f"{MUST_RATIO} of that | {ratio:.2f}, {verdict(ratio, MUST_RATIO)} |",
        ]
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--page", type=Path, help="put the table between the marks of this page")
    parser.add_argument("--count", type=int, default=100_000, help="Gaussians on the mesh")
    parser.add_argument("--poses", type=int, default=200)
    parser.add_argument("--seconds", type=float, default=4.0, help="for each row")
    options = parser.parse_args()
    field = lobby_field(options.count)
    assert field.sources is not None
    poses = Pose.scatter(ROOM, max(options.poses, PICTURES), 0)
    load = os.getloadavg()[0]
    table = [*path_rows(field, poses, options.seconds), *picture_rows(field, poses, options.seconds)]
    found = field.paths(poses, parts="sources", strongest=32)
    about = circumstances()
    text = "\n".join(
        [
            f"{about['cpu']}, {about['instruction_set']}, {about['threads']} threads, commit "
            f"{str(about['commit'])[:12]}, load average {load:.1f} to {os.getloadavg()[0]:.1f}.",
            "",
            HEADER,
            *table,
            "",
            f"{len(field.surface)} Gaussians, {len(field.sources.planes)} planes, {len(field.sources)} sources, "
            f"{float(found.valid.sum(-1).double().mean()):.1f} of them open at a pose.",
        ]
    )
    print(text)
    if options.page is not None:
        write_whole(options.page, between_marks(options.page.read_text(), "paths", text).encode())


if __name__ == "__main__":
    torch.set_grad_enabled(False)
    main()
