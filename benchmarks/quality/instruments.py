"""Fields fitted to what instruments show: ideal spectra, pictures of an 8x8 array, and lists of paths by SAGE.

    python -m benchmarks.quality.instruments --paths FOLDER [--kinds ideal capon bartlett tapered sage] [--train 40]

FOLDER holds traced paths of the lobby (`rf3dgs trace lobby --preset realistic --rx.count 480 --out FOLDER`). Positions
are split as by `benchmarks.quality.radiance`; trained is on positions of its pool, judged by ideal spectra at its
validation positions, at random and in the region. At every training position an array of 8x8 patches is turned to four
sides and sounded: noise, and elements that see --fov degrees of height. Its pictures, by each method, are what fields
are fitted to, on the same Gaussians of the scene's own mesh, so that only the instrument differs. Covariances are
averaged forward and backward. Diffuse paths are merged before they are sounded, in cells of 3 degrees and one
resolution of delay; ideal spectra are made of all.
"""

import argparse
import json
import math
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch

from benchmarks.quality.protocol.split import SplitConfig, split_of
from rf3dgs.channel.arrays import planar_array
from rf3dgs.channel.binning import bin_diffuse
from rf3dgs.channel.io import PathsReader
from rf3dgs.channel.sounding import Sounding
from rf3dgs.cli.chain import geometry_of_mesh
from rf3dgs.cli.facts import open_scene
from rf3dgs.core.files import write_whole
from rf3dgs.core.frames import Pose
from rf3dgs.core.grids import DirectionGrid, equirect_grid, pinhole_grid
from rf3dgs.evaluation.protocol import evaluate
from rf3dgs.evaluation.scores import SCORE
from rf3dgs.field.radio_field import RadioField
from rf3dgs.propagation.sounder import Sounder, sound
from rf3dgs.spectra.codec import DbWindow, window_of
from rf3dgs.spectra.config import Loading
from rf3dgs.spectra.path_lists import path_targets
from rf3dgs.spectra.sage import sage
from rf3dgs.spectra.scan import spectrum_of
from rf3dgs.spectra.sounded import spectrum_of_sounding
from rf3dgs.spectra.spectrum import Spectrum, stack_spectra
from rf3dgs.spectra.yaws import at_yaws
from rf3dgs.splats.gaussians import Gaussians
from rf3dgs.training.config import RadioConfig
from rf3dgs.training.radio import fit_radio

YAWS = (0.0, math.pi / 2, math.pi, -math.pi / 2)
KINDS = ("ideal", "capon", "bartlett", "tapered", "sage")
COLUMNS = ("peak_within_1", "beam_loss_eigen", "beam_loss_peak", "rmse_db", "path_gain")
RANGE_DB = 80.0
MOST_PATHS = 8  # that SAGE may report of each side


def sounder_of(fov_deg: float, snr_db: float, points: int, seed: int) -> Sounder:
    """The sounder at every position; 1 GHz."""
    array = planar_array(8, 8, "patch")
    return Sounder(bandwidth=1e9, points=points, array_rx=array, snr_db=snr_db, fov_rx_deg=fov_deg, seed=seed)


def sounded(reader: PathsReader, index: list[int], options: argparse.Namespace) -> Sounding:
    """The soundings `[4 x position]` of positions, four sides of each one after the other."""
    rows = []
    for number in index:
        sounder = sounder_of(options.fov, options.snr_db, options.points, 4 * number)
        merged = bin_diffuse(reader[number], cell=math.radians(3.0), delay_step=1.0 / sounder.bandwidth)
        rows.append(sound(at_yaws(merged, YAWS), sounder))
    first = rows[0]
    return Sounding(
        response=torch.cat([row.response for row in rows]),
        offsets=first.offsets,
        frequency=first.frequency,
        tx=first.tx,
        rx=Pose(torch.cat([row.rx.position for row in rows]), torch.cat([row.rx.orientation for row in rows])),
        array_rx=first.array_rx,
        noise_power=torch.cat([torch.as_tensor(row.noise_power) for row in rows]),
        fov_rx=first.fov_rx,
    )


def ideal_of(reader: PathsReader, index: list[int], grid: DirectionGrid) -> Spectrum:
    return stack_spectra([spectrum_of(reader[number], None, grid) for number in index])


