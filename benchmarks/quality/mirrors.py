"""How many of the traced mirror paths the point sources reproduce, and how many they make up.

    python -m benchmarks.quality.mirrors --paths FOLDER [--geometry photos|mesh|FILE.ply] [--train 40] [--test 60]

FOLDER holds traced paths of the lobby (`rf3dgs trace lobby --preset realistic --out FOLDER`). Ideal spectra of --train
positions are what sources are fitted to; at --test others the strong mirror paths, within 30 dB of the strongest path
of their position, are sought among the rays. One is found when a ray arrives within 1 degree and 1 ns, and right when
its gain is within 2 dB too. False rays are as strong and have no such path. Rows: planes as the geometry has them,
refined by peaks, and completed by virtual sources; columns: found and right by order, false rays a position, median
errors of what was found. Positions without line of sight are also told apart.
"""

import argparse
import json
import time
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from rf3dgs.channel.io import PathsReader
from rf3dgs.channel.paths import Paths
from rf3dgs.cli.chain import geometry_of_mesh
from rf3dgs.cli.facts import open_scene
from rf3dgs.core.angles import angle_between
from rf3dgs.core.files import write_whole
from rf3dgs.core.grids import equirect_grid
from rf3dgs.field.rays import Rays
from rf3dgs.geometry import find_surfaces
from rf3dgs.spectra.scan import spectrum_of
from rf3dgs.spectra.spectrum import stack_spectra
from rf3dgs.splats.gaussians import Gaussians
from rf3dgs.splats.obstacles import Obstacles
from rf3dgs.splats.ply import read_ply
from rf3dgs.training.config import SourceConfig
from rf3dgs.training.source_fit import fit_sources

SPECULAR = 1
STRONG = 1e-3
ANGLE, DELAY, LEVEL_DB = 1.0, 1e-9, 2.0  # degrees, seconds, decibels
VARIANTS = {
    "line of sight": SourceConfig(order=0),
    "planes as they are": SourceConfig(refine=False, complete=False, square=False),
    "refined": SourceConfig(complete=False),
    "refined, completed": SourceConfig(),
    "order 3": SourceConfig(order=3),
}


@dataclass(frozen=True, eq=False)
class Truth:
    """The strong specular paths of one receiver: gain, delay, arrival and order of each; and its diffuse power."""

    receiver: Tensor
    gain: Tensor
    delay: Tensor
    arrival: Tensor
    order: Tensor
    top: float


def truth_of(paths: Paths) -> Truth:
    gain = paths.path_gain
    assert paths.kind is not None
    assert paths.order is not None
    mirror = paths.valid & ((paths.order == 0) | (paths.kind == SPECULAR))
    top = float(gain[mirror].max()) if bool(mirror.any()) else 0.0
    chosen = torch.nonzero(mirror & (gain > STRONG * top)).squeeze(-1)
    columns = (gain[chosen], paths.delay[chosen], paths.aoa[chosen], paths.order[chosen])
    return Truth(paths.rx.position, *columns, top)


def compare(truths: list[Truth], rays: list[Rays]) -> dict[str, float]:
    """Shares and errors over all positions; see the module's text."""
    counts = {f"{what} {order}": 0 for what in ("of", "found", "right") for order in range(4)}
    false, angles, levels, hidden, top_seen = 0, [], [], 0, 0
    for truth, one in zip(truths, rays, strict=True):
        angle = torch.rad2deg(angle_between(truth.arrival[:, None], one.arrival[None]))
        late = (truth.delay[:, None] - one.delay).abs()
        level = 10 * torch.log10(one.power[None] / truth.gain[:, None])
        good = (angle < ANGLE) & (late < DELAY)
        false += int(((one.power > STRONG * truth.top) & ~good.any(0)).sum())
        for row, order in enumerate(truth.order.tolist()):
            counts[f"of {order}"] += 1
            if bool(good[row].any()):
                which = int(torch.where(good[row], level[row].abs(), torch.inf).argmin())
                counts[f"found {order}"] += 1
                counts[f"right {order}"] += abs(float(level[row, which])) < LEVEL_DB
                if order:
                    angles.append(float(angle[row, which]))
                    levels.append(abs(float(level[row, which])))
        if not bool((truth.order == 0).any()) and len(truth.gain):
            hidden += 1
            top_seen += bool(good[int(truth.gain.argmax())].any())
    result = {name: float(value) for name, value in counts.items()}
    result |= {"false": false / max(1, len(truths)), "hidden": float(hidden), "hidden top found": float(top_seen)}
    for name, values in (("angle", angles), ("level", levels)):
        result[name] = float(torch.tensor(values).median()) if values else float("nan")
    return result


def geometry_of(name: str) -> Gaussians:
    if name == "mesh":
        return geometry_of_mesh(open_scene("lobby"), 60_000, 0)
    return read_ply(Path(name))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--paths", type=Path, required=True, help="a folder of traced paths of the lobby")
    parser.add_argument("--geometry", default="mesh", help='"mesh", or a .ply such as rf3dgs demo writes')
    parser.add_argument("--train", type=int, default=40)
    parser.add_argument("--test", type=int, default=60)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--variants", nargs="+", default=list(VARIANTS)[1:4], choices=list(VARIANTS))
    parser.add_argument("--json", type=Path, help="write the figures to this file")
    options = parser.parse_args()
    reader = PathsReader(options.paths)
    order = torch.randperm(len(reader), generator=torch.Generator().manual_seed(options.seed)).tolist()
    grid = equirect_grid(180, 90)
    train = stack_spectra([spectrum_of(reader[index], None, grid) for index in order[: options.train]])
    truths = [truth_of(reader[index]) for index in order[options.train : options.train + options.test]]
    receivers = torch.stack([truth.receiver for truth in truths])
    geometry = geometry_of(options.geometry)
    surfaces = find_surfaces(geometry, train.pose.position)
    shape = (geometry.means, geometry.quats, geometry.scales, geometry.opacities)
    obstacles = Obstacles(*shape)
    print(f"{len(geometry):,} Gaussians, {len(surfaces.planes)} planes, {len(train)} training positions")
    print(f"{'':20} {'found (right) of all, orders 0 1 2 3':52} false/pos  angle  level  no sight  sources  CPU s")
    results = {}
    for name in options.variants:
        started = time.process_time()
        fit = fit_sources(train, surfaces, obstacles, open_scene("lobby").tx, VARIANTS[name], geometry=geometry)
        seconds = time.process_time() - started
        figures = compare(truths, fit.sources.rays_each(receivers, fit.obstacles))
        results[name] = figures | {"sources": float(len(fit.sources)), "seconds": seconds}
        parts = [
            f"{figures[f'found {order}']:.0f} ({figures[f'right {order}']:.0f})/{figures[f'of {order}']:.0f}"
            for order in range(4)
        ]
        print(
            f"{name:20} {'  '.join(parts):52} {figures['false']:8.2f}  {figures['angle']:.2f}  {figures['level']:5.2f} "
            f" {figures['hidden top found']:.0f}/{figures['hidden']:.0f}  {len(fit.sources):7}  {seconds:.1f}",
            flush=True,
        )
    if options.json is not None:
        write_whole(options.json, (json.dumps(results, indent=2) + "\n").encode())


if __name__ == "__main__":
    torch.set_grad_enabled(False)
    main()
