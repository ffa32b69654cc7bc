"""Does a field know how sure it is? Coverage of its uncertainty at positions that it never saw.

    python -m benchmarks.quality.sureness GEOMETRY.ply [--dataset lobby] [--holdouts random region half] [--seeds 0 1]
        [--out out/sureness]

The training and validation positions of the dataset (its sealed test is not read) are split anew: a fifth of them at
random; a fifth in one region behind a buffer; or the half beyond the middle of the longer side, which lies outside the
trained box. The field is fitted to the rest with its uncertainty, and at what was held out the share of errors within
the interval of each nominal share is counted, over solid angle, for the directions of the spectra and for the eight
strongest paths of each position (the spectrum's level in the direction of the path). `normal` are the shares that
multiples of the standard deviation by a normal distribution hold. Medians of the standard deviation, and of half the
intervals of paths, tell near from far.
Writes sureness.json and coverage.png.
"""

import argparse
import json
import os
import time
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from rf3dgs.cli.facts import open_dataset
from rf3dgs.core.files import write_whole
from rf3dgs.data.split import split_positions
from rf3dgs.field.lit import LitSurface
from rf3dgs.field.radio_field import RadioField
from rf3dgs.field.uncertainty import floor_db
from rf3dgs.spectra.spectrum import Spectrum, stack_spectra
from rf3dgs.splats.gaussians import Gaussians
from rf3dgs.splats.ply import read_ply
from rf3dgs.training.config import RadioConfig
from rf3dgs.training.radio import fit_radio

NOMINAL = (0.5, 0.68, 0.9, 0.95)
HOLDOUTS = ("random", "region", "half")


@dataclass(frozen=True)
class Score:
    """One hold-out: shares by nominal share, and standard deviations [dB]."""

    holdout: str
    seed: int
    train: int
    test: int
    covered: dict[str, list[float]]
    by_position: list[float]
    std_db: dict[str, float]
    rmse_db: float
    cpu_s: float
    load: float


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("geometry", type=Path)
    parser.add_argument("--dataset", default="lobby")
    parser.add_argument("--holdouts", nargs="+", choices=HOLDOUTS, default=HOLDOUTS)
    parser.add_argument("--seeds", nargs="+", type=int, default=[0, 1])
    parser.add_argument("--out", type=Path, default=Path("out/sureness"))
    asked = parser.parse_args()
    dataset, geometry = open_dataset(asked.dataset), read_ply(asked.geometry)
    parts = [part for part in (dataset.train.spectra, dataset.validation.spectra) if part is not None]
    spectra = stack_spectra([one for part in parts for one in map(part.__getitem__, range(len(part)))])
    asked.out.mkdir(parents=True, exist_ok=True)
    scores = []
    for seed in asked.seeds:
        for holdout in asked.holdouts:
            if holdout == "half" and seed != asked.seeds[0]:
                continue  # nothing in it is drawn
            scores.append(score(geometry, spectra, holdout, seed))
            print(told(scores[-1]), flush=True)
            write_whole(asked.out / "sureness.json", json.dumps([vars(one) for one in scores], indent=1).encode())
    write_whole(asked.out / "coverage.png", drawn(scores))


def score(geometry: Gaussians, spectra: Spectrum, holdout: str, seed: int) -> Score:
    """Fit without the held-out positions, and count at them."""
    train, test = parted(spectra.pose.position, holdout, seed)
    started = time.process_time()
    field = fit_radio(geometry, spectra[train], RadioConfig(model="mirror", seed=seed, uncertainty=True))
    spent = time.process_time() - started
    truth = spectra[test]
    std = field.uncertainty(truth.pose, truth.grid)
    error, counts = errors(field, truth)
    assert field.doubt is not None
    widths = [field.doubt.width(share) for share in NOMINAL]
    normal = [float(torch.erfinv(torch.tensor(share))) * 2**0.5 for share in NOMINAL]
    at_paths, sizes = path_errors(field, truth)

    def shares(wrong: Tensor, sure: Tensor, weight: Tensor, by: list[float]) -> list[float]:
        return [float((weight * (wrong < width * sure)).sum() / weight.sum()) for width in by]

    covered = {
        "directions": shares(error, std, counts, widths),
        "normal": shares(error, std, counts, normal),
        "paths": [float((at_paths < size).float().mean()) for size in sizes],
    }
    inside = field.covers(truth.pose, margin=0.0)
    seen = field.uncertainty(spectra.pose[train[:8]], truth.grid)
    deviations = {"at training positions": seen.median(), "held out": std.median()}
    deviations |= {f"paths {share:.0%}": size.median() for share, size in zip(NOMINAL, sizes, strict=True)}
    if bool(inside.any()):
        deviations["inside the box"] = std[inside].median()
    if not bool(inside.all()):
        deviations["outside the box"] = std[~inside].median()
    return Score(
        holdout,
        seed,
        len(train),
        len(test),
        covered,
        [shares(error[row], std[row], counts[row], [1.0])[0] for row in range(len(test))],
        {name: float(value) for name, value in deviations.items()},
        float(((error.square() * counts).sum() / counts.sum()).sqrt()),
        spent,
        os.getloadavg()[0],
    )


