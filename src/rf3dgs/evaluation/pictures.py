"""Pictures of spectra: colours in NumPy, PNG and JPEG bytes, files written whole or not at all."""

import io
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch

from rf3dgs.core.angles import angles_of
from rf3dgs.core.errors import InputError
from rf3dgs.core.files import write_whole
from rf3dgs.spectra.codec import DbWindow, window_of
from rf3dgs.spectra.spectrum import Spectrum

# Anchors at equal steps, dark blue over green to yellow: even steps look even, also in grey print.
LEVEL_COLOURS = np.array(
    [
        *((68, 1, 84), (72, 36, 117), (65, 68, 135), (53, 95, 141), (42, 120, 142), (33, 145, 140)),
        *((34, 168, 132), (68, 191, 112), (122, 209, 81), (189, 223, 38), (253, 231, 37)),
    ],
    dtype=float,
)
DIFFERENCE_COLOURS = np.array([(33, 102, 172), (146, 197, 222), (247, 247, 247), (244, 165, 130), (178, 24, 43)], float)
NOTHING = np.array([222, 224, 228], dtype=np.uint8)  # where no path arrives


def coloured(value: np.ndarray, anchors: np.ndarray = LEVEL_COLOURS) -> np.ndarray:
    """uint8 `[*shape, 3]` colours of values in [0, 1] `[*shape]`, interpolated between the anchors; clipped."""
    steps = np.linspace(0.0, 1.0, len(anchors))
    channels = [np.interp(np.clip(value, 0.0, 1.0), steps, anchors[:, channel]) for channel in range(3)]
    return np.stack(channels, -1).round().astype(np.uint8)


def hues(turn: np.ndarray) -> np.ndarray:
    """uint8 `[*shape, 3]` colours of a cyclic value `[*shape]` that comes round at every integer."""
    phase = 2.0 * np.pi * (turn[..., None] - np.array([0.0, 1.0, 2.0]) / 3.0)
    return (255.0 * (0.5 + 0.42 * np.cos(phase))).round().astype(np.uint8)


def colour_range(spectra: Sequence[Spectrum]) -> DbWindow:
    """Where colours show most: from the 3rd to the 99.7th percentile of the levels of all `spectra`, in whole dB.

    Stronger directions are as bright as the end. A field's own window, made so that nothing is clipped, is wider.
    """
    levels = torch.cat([spectrum.gain_db[spectrum.power > 0] for spectrum in spectra]).numpy()
    if levels.size == 0:
        raise InputError("these spectra have no power at all; there is nothing to draw")
    low, high = np.percentile(levels, (3.0, 99.7))
    return DbWindow(float(np.floor(low)), float(max(np.ceil(high), np.floor(low) + 10.0)))


def spectrum_picture(spectrum: Spectrum, window: DbWindow | None = None) -> np.ndarray:
    """The level in the dB window as a uint8 `[row, col, 3]` picture, row 0 up and column 0 left.

    The window's floor is dark blue and its ceiling yellow; by default the window is the spectrum's own.
    """
    _one(spectrum)
    window = window_of(spectrum) if window is None else window
    return coloured(window.encode(spectrum.power).numpy())


def difference_picture(truth: Spectrum, prediction: Spectrum, window: DbWindow, *, span_db: float = 20.0) -> np.ndarray:
    """Predicted minus true level, both clipped to the window: uint8 `[row, col, 3]`, red too strong, blue too weak.

    The colours end at plus and minus `span_db`.
    """
    gap = window.encode(prediction.power) - window.encode(truth.power)
    gap_db = gap.numpy() * window.span_db
    return coloured(0.5 + 0.5 * gap_db / span_db, DIFFERENCE_COLOURS)


def delay_picture(spectrum: Spectrum, window: DbWindow, *, longest: float) -> np.ndarray:
    """Delays from 0 to `longest` [s] as uint8 `[row, col, 3]`; grey below the window's floor."""
    if spectrum.delay is None:
        raise InputError("this spectrum has no delays to draw")
    return _masked(coloured(spectrum.delay.numpy() / longest), spectrum, window)


def departure_pictures(spectrum: Spectrum, window: DbWindow) -> tuple[np.ndarray, np.ndarray]:
    """Azimuth (cyclic hues) and zenith of the angle of departure as uint8 `[row, col, 3]`; grey below the floor."""
    if spectrum.aod is None:
        raise InputError("this spectrum has no angles of departure to draw")
    zenith, azimuth = angles_of(spectrum.aod)
    turn = azimuth.numpy() / (2 * np.pi)
    return _masked(hues(turn), spectrum, window), _masked(coloured(zenith.numpy() / np.pi), spectrum, window)


