"""Curves of scores over the number of training positions, as PNG bytes."""

import io
from collections.abc import Sequence

import numpy as np

from benchmarks.quality.protocol.results import Place, Results
from rf3dgs.evaluation.figures import STYLE
from rf3dgs.evaluation.scores import Score

MARKS = "os^vDPX*<>hp"


def curves_of(results: Results, scores: Sequence[Score]) -> bytes:
    """A row for each hold-out and draw, a column for each score; bars are 95 % intervals, dotted the second solve.

    A method that was trained once is a mark of its own, and where it lies far off it is left outside.
    """
    import matplotlib as mpl
    from matplotlib.figure import Figure

    lines = list(dict.fromkeys((place.holdout, place.draw) for place in results.places if place.draw == "uniform"))
    names = [name for name in results.models if any(results.seeds(place, name) for place in results.places)]
    colours = mpl.colormaps["tab20"](np.linspace(0, 1, 20))
    with mpl.rc_context({**STYLE, "font.size": 8}):
        figure = Figure(figsize=(3.0 * len(scores), 0.8 + 2.5 * len(lines)), dpi=110, layout="constrained")
        axes = figure.subplots(len(lines), len(scores), squeeze=False)
        for row, (holdout, draw) in zip(axes, lines, strict=True):
            places = [place for place in results.places if (place.holdout, place.draw) == (holdout, draw)]
            for axis, score in zip(row, scores, strict=True):
                for number, name in enumerate(names):
                    _curve(axis, results, places, name, score, colours[number % 20], MARKS[number % len(MARKS)])
                second = results.second(places[0], score)
                if second is not None and np.isfinite(second.value):
                    axis.axhline(second.value, color="#70757d", linestyle=":", label="second solve")
                low, high = _limits(results, places, names, score)
                axis.set_ylim(low, high)
                axis.set_xscale("log")
                counts = sorted({place.count for place in places})
                axis.set_xticks(counts, [str(count) for count in counts])
                axis.minorticks_off()
                axis.set_title(f"{score.label} [{score.unit}]" if score.unit else score.label)
            row[0].set_ylabel(f"{holdout} hold-out")
        for axis in axes[-1]:
            axis.set_xlabel("training positions")
        handles, labels = axes[0, 0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside lower center", ncols=min(len(labels), 9))
        buffer = io.BytesIO()
        figure.savefig(buffer, format="png")
    return buffer.getvalue()


def _limits(results: Results, places: Sequence[Place], names: Sequence[str], score: Score) -> tuple[float, float]:
    """Ends of the axis: all that was trained more than once, with a margin; everything where nothing was."""
    values: dict[str, list[float]] = {}
    for name in names:
        found = [results.estimate(place, name, score) for place in places]
        values[name] = [one.value for one in found if one is not None and np.isfinite(one.value)]
    curves = [value for of in values.values() if len(of) > 1 for value in of]
    second = results.second(places[0], score)
    curves = curves or [value for of in values.values() for value in of] or [0.0]
    curves += [second.value] if second is not None and np.isfinite(second.value) else []
    margin = 0.25 * max(max(curves) - min(curves), 1e-6)
    return min(curves) - margin, max(curves) + margin


def _curve(
    axis, results: Results, places: Sequence[Place], name: str, score: Score, colour: np.ndarray, mark: str
) -> None:
    found = [(place.count, results.estimate(place, name, score)) for place in places]
    points = [(count, one) for count, one in found if one is not None and np.isfinite(one.value)]
    if not points:
        axis.plot([], [], color=colour, marker=mark, label=name)
        return
    counts = [count for count, _ in points]
    values = np.array([one.value for _, one in points])
    errors = np.array([[one.value - one.low, one.high - one.value] for _, one in points]).T.clip(min=0)
    width = 2.2 if name == "mirror" else 1.2
    axis.errorbar(counts, values, np.nan_to_num(errors), color=colour, marker=mark, markersize=4, lw=width, label=name)
