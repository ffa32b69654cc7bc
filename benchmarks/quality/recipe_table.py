"""The table of the published recipe: scores of each target, their differences, and the paper's numbers beside them."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from benchmarks.quality.protocol.figure import rows_of

NAMES = {
    "rf3dgs-jet": "jet colours, 8 bits (published)",
    "rf3dgs-db": "level, one channel",
    "rf3dgs-view": "level by each picture's range",
    "rf3dgs-view-linear": "linear by each picture's peak",
    "preset": 'preset "paper" of `fit-radio`',
    "constant": "constant",
    "nearest": "nearest",
    "linear": "linear",
}
COLUMNS = {
    "psnr_own": ("PSNR, own scale [dB]", 2),
    "psnr_rgb": ("PSNR, jet RGB [dB]", 2),
    "psnr_grey": ("PSNR, grey [dB]", 2),
    "ssim_rgb": ("SSIM, jet RGB", 3),
    "ssim_grey": ("SSIM, grey", 3),
    "rmse_db": ("RMSE [dB]", 2),
    "peak_deg": ("main peak, median [deg]", 2),
    "path_gain_db": ("path gain [dB]", 2),
}
DIFFERENCES = (
    ("rf3dgs-db", "rf3dgs-jet"),
    ("rf3dgs-view", "rf3dgs-db"),
    ("rf3dgs-view-linear", "rf3dgs-db"),
    ("preset", "rf3dgs-db"),
)
KNOWN = {("rf3dgs-db", "rf3dgs-jet"): "+0.6", ("rf3dgs-view", "rf3dgs-db"): "-6.2"}
"""PSNR [dB] that a third party found between these two on its own lobby."""
PUBLISHED = (
    ("paper, text to Fig. 9: ideal spectra", "about 15", "about 0.5"),
    ("its released models, re-scored by others: ideal", "15.51", "0.628"),
    ("MVDR", "16.02", "0.731"),
    ("CBF, per view", "14.13", "0.723"),
)
Rows = Sequence[Mapping[str, Any]]


def page_of(run: Mapping[str, Any]) -> str:
    """The tables as Markdown, and what they cost."""
    parts = [caption(run)]
    for count in sorted({row["positions"] for row in run["rows"]}):
        rows = [row for row in run["rows"] if row["positions"] == count]
        parts += [f"{count} training positions:", scores(rows), differences(rows, run["views"])]
    return "\n\n".join(part for part in parts if part)


def caption(run: Mapping[str, Any]) -> str:
    low, high = run["window_db"]
    total = sum(row["fit_cpu_s"] + row["judging_cpu_s"] for row in run["rows"])
    width, height = run["size"]
    gaussians = ", ".join(f"{count:,}" for count in run["gaussians"])
    return (
        f"{run['held']} {run['judge']} positions, {run['views']} pictures of {width}x{height} each; "
        f"{gaussians} Gaussians; {run['steps']:,} iterations; window {low:g} to {high:g} dB; mean over "
        f"seeds {', '.join(str(seed) for seed in run['seeds'])}. While errors are small jet RGB is "
        f"{run['jet_gap_db']:.1f} dB below grey. Fits and judging took {total:.0f} s of CPU time."
    )


def scores(rows: Rows) -> str:
    """One line a model, then the paper's."""
    lines = []
    for name in dict.fromkeys(row["model"] for row in rows):
        mine = [row for row in rows if row["model"] == name]
        cells = []
        for key, (_, digits) in COLUMNS.items():
            values = np.array([row["values"][key] for row in mine])
            value = float(np.median(values) if key == "peak_deg" else np.mean(values))
            cells.append("-" if np.isnan(value) else f"{value:.{digits}f}")
        cost = float(np.mean([row["fit_cpu_s"] for row in mine]))
        lines.append([NAMES[name], *cells, f"{cost:.1f}"])
    for title, psnr, ssim in PUBLISHED:
        cells = {"psnr_rgb": psnr, "ssim_rgb": ssim}
        lines.append([f"*{title}*", *(cells.get(key, "") for key in COLUMNS), ""])
    return rows_of(["target", *(title for title, _ in COLUMNS.values()), "fit, CPU [s]"], lines)


def differences(rows: Rows, views: int) -> str:
    """PSNR in the common window between two targets: over positions, one standard error, and each seed's own."""
    head = ["PSNR, grey, difference [dB]", "mean and standard error over positions", "each seed", "found by others"]
    lines = []
    for better, base in DIFFERENCES:
        first, second = (
            [np.array(row["values"]["psnr_grey"]) for row in rows if row["model"] == name] for name in (better, base)
        )
        if not first or not second:
            continue
        each = np.array(first) - np.array(second)  # [seed, picture]
        places = each.mean(0).reshape(-1, views).mean(1)
        error = f" ± {places.std(ddof=1) / np.sqrt(len(places)):.2f}" if len(places) > 1 else ""
        seeds = ", ".join(f"{value:+.2f}" for value in each.mean(1))
        known = KNOWN.get((better, base), "")
        lines.append([f"{NAMES[better]} over {NAMES[base]}", f"{places.mean():+.2f}{error}", seeds, known])
    return rows_of(head, lines) if lines else ""
