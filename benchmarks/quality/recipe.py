"""The published recipe and what its choices cost: jet colours, levels, and pictures each by its own range.

    python -m benchmarks.quality.recipe --scale laptop --paths paper.paths --steps 10000 --seeds 0 1

docs/how-to/published-recipe.md says what is compared and has the table.
"""

import argparse
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import torch

from benchmarks.quality.methods.copies import METHODS as COPIES
from benchmarks.quality.methods.method import Method, Scale, Task
from benchmarks.quality.methods.published import STEPS, TARGETS
from benchmarks.quality.protocol.figure import made_by, page_or_sentence, parser_of, study_of, write_json
from benchmarks.quality.protocol.study import Study, say
from benchmarks.quality.recipe_table import page_of
from rf3dgs.core.errors import RfError
from rf3dgs.core.files import write_whole
from rf3dgs.evaluation import metrics
from rf3dgs.evaluation.baselines.published import PublishedConfig, PublishedField, fit_published
from rf3dgs.evaluation.colours import colour_psnr, colour_ssim, jet_gap_db
from rf3dgs.evaluation.protocol import Predictor
from rf3dgs.spectra.codec import DbWindow
from rf3dgs.spectra.jet import jet_picture
from rf3dgs.spectra.spectrum import Spectrum, stack_spectra
from rf3dgs.training.config import RadioConfig
from rf3dgs.training.radio import fit_radio

POSITIONS: dict[Scale, int] = {"smoke": 6, "laptop": 80, "paper": 160}
PRESET = "preset"
FLOORS = {method.name: method for method in COPIES if method.name in ("constant", "nearest", "linear")}
MODELS = (*TARGETS, PRESET, *FLOORS)
Values = dict[str, np.ndarray]


def method_of(name: str, steps: int) -> Method:
    """A model of the table; the trained ones with so many iterations."""
    if name in FLOORS:
        return FLOORS[name]

    def fit(task: Task) -> Predictor:
        assert task.geometry is not None
        if name == PRESET:
            ends = {"floor_db": task.window.floor_db, "ceil_db": task.window.ceil_db}
            return fit_radio(task.geometry, task.spectra, preset_config(steps, task.seed, ends))
        config = PublishedConfig(target=TARGETS[name], steps=steps, seed=task.seed)
        return fit_published(task.geometry, task.spectra, config, window=task.window)

    return Method(name, fit, ("geometry",))


def preset_config(steps: int, seed: int, ends: Mapping[str, float]) -> RadioConfig:
    """This package's own preset "paper", in a window and on Gaussians that are left as they are."""
    return replace(RadioConfig.paper(steps=steps, seed=seed), detail="keep", **ends)


def values_of(predictor: Predictor, truth: Spectrum, window: DbWindow) -> Values:
    """Every score of every picture `[n]`; PSNR in the model's own scale is NaN for those that have none."""
    grid, weight = truth.grid, metrics.pixel_weight(truth.grid)
    poses = [truth.pose[index] for index in range(len(truth))]
    drawn = stack_spectra([predictor.render(pose, grid) for pose in poses])
    level, other = window.encode(truth.power), window.encode(drawn.power)
    colours, shown = jet_picture(level), jet_picture(other)
    own = torch.full((len(truth),), torch.nan)
    if isinstance(predictor, PublishedField):
        pictures = torch.stack([predictor.picture(pose, grid).clamp(0.0, 1.0) for pose in poses])
        own = colour_psnr(predictor.scale.paint(truth.power), pictures, weight)
    found = {
        "psnr_own": own,
        "psnr_rgb": colour_psnr(colours, shown, weight),
        "psnr_grey": metrics.psnr(level, other, weight),
        "ssim_rgb": colour_ssim(colours, shown, grid),
        "ssim_grey": metrics.ssim(level, other, grid),
        "rmse_db": metrics.rmse_db(truth.power, drawn.power, window, weight),
        "peak_deg": torch.rad2deg(metrics.peak_error(truth, drawn)),
        "path_gain_db": metrics.path_gain_error(truth, drawn),
    }
    return {name: value.double().numpy() for name, value in found.items()}


def measured(study: Study, wish: argparse.Namespace) -> dict[str, Any]:
    """All values of all models, positions and seeds."""
    judged = study.truth("random")
    steps = wish.steps or STEPS[study.config.scale]
    rows = []
    for count in wish.positions or [POSITIONS[study.config.scale]]:
        for seed in wish.seeds:
            task = study.task(count, seed)
            for name in wish.models:
                say(f"{name}, {count} positions, seed {seed}")
                start = time.process_time()
                predictor = method_of(name, steps).made(task)
                fitted = time.process_time()
                values = values_of(predictor, judged.spectra, judged.window)
                spent = time.process_time() - fitted
                row = {"model": name, "positions": count, "seed": seed, "fit_cpu_s": fitted - start}
                rows.append(row | {"judging_cpu_s": spent, "values": {k: v.tolist() for k, v in values.items()}})
    return {
        "rows": rows,
        "steps": steps,
        "window_db": [judged.window.floor_db, judged.window.ceil_db],
        "judge": study.config.judge,
        "held": len(judged.spectra) // judged.views,
        "views": judged.views,
        "size": list(study.config.pictures.size),
        "gaussians": [len(study.geometry(seed)) for seed in wish.seeds],
        "seeds": wish.seeds,
        "jet_gap_db": jet_gap_db(judged.window.encode(judged.spectra.power)),
    }


def main(words: Sequence[str] | None = None) -> int:
    parser = parser_of(__doc__, "recipe")
    parser.add_argument("--models", nargs="+", choices=MODELS, default=list(MODELS))
    parser.add_argument("--positions", nargs="+", type=int, help="training positions, one or more numbers")
    parser.add_argument("--steps", type=int, help="iterations; those of the scale when missing")
    parser.add_argument("--seeds", nargs="+", type=int, default=[0], help="of the positions and the pictures' order")
    wish = parser.parse_args(words)
    try:
        run = measured(study_of(wish, "recipe", holdouts=("random",)), wish)
    except RfError as error:
        say(f"recipe: {error}")
        return 2
    text = f"{page_of(run)}\n\n{made_by('recipe', wish.seeds, words)}"
    write_json(wish.out / f"recipe-{wish.scale}.json", run)
    write_whole(wish.out / f"recipe-{wish.scale}.md", (text + "\n").encode())
    print(text)
    return page_or_sentence(wish.page, "recipe", text)


if __name__ == "__main__":
    sys.exit(main())
