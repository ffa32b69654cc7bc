"""What a field is worth when its transmitter moves: the lobby, 40 positions at one place, none or ten at another.

    python -m benchmarks.quality.moved --paths FOLDER --there FOLDER [--geometry mesh|FILE.ply] [--preset diffuse]

--paths are traced paths of the lobby for its own transmitter (`rf3dgs trace lobby --preset paper`); --there is a folder
for those of 40 other receivers with the transmitter at --tx, traced when it is missing (two minutes of CPU time).
Ideal spectra, spheres of 180x90. Rows:

    moved                 the mirror model fitted to 40 positions at the old place, `moved_to` the new one
    moved, old residual   the same with the residual that `moved_to` drops
    moved, old shadows    the same with the shadows of the old place
    moved, gate 0.1       the same with ways open where a tenth passes, whatever the fit found
    moved, then 10        the moved field, refined by the ten measurements at the new place
    never moved           the field of the old place as it is: what moving does at all
    nearest, idw4         lookups in these ten
    fitted there to 10    the mirror model fitted to these ten
    at home               the field of the old place at 30 other positions there, whole and without its residual

Columns: median and mean of the main peak's error [deg], losses of beams [dB], RMSE and MAE [dB], path gain [dB], delay
[ns], departure [deg]; means over 30 positions.
"""

import argparse
import json
import os
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from benchmarks.quality.mirrors import geometry_of
from rf3dgs.channel.arrays import planar_array
from rf3dgs.channel.io import PathsReader
from rf3dgs.core.files import write_whole
from rf3dgs.core.frames import Pose
from rf3dgs.core.grids import equirect_grid
from rf3dgs.core.progress import Console
from rf3dgs.evaluation.baselines.lookup import InverseDistance, NearestNeighbour
from rf3dgs.evaluation.beams import panel_covariance
from rf3dgs.evaluation.protocol import Predictor, score
from rf3dgs.field.lit import LitSurface
from rf3dgs.field.radio_field import RadioField
from rf3dgs.propagation.config import TraceConfig
from rf3dgs.propagation.jobs.job import run_job
from rf3dgs.propagation.jobs.trace_job import TraceJob
from rf3dgs.propagation.sites.lobby import lobby
from rf3dgs.propagation.sites.presets import preset_of
from rf3dgs.propagation.sites.scene import without_looks
from rf3dgs.spectra.codec import DbWindow, window_of
from rf3dgs.spectra.scan import spectrum_of
from rf3dgs.spectra.spectrum import Spectrum, stack_spectra
from rf3dgs.training.config import RadioConfig
from rf3dgs.training.radio import fit_radio
from rf3dgs.training.refine import refine_field

TRAIN, MEASURED, JUDGED = 40, 10, 30
RANGE_DB = 80.0
ARRAY = planar_array(8, 8, pattern="patch")
COLUMNS = {
    "peak": "peak_deg",
    "eigen": "beam_loss_eigen_db",
    "beam": "beam_loss_peak_db",
    "RMSE": "rmse_db",
    "MAE": "mae_db",
    "gain": "path_gain_db",
    "delay": "delay_ns",
    "depart": "departure_deg",
}


def traced_there(folder: Path, tx: Pose, rx: Pose, preset: str, rays: int) -> None:
    """The paths to receivers `rx` `[rx]` with the transmitter at `tx`; a killed run goes on."""
    scene, config = preset_of(preset).applied(lobby(), TraceConfig(rays=rays))
    frequency = config.frequency or scene.frequency
    job = TraceJob(without_looks(scene), tx, rx, frequency, config, rule={"site": "lobby"})
    run_job(job, folder, progress=Console())


def spectra_of(reader: PathsReader, places: list[int]) -> Spectrum:
    grid = equirect_grid(180, 90)
    return stack_spectra([spectrum_of(reader[place], None, grid) for place in places])


def figures(predictor: Predictor, truth: Spectrum, window: DbWindow) -> dict[str, float]:
    """Mean of each score over the positions, and the median of the peak's."""
    drawn = stack_spectra([predictor.render(truth.pose[place], truth.grid) for place in range(len(truth))])
    values = score(truth, drawn, panel_covariance(truth, ARRAY), window, ARRAY)
    found = {name: float(np.nanmean(np.abs(values[key]))) for name, key in COLUMNS.items()}
    return {"median": float(np.nanmedian(values["peak_deg"]))} | found


