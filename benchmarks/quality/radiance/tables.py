"""The results as text of 80 columns, as a page of Markdown, and as JSON."""

import math
import textwrap
from collections import Counter
from collections.abc import Iterator, Sequence
from typing import Any

from benchmarks.quality.protocol.compare import MUST_NOT_LOSE, MUST_WIN, ROWS
from benchmarks.quality.protocol.results import Place, Results
from benchmarks.quality.radiance.checks import checks
from rf3dgs.evaluation.table import Estimate

WIDTH = 80
LABEL = 34
COLUMN = 8
VERDICTS = (*MUST_WIN, *MUST_NOT_LOSE)


def text_of(results: Results) -> str:
    """All tables, then the checks, for a terminal."""
    lines = [line for place in results.places for line in (*_numbers(results, place), "")]
    for subject in results.subjects:
        lines += [
            f"Does {subject} beat lookup? (1) Does it reach the targets? (2)",
            *_check_lines(results, subject),
            "",
        ]
    return "\n".join(lines).rstrip()


def title(results: Results, place: Place) -> str:
    return (
        f"{place.scene} {place.preset}, {place.holdout} hold-out, {place.count} training positions, "
        f"{results.positions(place)} {results.judge} positions, geometry {results.geometry}"
    )


def _numbers(results: Results, place: Place) -> Iterator[str]:
    yield from textwrap.wrap(title(results, place), WIDTH)
    fit = (WIDTH - LABEL) // COLUMN - 1
    for start in range(0, max(len(results.models), 1), fit):
        models = list(results.models[start : start + fit])
        yield f"{'':{LABEL}}" + "".join(f"{name[: COLUMN - 1]:>{COLUMN}}" for name in (*models, "2nd"))
        for score in ROWS:
            cells = [results.estimate(place, model, score) for model in models] + [results.second(place, score)]
            label = f"{score.label} [{score.unit}]"
            yield f"{label:{LABEL}}" + "".join(
                f"{'-' if cell is None else score.text(cell.value):>{COLUMN}}" for cell in cells
            )
        counts = [len(results.seeds(place, model)) for model in models]
        yield f"{'seeds':{LABEL}}" + "".join(f"{count:>{COLUMN}}" for count in counts)
    for subject in results.subjects:
        baselines = results.baselines(subject)
        if not results.seeds(place, subject):
            continue
        yield f"{subject[:14] + ' against':{LABEL}}" + "".join(f"{name[: COLUMN - 1]:>{COLUMN}}" for name in baselines)
        for score in VERDICTS:
            verdicts = [results.verdict(place, subject, name, score) for name in baselines]
            label = f"  {score.label}"
            yield f"{label:{LABEL}}" + "".join(f"{verdict:>{COLUMN}}" for verdict in verdicts)


def _check_lines(results: Results, subject: str) -> Iterator[str]:
    found = checks(results, subject)
    for check in found:
        if check.demand == 2 or not check.passed:
            yield from textwrap.wrap(check.line(), WIDTH, subsequent_indent=" " * 7)
    for demand in (1, 2):
        some = [check.passed for check in found if check.demand == demand]
        yield f"{subject}: {sum(some)} of {len(some)} checks of ({demand}) pass"


def page_of(results: Results, command: str) -> str:
    """A page of Markdown with every interval."""
    commits = Counter(fact["made"]["commit"] for fact in results.facts)
    lines = [
        "# Radiance models against lookup",
        "",
        f"Made by `{command}`, judged by the {results.judge} positions, geometry {results.geometry}. Cells are of "
        f"{', '.join(f'commit {name} ({count})' for name, count in commits.most_common()) or 'nothing'}. "
        "Numbers in brackets are 95 % intervals from a bootstrap over positions and seeds together; a difference is "
        "the model minus the baseline. Nothing is corrected for many comparisons.",
    ]
    for place in results.places:
        lines += ["", f"## {title(results, place)}", "", *_page_numbers(results, place)]
        for subject in results.subjects:
            if results.seeds(place, subject):
                lines += ["", *_page_differences(results, place, subject)]
    for subject in results.subjects:
        lines += [
            "",
            f"## Checks of {subject}",
            "",
            "```",
            *(check.line() for check in checks(results, subject)),
            "```",
        ]
    return "\n".join([*lines, "", "## What it cost", "", *_costs(results), ""])


