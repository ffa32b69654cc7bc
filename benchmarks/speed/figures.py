"""Figures of the cost against Gaussians, pixels, channels and threads."""

import io
from pathlib import Path

from rf3dgs.core.files import write_whole
from rf3dgs.evaluation.figures import STYLE

AXES = {
    "gaussians": ("thousand Gaussians", 1e-3, "cpu_ms"),
    "pixels": ("thousand pixels", 1e-3, "cpu_ms"),
    "channels": ("channels", 1, "cpu_ms"),
    "threads": ("threads", 1, "wall_ms"),
}
COLOURS = {"render": "#0b6e99", "frozen step": "#d9822b"}


def draw_scaling(result: dict, folder: Path) -> None:
    """Write scaling.png and scaling.svg: one panel for each of `AXES`, the floor dashed."""
    import matplotlib as mpl
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(9.6, 6.4), dpi=150, layout="constrained")
        FigureCanvasAgg(figure)
        for axis, (name, (label, unit, cost)) in zip(figure.subplots(2, 2).ravel(), AXES.items(), strict=True):
            for kind, found in result[name].items():
                at = [unit * point["at"] for point in found["points"]]
                axis.plot(at, [point[cost] for point in found["points"]], "o-", color=COLOURS[kind], label=kind)
                if cost == "cpu_ms":
                    floor = [point["floor_ms"] for point in found["points"]]
                    axis.plot(at, floor, "--", color=COLOURS[kind], label=f"{kind}, floor")
            axis.set_ylim(bottom=0)
            axis.set_xticks(at[-3:] if unit < 1 else at)
            axis.set_xlabel(label)
            axis.set_ylabel("CPU time of all threads [ms]" if cost == "cpu_ms" else "time of the clock [ms]")
        axis = figure.axes[0]
        figure.legend(*axis.get_legend_handles_labels(), loc="outside upper center", ncols=4)
        for kind in ("png", "svg"):
            buffer = io.BytesIO()
            figure.savefig(buffer, format=kind)
            write_whole(folder / f"scaling.{kind}", buffer.getvalue())
