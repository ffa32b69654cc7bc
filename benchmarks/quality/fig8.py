"""The paper's Fig. 8: quality against the number of training positions, and what training and rendering cost.

    python -m benchmarks.quality.fig8 --scale laptop --paths paper.paths --read-test

Every method is trained on the same positions and judged at the same held-out ones: 5 to 160 positions with a random and
a region hold-out, drawn evenly and clustered; with --read-test also the paper's fractions of 640. A run that was
stopped goes on. docs/how-to/figures-8.md has what came out.
"""

import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from benchmarks.quality.methods import known, methods_of
from benchmarks.quality.methods.method import Scale
from benchmarks.quality.protocol.curves import curves_of
from benchmarks.quality.protocol.figure import (
    command_of,
    cpu_hours,
    made_by,
    page_or_sentence,
    parser_of,
    rows_of,
    study_of,
    write_json,
)
from benchmarks.quality.protocol.html import costs, html_of, title_of
from benchmarks.quality.protocol.results import Results
from benchmarks.quality.protocol.study import Study, say
from rf3dgs.core.errors import RfError
from rf3dgs.core.files import write_whole
from rf3dgs.evaluation.scores import SCORE

ALL, SOME, ONE = "every count", "some counts", "one count"
METHODS: Mapping[str, str] = {
    **dict.fromkeys(("nearest", "idw4", "linear", "constant", "mirror"), ALL),
    **dict.fromkeys(("paper", "rf3dgs-jet", "rf3dgs-db", "nerf2", "nerf2-db", "cgan"), SOME),
    **dict.fromkeys(("los", "tr38901-inh", "twin-2cm", "twin-5cm", "twin-10cm", "twin-materials"), ONE),
}
"""How often each method is trained; those that learn little or nothing, once."""


@dataclass(frozen=True)
class Counts:
    """Training positions at a scale."""

    all: tuple[int, ...]
    some: tuple[int, ...]
    one: int
    fractions: tuple[int, ...]
    """Of the paper's protocol; methods trained at some counts take the first and the last."""
    clustered: tuple[int, ...]
    seeds: tuple[int, ...]


LADDER = (5, 10, 20, 40, 80, 160)
FRACTIONS = (128, 256, 384, 512, 640)
COUNTS: Mapping[Scale, Counts] = {
    "smoke": Counts((4, 8), (8,), 8, (8, 32), (8,), (0,)),
    "laptop": Counts(LADDER, (10, 40, 160), 40, FRACTIONS, (40,), (0,)),
    "paper": Counts(
        (5, 10, 20, 40, 80, 160), (5, 10, 20, 40, 80, 160), 40, (128, 256, 384, 512, 640), (40,), (0, 1, 2)
    ),
}
SHOWN = ("psnr", "ssim", "rmse_db", "peak_within_1", "beam_loss_eigen", "path_gain")
IN_PAGE = (
    *("psnr", "ssim", "flip", "rmse_db", "peak_median", "peak_within_1", "beam_loss_eigen", "path_gain"),
    *("wasserstein", "delay", "departure"),
)


def gather(study: Study, results: Results, names: Sequence[str], counts: Counts, *, fractions: bool) -> None:
    """Make or read the cells of one protocol, few positions first."""
    ladder = counts.fractions if fractions else counts.all
    often = [name for name in names if METHODS.get(name, ALL) == ALL]
    for seed in counts.seeds:
        for count in ladder:
            some = count in ((ladder[0], ladder[-1]) if fractions else counts.some)
            wanted = often + [name for name in names if METHODS.get(name) == SOME and some]
            wanted += [name for name in names if METHODS.get(name) == ONE and count == counts.one]
            study.add(results, methods_of(wanted), count, seed)
        for count in () if fractions else counts.clustered:
            study.add(results, methods_of(often), count, seed, "clustered")


def tables(results: Results, scores: Sequence[str]) -> str:
    """For the page: at each place every method's scores, and the second solve's."""
    shown = [SCORE[key] for key in scores if key in SCORE]
    head = ["", *(f"{score.label} [{score.unit}]" if score.unit else score.label for score in shown)]
    parts = []
    for place in results.places:
        names = [name for name in results.models if results.seeds(place, name)]
        found = {name: [results.estimate(place, name, score) for score in shown] for name in names}
        found["second solve"] = [results.second(place, score) for score in shown]
        rows = [
            [name, *("-" if one is None else score.text(one.value) for one, score in zip(row, shown, strict=True))]
            for name, row in found.items()
            if any(one is not None for one in row)
        ]
        parts.append(f"**{title_of(results, place)}**\n\n{rows_of(head, rows)}")
    return "\n\n".join(parts)


def cost_table(results: Results) -> str:
    rows = [
        [name, str(count), f"{wall:.1f}", f"{cpu:.1f}", f"{drawn:.1f}", f"{memory:.2f}"]
        for name, count, wall, cpu, drawn, memory in costs(results)
        if count in (40, 160, 640) or METHODS.get(name) == ONE
    ]
    return rows_of(["", "positions", "fit [s]", "fit [CPU s]", "a picture [CPU ms]", "peak memory [GB]"], rows)


def main(words: Sequence[str] | None = None) -> int:
    parser = parser_of(__doc__, "fig8")
    parser.add_argument("--methods", nargs="+", help="names, Python files; all of METHODS that there are when missing")
    parser.add_argument("--again", type=int, help="held-out positions solved a second time; 8 at laptop")
    wish = parser.parse_args(words)
    counts = COUNTS[wish.scale]
    names = wish.methods or [name for name in METHODS if name in known()]
    again = wish.again if wish.again is not None else {"smoke": 0, "laptop": 8, "paper": 40}[wish.scale]
    runs: dict[str, Results] = {}
    try:
        listed = [method.name for method in methods_of(names)]
        judge = "test" if wish.read_test else "validation"
        for split in ("own", "paper") if wish.read_test else ("own",):
            study = study_of(wish, "fig8", split=split)
            results = runs[split] = Results(listed, judge, Path(study.config.geometry).stem, list(counts.seeds))
            if again:
                study.add_second(results, again)
            gather(study, results, names, counts, fractions=split == "paper")
    except RfError as error:
        say(f"fig8: {error}")
        return 2
    spent = cpu_hours(fact for results in runs.values() for fact in results.facts)
    made = made_by("fig8", counts.seeds, words, **{"CPU hours of fits and rendering": spent})
    folder = wish.pictures or wish.out
    numbers = {"command": command_of("fig8", words), "scale": wish.scale}
    pages = []
    for split, results in runs.items():
        keys = [key for key in SHOWN if key in SCORE]
        png = curves_of(results, [SCORE[key] for key in keys])
        name = f"fig8-{wish.scale}" + ("-fractions" if split == "paper" else "")
        write_whole(folder / f"{name}.png", png)
        lead = "Quality against the number of training positions, and what it costs."
        write_whole(wish.out / f"{name}.html", html_of(results, "Figure 8", lead, made, [("Scores", png)]).encode())
        numbers[split] = {"facts": results.facts}
        pages.append(f"{tables(results, IN_PAGE)}\n\n**Cost**\n\n{cost_table(results)}")
    write_json(wish.out / f"fig8-{wish.scale}.json", numbers)
    text = "\n\n".join([*pages, made])
    print(text)
    return page_or_sentence(wish.page, "fig8", text)


if __name__ == "__main__":
    sys.exit(main())
