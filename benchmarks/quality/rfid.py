"""Measured spectra of a still array: is a field of the transmitter's places better than a copy of the nearest picture?

    python -m benchmarks.quality.rfid FOLDER [--buffer 0.03] [--folds 5] [--seed 0] [--out out/rfid]

FOLDER is laid out as docs/how-to/measured-rfid.md says. Every place is judged once. "region": slabs across the longest
axis of the places, with nothing nearer than the buffer left to train on. "random": the same number of folds at random.
Intervals (95 %) resample runs of seven pictures that follow each other, since a picture says much of the next.
"""

import argparse
import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from benchmarks.quality.protocol.compare import difference, estimate
from rf3dgs.channel.response import manifold
from rf3dgs.core.angles import angle_between
from rf3dgs.core.grids import DirectionGrid
from rf3dgs.core.units import wavelength
from rf3dgs.data.formats.gateway import GatewaySpectra, read_gateway
from rf3dgs.evaluation.metrics import pixel_weight, psnr, ssim
from rf3dgs.evaluation.pictures import coloured, encoded
from rf3dgs.evaluation.scores import Score
from rf3dgs.field.gateway import kernel
from rf3dgs.training.gateway_fit import GatewayConfig, blocks_of, fit_gateway
from rf3dgs.training.phase_retrieval import element_responses

RUN = 7  # pictures, about 5 cm of the way
SCORES = (
    Score("psnr", "PSNR", "dB", "higher", "psnr", "mean", 2, "Of amplitude pictures, the truth's largest is 1."),
    Score("ssim", "SSIM", "", "higher", "ssim", "mean", 3, "Structural similarity of the same pictures."),
    Score("peak", "main peak", "deg", "lower", "peak", "mean", 1, "Mean angle between the brightest directions."),
)
NEAREST, SOURCES, FIELD = "nearest", "four sources", "field"
MODELS = (NEAREST, "idw4", "idw8", "mean", "kriging", SOURCES, FIELD)
Parts = list[tuple[Tensor, Tensor]]


def region_folds(places: Tensor, folds: int, buffer: float) -> Parts:
    """(train, test) indices of slabs; training places are more than `buffer` [m] from every test place."""
    distance = torch.cdist(places, places)
    return [((distance[:, test].amin(1) > buffer).nonzero()[:, 0], test) for test in blocks_of(places, folds)]


def random_folds(count: int, folds: int, seed: int) -> Parts:
    fold = torch.from_numpy(np.random.default_rng(seed).permutation(count) % folds)
    return [((fold != one).nonzero()[:, 0], (fold == one).nonzero()[:, 0]) for one in range(folds)]


def lookups(train: GatewaySpectra, places: Tensor) -> dict[str, Tensor]:
    """Pictures `[place, row, col]` made of training pictures alone."""
    distance = torch.cdist(places, train.places)
    near, order = distance.sort(dim=1, stable=True)
    pictures = {NEAREST: train.amplitude[order[:, 0]]}
    for count in (4, 8):
        weight = near[:, :count].clamp_min(1e-9) ** -2
        weight = (weight / weight.sum(1, keepdim=True)).float()
        pictures[f"idw{count}"] = torch.einsum("pn,pnrc->prc", weight, train.amplitude[order[:, :count]])
    mean = train.amplitude.mean(0)
    length = 0.3 * wavelength(train.frequency)
    gram = kernel(train.places, train.places, length) + 0.1 * torch.eye(len(train))
    weights = (kernel(places, train.places, length) @ torch.linalg.inv(gram)).float()
    kriged = mean + torch.einsum("pn,nrc->prc", weights, train.amplitude - mean)
    return pictures | {"mean": mean.expand(len(places), -1, -1), "kriging": kriged}


def scores_of(truth: Tensor, drawn: Tensor, grid: DirectionGrid) -> dict[str, Tensor]:
    drawn = drawn.clamp(0.0, 1.0)
    peaks = [grid.directions.reshape(-1, 3)[picture.flatten(1).argmax(1)] for picture in (truth, drawn)]
    return {
        "psnr": psnr(truth, drawn, pixel_weight(grid)),
        "ssim": ssim(truth, drawn, grid),
        "peak": torch.rad2deg(angle_between(*peaks)),
    }


def judged(spectra: GatewaySpectra, parts: Parts, seed: int) -> tuple[dict[str, dict[str, Tensor]], Tensor, Tensor]:
    """Scores `[place]` by model and column, distances `[place]` to training [m], and the field's pictures."""
    table = {name: {score.column: torch.zeros(len(spectra)) for score in SCORES} for name in MODELS}
    distance, pictures = torch.zeros(len(spectra)), torch.zeros_like(spectra.amplitude)
    for number, (train, test) in enumerate(parts):
        part, places, truth = spectra[train], spectra.places[test], spectra.amplitude[test]
        drawn = lookups(part, places)
        fixed = GatewayConfig(sources=(4,), lengths=(0.3,), noises=(0.1,), seed=seed)
        alone = fit_gateway(part, fixed).field
        drawn[SOURCES] = alone.of_sources().render(places, spectra.grid)
        fit = fit_gateway(part, GatewayConfig(seed=seed))
        drawn[FIELD] = pictures[test] = fit.field.render(places, spectra.grid)
        distance[test] = torch.cdist(places, part.places).amin(1).float()
        for name, picture in drawn.items():
            for column, values in scores_of(truth, picture, spectra.grid).items():
                table[name][column][test] = values
        best = {sources: min(v for key, v in fit.errors.items() if key[0] == sources) for sources, _, _ in fit.errors}
        tried = ", ".join(f"{sources}: {error:.4f}" for sources, error in best.items())
        count, length, noise = fit.choice
        print(
            f"  fold {number}: {len(train)} train, {len(test)} test; {count} sources, length {length}, noise {noise}; "
            f"error left out by number of sources {tried}; misfit {fit.misfit:.4f}",
            flush=True,
        )
    return table, distance, pictures


