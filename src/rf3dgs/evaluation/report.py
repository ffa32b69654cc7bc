"""The report: one HTML file with pictures, numbers and what they mean, readable offline, on a phone and on paper."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from html import escape
from pathlib import Path

import numpy as np
import torch

from rf3dgs.core.files import write_whole
from rf3dgs.evaluation import page, provenance
from rf3dgs.evaluation.figures import distributions, position_map
from rf3dgs.evaluation.panels import colour_bar, data_address, even_ticks, panel
from rf3dgs.evaluation.pictures import (
    DIFFERENCE_COLOURS,
    colour_range,
    coloured,
    delay_picture,
    departure_pictures,
    difference_picture,
    encoded,
    hues,
    photo_picture,
    spectrum_picture,
)
from rf3dgs.evaluation.protocol import Predictor
from rf3dgs.evaluation.results import results
from rf3dgs.evaluation.table import FIELD, Evaluation
from rf3dgs.spectra.codec import DbWindow
from rf3dgs.spectra.spectrum import Spectrum

SPAN_DB = 20.0


@dataclass(frozen=True, eq=False)
class PhotoPair:
    """A held-out photograph and the rendering of its camera, both `[row, col, 3]` in [0, 1]."""

    name: str
    photo: torch.Tensor | np.ndarray
    rendering: torch.Tensor | np.ndarray


@dataclass(frozen=True, eq=False)
class SpectrumExample:
    """One held-out position: the true spectrum, the field's, and the nearest training position's copy."""

    label: str
    truth: Spectrum
    field: Spectrum
    nearest: Spectrum | None = None

    @classmethod
    def of(cls, label: str, predictor: Predictor, truth: Spectrum, train: Spectrum | None = None) -> "SpectrumExample":
        """Render one position with `predictor` (and the copy from `train`); `truth` is the spectrum of one pose."""
        from rf3dgs.evaluation.baselines.lookup import NearestNeighbour

        copy = None if train is None else NearestNeighbour(train).render(truth.pose, truth.grid)
        return cls(label, truth, predictor.render(truth.pose, truth.grid), copy)


@dataclass(frozen=True, eq=False)
class ReportInputs:
    """Everything that the report shows; what is left out leaves no gap."""

    title: str
    """Heading of the page."""
    evaluations: Mapping[str, Evaluation]
    """Hold-out name ("random", "region") to its evaluation."""
    facts: Mapping[str, object] = field(default_factory=dict)
    """Facts of the dataset and the field: name to value, as shown."""
    photos: Sequence[PhotoPair] = ()
    """Held-out photographs and their renderings."""
    examples: Sequence[SpectrumExample] = ()
    """Held-out spectra shown side by side."""
    positions: np.ndarray | torch.Tensor | None = None
    """Receiver positions `[n, 3]` [m] of the map."""
    roles: Sequence[str] = ()
    """One role per position: "train", "validation", "test" or "region"."""
    tx: np.ndarray | torch.Tensor | None = None
    """The transmitter's position `[3]` [m]."""
    footprint: Sequence[np.ndarray] = ()
    """Outlines `[k, 2]` [m] of the site from above, as `figures.footprint_of` makes them."""
    timings: Mapping[str, float] = field(default_factory=dict)
    """Stage name to seconds."""
    seed: int | None = None
    """Seed of the run."""
    command: str = ""
    """The command that makes this report again."""
    window: DbWindow | None = None
    """dB window of errors and masks; default the first evaluation's."""
    colours: DbWindow | None = None
    """Levels [dB] at the ends of the colour scale; default what shows most of the true examples."""


def write_report(path: str | Path, inputs: ReportInputs) -> Path:
    """Write the report as one self-contained HTML file, whole or not at all; returns its path."""
    if inputs.window is None and inputs.evaluations:
        floor, ceiling = next(iter(inputs.evaluations.values())).window
        inputs = replace(inputs, window=DbWindow(floor, ceiling))
    sections = (
        page.section("What was measured", page.facts(inputs.facts)),
        page.section("How good it is", *results(inputs.evaluations)),
        page.section("Photographs and renderings", *_photos(inputs.photos)),
        page.section("True and predicted spectra", *_spectra(inputs)),
        page.section("Delays and angles of departure", *_channel_state(inputs)),
        page.section("How the errors are distributed", *_distributions(inputs.evaluations)),
        page.section("Where", *_map(inputs)),
        page.section("How long it took", *_timings(inputs.timings)),
        page.section("How to get this again", *_again(inputs)),
    )
    lead = (
        "A radio radiance field against spectra that it has not seen, beside simply copying what was measured nearby."
    )
    write_whole(path, page.page(inputs.title, lead, [part for part in sections if part]).encode())
    return Path(path)


def _photos(photos: Sequence[PhotoPair]) -> list[str]:
    pairs = []
    for pair in photos:
        photo, rendering = photo_picture(pair.photo), photo_picture(pair.rendering)
        error = np.mean((photo / 255.0 - rendering / 255.0) ** 2) if photo.shape == rendering.shape else np.nan
        score = "" if np.isnan(error) else f", PSNR {-10 * np.log10(max(error, 1e-10)):.1f} dB"
        left, right = (data_address(encoded(picture, "JPEG"), "jpeg") for picture in (photo, rendering))
        pairs.append(
            f'<figure class="pair">{page.image(left, "photograph")}{page.image(right, "rendering")}'
            f"<figcaption>{escape(pair.name)}: photograph (left), rendering (right){score}</figcaption></figure>"
        )
    return [f'<div class="pairs">{"".join(pairs)}</div>'] if pairs else []


