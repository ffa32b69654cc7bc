"""The published recipe and what its choices cost: jet colours, levels, and pictures each by its own range.

    python -m benchmarks.quality.recipe --paths FOLDER --geometry FILE --scale laptop [--page PAGE]

docs/how-to/published-recipe.md says what is compared and has the table.
"""

import argparse
import json
import shlex
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from benchmarks.quality.methods.copies import METHODS as COPIES
from benchmarks.quality.methods.method import SCALES, Method, Scale, Task
from benchmarks.quality.methods.published import STEPS, TARGETS
from benchmarks.quality.recipe_data import pictures_of
from benchmarks.quality.recipe_table import page_of
from rf3dgs.core.errors import InputError, RfError
from rf3dgs.core.files import write_whole
from rf3dgs.core.progress import Console
from rf3dgs.evaluation import metrics
from rf3dgs.evaluation.baselines.published import PublishedConfig, PublishedField, fit_published
from rf3dgs.evaluation.colours import colour_psnr, colour_ssim, jet_gap_db
from rf3dgs.evaluation.protocol import Predictor
from rf3dgs.spectra.codec import DbWindow, window_of
from rf3dgs.spectra.jet import jet_picture
from rf3dgs.spectra.spectrum import Spectrum, stack_spectra
from rf3dgs.splats.ply import read_ply
from rf3dgs.training.config import RadioConfig
from rf3dgs.training.radio import fit_radio

SIZES: dict[Scale, tuple[int, int]] = {"smoke": (36, 24), "laptop": (75, 50), "paper": (300, 200)}
POSITIONS: dict[Scale, tuple[int, int]] = {"smoke": (6, 4), "laptop": (80, 40), "paper": (400, 40)}
RANGE_DB = 80.0  # between the window's ends, as in the other tables
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


def measured(wish: argparse.Namespace) -> dict[str, Any]:
    """All values of all models, positions and seeds."""
    positions, held = POSITIONS[wish.scale]
    positions = wish.positions or [positions]
    progress = Console()
    pool, truth = pictures_of(
        wish.paths,
        wish.out / f"data-{wish.scale}",
        positions=max(positions),
        held=wish.held or held,
        size=SIZES[wish.scale],
        progress=progress,
    )
    found = window_of(pool)
    window = DbWindow(max(found.floor_db, found.ceil_db - RANGE_DB), found.ceil_db)
    geometry, steps = read_ply(wish.geometry), wish.steps or STEPS[wish.scale]
    order = torch.randperm(max(positions), generator=torch.Generator().manual_seed(0))
    rows = []
    for count in positions:
        views = (4 * order[:count, None] + torch.arange(4)).flatten().sort().values
        for seed in wish.seeds:
            for name in wish.models:
                if name in FLOORS and seed != wish.seeds[0]:
                    continue  # they have no seed
                print(f"{name}, {count} positions, seed {seed}", file=sys.stderr, flush=True)
                task = Task(pool[views], window, seed, wish.scale, geometry)
                start = time.process_time()
                predictor = method_of(name, steps).made(task)
                fitted = time.process_time()
                values = values_of(predictor, truth, window)
                judged = time.process_time() - fitted
                row = {"model": name, "positions": count, "seed": seed, "fit_cpu_s": fitted - start}
                rows.append(row | {"judging_cpu_s": judged, "values": {k: v.tolist() for k, v in values.items()}})
    return {
        "rows": rows,
        "steps": steps,
        "window_db": [window.floor_db, window.ceil_db],
        "held": len(truth) // 4,
        "size": list(SIZES[wish.scale]),
        "gaussians": len(geometry),
        "seeds": wish.seeds,
        "jet_gap_db": jet_gap_db(window.encode(truth.power)),
    }


def asked(words: Sequence[str] | None = None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--paths", type=Path, required=True, help="what rf3dgs trace wrote")
    parser.add_argument("--geometry", type=Path, required=True, help="Gaussians of the site, a .ply file")
    parser.add_argument("--scale", choices=SCALES, default="laptop", help="pictures of 36x24, 75x50 or 300x200")
    parser.add_argument("--models", nargs="+", choices=MODELS, default=list(MODELS))
    parser.add_argument("--positions", nargs="+", type=int, help="training positions, one or more numbers")
    parser.add_argument("--held", type=int, help="validation positions that judge")
    parser.add_argument("--steps", type=int, help="iterations; those of the scale when missing")
    parser.add_argument("--seeds", nargs="+", type=int, default=[0], help="decide the order of the pictures")
    parser.add_argument("--page", type=Path, help="put the table into this page")
    parser.add_argument("--out", type=Path, default=Path("out/recipe"))
    return parser.parse_args(words)


def main(words: Sequence[str] | None = None) -> int:
    wish = asked(words)
    try:
        if wish.page is not None:
            parted(wish.page)
        run = measured(wish)
    except RfError as error:
        print(f"recipe: {error}", file=sys.stderr)
        return 2
    run["command"] = command_of(sys.argv[1:] if words is None else words)
    text = page_of(run)
    write_whole(wish.out / "recipe.json", (json.dumps(run) + "\n").encode())
    write_whole(wish.out / "recipe.md", (text + "\n").encode())
    print(text)
    if wish.page is not None:
        put_into(wish.page, text)
    return 0


def command_of(words: Sequence[str]) -> str:
    """The command as a page may show it: of files their names alone, and not where it wrote."""
    kept = [
        Path(word).name if "/" in word else word
        for before, word in zip(("", *words), words, strict=False)
        if not {before, word} & {"--out", "--page"}
    ]
    return shlex.join(["python", "-m", "benchmarks.quality.recipe", *kept])


def put_into(page: Path, text: str) -> None:
    """Replace what stands between the two marks of the page."""
    head, tail = parted(page)
    write_whole(page, f"{head}\n{text}\n\n{tail}".encode())


def parted(page: Path) -> tuple[str, str]:
    """The page up to the first mark and from the second one; InputError where they are missing."""
    head, mark, rest = page.read_text(encoding="utf-8").partition("<!-- recipe -->\n")
    _, end, tail = rest.partition("<!-- end of recipe -->")
    if not mark or not end:
        raise InputError(f"{page} has no marks <!-- recipe --> and <!-- end of recipe -->; add them")
    return head + mark, end + tail


if __name__ == "__main__":
    raise SystemExit(main())
