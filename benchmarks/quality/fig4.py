"""The paper's Fig. 4: beam patterns of an array, and one position of the lobby as ideal, CBF, TCBF, MVDR and MUSIC.

    python -m benchmarks.quality.fig4 --out docs/pictures

Traces one receiver of the built-in lobby (about 20 s; needs the extra `trace`), looks from it with an 8x8 patch array
and writes fig4.png. Rows: the element and the beams, as a cut through boresight and as pictures; the spectra in dB,
each in its own window; the spectra on a linear scale relative to their own peak. The scale that the paper gives each is
named: linear per view for CBF and TCBF, dB for ideal and MVDR.
"""

import argparse
import io
import math
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from rf3dgs.channel.arrays import PlanarArray, planar_array
from rf3dgs.channel.paths import Paths
from rf3dgs.channel.patterns import power_pattern
from rf3dgs.channel.response import manifold
from rf3dgs.core.files import write_whole
from rf3dgs.core.frames import Pose
from rf3dgs.core.grids import DirectionGrid, pinhole_grid
from rf3dgs.core.units import db_from_power
from rf3dgs.evaluation.figures import STYLE
from rf3dgs.evaluation.pictures import LEVEL_COLOURS, colour_range, coloured
from rf3dgs.propagation.sionna import trace_each
from rf3dgs.propagation.sites.lobby import lobby
from rf3dgs.spectra.beamformers import hann_taper
from rf3dgs.spectra.codec import DbWindow, PerViewLinear, paper_scale
from rf3dgs.spectra.config import ArrayProcessing, Method
from rf3dgs.spectra.scan import spectrum_of
from rf3dgs.spectra.spectrum import Spectrum

METHODS: dict[Method, str] = {
    "ideal": "ideal",
    "bartlett": "CBF",
    "tapered": "TCBF (Hann)",
    "capon": "MVDR",
    "music": "MUSIC",
}
SHARE = 4  # MUSIC's sources: elements / SHARE. MDL counts nearly as many as there are elements among diffuse walls
BEAMS = ((None, 0.0), ("bartlett", 0.0), ("bartlett", 35.0), ("tapered", 0.0))
PATTERN_WINDOW = DbWindow(-40.0, 0.0)
COLOURS = {None: "#70757d", "bartlett": "#0b6e99", "tapered": "#d9822b"}
IN_PAPER = ("ideal", "bartlett", "tapered", "capon")


def one_position(position: list[float], towards: list[float]) -> tuple[Paths, Pose]:
    """All paths to one place of the lobby, and the pose of an array there."""
    pose = Pose.look_at(position, towards)
    paths = next(trace_each(lobby(), None, Pose(pose.position[None], pose.orientation[None])))
    return paths[0], pose


def beam(array: PlanarArray, directions: Tensor, method: str | None, azimuth_deg: float) -> Tensor:
    """Power `[*batch]`, 1 at its peak, of the element (None) or of a beam steered to an azimuth on the horizon."""
    if method is None:
        return power_pattern(array.pattern, directions) / array.peak_gain
    angle = math.radians(azimuth_deg)
    taper = hann_taper(array) if method == "tapered" else torch.ones(array.count)
    steered = manifold(array, torch.tensor([math.cos(angle), math.sin(angle), 0.0], dtype=torch.float64))
    weights = (taper * steered / steered.abs()).conj()
    power = (manifold(array, directions.double()) @ weights).abs().square()
    return power / (array.peak_gain * taper.sum() ** 2)


def spectra(paths: Paths, pose: Pose, array: PlanarArray, grid: DirectionGrid, snr_db: float) -> dict[str, Spectrum]:
    """The five spectra of one position, from 256 frequencies over 2 GHz."""
    found = {}
    for method in METHODS:
        if method == "ideal":
            found[method] = spectrum_of(paths, grid=grid, pose=pose)
            continue
        sources = array.count // SHARE if method == "music" else None
        how = ArrayProcessing(snr_db=snr_db, sources=sources)
        found[method] = spectrum_of(paths, array, grid, method=method, processing=how, pose=pose)
    return found