def _spectra(inputs: ReportInputs) -> list[str]:
    window = inputs.window
    if window is None or not inputs.examples:
        return []
    colours = colour_range([example.truth for example in inputs.examples]) if inputs.colours is None else inputs.colours
    scales = _scales(colours)
    parts = [
        page.note(
            "Looking out of the receiver: up is up, left is left. The ring marks the strongest direction. All levels "
            "share one colour scale, which ends where it shows the room best: stronger directions are as bright as its "
            "end. Errors are prediction minus truth inside the window of the table: red too strong, blue too weak."
        )
    ]
    for example in inputs.examples:
        views = {"truth": example.truth, FIELD: example.field, "nearest": example.nearest}
        shown = [
            page.figure(panel(spectrum_picture(view, colours), view.grid, name, mark=_strongest(view)), caption)
            for (name, view), caption in zip(views.items(), ("Truth", "Field", "Nearest neighbour"), strict=True)
            if view is not None
        ]
        for name, view in (("field", example.field), ("nearest neighbour", example.nearest)):
            if view is not None:
                picture = difference_picture(example.truth, view, window, span_db=SPAN_DB)
                shown.append(page.figure(panel(picture, view.grid, f"error of the {name}"), f"Error of the {name}"))
        shown.append(scales)
        parts.append(f'<h3>{escape(example.label)}</h3><div class="grid">{"".join(shown)}</div>')
    return parts


def _scales(window: DbWindow) -> str:
    ramp = np.linspace(0, 1, 256)
    level = colour_bar(coloured(ramp), even_ticks(window.floor_db, window.ceil_db), "power [dB]")
    gap = colour_bar(coloured(ramp, DIFFERENCE_COLOURS), even_ticks(-SPAN_DB, SPAN_DB, count=4), "error [dB]")
    return f'<div class="scales">{level}{gap}</div>'


def _strongest(spectrum: Spectrum) -> tuple[float, float]:
    row, col = divmod(int(spectrum.power.argmax()), spectrum.grid.width)
    return col + 0.5, row + 0.5


def _channel_state(inputs: ReportInputs) -> list[str]:
    window = inputs.window
    examples = [item for item in inputs.examples if item.truth.delay is not None and item.truth.aod is not None]
    if window is None or not examples:
        return []
    reached = torch.cat(
        [x.truth.delay[x.truth.gain_db >= window.floor_db] for x in examples if x.truth.delay is not None]
    )
    longest = float(np.percentile(reached.numpy(), 99)) if len(reached) else 1e-7
    parts = [page.note("Grey: below the window's floor, no path worth a delay.")]
    for example in examples[:2]:
        shown = []
        views = (("Truth", example.truth), ("Field", example.field), ("Nearest neighbour", example.nearest))
        kept = [
            (name, view) for name, view in views if view is not None and view.delay is not None and view.aod is not None
        ]
        for name, view in kept:
            shown.append(_panel_of(delay_picture(view, window, longest=longest), view, f"{name}: delay"))
        for part, quantity in enumerate(("departure azimuth", "departure zenith")):
            for name, view in kept:
                shown.append(_panel_of(departure_pictures(view, window)[part], view, f"{name}: {quantity}"))
        parts.append(f'<h3>{escape(example.label)}</h3><div class="grid">{"".join(shown)}</div>')
    ramp = np.linspace(0, 1, 256)
    bars = (
        colour_bar(coloured(ramp), even_ticks(0, 1e9 * longest), "delay [ns]"),
        colour_bar(hues(ramp - 0.5), _evenly(-180, 180), "departure azimuth [deg], world"),
        colour_bar(coloured(ramp), _evenly(0, 180), "departure zenith [deg]"),
    )
    return [*parts, f'<div class="bars">{"".join(bars)}</div>']


def _evenly(low: int, high: int) -> list[tuple[float, str]]:
    return [(quarter / 4, f"{low + (high - low) * quarter / 4:g}") for quarter in range(5)]


def _panel_of(picture: np.ndarray, view: Spectrum, caption: str) -> str:
    return page.figure(panel(picture, view.grid, caption), caption)


def _distributions(evaluations: Mapping[str, Evaluation]) -> list[str]:
    return [
        f'<h3>{escape(name)}</h3><div class="wide">'
        f"{page.image(data_address(distributions(evaluation)), f'cumulative error distributions, {name}')}</div>"
        for name, evaluation in evaluations.items()
    ]


def _map(inputs: ReportInputs) -> list[str]:
    if inputs.positions is None or not len(inputs.positions):
        return []
    tx = None if inputs.tx is None else np.asarray(inputs.tx)
    picture = position_map(
        *(np.asarray(inputs.positions), inputs.roles, dict(inputs.evaluations)), tx=tx, footprint=inputs.footprint
    )
    return [f'<div class="wide map">{page.image(data_address(picture), "map of the positions")}</div>']


def _timings(timings: Mapping[str, float]) -> list[str]:
    if not timings:
        return []
    longest, total = max(max(timings.values()), 1e-9), sum(timings.values())
    rows = "".join(
        f'<tr><th>{escape(name)}</th><td>{seconds:.1f} s</td><td style="width:55%">'
        f'<span class="time" style="width:{100 * seconds / longest:.1f}%"></span></td></tr>'
        for name, seconds in timings.items()
    )
    return [
        f'<div class="scroll"><table><tbody>{rows}<tr><th><b>all</b></th><td><b>{total:.1f} s</b></td><td></td></tr>'
        "</tbody></table></div>"
    ]


def _again(inputs: ReportInputs) -> list[str]:
    about: dict[str, object] = {} if inputs.seed is None else {"Seed": inputs.seed}
    about |= provenance.machine()
    about |= provenance.versions()
    return [f"<pre>{escape(inputs.command)}</pre>" if inputs.command else "", page.facts(about)]
