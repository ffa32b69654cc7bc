"""Figures of the report that need real plotting: error distributions and the map of positions, as PNG bytes."""

import io
from collections.abc import Sequence
from typing import Any

import numpy as np

from rf3dgs.evaluation.pictures import LEVEL_COLOURS
from rf3dgs.evaluation.table import CEILING, FIELD, Evaluation

METHOD_COLOURS = {FIELD: "#0b6e99", "nearest": "#d9822b", "inverse distance": "#8a5fb5", CEILING: "#70757d"}
METHOD_LINES = {FIELD: "-", "nearest": "--", "inverse distance": "-.", CEILING: ":"}
_CURVES = (
    ("peak_deg", "Main-peak error [deg]", "log"),
    ("beam_loss_eigen_db", "Beam loss, eigenbeam [dB]", "linear"),
    ("rmse_db", "RMSE in the window [dB]", "linear"),
    ("path_gain_db", "Path gain error [dB]", "linear"),
    ("delay_ns", "Delay error [ns]", "linear"),
    ("departure_deg", "Departure error [deg]", "linear"),
)
STYLE: dict[Any, Any] = {
    **{"font.size": 9, "axes.spines.top": False, "axes.spines.right": False, "axes.grid": True},
    **{"grid.color": "#e4e7eb", "axes.edgecolor": "#8a9099", "axes.axisbelow": True, "legend.frameon": False},
}


def distributions(evaluation: Evaluation) -> bytes:
    """Cumulative distributions of six errors over the positions, one curve per method."""
    import matplotlib as mpl
    from matplotlib.figure import Figure

    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(9.6, 5.4), dpi=150, layout="constrained")
        axes = figure.subplots(2, 3).ravel()
        for axis, (column, label, scale) in zip(axes, _CURVES, strict=True):
            for method in evaluation.methods:
                values = np.sort(evaluation.column(method, column))
                values = values[~np.isnan(values)]
                if not len(values):
                    continue
                share = np.arange(len(values) + 1) / len(values)
                values = np.maximum(values, 0.01) if scale == "log" else values
                start = values[0] if scale == "log" else 0.0
                colour, line = METHOD_COLOURS.get(method, "#444444"), METHOD_LINES.get(method, "-")
                shown = np.concatenate(([start], values))
                axis.step(shown, share, where="post", color=colour, linestyle=line, linewidth=1.8, label=method)
            axis.set_xscale(scale)
            axis.set_ylim(0, 1.02)
            if scale == "linear":
                axis.set_xlim(left=0)
            axis.set_xlabel(label)
        for axis in axes[::3]:
            axis.set_ylabel("share of positions")
        handles, labels = axes[2].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside upper center", ncols=4)
        return _png(figure)


def position_map(
    positions: np.ndarray,
    roles: Sequence[str],
    evaluations: dict[str, Evaluation],
    *,
    tx: np.ndarray | None = None,
    footprint: Sequence[np.ndarray] = (),
) -> bytes:
    """The site from above [m]: where was measured, for what, and the field's RMSE [dB] at the held-out positions.

    positions `[n, 3]` with one role each; footprint: outlines `[k, 2]`, two points for a wall seen from above.
    """
    import matplotlib as mpl
    from matplotlib.cm import ScalarMappable
    from matplotlib.collections import LineCollection, PolyCollection
    from matplotlib.colors import LinearSegmentedColormap, Normalize
    from matplotlib.figure import Figure

    with mpl.rc_context({**STYLE, "axes.grid": False}):
        span = np.ptp(positions[:, :2], axis=0).max(initial=1.0) if len(positions) else 1.0
        figure = Figure(figsize=(7.6, 6.6), dpi=150, layout="constrained")
        axis = figure.add_subplot()
        areas = [outline for outline in footprint if len(outline) > 2]
        walls = [outline for outline in footprint if len(outline) == 2]
        axis.add_collection(PolyCollection(areas, facecolor="#e3e6ea", edgecolor="#e3e6ea", linewidth=0.4))
        axis.add_collection(LineCollection(walls, colors="#7c838c", linewidths=1.1))
        names = np.array(roles)
        for role, marker, colour, size in (
            ("train", "o", "#9aa1aa", 16),
            ("validation", "v", "#9aa1aa", 20),
            ("buffer", "x", "#c3c8ce", 14),
        ):
            chosen = positions[names == role]
            if len(chosen):
                axis.scatter(chosen[:, 0], chosen[:, 1], s=size, marker=marker, color=colour, label=role, zorder=3)
        errors = [evaluation.column(FIELD, "rmse_db") for evaluation in evaluations.values()]
        if errors:
            every = np.concatenate(errors)
            scale = Normalize(np.nanmin(every) - 0.05, np.nanmax(every) + 0.05)
            colours = LinearSegmentedColormap.from_list("level", LEVEL_COLOURS / 255.0)
            markers = dict(zip(evaluations, ("o", "s", "D", "^", "P"), strict=False))
            for (name, evaluation), error in zip(evaluations.items(), errors, strict=True):
                x, y = evaluation.positions[:, 0], evaluation.positions[:, 1]
                style = {"cmap": colours, "norm": scale, "edgecolors": "#20242a", "linewidths": 0.7, "zorder": 4}
                axis.scatter(x, y, c=error, s=62, marker=markers.get(name, "o"), label=f"held out: {name}", **style)
            bar = figure.colorbar(ScalarMappable(scale, colours), ax=axis, shrink=0.75)
            bar.set_label("RMSE of the field [dB]")
        if tx is not None:
            point = {"s": 190, "marker": "*", "color": "#c62828", "edgecolors": "white", "zorder": 5}
            axis.scatter([tx[0]], [tx[1]], label="transmitter", **point)
        axis.set_aspect("equal")
        axis.autoscale_view()
        axis.margins(0.04 if span > 0 else 0.1)
        axis.set_xlabel("x [m]")
        axis.set_ylabel("y [m]")
        axis.legend(loc="upper center", bbox_to_anchor=(0.5, -0.09), ncols=3)
        return _png(figure)


def footprint_of(
    vertices: np.ndarray, faces: np.ndarray, *, low: float = 0.1, high: float = 2.4
) -> tuple[np.ndarray, ...]:
    """Outlines for the map from a mesh (vertices `[v, 3]` [m], faces `[f, 3]`): what stands between two heights [m].

    Floor and ceiling drop out; an upright face becomes the line it stands on, any other face a triangle.
    """
    outlines = []
    for corners in np.asarray(vertices, dtype=float)[np.asarray(faces)]:
        if corners[:, 2].max() < low or corners[:, 2].min() > high:
            continue
        plan = corners[:, :2]
        edges = plan[[1, 2, 0]] - plan
        area = 0.5 * abs(edges[0, 0] * edges[1, 1] - edges[0, 1] * edges[1, 0])
        length = np.linalg.norm(edges, axis=1)
        if area < 1e-3 * max(length.max(), 1e-9) ** 2:
            longest = int(length.argmax())
            outlines.append(plan[[longest, (longest + 1) % 3]])
        else:
            outlines.append(plan)
    return tuple(outlines)


def _png(figure) -> bytes:
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    FigureCanvasAgg(figure)
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png")
    return buffer.getvalue()