def of_runs(values: Tensor) -> np.ndarray:
    """Means `[1, run]` over pictures that follow each other: what is resampled."""
    return np.array([[float(run.mean()) for run in values.split(RUN)]])


def print_table(table: dict[str, dict[str, Tensor]], distance: Tensor) -> None:
    median, most = 100 * float(distance.median()), 100 * float(distance.max())
    print(f"\nto the nearest training place: median {median:.1f} cm, most {most:.1f} cm\n")
    heads = " | ".join(f"{score.label} {score.unit}".strip() for score in SCORES)
    print(f"| model | {heads} |\n|---|{'---|' * len(SCORES)}")
    for name in MODELS:
        cells = []
        for score in SCORES:
            found = estimate(of_runs(table[name][score.column]), score)
            cells.append(f"{score.text(found.value)} ({score.text(found.low)} to {score.text(found.high)})")
        print(f"| {name} | {' | '.join(cells)} |")
    print(f"\n| field less | {' | '.join(score.label for score in SCORES)} |\n|---|{'---|' * len(SCORES)}")
    for name in MODELS[:-1]:
        cells = []
        for score in SCORES:
            found = difference(of_runs(table[FIELD][score.column]), of_runs(table[name][score.column]), score)
            value = found.estimate
            cells.append(
                f"{value.value:+.{score.digits}f} ({value.low:+.{score.digits}f} to "
                f"{value.high:+.{score.digits}f}), {found.verdict}"
            )
        print(f"| {name} | {' | '.join(cells)} |")


def print_repeats(spectra: GatewaySpectra) -> None:
    """How alike pictures of places a few centimetres apart are, soon after each other and later."""
    first, second = torch.triu_indices(len(spectra), len(spectra), 1)
    distance, later = torch.cdist(spectra.places, spectra.places)[first, second], second - first
    pictures = spectra.amplitude[:, ::3, ::6]
    error = (pictures[first] - pictures[second]).square().mean((1, 2)).clamp_min(1e-10)
    level = -10 * torch.log10(error)
    print("| places apart | at most 9 pictures later | more than 30 later |\n|---|---|---|")
    for low, high in ((0.02, 0.03), (0.03, 0.04), (0.04, 0.05), (0.05, 0.08), (0.08, 0.12)):
        near = (distance >= low) & (distance < high)
        cells = []
        for chosen in (near & (later <= 9), near & (later > 30)):
            cells.append(f"{level[chosen].median():.1f} dB ({int(chosen.sum())} pairs)" if chosen.any() else "none")
        print(f"| {100 * low:.0f} to {100 * high:.0f} cm | {' | '.join(cells)} |")
    print()


def print_poses(spectra: GatewaySpectra) -> None:
    """Mean power towards the transmitter under each reading of the quaternion, over that of all directions."""
    responses, _ = element_responses(spectra)
    ahead, left, up = spectra.pose.world_from_device.mT
    to = torch.nn.functional.normalize(spectra.places.mean(0).float() - spectra.pose.position, dim=0)
    x, y, z = (float(to @ axis) for axis in (ahead, left, up))
    everywhere = (
        responses @ manifold(spectra.array, spectra.grid.directions[::6, ::12].double().reshape(-1, 3)).conj().mT
    )
    mean = everywhere.abs().square().mean()
    for name, way in {
        "as read (x y z w)": (x, y, z),
        "half a turn on (as w x y z)": (x, -y, -z),
        "a quarter turn on": (x, -z, y),
        "a quarter turn back": (x, z, -y),
    }.items():
        steering = manifold(spectra.array, torch.tensor(way, dtype=torch.float64))
        level = (responses @ steering.conj()).abs().square().mean() / mean
        print(f"towards the transmitter, array {name}: {10 * math.log10(float(level)):+.1f} dB over the mean direction")
    print()


def save_pictures(spectra: GatewaySpectra, pictures: Tensor, path: Path) -> None:
    """Every tenth place: measured left, drawn right."""
    rows = [
        torch.cat((spectra.amplitude[one], torch.ones(90, 6), pictures[one].clamp(0, 1)), 1)
        for one in range(0, len(spectra), 10)
    ]
    sheet = torch.cat([torch.cat((row, torch.ones(6, row.shape[1]))) for row in rows])
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(encoded(coloured(sheet.numpy())))


def main(words: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, help="gateway_info.yml, tx_pos.csv and spectrum/")
    parser.add_argument("--buffer", type=float, default=0.03, help="no training place is nearer to a test slab [m]")
    parser.add_argument("--folds", type=int, default=5)
    parser.add_argument("--seed", type=int, default=0, help="decides the random folds and starts")
    parser.add_argument("--splits", nargs="+", choices=("region", "random"), default=["region", "random"])
    parser.add_argument("--out", type=Path, default=Path("out/rfid"), help="for the pictures")
    wish = parser.parse_args(words)
    spectra = read_gateway(wish.folder)
    print_poses(spectra)
    print_repeats(spectra)
    for split in wish.splits:
        buffered = region_folds(spectra.places, wish.folds, wish.buffer)
        print(f"## {split}" + (f", buffer {100 * wish.buffer:g} cm" if split == "region" else ""))
        parts = buffered if split == "region" else random_folds(len(spectra), wish.folds, wish.seed)
        table, distance, pictures = judged(spectra, parts, wish.seed)
        print_table(table, distance)
        save_pictures(spectra, pictures, wish.out / f"{split}.png")


if __name__ == "__main__":
    main()
