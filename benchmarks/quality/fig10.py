"""The paper's Figs. 10 and 11: fields trained on ideal, CBF, TCBF and MVDR spectra, judged by two truths.

    python -m benchmarks.quality.fig10 --scale smoke|laptop|paper --page docs/how-to/figures-10.md

At each position stand four pinhole pictures, of an ideal lobe or of an 8x8 array of patches, whose covariance is the
expectation over the paths' phases. For each kind the same positions train the published recipe (for CBF and TCBF also
on linear pictures over their own peaks, as in the paper), our field and the nearest neighbour. They are judged by the
same kind at held-out positions, and by ideal spectra there. "instrument" is the instrument's own picture of the
held-out place. Writes fig10.png, fig11.png, fig10.json and, with --page, tables. docs/how-to/figures-10.md explains.
"""

import argparse
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.quality.methods import methods_of
from benchmarks.quality.methods.method import Scale
from benchmarks.quality.protocol.cells import Extra, Key, Truth, Values
from benchmarks.quality.protocol.compare import estimate
from benchmarks.quality.protocol.figure import made_by, page_or_sentence, parser_of, rows_of, study_of, told, write_json
from benchmarks.quality.protocol.kept import kept_beside, kept_pictures
from benchmarks.quality.protocol.panels import COLOURS, panels, small_png
from benchmarks.quality.protocol.results import Results
from benchmarks.quality.protocol.study import Study
from benchmarks.quality.spectra_kinds import KINDS, OWN_SCORES, between_kinds, methods_for, same_places, scale_of
from rf3dgs.core.errors import InputError
from rf3dgs.core.files import write_whole
from rf3dgs.evaluation.figures import STYLE
from rf3dgs.evaluation.pictures import coloured
from rf3dgs.evaluation.scores import SCORE, Score
from rf3dgs.evaluation.table import Estimate
from rf3dgs.spectra.codec import DbWindow
from rf3dgs.spectra.config import Method as SpectrumMethod
from rf3dgs.spectra.spectrum import Spectrum

NAME = "fig10"
COUNT: Mapping[Scale, int] = {"smoke": 4, "laptop": 40, "paper": 80}
TRUTHS = {"random": "the same kind", "random-ideal": "ideal spectra"}
DIRECT = "instrument"
SHOWN = ("psnr", "ssim", "lpips", "flip", "rmse_db", "peak_median", "peak_p90", "peak_within_1", "wasserstein")
SCORES: tuple[Score, ...] = (
    *OWN_SCORES[:2],
    *(SCORE[name] for name in SHOWN if name in SCORE),
    *OWN_SCORES[2:],
    SCORE["path_gain"],
)


@dataclass(frozen=True, eq=False)
class Row:
    """A line of a table: what was trained on a kind, judged by one truth; `values` by column `[picture]`."""

    kind: SpectrumMethod
    model: str
    truth: str
    values: Values
    views: int

    @cached_property
    def estimates(self) -> dict[str, Estimate]:
        """Scores by key, with their intervals over positions."""
        return {score.key: estimate(self.values[score.column][None], score, views=self.views) for score in SCORES}


@dataclass(frozen=True, eq=False)
class Seen:
    """What is drawn of a kind: the truth's pictures, those of each model, and the window of either."""

    truth: Spectrum
    models: Mapping[str, Spectrum]
    window: DbWindow


