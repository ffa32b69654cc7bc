"""The report's tables: every number with its interval, and honest sentences about them."""

import math
from collections.abc import Mapping
from html import escape

from rf3dgs.evaluation import page
from rf3dgs.evaluation.scores import SCORES, Score
from rf3dgs.evaluation.table import CEILING, Evaluation


def results(evaluations: Mapping[str, Evaluation]) -> list[str]:
    """Per hold-out what can be said, the table, and where the field loses or is not surely ahead."""
    parts = []
    for name, evaluation in evaluations.items():
        parts.append(f"<h3>Hold-out: {escape(name)}</h3><p>{escape(evaluation.summary())}</p>")
        parts.append(_table(evaluation))
        if evaluation.losses:
            items = "".join(f'<li class="lost">{escape(item.sentence())}</li>' for item in evaluation.losses)
            parts.append(f"<p>Where the field loses:</p><ul>{items}</ul>")
        unsure = [item for item in evaluation.wins if not item.clear]
        if unsure:
            items = "".join(f"<li>{escape(item.sentence())}</li>" for item in unsure)
            parts.append(f"<p>Ahead, but not for certain:</p><ul>{items}</ul>")
    if parts:
        window = next(iter(evaluations.values())).window
        parts.append(
            page.note(
                "Shaded: the best of the methods that predict. Small print: 95 % bootstrap interval over positions. "
                f'The window runs from {window[0]:.1f} to {window[1]:.1f} dB. "{CEILING}" is the truth traced again '
                "with another seed and number of rays: its own noise, and the best that any prediction can show."
            )
        )
        terms = "".join(f"<dt>{score.label}</dt><dd>{escape(score.meaning)}</dd>" for score in SCORES)
        parts.append(f"<details><summary>What each score means</summary><dl>{terms}</dl></details>")
    return parts


def _table(evaluation: Evaluation) -> str:
    heads = "".join(f"<th{_kind(method)}>{escape(method)}</th>" for method in evaluation.methods)
    rows = []
    for score in SCORES:
        unit = f' <span class="unit">[{score.unit}]</span>' if score.unit else ""
        arrow = "\N{DOWNWARDS ARROW}" if score.better == "lower" else "\N{UPWARDS ARROW}"
        arrow += f'<span class="word"> {score.better}</span>'
        best = evaluation.best(score.key)
        cells = "".join(_cell(evaluation, method, score, method in best) for method in evaluation.methods)
        rows.append(f'<tr><th>{score.label}{unit}</th><td class="unit">{arrow}</td>{cells}</tr>')
    return (
        f'<div class="scroll"><table><thead><tr><th>score</th><th>better</th>{heads}</tr></thead>'
        f"<tbody>{''.join(rows)}</tbody></table></div>"
    )


def _cell(evaluation: Evaluation, method: str, score: Score, is_best: bool) -> str:
    estimate = evaluation.estimate(method, score.key)
    if math.isnan(estimate.value):
        return f"<td{_kind(method)}>not available</td>"
    inside = score.text(estimate.value)
    if not math.isnan(estimate.low):
        inside += f'<span class="range">{score.text(estimate.low)} to {score.text(estimate.high)}</span>'
    return f'<td class="best">{inside}</td>' if is_best else f"<td{_kind(method)}>{inside}</td>"


def _kind(method: str) -> str:
    return ' class="ceiling"' if method == CEILING else ""