def parted(positions: Tensor, holdout: str, seed: int) -> tuple[Tensor, Tensor]:
    """Numbers of the positions that train and of those held out."""
    if holdout == "half":
        along = positions[:, int((positions.amax(0) - positions.amin(0)).argmax())]
        far = along > along.median()
        return torch.nonzero(~far).squeeze(-1), torch.nonzero(far).squeeze(-1)
    part = {"test": 0.2, "region": 0.0} if holdout == "random" else {"test": 0.0, "region": 0.2}
    roles = split_positions(positions, validation=0.0, seed=seed, **part)
    train, test = ([n for n, role in enumerate(roles) if role in names] for names in (("train",), ("test", "region")))
    return torch.tensor(train), torch.tensor(test)


def errors(field: RadioField, truth: Spectrum) -> tuple[Tensor, Tensor]:
    """|error| [dB] and solid angle `[position, row, col]`, zero where truth and field are both under the floor."""
    assert isinstance(field.surface, LitSurface)
    low = floor_db(field.surface)
    shown, true = field.render(truth.pose, truth.grid, csi=False).gain_db, truth.gain_db
    counts = truth.grid.solid_angle * ((shown > low) | (true > low))
    return (shown.clamp_min(low) - true.clamp_min(low)).abs(), counts


def path_errors(field: RadioField, truth: Spectrum) -> tuple[Tensor, list[Tensor]]:
    """|error| `[path]` [dB] of the level in the pixel of each of the field's paths, and for each nominal share half of
    the interval that should hold it."""
    paths = field.paths(truth.pose, strongest=8)
    sizes = [field.uncertainty_of(paths, share=share)[paths.valid] for share in NOMINAL]
    shown = field.render(truth.pose, truth.grid, csi=False)
    x, y = truth.grid.pixel_of(truth.pose.to_device(paths.aoa))[0].unbind(-1)
    col, row = x.long().clamp(0, truth.grid.width - 1), y.long().clamp(0, truth.grid.height - 1)
    place = torch.arange(len(truth))[:, None].expand_as(row)
    return (shown.gain_db - truth.gain_db).abs()[place, row, col][paths.valid], sizes


def told(one: Score) -> str:
    """A few lines about one hold-out."""
    rows = [
        f"{one.holdout} {one.seed}: {one.train} train, {one.test} held out, RMSE {one.rmse_db:.2f} dB, "
        f"fit {one.cpu_s:.0f} s CPU, load {one.load:.1f}",
        "  nominal     " + " ".join(f"{100 * share:5.1f}" for share in NOMINAL),
    ]
    rows += [f"  {name:<11} " + " ".join(f"{100 * share:5.1f}" for share in row) for name, row in one.covered.items()]
    rows.append("  68 % by position, from " + f"{100 * min(one.by_position):.0f} to {100 * max(one.by_position):.0f}")
    rows.append("  medians: " + ", ".join(f"{name} {value:.2f} dB" for name, value in one.std_db.items()))
    return "\n".join(rows)


def drawn(scores: list[Score]) -> bytes:
    """Coverage against the nominal share, one line for each hold-out, as PNG."""
    from io import BytesIO

    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9, 4.5), layout="constrained")
    FigureCanvasAgg(figure)
    for axes, what in zip(figure.subplots(1, 2), ("directions", "paths"), strict=True):
        axes.plot([0.4, 1], [0.4, 1], color="0.7", linestyle="--")
        for one in scores:
            style = {"random": "o-", "region": "s-", "half": "^-"}[one.holdout]
            axes.plot(NOMINAL, one.covered[what], style, label=f"{one.holdout} {one.seed}", markersize=4)
        axes.set(title=what, xlabel="nominal share", ylabel="share of errors within", xlim=(0.4, 1), ylim=(0.2, 1))
        axes.legend(fontsize=8)
    buffer = BytesIO()
    figure.savefig(buffer, format="png", dpi=110)
    return buffer.getvalue()


if __name__ == "__main__":
    main()