def field_of(kind: str, target: Spectrum | Sounding, geometry: Gaussians, options: argparse.Namespace) -> RadioField:
    """The mirror field fitted to what one instrument shows."""
    grid = tuple(options.grid)
    config = RadioConfig(
        model="mirror", floor_db=options.floor_db, array_grid=grid, array_rounds=options.rounds, seed=options.seed
    )
    return fit_radio(geometry, shown(kind, target, options), config)


def shown(kind: str, target: Spectrum | Sounding, options: argparse.Namespace) -> Spectrum:
    """What a field is given: ideal spectra, pictures, or the spectra of lists of paths."""
    if isinstance(target, Spectrum):
        return target
    if kind == "sage":
        return path_targets(sage(target, limit=MOST_PATHS, untold="ahead"), target, equirect_grid(*options.grid))
    width, height = options.picture
    loading = Loading(options.loading) if kind == "capon" else None
    how = {"averaging": "forward-backward", "loading": loading}
    return spectrum_of_sounding(target, pinhole_grid(width, height, 110), method=kind, **how)


def scores(field: RadioField, truth: dict[str, Spectrum], window: DbWindow) -> dict[str, dict[str, float]]:
    result = {}
    for holdout, spectra in truth.items():
        values = evaluate(field, spectra, holdout=holdout, window=window).values["field"]
        result[holdout] = {name: SCORE[name].of(np.asarray(values[SCORE[name].column])) for name in COLUMNS}
    return result


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--paths", type=Path, required=True, help="a folder of traced paths of the lobby")
    parser.add_argument("--kinds", nargs="+", default=list(KINDS), choices=KINDS)
    parser.add_argument("--train", type=int, default=40, help="training positions")
    parser.add_argument("--judged", type=int, default=40, help="validation positions of each hold-out, at most")
    parser.add_argument("--gaussians", type=int, default=40_000, help="on the scene's mesh")
    parser.add_argument("--grid", type=int, nargs=2, default=(120, 60), help="columns and rows of the spheres")
    parser.add_argument("--picture", type=int, nargs=2, default=(60, 48), help="columns and rows of array pictures")
    parser.add_argument("--fov", type=float, default=90.0, help="vertical field of view of the elements [deg]")
    parser.add_argument("--snr-db", type=float, default=20.0, help="at the elements")
    parser.add_argument("--points", type=int, default=192, help="frequencies that are sounded")
    parser.add_argument("--loading", type=float, default=1e-2, help="of Capon, relative")
    parser.add_argument("--rounds", type=int, default=1, help="looks at the pictures after the first")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--json", type=Path, help="write the figures to this file")
    options = parser.parse_args()
    reader, grid = PathsReader(options.paths), equirect_grid(*options.grid)
    split = split_of(reader.rx.position[:480], SplitConfig())
    train = split.training(options.train, options.seed).tolist()
    judged = {name: split.part("validation", name)[: options.judged].tolist() for name in ("random", "region")}
    truth = {name: ideal_of(reader, index, grid) for name, index in judged.items()}
    ideal = ideal_of(reader, train, grid)
    window = window_of(ideal)
    window = DbWindow(max(window.floor_db, window.ceil_db - RANGE_DB), window.ceil_db)
    options.floor_db = window.floor_db
    measured = sounded(reader, train, options) if set(options.kinds) - {"ideal"} else None
    geometry = geometry_of_mesh(open_scene("lobby"), options.gaussians, 0)
    report(ideal, measured, geometry, truth, window, options)


def report(
    ideal: Spectrum,
    measured: Sounding | None,
    geometry: Gaussians,
    truth: dict[str, Spectrum],
    window: DbWindow,
    options: argparse.Namespace,
    say: Callable[[str], None] = print,
) -> None:
    """Fit and judge each kind of target, a line each."""
    say("kind      hold-out  " + "  ".join(f"{SCORE[name].label} [{SCORE[name].unit}]" for name in COLUMNS) + "  CPU s")
    results = {}
    for kind in options.kinds:
        started = time.process_time()
        target = ideal if kind == "ideal" else measured
        assert target is not None
        found = scores(field_of(kind, target, geometry, options), truth, window)
        spent = time.process_time() - started
        results[kind] = found | {"CPU s": spent}
        for holdout, row in found.items():
            line = "  ".join(f"{SCORE[name].text(row[name]):>8}" for name in COLUMNS)
            say(f"{kind:9} {holdout:8}  {line}  {spent:8.0f}")
    if options.json is not None:
        write_whole(options.json, (json.dumps(results, indent=2) + "\n").encode())


if __name__ == "__main__":
    torch.set_grad_enabled(False)
    main()
