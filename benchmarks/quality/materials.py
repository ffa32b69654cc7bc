"""Pictures of how surfaces scatter: the roughness criterion (Fig. 2 of the paper) and the scattering lobes.

    python -m benchmarks.quality.materials [--out docs/pictures]

roughness.png: the largest height of roughness that still mirrors, over the angle of incidence, by Rayleigh's and by
Fraunhofer's criterion at five frequencies and for green light, with the surfaces of `materials.SURFACES` beside.
lobes.png: the diffuse power over the directions it leaves to, Lambert's law and directive lobes.
Printed: the scattering amplitude S of every surface at the presets' frequencies.
"""

import argparse
import io
import math
from pathlib import Path

import numpy as np

from rf3dgs.core.files import write_whole
from rf3dgs.core.units import SPEED_OF_LIGHT
from rf3dgs.evaluation.figures import STYLE
from rf3dgs.propagation.sites.materials import SURFACES, scattering_amplitude, smooth_height

FREQUENCIES = {
    "2.4 GHz": 2.4e9,
    "10 GHz": 10e9,
    "28 GHz": 28e9,
    "60 GHz": 60e9,
    "light, 550 nm": SPEED_OF_LIGHT / 550e-9,
}
COLOURS = ("#8a5fb5", "#0b6e99", "#2a9d6f", "#d9822b", "#6b8e23")
INCIDENCE = math.radians(45)


def directive(out: np.ndarray, alpha_r: int | None) -> np.ndarray:
    """Pattern `[...]` over unit vectors `[..., 3]` above z = 0, its integral over the half space 1.

    Lambert's cosine, or ((1 + cos psi) / 2)^alpha with psi from the mirror direction (the directive model of
    Degli-Esposti et al., 2007), normalised numerically.
    """
    mirror = np.array([math.sin(INCIDENCE), 0.0, math.cos(INCIDENCE)])

    def shape(directions: np.ndarray) -> np.ndarray:
        if alpha_r is None:
            return directions[..., 2]
        return ((1 + directions @ mirror) / 2) ** alpha_r

    z, turn = (np.arange(400) + 0.5) / 400, (np.arange(800) + 0.5) / 800 * 2 * math.pi
    flat = np.sqrt(1 - z**2)[:, None]
    sphere = np.stack((flat * np.cos(turn), flat * np.sin(turn), np.broadcast_to(z[:, None], (400, 800))), -1)
    return shape(out) / (shape(sphere).mean() * 2 * math.pi)


def draw_roughness():
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7.2, 4.2), dpi=110, layout="constrained")
    axis = figure.subplots()
    angles = np.radians(np.linspace(0, 88, 200))
    for colour, (name, frequency) in zip(COLOURS, FREQUENCIES.items(), strict=True):
        for parts, line in ((8, "-"), (32, ":")):
            heights = [1e3 * smooth_height(frequency, angle, parts=parts) for angle in angles]
            axis.plot(np.degrees(angles), heights, line, color=colour, label=name if parts == 8 else None)
    for name, at in (("concrete", 2), ("ceiling_board", 22), ("wood", 2), ("glass", 2), ("marble", 22), ("skin", 42)):
        height = 1e3 * SURFACES[name].roughness
        axis.axhline(height, color="#b0b6bd", linewidth=0.8, zorder=0)
        axis.annotate(name.replace("_", " "), (at, 1.08 * height), color="#5b626b", fontsize=8)
    axis.set_yscale("log")
    axis.set_xlim(0, 88)
    axis.set_xlabel("angle of incidence from the normal [deg]")
    axis.set_ylabel("height of roughness [mm]")
    axis.set_title("A surface mirrors below its curve: Rayleigh (solid), Fraunhofer (dotted)", fontsize=10, loc="left")
    figure.legend(loc="outside right upper")
    return figure


def draw_lobes():
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9.6, 3.0), dpi=110)
    zenith, azimuth = np.meshgrid(np.linspace(0, math.pi / 2, 60), np.linspace(-math.pi, math.pi, 120), indexing="ij")
    out = np.stack((np.sin(zenith) * np.cos(azimuth), np.sin(zenith) * np.sin(azimuth), np.cos(zenith)), -1)
    cases = (("Lambert", None), ("alpha_R = 4", 4), ("alpha_R = 12", 12), ("alpha_R = 30", 30))
    for number, (name, alpha_r) in enumerate(cases, 1):
        axis = figure.add_subplot(1, 4, number, projection="3d", computed_zorder=False)
        pattern = directive(out, alpha_r)
        size = pattern.max()
        points = out * (pattern / size)[..., None]
        axis.plot_surface(
            *np.moveaxis(points, -1, 0),
            color="#2a9d6f",
            rstride=2,
            cstride=3,
            linewidth=0.1,
            edgecolor="#14573d",
            alpha=0.85,
        )
        for sign, colour in ((-1, "#d9822b"), (1, "#0b6e99")):  # the wave comes in, the mirror direction goes out
            tip = 1.15 * np.array([sign * math.sin(INCIDENCE), 0.0, math.cos(INCIDENCE)])
            axis.plot(*np.stack((np.zeros(3), tip), -1), color=colour, linewidth=1.5)
        axis.set(xlim=(-0.9, 0.9), ylim=(-0.9, 0.9), zlim=(0, 1.1), xticks=[], yticks=[], zticks=[])
        axis.set_box_aspect((1.8, 1.8, 1.1))
        axis.view_init(elev=18, azim=-75)
        axis.set_title(f"{name}, peak {10 * math.log10(math.pi * size):.1f} dB", fontsize=9, y=0.98)
    figure.subplots_adjust(left=0.0, right=1.0, bottom=0.0, top=0.92, wspace=0.0)
    return figure


def main() -> None:
    import matplotlib as mpl
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("docs/pictures"), help="the folder for the pictures")
    folder = parser.parse_args().out
    folder.mkdir(parents=True, exist_ok=True)
    for name, draw in (("roughness", draw_roughness), ("lobes", draw_lobes)):
        with mpl.rc_context(STYLE):
            figure = draw()
            FigureCanvasAgg(figure)
            buffer = io.BytesIO()
            figure.savefig(buffer, format="png")
        write_whole(folder / f"{name}.png", buffer.getvalue())
    frequencies = [frequency for frequency in FREQUENCIES.values() if frequency < 1e12]
    print(f"{'surface':14}" + "".join(f"{name:>9}" for name in FREQUENCIES if "GHz" in name) + "   alpha_R")
    for name, surface in SURFACES.items():
        amplitudes = "".join(f"{scattering_amplitude(surface, frequency):9.2f}" for frequency in frequencies)
        print(f"{name:14}{amplitudes}   {surface.alpha_r}")


if __name__ == "__main__":
    main()