def _page_numbers(results: Results, place: Place) -> Iterator[str]:
    yield from _row("", *results.models, "second solve", head=True)
    for score in ROWS:
        cells = [results.estimate(place, model, score) for model in results.models] + [results.second(place, score)]
        yield from _row(f"{score.label} [{score.unit}]", *(_shown(cell, score.digits) for cell in cells))


def _page_differences(results: Results, place: Place, subject: str) -> Iterator[str]:
    baselines = results.baselines(subject)
    yield from _row(f"{subject} minus", *baselines, head=True)
    for score in VERDICTS:
        cells = []
        for name in baselines:
            found = results.difference(place, subject, name, score)
            cells.append("-" if found is None else f"{_shown(found.estimate, score.digits)} {found.verdict}")
        yield from _row(f"{score.label} [{score.unit}]", *cells)


def _costs(results: Results) -> Iterator[str]:
    yield from _row("model", "positions", "fits", "fit [s]", "fit, CPU [s]", "peak memory [GB]", "load", head=True)
    groups: dict[tuple[str, int], dict[Any, dict[str, Any]]] = {}
    for fact in results.facts:
        key = fact["key"]
        one = groups.setdefault((key["model"], key["count"]), {})
        one[key["scene"], key["preset"], key["seed"]] = fact
    for (model, count), by_fit in groups.items():
        facts = list(by_fit.values())
        wall, cpu = (_mean([fact["fit"][name] for fact in facts]) for name in ("seconds", "cpu_seconds"))
        memory = [fact["peak_memory_bytes"] / 1e9 for fact in facts if fact["peak_memory_bytes"]]
        peak, load = max(memory, default=math.nan), _mean([fact["load"] for fact in facts])
        yield from _row(model, str(count), str(len(facts)), f"{wall:.1f}", f"{cpu:.1f}", f"{peak:.2f}", f"{load:.1f}")


def numbers_of(results: Results) -> dict[str, Any]:
    """Estimates, differences and checks as JSON can hold them."""
    rows = []
    for place in results.places:
        table = {m: {s.key: _plain(results.estimate(place, m, s)) for s in ROWS} for m in results.models}
        table["second solve"] = {s.key: _plain(results.second(place, s)) for s in ROWS}
        against: dict[str, Any] = {}
        for subject in results.subjects:
            for name in results.baselines(subject):
                found = {s.key: results.difference(place, subject, name, s) for s in VERDICTS}
                against.setdefault(subject, {})[name] = {
                    key: None if one is None else _plain(one.estimate) | {"verdict": one.verdict, "seeds": one.seeds}
                    for key, one in found.items()
                }
        rows.append({**vars(place), "positions": results.positions(place), "table": table, "against": against})
    lines = {subject: [check.line() for check in checks(results, subject)] for subject in results.subjects}
    return {"judge": results.judge, "geometry": results.geometry, "places": rows, "checks": lines}


def _plain(found: Estimate | None) -> dict[str, Any]:
    if found is None:
        return {}
    return {name: None if math.isnan(value) else value for name, value in vars(found).items()}


def _shown(found: Estimate | None, digits: int) -> str:
    if found is None or math.isnan(found.value):
        return "-"
    low, high = ("-" if math.isnan(v) else f"{v:.{digits}f}" for v in (found.low, found.high))
    return f"{found.value:.{digits}f} [{low}, {high}]"


def _mean(values: Sequence[float]) -> float:
    return sum(values) / len(values) if values else math.nan


def _row(*cells: str, head: bool = False) -> Iterator[str]:
    yield f"| {' | '.join(cells)} |"
    if head:
        yield "|" + "---|" * len(cells)
