"""Panels of the report: a picture of directions with its axes, and colour bars, as inline SVG.

Text stays text, so that panels are sharp on any screen and in print; the picture inside is a PNG in a data address.
"""

import base64
import math
from html import escape

import numpy as np

from rf3dgs.core.grids import DirectionGrid
from rf3dgs.evaluation.pictures import encoded

Ticks = list[tuple[float, str]]
_LEFT, _RIGHT, _TOP, _BOTTOM, _PLOT = 46, 22, 6, 38, 400


def data_address(content: bytes, kind: str = "png") -> str:
    """A picture's bytes as a `data:` address."""
    return f"data:image/{kind};base64,{base64.b64encode(content).decode()}"


def axis_ticks(grid: DirectionGrid) -> tuple[Ticks, Ticks]:
    """Ticks (pixel coordinate, degrees as text) across and down: azimuth, positive to the left, and zenith.

    On a pinhole grid azimuth is marked along the middle row and zenith along the middle column.
    """
    if grid.kind == "equirect":
        across = [((180 - azimuth) / 360 * grid.width, f"{azimuth}") for azimuth in (180, 90, 0, -90, -180)]
        return across, [(zenith / 180 * grid.height, f"{zenith}") for zenith in (0, 45, 90, 135, 180)]
    if grid.K is None:
        return [], []
    (fx, _, cx), (_, fy, cy) = grid.K[0].tolist(), grid.K[1].tolist()
    steps = range(-75, 76, 15)
    across = [(cx - fx * math.tan(math.radians(azimuth)), f"{azimuth}") for azimuth in steps]
    down = [(cy - fy * math.tan(math.radians(up)), f"{90 - up}") for up in steps]
    return [tick for tick in across if 0 <= tick[0] <= grid.width], [
        tick for tick in down if 0 <= tick[0] <= grid.height
    ]


def panel(picture: np.ndarray, grid: DirectionGrid, label: str, *, mark: tuple[float, float] | None = None) -> str:
    """One figure with axes: a uint8 `[row, col, 3]` picture on its grid; `mark` circles a pixel (x, y)."""
    scale = _PLOT / grid.width
    height = grid.height * scale
    across, down = axis_ticks(grid)
    parts = [
        f'<svg viewBox="0 0 {_LEFT + _PLOT + _RIGHT} {_TOP + height + _BOTTOM:.0f}" role="img" '
        f'aria-label="{escape(label)}">',
        f'<image x="{_LEFT}" y="{_TOP}" width="{_PLOT}" height="{height:.1f}" preserveAspectRatio="none" '
        f'href="{data_address(encoded(picture))}"/>',
        f'<rect x="{_LEFT}" y="{_TOP}" width="{_PLOT}" height="{height:.1f}" class="frame"/>',
    ]
    for place, text in across:
        x = _LEFT + place * scale
        parts.append(f'<path class="tick" d="M{x:.1f} {_TOP + height:.1f}v4"/>')
        parts.append(f'<text x="{x:.1f}" y="{_TOP + height + 16:.1f}" text-anchor="middle">{_sign(text)}</text>')
    for place, text in down:
        y = _TOP + place * scale
        parts.append(f'<path class="tick" d="M{_LEFT} {y:.1f}h-4"/>')
        parts.append(f'<text x="{_LEFT - 7}" y="{y + 4:.1f}" text-anchor="end">{text}</text>')
    middle = _TOP + height / 2
    parts.append(
        f'<text x="{_LEFT + _PLOT / 2}" y="{_TOP + height + 32:.1f}" text-anchor="middle">azimuth [deg]</text>'
    )
    parts.append(f'<text transform="translate(11 {middle:.1f}) rotate(-90)" text-anchor="middle">zenith [deg]</text>')
    if mark is not None:
        x, y = _LEFT + mark[0] * scale, _TOP + mark[1] * scale
        parts.append(f'<circle cx="{x:.1f}" cy="{y:.1f}" r="7" class="mark-under"/>')
        parts.append(f'<circle cx="{x:.1f}" cy="{y:.1f}" r="7" class="mark"/>')
    return "".join(parts) + "</svg>"


def colour_bar(colours: np.ndarray, ticks: Ticks, label: str) -> str:
    """A horizontal colour bar: uint8 colours `[n, 3]`, ticks at fractions of its length, and what it shows."""
    width, left = 420, 20
    parts = [
        f'<svg class="bar" viewBox="0 0 {width + 2 * left} 50" role="img" aria-label="{escape(label)}">',
        f'<image x="{left}" y="2" width="{width}" height="12" preserveAspectRatio="none" '
        f'href="{data_address(encoded(colours[None]))}"/>',
        f'<rect x="{left}" y="2" width="{width}" height="12" class="frame"/>',
    ]
    for place, text in ticks:
        x = left + place * width
        parts.append(f'<path class="tick" d="M{x:.1f} 14v4"/>')
        parts.append(f'<text x="{x:.1f}" y="30" text-anchor="middle">{_sign(text)}</text>')
    parts.append(f'<text x="{left + width / 2}" y="46" text-anchor="middle">{escape(label)}</text></svg>')
    return "".join(parts)


def even_ticks(low: float, high: float, *, count: int = 5) -> Ticks:
    """Round numbers inside [low, high] and their fractions of it, about `count` of them."""
    raw = (high - low) / max(count, 1)
    power = 10.0 ** math.floor(math.log10(raw))
    step = next(factor * power for factor in (1, 2, 2.5, 5, 10) if factor * power >= raw * 0.999)
    first = math.ceil(low / step - 1e-9)
    marks = [index * step for index in range(first, math.floor(high / step + 1e-9) + 1)]
    return [((mark - low) / (high - low), f"{mark:g}") for mark in marks]


def _sign(text: str) -> str:
    return escape(text).replace("-", "\N{MINUS SIGN}")