def of_kind(wish: argparse.Namespace, kind: SpectrumMethod, ideal: Truth | None) -> tuple[Truth, list[Row], Seen]:
    """The truth of a kind, its rows by either truth, and what to draw; without `ideal` the kind is ideal."""
    study = study_of(wish, NAME, method=kind, holdouts=("random",), keep=4)
    pool = study.data.dataset.train.spectra
    assert pool is not None
    scales = {pool.instrument.name: scale_of(pool, study.data.window())}
    if ideal is not None:
        scales[ideal.spectra.instrument.name] = ideal.window
    extra = Extra(NAME, partial(between_kinds, scales=scales))
    study = Study(replace(study.config, extra=extra))
    home = study.truth("random")
    judges = {} if ideal is None else {"random-ideal": replace(ideal, extra=extra)}
    if ideal is not None and not same_places(home.spectra, ideal.spectra):
        raise InputError(f"{kind} and ideal spectra have other held-out poses; remove {study.config.out} and try again")
    methods = [*methods_of(["nearest"]), *methods_for(kind, wish.scale)]
    names = [method.name for method in methods]
    results = Results(names, study.config.judge, study.config.geometry, [wish.seed])
    study.add(results, methods, wish.count, wish.seed, also=judges)
    rows = []
    for place in results.places:
        for name in names:
            values = results.values[place].get(name, {}).get(wish.seed)
            if values is not None:
                rows.append(Row(kind, name, place.holdout, values, home.views))
    for name, judge in judges.items():
        rows.append(Row(kind, DIRECT, name, judge.scored(home.spectra), home.views))
    if ideal is None:
        rows += [replace(row, truth="random-ideal") for row in rows]
    drawn = drawn_of(study, results, "random" if ideal is None else "random-ideal", ideal or home)
    return home, rows, Seen(home.spectra, drawn, home.window)


def table_of(rows: Sequence[Row], truth: str) -> str:
    """The rows of one truth in Markdown, with half the width of their intervals."""

    def text(row: Row, score: Score) -> str:
        found = row.estimates[score.key]
        if np.isnan(found.value):
            return "-"
        half = 0.5 * (found.high - found.low)
        return score.text(found.value) + ("" if np.isnan(half) else f" ± {half:.{score.digits}f}")

    head = ["trained on", "model", *(f"{score.label}{f' [{score.unit}]' if score.unit else ''}" for score in SCORES)]
    lines = [
        [KINDS[row.kind], row.model, *(text(row, score) for score in SCORES)] for row in rows if row.truth == truth
    ]
    return rows_of(head, lines)


def claims_of(rows: Sequence[Row]) -> str:
    """What the paper says of its Figs. 10 and 11, beside what is found here with the published recipe."""

    def value(kind: SpectrumMethod, truth: str, score: str, *models: str) -> float:
        found = [row for model in models for row in rows if (row.kind, row.model, row.truth) == (kind, model, truth)]
        return found[0].estimates[score].value if found else float("nan")

    def pair(truth: str, score: str) -> list[float]:
        return [value(kind, truth, score, "published-per-view", "published") for kind in ("bartlett", "tapered")]

    def texts(numbers: Sequence[float], digits: int = 1) -> str:
        return ", ".join("-" if np.isnan(number) else f"{number:.{digits}f}" for number in numbers)

    four = [value(kind, "random-ideal", "peak_median", "published-per-view", "published") for kind in KINDS]
    homes = [value(kind, "random", "psnr", "published") for kind in ("capon", "ideal")]
    same = [value(kind, "random", "ssim", "published") for kind in ("capon", "ideal")]
    lines = [
        ["PSNR of CBF, TCBF by ideal spectra [dB]", "about 5", texts(pair("random-ideal", "psnr_paper"))],
        ["PSNR of MVDR, ideal, each by its own kind [dB]", "MVDR higher", texts(homes)],
        ["SSIM of MVDR, ideal, each by its own kind", "MVDR higher", texts(same, 3)],
        ["main peak, median, of ideal, CBF, TCBF, MVDR [deg]", "5.94 for ideal", texts(four, 2)],
    ]
    return rows_of(["published recipe", "paper", "here"], lines)


def drawn_of(study: Study, results: Results, holdout: str, judge: Truth) -> dict[str, Spectrum]:
    """What each model drew of the first position, as judged by `holdout`."""
    keys = [Key(**fact["key"]) for fact in results.facts]
    return {
        key.model: kept_pictures(kept_beside(key.path(study.config.cells)), judge.spectra)
        for key in keys
        if key.holdout == holdout
    }


def draw(seen: Mapping[SpectrumMethod, Seen], ideal: Truth) -> bytes:
    """fig10.png: one view of the first position, each kind a row."""
    view = int(ideal.spectra.path_gain[: ideal.views].argmax())
    columns = ("instrument", "published", "published-per-view", "nearest", "mirror")
    rows = []
    for one in seen.values():

        def shown(name: str, one: Seen = one) -> np.ndarray | None:
            if name == "instrument":
                return coloured(one.window.encode(one.truth.power[view]).numpy())
            if name not in one.models:
                return None
            window = ideal.window if name == "mirror" else one.window
            return coloured(window.encode(one.models[name].power[view]).numpy())

        rows.append([shown(name) for name in columns])
    titles = ("instrument there", "published", "published, linear per view", "nearest", "ours, as ideal lobe")
    return panels(rows, titles, [KINDS[kind] for kind in seen])


