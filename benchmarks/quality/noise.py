"""How far two solves of the same receivers are apart, and what binned paths lose: no model can do better than that.

    python -m benchmarks.quality.noise --scene lobby --positions 8 [--json out/noise.json] [--page PAGE]

The second solve has another seed and another number of rays, and so another lattice of them. Both are binned as
`rf3dgs trace` does, and compared as spectra: ideal on the spheres of the preset "sphere" and of no preset, Bartlett and
Capon of an 8x8 array in pictures of 90 degrees forward and backward. Coherent: 256 frequencies over 2 GHz, as
`rf3dgs spectra` takes them, where each binned path has one phase; uncorrelated: the expectation over phases. For the
first `--binning` receivers spectra of binned paths are compared with those of all paths, the array's forward.
"""

import argparse
import json
import math
import os
import time
from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from benchmarks.quality.protocol.figure import put_into
from rf3dgs.channel.arrays import PlanarArray, planar_array
from rf3dgs.channel.binning import bin_diffuse
from rf3dgs.channel.paths import Paths
from rf3dgs.cli.chain import REPEAT_RAYS, REPEAT_SEED
from rf3dgs.cli.facts import open_scene
from rf3dgs.core.files import write_whole
from rf3dgs.core.grids import DirectionGrid, equirect_grid, pinhole_grid
from rf3dgs.core.progress import Console
from rf3dgs.evaluation import metrics
from rf3dgs.propagation.config import TraceConfig
from rf3dgs.propagation.sionna import trace_each
from rf3dgs.propagation.sites.presets import preset_of
from rf3dgs.spectra.codec import window_of
from rf3dgs.spectra.covariance import covariance_of
from rf3dgs.spectra.scan import array_instrument, beamform, spectrum_of
from rf3dgs.spectra.spectrum import Spectrum, stack_spectra
from rf3dgs.spectra.steering import PlanarSteering
from rf3dgs.spectra.yaws import at_yaws

YAWS = (0.0, 180.0)
SIZES = ((0.5, 0.5), (1.0, 1.0), (1.0, 5.0), (2.0, 2.0), (4.0, 5.0))  # cell [deg] and delay step [ns]
Pictures = dict[str, Spectrum]


class Receiver:
    """What is looked through: the sphere, and an array behind a pinhole for each yaw [deg]."""

    def __init__(self, yaws: Sequence[float] = YAWS) -> None:
        self.yaws = [math.radians(yaw) for yaw in yaws]
        self.spheres: list[DirectionGrid] = [equirect_grid(360, 180), equirect_grid(180, 90)]
        self.pinhole: DirectionGrid = pinhole_grid(150, 100, fov_deg=90.0)
        self.array: PlanarArray = planar_array(8, 8, pattern="patch")
        self.steering = PlanarSteering(self.array, self.pinhole.directions)

    def ideal(self, paths: Paths) -> Pictures:
        found = [spectrum_of(paths, None, sphere) for sphere in self.spheres]
        return {f"{one.instrument.name}, {one.grid.width}x{one.grid.height}": stack_spectra([one]) for one in found}

    def arrays(self, paths: Paths, snapshots: Iterable[int | None] = (None, 256)) -> Pictures:
        """Bartlett and Capon pictures `[yaw, row, col]`, uncorrelated (None) or coherent over so many frequencies."""
        turned = at_yaws(paths, self.yaws)
        found: Pictures = {}
        for count in snapshots:
            R = covariance_of(turned, self.array, snapshots=count)
            for method in ("bartlett", "capon"):
                power = (beamform(method, R, self.steering, self.array) / self.array.peak_gain).float()
                instrument = array_instrument(self.array, method)
                name = f"{method} 8x8, {'uncorrelated' if count is None else 'coherent'}"
                found[name] = Spectrum(power, self.pinhole, turned.rx, paths.frequency, instrument, method, tx=paths.tx)
        return found


