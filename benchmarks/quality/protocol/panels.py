"""Pictures side by side with names, as one small PNG file."""

import io
from collections.abc import Sequence
from typing import Any

import numpy as np

from rf3dgs.evaluation.figures import STYLE

COLOURS = ("#0b6e99", "#d9822b", "#8a5fb5", "#3f8f4f", "#70757d", "#b0413e")


def panels(rows: Sequence[Sequence[np.ndarray | None]], columns: Sequence[str], names: Sequence[str]) -> bytes:
    """A PNG of uint8 `[row, col, 3]` pictures, a name over each column and beside each row; None stays empty."""
    import matplotlib as mpl
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    with mpl.rc_context({**STYLE, "font.size": 8, "axes.titlesize": 8}):
        figure = Figure(figsize=(2.0 * len(columns) + 0.3, 1.4 * len(rows) + 0.2), dpi=100, layout="constrained")
        FigureCanvasAgg(figure)
        axes = figure.subplots(len(rows), len(columns), squeeze=False)
        for number, row in enumerate(rows):
            for axis, picture in zip(axes[number], row, strict=True):
                axis.set_xticks([])
                axis.set_yticks([])
                axis.grid(False)
                if picture is None:
                    axis.axis("off")
                else:
                    axis.imshow(picture, interpolation="nearest")
            axes[number, 0].set_ylabel(names[number])
        for axis, column in zip(axes[0], columns, strict=True):
            axis.set_title(column)
        return small_png(figure)


def small_png(figure: Any) -> bytes:
    """A drawn figure as PNG bytes in 128 colours."""
    from PIL import Image

    buffer, small = io.BytesIO(), io.BytesIO()
    figure.savefig(buffer, format="png")
    picture = Image.open(io.BytesIO(buffer.getvalue())).convert("RGB")
    picture.quantize(128, dither=Image.Dither.NONE).save(small, "PNG", optimize=True)
    return small.getvalue()
