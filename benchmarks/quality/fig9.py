"""The paper's Fig. 9: where PSNR and SSIM mislead.

    python -m benchmarks.quality.fig9 --scale laptop --paths paper.paths

Two tests of every picture score. Harmed truths: each held-out picture is changed in a way whose harm is known (its
level, its direction, its sharpness, its strongest beam), and scored. Methods: of two methods' pictures of one view,
does the score prefer the one whose beam loses less? docs/how-to/figures-9.md has what came out.
"""

import argparse
import math
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from itertools import combinations
from pathlib import Path

import numpy as np
import torch
from scipy.ndimage import gaussian_filter

from benchmarks.quality.methods import known, methods_of
from benchmarks.quality.methods.method import Scale
from benchmarks.quality.protocol.cells import Extra, Key, Truth
from benchmarks.quality.protocol.figure import (
    cpu_hours,
    made_by,
    page_or_sentence,
    parser_of,
    rows_of,
    study_of,
    write_json,
)
from benchmarks.quality.protocol.kept import kept_beside, kept_pictures
from benchmarks.quality.protocol.panels import small_png
from benchmarks.quality.protocol.results import Results
from benchmarks.quality.protocol.study import Study, say
from rf3dgs.core.errors import RfError
from rf3dgs.core.files import write_whole
from rf3dgs.core.units import db_from_power, power_from_db
from rf3dgs.evaluation.figures import STYLE
from rf3dgs.evaluation.pictures import coloured
from rf3dgs.evaluation.scores import SCORE, Score
from rf3dgs.spectra.codec import DbWindow
from rf3dgs.spectra.spectrum import Spectrum

METHODS = ("nearest", "constant", "rf3dgs-jet", "rf3dgs-db", "nerf2", "nerf2-db", "cgan", "mirror")
POSITIONS: Mapping[Scale, int] = {"smoke": 8, "laptop": 40, "paper": 160}
PICTURE_SCORES = ("psnr", "ssim", "flip", "lpips", "rmse_db", "wasserstein")
PHYSICS = ("peak_median", "peak_within_1", "beam_loss_eigen", "path_gain")
SHORT = {"psnr": "PSNR", "ssim": "SSIM", "flip": "FLIP", "rmse_db": "RMSE", "peak_median": "peak"}
SHORT |= {"beam_loss_eigen": "beam loss"}
KEPT = 160  # pictures, one of which is shown
CLEAR_DB = 1.0  # two beam losses this far apart are told apart
Values = Mapping[str, np.ndarray]
Harm = Callable[[np.ndarray, np.random.Generator], np.ndarray]


def no_more(truth: Spectrum, drawn: Spectrum, window: DbWindow) -> dict[str, torch.Tensor]:
    """No scores but those of every figure; the cells that keep pictures have a folder of their own."""
    return {}


def offset(level: np.ndarray, random: np.random.Generator) -> np.ndarray:
    return level + 3.0


def turned(level: np.ndarray, random: np.random.Generator) -> np.ndarray:
    return np.roll(level, 3, axis=1)


def blurred(level: np.ndarray, random: np.random.Generator) -> np.ndarray:
    return gaussian_filter(level, 2.0, mode="nearest")


def beamless(level: np.ndarray, random: np.random.Generator) -> np.ndarray:
    return np.minimum(level, level.max() - 20.0)


def clipped(level: np.ndarray, random: np.random.Generator) -> np.ndarray:
    return np.minimum(level, np.percentile(level, 98.0))


def noisy(level: np.ndarray, random: np.random.Generator) -> np.ndarray:
    return level + random.normal(0.0, 4.0, level.shape)