def differences(truth: Spectrum, other: Spectrum) -> dict[str, float | int | None]:
    """Scores of `other` against `truth`, both `[picture, row, col]`; None where the spectra have no such value."""
    window, weight = window_of(truth), metrics.pixel_weight(truth.grid)
    peak = torch.rad2deg(metrics.peak_error(truth, other)).double().numpy()
    no_csi = truth.delay is None
    distinct = peak[metrics.is_distinct(truth).numpy()]
    return {
        "pictures": len(peak),
        "peak_median_deg": float(np.median(peak)),
        "peak_p90_deg": float(np.percentile(peak, 90)),
        "peak_within_1_percent": 100.0 * float((peak <= 1.0).mean()),
        "distinct_pictures": len(distinct),
        "distinct_median_deg": float(np.median(distinct)) if len(distinct) else None,
        "distinct_p90_deg": float(np.percentile(distinct, 90)) if len(distinct) else None,
        "distinct_within_1_percent": 100.0 * float((distinct <= 1.0).mean()) if len(distinct) else None,
        "rmse_db": float(metrics.rmse_db(truth.power, other.power, window, weight).mean()),
        "path_gain_db": float(metrics.path_gain_error(truth, other).mean()),
        "delay_ns": None if no_csi else 1e9 * float(metrics.delay_error(truth, other, window).mean()),
        "departure_deg": None if no_csi else math.degrees(float(metrics.departure_error(truth, other, window).mean())),
    }


def gathered(rows: Sequence[Pictures]) -> Pictures:
    return {
        name: stack_spectra([row[name][index] for row in rows for index in range(len(row[name]))]) for name in rows[0]
    }


def as_traced(paths: Paths, cell_deg: float = 1.0, step_ns: float = 1.0) -> Paths:
    return bin_diffuse(paths, cell=math.radians(cell_deg), delay_step=1e-9 * step_ns)


def binning(receiver: Receiver, all_paths: Sequence[Paths]) -> list[dict]:
    """What is lost by each size of bins, over the first receivers."""
    everything = []
    for paths in all_paths:
        everything.append(receiver.ideal(paths) | receiver.arrays(paths))
    truth = gathered(everything)
    rows = []
    for cell, step in SIZES:
        binned = [as_traced(paths, cell, step) for paths in all_paths]
        found = gathered([receiver.ideal(paths) | receiver.arrays(paths) for paths in binned])
        share = sum(int(paths.count) for paths in binned) / sum(int(paths.count) for paths in all_paths)
        for name, spectra in found.items():
            score = differences(truth[name], spectra)
            rows.append({"cell_deg": cell, "step_ns": step, "paths_percent": 100.0 * share, "what": name, **score})
    return rows


def measured(wish: argparse.Namespace) -> dict:
    """Both solves, their differences, and the loss of binning, as JSON can hold them."""
    began, load = time.process_time(), os.getloadavg()[0]
    scene, first = open_scene(wish.scene), TraceConfig(rays=wish.rays)
    if wish.preset is not None:
        scene, first = preset_of(wish.preset).applied(scene, first)
    rx = scene.receivers(wish.positions, wish.rx_seed)
    second = replace(first, rays=round(wish.rays * REPEAT_RAYS), seed=REPEAT_SEED)
    receiver = Receiver()
    solves: tuple[list[Pictures], list[Pictures]] = ([], [])
    kept: list[Paths] = []
    counts: list[int] = []
    progress = Console()
    pairs = zip(trace_each(scene, None, rx, first, progress), trace_each(scene, None, rx, second), strict=True)
    for one, other in pairs:
        if len(kept) < wish.binning:
            kept.append(one[0])
        counts.append(int(one.count.sum()))
        for solve, paths in zip(solves, (one[0], other[0]), strict=True):
            small = as_traced(paths)
            solve.append(receiver.ideal(small) | receiver.arrays(small))
    truth, again = gathered(solves[0]), gathered(solves[1])
    ceiling = [{"what": name, **differences(truth[name], again[name])} for name in truth]
    losses = binning(Receiver(YAWS[:1]), kept) if kept else []
    return {
        "scene": scene.name,
        "preset": wish.preset,
        "positions": wish.positions,
        "binning_positions": len(kept),
        "rays": [first.rays, second.rays],
        "seeds": [first.seed, second.seed],
        "depth": first.depth,
        "paths_per_position": [min(counts), max(counts)],
        "ceiling": ceiling,
        "binning": losses,
        "cpu_seconds": time.process_time() - began,
        "load": [load, os.getloadavg()[0]],
    }