def variants(field: RadioField, tx: Pose) -> dict[str, Predictor]:
    """The moved field, and what it would be without one thing that moving does."""
    began = time.process_time()
    moved = field.moved_to(tx)
    assert moved.sources is not None
    print(f"moved in {time.process_time() - began:.1f} s of CPU time, {len(moved.sources)} point sources")
    old, new = field.surface, moved.surface
    assert isinstance(old, LitSurface)
    assert isinstance(new, LitSurface)
    residual = replace(new, segment_sh=old.segment_sh, cell_sh=old.cell_sh, level=old.level)
    shadows = replace(new, visibility=old.visibility)
    return {
        "moved": moved,
        "moved, old residual": replace(moved, surface=residual),
        "moved, old shadows": replace(moved, surface=shadows),
        "moved, gate 0.1": replace(moved, sources=replace(moved.sources, open_above=0.1)),
        "never moved": field,
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--paths", type=Path, required=True, help="traced paths of the lobby")
    parser.add_argument("--there", type=Path, required=True, help="traced paths for the new place, made when missing")
    parser.add_argument("--geometry", default="mesh", help='"mesh", or a .ply such as rf3dgs demo writes')
    parser.add_argument("--preset", default="diffuse")
    parser.add_argument("--tx", type=float, nargs=3, default=(12.4, 13.6, 2.6), help="the new place [m]")
    parser.add_argument("--rays", type=int, default=TraceConfig().rays, help="rays of the new traces")
    parser.add_argument("--json", type=Path, help="write the figures to this file")
    options = parser.parse_args()
    reader, tx = PathsReader(options.paths), Pose(options.tx)
    order = torch.randperm(len(reader), generator=torch.Generator().manual_seed(0)).tolist()
    others = order[TRAIN : TRAIN + MEASURED + JUDGED]
    if not (options.there / "manifest.json").exists():
        traced_there(options.there, tx, reader.rx[torch.tensor(others)], options.preset, options.rays)
    after = PathsReader(options.there)
    if float((after.rx.position - reader.rx.position[others]).abs().max()) > 1e-3:
        parser.error(f"{options.there} holds other receivers; remove it or name another folder")
    train, home = spectra_of(reader, order[:TRAIN]), spectra_of(reader, others[MEASURED:])
    measured = spectra_of(after, list(range(MEASURED)))
    truth = spectra_of(after, list(range(MEASURED, MEASURED + JUDGED)))
    found = window_of(train)
    window = DbWindow(max(found.floor_db, found.ceil_db - RANGE_DB), found.ceil_db)
    config, geometry = RadioConfig(model="mirror", floor_db=window.floor_db), geometry_of(options.geometry)
    began = time.process_time()
    field = fit_radio(geometry, train, config)
    print(f"{len(geometry):,} Gaussians, fitted in {time.process_time() - began:.0f} s of CPU time", flush=True)
    rows = variants(field, tx) | {
        "moved, then 10": refine_field(field.moved_to(tx), measured),
        "nearest of 10": NearestNeighbour(measured),
        "idw4 of 10": InverseDistance(measured),
        "fitted there to 10": fit_radio(geometry, measured, config),
    }
    assert isinstance(field.surface, LitSurface)
    at_home = {"at home": field, "at home, no residual": replace(field, surface=field.surface.without_residual())}
    print(f"{'':22}" + "".join(f"{name:>8}" for name in ("median", *COLUMNS)))
    results = {}
    for judged, predictors in ((truth, rows), (home, at_home)):
        for name, predictor in predictors.items():
            results[name] = figures(predictor, judged, window)
            print(f"{name:22}" + "".join(f"{value:8.2f}" for value in results[name].values()), flush=True)
    print(f"load {os.getloadavg()[0]:.1f}")
    if options.json is not None:
        write_whole(options.json, (json.dumps(results, indent=2) + "\n").encode())


if __name__ == "__main__":
    torch.set_grad_enabled(False)
    main()
