"""Speed of segments through the Gaussians: the native core against the specification, and what a few segments cost.

    python -m benchmarks.speed.segments [--page docs/performance.md]

Gaussians are sampled on the meshes of the built-in lobby. Random segments join points of the room, legs join receivers,
shadows join every Gaussian with the transmitter. The specification answers a few of the same legs in the same run.
"""

import argparse
import os
from pathlib import Path

import torch

from benchmarks.speed.page import between_marks
from benchmarks.speed.table import circumstances
from benchmarks.speed.timing import Timing, measure
from rf3dgs.cli.chain import geometry_of_mesh
from rf3dgs.core.files import write_whole
from rf3dgs.core.threads import thread_count
from rf3dgs.propagation.sites.lobby import lobby
from rf3dgs.splats.obstacles import Obstacles
from rf3dgs.splats.surface import normals
from rf3dgs.splats.transmittance import segment_transmittance

HEADER = "| segments | CPU ms | clock ms | CPU ns a segment | M segments a second of CPU |\n|---|---|---|---|---|"


def line(label: str, count: int, timing: Timing) -> str:
    each = 1e6 * timing.cpu_min / count
    return f"| {label} | {timing.cpu_min:.3g} | {timing.wall_min:.3g} | {each:.0f} | {1e3 / each:.3g} |"


def rows(count: int, gaussians: int, checked: int, seconds: float) -> list[str]:
    """The lines of the table and a sentence on the specification."""
    scene = lobby()
    assert scene.tx is not None
    cloud = geometry_of_mesh(scene, gaussians, 0)
    shape = (cloud.means, cloud.quats, cloud.scales, cloud.opacities)
    obstacles = Obstacles(*shape, torch.zeros(len(cloud), dtype=torch.long))
    generator = torch.Generator().manual_seed(0)
    low, high = cloud.means.amin(0), cloud.means.amax(0)
    random = low + (high - low) * torch.rand(2, count, 3, generator=generator)
    places = scene.receivers(2000, 1).position
    legs = places[torch.randint(len(places), (2, count), generator=generator)]
    lifted = cloud.means + 0.05 * normals(cloud)
    tx = scene.tx.position.expand(len(cloud), 3).contiguous()
    obstacles.transmittance(legs[0, :1], legs[1, :1])

    def timed(start: torch.Tensor, end: torch.Tensor, skip: torch.Tensor | None = None) -> Timing:
        return measure(lambda _: obstacles.transmittance(start, end, skip_end=skip), 1, seconds)

    table = [
        line(f"{count} random", count, timed(random[0], random[1])),
        line(f"{count} between receivers", count, timed(legs[0], legs[1])),
        line(
            f"{count} between receivers, labels compared",
            count,
            timed(legs[0], legs[1], torch.ones(count, dtype=torch.long)),
        ),
        line(f"{len(tx)} shadows of the transmitter", len(tx), timed(lifted, tx)),
        line("100 between receivers", 100, timed(legs[0, :100], legs[1, :100])),
        line("1 between receivers", 1, timed(legs[0, :1], legs[1, :1])),
    ]
    few = (legs[0, :checked], legs[1, :checked])
    specified = measure(lambda _: segment_transmittance(*shape, *few), 1, 0.0, rounds=2)
    core = timed(*few)
    build = measure(lambda _: Obstacles(*shape).transmittance(legs[0, :1], legs[1, :1]), 1, seconds)
    ratio = specified.cpu_min / core.cpu_min
    return [
        *table,
        "",
        f"{len(cloud)} Gaussians; their tree is built in {build.cpu_min:.0f} ms. The specification takes "
        f"{1e3 * specified.cpu_min / checked:.0f} us of CPU time a segment, {ratio:.0f} times the core's for the same.",
    ]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--page", type=Path, help="put the table between the marks of this page")
    parser.add_argument("--segments", type=int, default=1_000_000)
    parser.add_argument("--gaussians", type=int, default=100_000)
    parser.add_argument("--checked", type=int, default=200, help="segments that the specification answers")
    parser.add_argument("--seconds", type=float, default=2.0, help="for each row")
    options = parser.parse_args()
    torch.set_num_threads(thread_count())
    load = os.getloadavg()[0]
    table = rows(options.segments, options.gaussians, options.checked, options.seconds)
    about = circumstances()
    where = (
        f"{about['cpu']}, {about['instruction_set']}, {about['threads']} threads, commit {str(about['commit'])[:12]}, "
        f"load average {load:.1f} to {os.getloadavg()[0]:.1f}."
    )
    text = "\n".join([where, "", HEADER, *table])
    print(text)
    if options.page is not None:
        write_whole(options.page, between_marks(options.page.read_text(), "segments", text).encode())


if __name__ == "__main__":
    torch.set_grad_enabled(False)
    main()
