"""Results as one page of HTML: every score of every method, with intervals over seeds and positions."""

from collections import Counter
from collections.abc import Iterator, Sequence
from html import escape

from benchmarks.quality.protocol.results import Place, Results
from rf3dgs.evaluation.page import facts, figure, image, note, page, section
from rf3dgs.evaluation.panels import data_address
from rf3dgs.evaluation.scores import SCORES, Score
from rf3dgs.evaluation.table import Estimate


def html_of(
    results: Results,
    title: str,
    lead: str,
    made: str,
    pictures: Sequence[tuple[str, bytes]] = (),
    scores: Sequence[Score] = SCORES,
) -> str:
    """The page: `pictures` (caption, PNG) first, then a table for each place, then what the fits cost."""
    drawn = [figure(image(data_address(png), caption), caption, kind="wide") for caption, png in pictures]
    tables = [
        section(title_of(results, place), _table(results, place, scores), note(_note(results, place)))
        for place in results.places
    ]
    machines = Counter(fact["made"]["machine"] for fact in results.facts)
    about = {"Made by": made.removeprefix("Made by "), "Machine": ", ".join(machines)}
    about["Judged by"] = f"{results.judge} positions"
    parts = [section("What this is", facts(about)), *drawn, *tables, section("What it cost", _costs(results))]
    return page(title, lead, parts)


def title_of(results: Results, place: Place) -> str:
    draw = "" if place.draw == "uniform" else f" ({place.draw})"
    return (
        f"{place.scene} {place.preset}, {place.holdout} hold-out, {place.count} training positions{draw}, "
        f"{results.positions(place)} judged"
    )


def _note(results: Results, place: Place) -> str:
    most = max((len(results.seeds(place, name)) for name in results.models), default=0)
    return (
        "Below each number its 95 % interval from resampling positions and seeds together "
        f"({most} seeds at most; with one seed positions alone). The best number is shaded; the second solve of the "
        "truth is the ceiling and takes no part."
    )


def _table(results: Results, place: Place, scores: Sequence[Score]) -> str:
    models = [name for name in results.models if results.seeds(place, name)]
    head = "".join(f"<th>{escape(name)}</th>" for name in models) + '<th class="ceiling">second solve</th>'
    body = []
    for score in scores:
        found = [results.estimate(place, name, score) for name in models]
        best = _best(found, score)
        cells = "".join(_cell(one, score, "best" if index in best else "") for index, one in enumerate(found))
        cells += _cell(results.second(place, score), score, "ceiling")
        unit = f' <span class="unit">[{escape(score.unit)}]</span>' if score.unit else ""
        meaning = escape(score.meaning, quote=True)
        body.append(f'<tr><th title="{meaning}">{escape(score.label)}{unit}</th>{cells}</tr>')
    return _framed(head, "".join(body))


def _framed(head: str, body: str) -> str:
    table = f"<table><thead><tr><th></th>{head}</tr></thead><tbody>{body}</tbody></table>"
    return f'<div class="scroll">{table}</div>'


def _cell(found: Estimate | None, score: Score, kind: str) -> str:
    if found is None or found.value != found.value:
        return f'<td class="{kind}">-</td>'
    between = f"{score.text(found.low)} to {score.text(found.high)}"
    return f'<td class="{kind}">{score.text(found.value)}<span class="range">{between}</span></td>'


def _best(found: Sequence[Estimate | None], score: Score) -> set[int]:
    there = {index: one.value for index, one in enumerate(found) if one is not None and one.value == one.value}
    texts = {index: score.text(value) for index, value in there.items()}
    if len(set(texts.values())) < 2:
        return set()
    top = (max if score.better == "higher" else min)(texts.values(), key=float)
    return {index for index, text in texts.items() if text == top}


def costs(results: Results) -> Iterator[tuple[str, int, float, float, float, float]]:
    """Method, training positions, mean fit [s], mean fit [CPU s], a picture's rendering [CPU ms], peak memory [GB]."""
    groups: dict[tuple[str, int], list[dict]] = {}
    for fact in results.facts:
        groups.setdefault((fact["key"]["model"], fact["key"]["count"]), []).append(fact)
    for (name, count), some in groups.items():
        wall, cpu = (sum(fact["fit"][key] for fact in some) / len(some) for key in ("seconds", "cpu_seconds"))
        drawn = [fact["rendering"] for fact in some]
        spent = sum(one["cpu_seconds"] for one in drawn) / sum(one["pictures"] for one in drawn)
        memory = max((fact["peak_memory_bytes"] or 0) / 1e9 for fact in some)
        yield name, count, wall, cpu, 1e3 * spent, memory


def _costs(results: Results) -> str:
    names = ("positions", "fit [s]", "fit [CPU s]", "rendering [CPU ms a picture]", "peak memory [GB]")
    rows = "".join(
        f"<tr><td>{escape(name)}</td><td>{count}</td>" + "".join(f"<td>{value:.2f}</td>" for value in rest) + "</tr>"
        for name, count, *rest in costs(results)
    )
    return _framed("".join(f"<th>{name}</th>" for name in names), rows)