def number(value: float | None, digits: int) -> str:
    return "-" if value is None else f"{value:.{digits}f}"


def page_tables(run: dict) -> str:
    """The run as Markdown."""
    of_preset = f" with preset {run['preset']}" if run["preset"] else ""
    (rays, more), (seed, other) = run["rays"], run["seeds"]
    lines = [
        f"{run['scene']}{of_preset}, {run['positions']} positions, depth {run['depth']}; first solve "
        f"{rays:,} rays and seed {seed}, second {more:,} rays and seed {other}; "
        f"{run['paths_per_position'][0]:,} to {run['paths_per_position'][1]:,} paths a position before binning.",
        "",
        "| second solve against first | pictures | main peak [deg]: median, P90, within 1 | distinct peaks: pictures, "
        "median, P90, within 1 | RMSE [dB] | path gain [dB] | delay [ns] | AoD [deg] |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for row in run["ceiling"]:
        lines.append(
            f"| {row['what']} | {row['pictures']} | {row['peak_median_deg']:.2f}, {row['peak_p90_deg']:.1f}, "
            f"{row['peak_within_1_percent']:.0f} % | {row['distinct_pictures']}, "
            f"{number(row['distinct_median_deg'], 2)}, {number(row['distinct_p90_deg'], 1)}, "
            f"{number(row['distinct_within_1_percent'], 0)} % | {row['rmse_db']:.2f} | {row['path_gain_db']:.3f} | "
            f"{number(row['delay_ns'], 2)} | {number(row['departure_deg'], 1)} |"
        )
    if run["binning"]:
        lines += [
            "",
            f"Binned paths against all paths of the same solve, {run['binning_positions']} positions:",
            "",
            "| bins | paths kept | spectrum | main peak [deg] median, P90 | RMSE [dB] | path gain [dB] | delay [ns] | "
            "AoD [deg] |",
            "|---|---|---|---|---|---|---|---|",
        ]
    for row in run["binning"]:
        lines.append(
            f"| {row['cell_deg']:g} deg, {row['step_ns']:g} ns | {row['paths_percent']:.1f} % | {row['what']} | "
            f"{row['peak_median_deg']:.3f}, {row['peak_p90_deg']:.2f} | {row['rmse_db']:.3f} | "
            f"{row['path_gain_db']:.4f} | {number(row['delay_ns'], 3)} | {number(row['departure_deg'], 2)} |"
        )
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scene", default="lobby")
    parser.add_argument("--preset", help='of rf3dgs trace, such as "paper"')
    parser.add_argument("--positions", type=int, default=8)
    parser.add_argument("--binning", type=int, default=4, help="positions whose paths are kept whole for comparison")
    parser.add_argument("--rays", type=int, default=300_000, help="of the first solve")
    parser.add_argument("--rx.seed", type=int, default=0)
    parser.add_argument("--json", type=Path, help="write the figures to this file")
    parser.add_argument("--read", type=Path, help="take the figures of this file instead of measuring")
    parser.add_argument("--page", type=Path, help="put the tables into this page")
    wish = parser.parse_args()
    run = measured(wish) if wish.read is None else json.loads(wish.read.read_text(encoding="utf-8"))
    tables = page_tables(run)
    print(tables)
    print(f"\n{run['cpu_seconds']:.0f} s of CPU time, load {run['load'][0]:.1f} to {run['load'][1]:.1f}")
    if wish.json is not None:
        write_whole(wish.json, (json.dumps(run, indent=1) + "\n").encode())
    if wish.page is not None:
        put_into(wish.page, "noise", tables)


if __name__ == "__main__":
    torch.set_grad_enabled(False)
    main()