def draw_angles(rows: Sequence[Row]) -> bytes:
    """fig11.png: how far the main peak is off, against ideal truth."""
    import matplotlib as mpl
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(9.6, 3.2), dpi=100, layout="constrained")
        FigureCanvasAgg(figure)
        models = (("published",), ("published-per-view", "published"), ("mirror",), (DIRECT,))
        titles = ("published, dB window", "published, as in the paper", "ours", "instrument there")
        for axis, wanted, title in zip(figure.subplots(1, 4, sharey=True), models, titles, strict=True):
            for kind, colour in zip(KINDS, COLOURS, strict=False):
                of = [
                    row for name in wanted for row in rows if (row.kind, row.model) == (kind, name) and "-" in row.truth
                ]
                if of:
                    error = np.sort(np.maximum(of[0].values["peak_deg"], 0.1))
                    axis.step(error, np.arange(1, len(error) + 1) / len(error), color=colour, label=KINDS[kind])
            axis.set_xscale("log")
            axis.set_xlim(0.1, 180.0)
            axis.set_xticks([0.1, 1, 10, 100], ["0.1", "1", "10", "100"])
            axis.set_ylim(0, 1.02)
            axis.set_title(title)
            axis.set_xlabel("main peak off by [deg]")
        figure.axes[0].set_ylabel("share of pictures")
        figure.axes[0].legend(loc="lower right", fontsize=7)
        return small_png(figure)


def as_json(rows: Sequence[Row], made: str, wish: argparse.Namespace) -> dict[str, Any]:
    """Every score with its interval."""
    found = []
    for row in rows:
        numbers = {key: [one.value, one.low, one.high] for key, one in row.estimates.items() if one.value == one.value}
        found.append({"trained on": row.kind, "model": row.model, "judged by": row.truth, "scores": numbers})
    return {"figure": NAME, "made": made, "positions": wish.count, "seed": wish.seed, "rows": found}


def main(words: Sequence[str] | None = None) -> int:
    return told(NAME, partial(figure, words))


def figure(words: Sequence[str] | None) -> int:
    parser = parser_of(__doc__, NAME)
    parser.add_argument("--count", type=int, help="training positions; 4, 40 or 80 by the scale")
    parser.add_argument("--kinds", nargs="+", choices=[*KINDS][1:], default=[*KINDS][1:], help="beside ideal")
    parser.add_argument("--seed", type=int, default=0, help="draws the training positions")
    wish = parser.parse_args(words)
    wish.count = COUNT[wish.scale] if wish.count is None else wish.count
    rows: list[Row] = []
    seen: dict[SpectrumMethod, Seen] = {}
    ideal: Truth | None = None
    asked = {"ideal", *wish.kinds}
    for kind in KINDS:
        if asked.isdisjoint({kind}):
            continue
        home, found, seen[kind] = of_kind(wish, kind, ideal)
        ideal = home if ideal is None else ideal
        rows += found
    assert ideal is not None
    judged = len(ideal.spectra) // ideal.views
    made = made_by(NAME, [wish.seed], words, positions=f"{wish.count} trained on and {judged} judged")
    parts = [f"Judged by {text}:\n\n{table_of(rows, truth)}" for truth, text in TRUTHS.items()]
    text = "\n\n".join([*parts, claims_of(rows), made])
    print(text)
    folder: Path = wish.pictures or wish.out
    folder.mkdir(parents=True, exist_ok=True)
    write_whole(folder / "fig10.png", draw(seen, ideal))
    write_whole(folder / "fig11.png", draw_angles(rows))
    write_json(wish.out / f"{NAME}.json", as_json(rows, made, wish))
    return page_or_sentence(wish.page, NAME, text)


if __name__ == "__main__":
    raise SystemExit(main())