def draw(array: PlanarArray, grid: DirectionGrid, seen: dict[str, Spectrum]) -> bytes:
    """The figure as PNG bytes, in 128 colours."""
    import matplotlib as mpl
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import LinearSegmentedColormap, Normalize
    from matplotlib.figure import Figure
    from PIL import Image

    with mpl.rc_context({**STYLE, "font.size": 8, "axes.titlesize": 8}):
        figure = Figure(figsize=(12.4, 6.1), dpi=100, layout="constrained")
        FigureCanvasAgg(figure)
        axes = figure.subplots(3, 5)
        _cuts(axes[0, 0], array)
        for axis, (method, azimuth) in zip(axes[0, 1:], BEAMS, strict=True):
            name = f"{METHODS[method]} beam at {azimuth:.0f} deg" if method else f"element ({array.pattern})"
            _picture(axis, coloured(PATTERN_WINDOW.encode(beam(array, grid.directions, method, azimuth)).numpy()))
            axis.set_title(f"{name}, -40 to 0 dB")
        for column, (method, name) in enumerate(METHODS.items()):
            spectrum, window = seen[method], colour_range([seen[method]])
            linear = isinstance(paper_scale(spectrum), PerViewLinear)
            _picture(axes[1, column], coloured(window.encode(spectrum.power).numpy()))
            scale = f"{window.floor_db:.0f} to {window.ceil_db:.0f} dB"
            _title(axes[1, column], f"{name}, {scale}", in_paper=method in IN_PAPER and not linear)
            _picture(axes[2, column], coloured(PerViewLinear().encode(spectrum.power).numpy()))
            _title(axes[2, column], f"{name}, linear per view", in_paper=method in IN_PAPER and linear)
        colours = LinearSegmentedColormap.from_list("level", LEVEL_COLOURS / 255.0)
        bar = figure.colorbar(ScalarMappable(Normalize(0, 1), colours), ax=axes[1:], shrink=0.6, pad=0.01)
        bar.set_label("share of the scale in the title")
        buffer = io.BytesIO()
        figure.savefig(buffer, format="png")
    small = io.BytesIO()
    picture = Image.open(io.BytesIO(buffer.getvalue())).convert("RGB")
    picture.quantize(128, dither=Image.Dither.NONE).save(small, "PNG", optimize=True)
    return small.getvalue()


def _cuts(axis, array: PlanarArray) -> None:
    angle = torch.linspace(-90.0, 90.0, 1441, dtype=torch.float64)
    turn = torch.deg2rad(angle)
    cut = torch.stack((torch.cos(turn), torch.sin(turn), torch.zeros_like(turn)), -1)
    for method, name in ((None, array.pattern), ("bartlett", "CBF"), ("tapered", "TCBF")):
        level = db_from_power(beam(array, cut, method, 0.0)).clamp_min(-60.0)
        axis.plot(angle, level, color=COLOURS[method], linewidth=1.2, label=name)
    axis.set_xlim(90, -90)
    axis.set_xticks([90, 45, 0, -45, -90])
    axis.set_ylim(-50, 10)
    axis.set_title(f"{array.label}: cut through boresight [dB]")
    axis.set_xlabel("azimuth [deg]")
    axis.legend(loc="upper center", ncols=3, handlelength=1.0, columnspacing=1.0, borderaxespad=0.1, fontsize=7)


def _picture(axis, picture: np.ndarray) -> None:
    axis.imshow(picture, interpolation="nearest")
    axis.set_xticks([])
    axis.set_yticks([])
    axis.grid(False)


def _title(axis, text: str, *, in_paper: bool) -> None:
    axis.set_title(f"{text} (paper)" if in_paper else text, fontweight="bold" if in_paper else "normal")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True, help="the folder that fig4.png is written to")
    parser.add_argument("--position", type=float, nargs=3, default=[9.0, 8.0, 1.5], help="of the receiver [m]")
    parser.add_argument("--towards", type=float, nargs=3, default=[2.0, 3.5, 1.6], help="where the array looks [m]")
    parser.add_argument("--array", type=int, nargs=2, default=[8, 8], help="rows and columns of patches")
    parser.add_argument("--snr-db", type=float, default=30.0, help="of the array's responses")
    options = parser.parse_args()
    paths, pose = one_position(options.position, options.towards)
    array, grid = planar_array(*options.array, "patch"), pinhole_grid(300, 200, 90)
    seen = spectra(paths, pose, array, grid, options.snr_db)
    print(f"{int(paths.count):,} paths; {array.label}, {options.snr_db:g} dB")
    for spectrum in seen.values():
        window = colour_range([spectrum])
        print(f"{spectrum.instrument.name}: {window.floor_db:.0f} to {window.ceil_db:.0f} dB")
    options.out.mkdir(parents=True, exist_ok=True)
    picture = draw(array, grid, seen)
    write_whole(options.out / "fig4.png", picture)
    print(f"{options.out / 'fig4.png'}: {len(picture) / 1e3:.0f} kB")


if __name__ == "__main__":
    torch.set_grad_enabled(False)
    main()