def ghost(level: np.ndarray, random: np.random.Generator) -> np.ndarray:
    """With a beam that is not there, 1 dB above the strongest, half a picture beside it."""
    rows, cols = level.shape
    row, col = np.unravel_index(level.argmax(), level.shape)
    beside = (col + cols // 2) % cols
    near = np.hypot(np.arange(rows)[:, None] - row, np.arange(cols) - beside) < 3
    return np.where(near, np.maximum(level, np.roll(level, cols // 2, axis=1) + 1.0), level)


HARMS: Mapping[str, tuple[str, Harm]] = {
    "noise of 4 dB": ("every pixel for itself", noisy),
    "3 dB more": ("the whole picture", offset),
    "turned": ("by 3 columns, about 3.6 degrees at laptop", turned),
    "blurred": ("2 pixels, in dB", blurred),
    "peaks clipped": ("at the picture's 98th percentile", clipped),
    "no strong beam": ("all above 20 dB below the peak cut off", beamless),
    "ghost beam": ("a second beam, 1 dB stronger, opposite", ghost),
}


def harmed(truth: Truth, harm: Harm, seed: int) -> dict[str, np.ndarray]:
    """Scores of the true pictures after one harm."""
    spectra, random = truth.spectra, np.random.default_rng(seed)
    floor = truth.window.floor_db
    levels = np.stack([harm(np.maximum(db_from_power(power).numpy(), floor), random) for power in spectra.power])
    power = power_from_db(torch.from_numpy(levels.astype(np.float32)))
    return truth.scored(replace(spectra, power=power))


def misorders(results: Results, holdout: str, score: Score, seed: int) -> tuple[float, int]:
    """Of all pairs of methods at all views whose beam losses differ clearly, the share that a score orders wrongly."""
    place = next(place for place in results.places if place.holdout == holdout)
    names = [name for name in results.models if results.seeds(place, name)]
    wrong = count = 0.0
    for one, other in combinations(names, 2):
        loss, value = (
            results.matrix(place, one, column, [seed])[0] - results.matrix(place, other, column, [seed])[0]
            for column in (SCORE["beam_loss_eigen"].column, score.column)
        )
        clear = (np.abs(loss) >= CLEAR_DB) & np.isfinite(value)
        worse = value < 0 if score.better == "higher" else value > 0
        wrong += float(((loss[clear] > 0) != worse[clear]).sum()) - 0.5 * float((value[clear] == 0).sum())
        count += int(clear.sum())
    return (100.0 * wrong / count if count else float("nan")), int(count)


def panels(truth: Truth, rows: Sequence[tuple[str, np.ndarray, Mapping[str, float]]], shown: Sequence[Score]) -> bytes:
    """One view as PNG: the truth, harmed truths and methods, each with its scores."""
    import matplotlib as mpl
    from matplotlib.figure import Figure

    window = window_of_view(truth)
    with mpl.rc_context({**STYLE, "font.size": 7}):
        columns = 4
        figure = Figure(figsize=(10.6, 2.5 * -(-len(rows) // columns)), dpi=100, layout="constrained")
        axes = figure.subplots(-(-len(rows) // columns), columns, squeeze=False).ravel()
        for axis in axes:
            axis.set_axis_off()
        for axis, (name, power, values) in zip(axes, rows, strict=False):
            axis.imshow(coloured(window.encode(torch.from_numpy(np.array(power))).numpy()), interpolation="nearest")
            axis.set_title(f"{name}\n{caption(values, shown)}")
        return small_png(figure)


def caption(values: Mapping[str, float], shown: Sequence[Score]) -> str:
    """The scores in three lines."""
    texts = [
        f"{SHORT[one.key]} {one.text(values[one.column])} {one.unit}".rstrip() for one in shown if one.column in values
    ]
    return "\n".join(", ".join(texts[start : start + 2]) for start in (0, 2, 4))


def window_of_view(truth: Truth) -> DbWindow:
    level = db_from_power(truth.spectra.power).numpy()
    top = float(np.ceil(level.max()))
    return DbWindow(max(truth.window.floor_db, top - 60.0), top)


def main(words: Sequence[str] | None = None) -> int:
    parser = parser_of(__doc__, "fig9")
    parser.add_argument("--methods", nargs="+", help="names, Python files; all of METHODS that there are when missing")
    parser.add_argument("--seed", type=int, default=0)
    wish = parser.parse_args(words)
    names = wish.methods or [name for name in METHODS if name in known()]
    count = POSITIONS[wish.scale]
    try:
        methods = methods_of(names)
        study = study_of(wish, "fig9", holdouts=("random",), extra=Extra("fig9", no_more), keep=KEPT)
        judge = "test" if wish.read_test else "validation"
        results = Results([method.name for method in methods], judge, Path(study.config.geometry).stem, [wish.seed])
        study.add(results, methods, count, wish.seed)
        truth = study.truth("random")
    except RfError as error:
        say(f"fig9: {error}")
        return 2
    pictures, physics = ([SCORE[key] for key in keys if key in SCORE] for keys in (PICTURE_SCORES, PHYSICS))
    found = {name: harmed(truth, harm, wish.seed) for name, (_, harm) in HARMS.items()}
    place = results.places[0]
    fitted = {name: results.values[place][name][wish.seed] for name in results.models if name in results.values[place]}
    head = ["", *(f"{score.label} [{score.unit}]" if score.unit else score.label for score in (*pictures, *physics))]

    def row(name: str, values: Mapping[str, np.ndarray]) -> list[str]:
        return [name, *(score.text(score.of(values[score.column])) for score in (*pictures, *physics))]

    shares = {score.key: misorders(results, "random", score, wish.seed) for score in (*pictures, SCORE["peak_median"])}
    orders = [
        [SCORE[key].label, f"{share:.0f} %" if pairs else "n/a", str(pairs)] for key, (share, pairs) in shares.items()
    ]
    text = "\n\n".join(
        [
            f"**Harmed truths**, {len(truth.spectra)} pictures",
            rows_of(head, [row(f"{name}: {HARMS[name][0]}", values) for name, values in found.items()]),
            f"**Methods**, {count} training positions, the same pictures",
            rows_of(head, [row(name, values) for name, values in fitted.items()]),
            f"**Pairs of methods at one view** whose eigenbeam losses differ by at least {CLEAR_DB:g} dB: how often "
            "the score prefers the one that loses more (50 % is a coin)",
            rows_of(["score", "prefers the worse", "pairs"], orders),
            made_by("fig9", [wish.seed], words, **{"CPU hours of fits and rendering": cpu_hours(results.facts)}),
        ]
    )
    draw(study, results, found, wish)
    numbers = {"harmed": found, "methods": fitted, "misorders": shares, "facts": results.facts}
    write_json(wish.out / f"fig9-{wish.scale}.json", plain(numbers))
    print(text)
    return page_or_sentence(wish.page, "fig9", text)


def plain(value):
    """Arrays as lists and NaN as null, for JSON."""
    if isinstance(value, Mapping):
        return {key: plain(one) for key, one in value.items()}
    if isinstance(value, np.ndarray):
        return [plain(one) for one in value.tolist()]
    return None if isinstance(value, float) and math.isnan(value) else value


def draw(study: Study, results: Results, found: Mapping[str, Values], wish: argparse.Namespace) -> None:
    """The panels of the view, among those kept, to which most power comes."""
    truth = study.truth("random")
    view = int(truth.spectra.path_gain[:KEPT].argmax())
    random, floor = np.random.default_rng(wish.seed), truth.window.floor_db
    shown = [SCORE[key] for key in SHORT if key in SCORE]
    true_level = np.maximum(db_from_power(truth.spectra.power[view]).numpy(), floor)

    def of_view(values: Values) -> dict[str, float]:
        return {column: float(value[view]) for column, value in values.items()}

    rows: list[tuple[str, np.ndarray, Mapping[str, float]]] = [("truth", truth.spectra.power[view].numpy(), {})]
    for name, (_, harm) in HARMS.items():
        rows.append((name, power_from_db(torch.from_numpy(harm(true_level, random))).numpy(), of_view(found[name])))
    for fact in results.facts:
        key = Key(**fact["key"])
        power = kept_pictures(kept_beside(key.path(study.config.cells)), truth.spectra).power
        rows.append((key.model, power[view].numpy(), of_view(results.values[results.places[0]][key.model][key.seed])))
    write_whole((wish.pictures or wish.out) / f"fig9-{wish.scale}.png", panels(truth, rows, shown))


if __name__ == "__main__":
    sys.exit(main())