def _masked(picture: np.ndarray, spectrum: Spectrum, window: DbWindow) -> np.ndarray:
    below = (spectrum.gain_db < window.floor_db).numpy()
    return np.where(below[..., None], NOTHING, picture)


def photo_picture(photo: np.ndarray | torch.Tensor) -> np.ndarray:
    """uint8 `[row, col, 3]` of a photograph in [0, 1] `[row, col, 3]`; clipped."""
    values = photo.detach().numpy() if isinstance(photo, torch.Tensor) else np.asarray(photo)
    if values.ndim != 3 or values.shape[2] != 3:
        raise InputError(f"a photograph must be [row, col, 3] with values from 0 to 1; got shape {list(values.shape)}")
    return (255.0 * np.clip(values, 0.0, 1.0)).round().astype(np.uint8)


def encoded(picture: np.ndarray, kind: str = "PNG") -> bytes:
    """The bytes of a PNG or JPEG file of a uint8 `[row, col, 3]` picture."""
    from PIL import Image

    buffer = io.BytesIO()
    options = {"quality": 88} if kind == "JPEG" else {"optimize": True}
    Image.fromarray(np.ascontiguousarray(picture)).save(buffer, kind, **options)
    return buffer.getvalue()


def save_spectrum_figure(
    spectrum: Spectrum, path: str | Path, *, window: DbWindow | None = None, title: str = ""
) -> None:
    """Write the spectrum as a PNG figure with axes in degrees and a colour bar in dB."""
    from PIL import Image, ImageDraw, ImageFont

    from rf3dgs.evaluation.panels import axis_ticks, even_ticks

    _one(spectrum)
    window = window_of(spectrum) if window is None else window
    height, width = spectrum.grid.shape
    zoom = max(1, round(900 / width))
    left, top, right, bottom = 78, 40 if title else 16, 130, 62
    wide, high = zoom * width, zoom * height
    figure = Image.new("RGB", (left + wide + right, top + high + bottom), "white")
    draw, font = ImageDraw.Draw(figure), ImageFont.load_default(16)
    picture = Image.fromarray(spectrum_picture(spectrum, window))
    figure.paste(picture.resize((wide, high), Image.Resampling.NEAREST), (left, top))
    draw.rectangle((left - 1, top - 1, left + wide, top + high), outline="black")
    across, down = axis_ticks(spectrum.grid)
    for place, text in across:
        x = left + zoom * place
        draw.line((x, top + high, x, top + high + 5), fill="black")
        draw.text((x, top + high + 8), text, "black", font, anchor="ma")
    for place, text in down:
        y = top + zoom * place
        draw.line((left - 6, y, left - 1, y), fill="black")
        draw.text((left - 10, y), text, "black", font, anchor="rm")
    draw.text((left + wide / 2, top + high + 32), "azimuth [deg], left is positive", "black", font, anchor="ma")
    label = Image.new("RGB", (high, 20), "white")
    ImageDraw.Draw(label).text((high / 2, 10), "zenith [deg]", "black", font, anchor="mm")
    figure.paste(label.rotate(90, expand=True), (6, top))
    draw.text((left + wide / 2, 10), title, "black", font, anchor="ma")
    bar = left + wide + 24
    scale = np.repeat(coloured(np.linspace(1.0, 0.0, high))[:, None], 18, 1)
    figure.paste(Image.fromarray(scale), (bar, top))
    draw.rectangle((bar - 1, top - 1, bar + 18, top + high), outline="black")
    for share, text in even_ticks(window.floor_db, window.ceil_db):
        y = top + high * (1.0 - share)
        draw.line((bar + 18, y, bar + 23, y), fill="black")
        draw.text((bar + 27, y), f"{text} dB", "black", font, anchor="lm")
    buffer = io.BytesIO()
    figure.save(buffer, format="png")
    write_whole(path, buffer.getvalue())


def _one(spectrum: Spectrum) -> None:
    if spectrum.pose.batch_shape:
        raise InputError(
            f"a picture shows one pose; got {list(spectrum.pose.batch_shape)}. Choose one, as in spectrum[0]"
        )
