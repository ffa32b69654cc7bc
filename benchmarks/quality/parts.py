"""What each part of a mirror field sends to one receiver, as four pictures of the whole sphere.

    python -m benchmarks.quality.parts lobby --at 8 5 1.5 [--out docs/pictures/parts.png]

From the top: the whole field, its point sources, its lit surfaces, its ambient light. Yellow is 15 dB under the
strongest direction of the whole and above, blue 75 dB under it and below. A second.
"""

import argparse
import io
from pathlib import Path

import numpy as np
from PIL import Image

from rf3dgs.cli.facts import open_field
from rf3dgs.core.files import write_whole
from rf3dgs.core.frames import Pose
from rf3dgs.core.grids import equirect_grid
from rf3dgs.evaluation.pictures import spectrum_picture
from rf3dgs.field.lit import PARTS
from rf3dgs.field.radio_field import RadioField
from rf3dgs.spectra.codec import DbWindow

WIDTH, GAP = 480, 4  # pixel
BRIGHT_DB, DARK_DB = 15.0, 75.0  # under the strongest direction
COLOURS = 200
"""Of the palette that keeps a picture small."""


def stacked(field: RadioField, pose: Pose) -> np.ndarray:
    """uint8 `[row, col, 3]`: the whole field and its parts at one pose, one under another with white between them."""
    grid = equirect_grid(WIDTH, WIDTH // 2)
    whole = field.render(pose, grid, csi=False)
    top = float(whole.gain_db.max())
    window = DbWindow(top - DARK_DB, top - BRIGHT_DB)
    spectra = [whole, *(field.only(part).render(pose, grid, csi=False) for part in PARTS)]
    white = np.full((GAP, WIDTH, 3), 255, dtype=np.uint8)
    rows = [row for spectrum in spectra for row in (spectrum_picture(spectrum, window), white)]
    return np.concatenate(rows[:-1])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("field", help='a field\'s folder, or "lobby" for the one that ships with the package')
    parser.add_argument("--at", type=float, nargs=3, required=True, metavar=("X", "Y", "Z"))
    parser.add_argument("--out", type=Path, default=Path("docs/pictures/parts.png"))
    options = parser.parse_args()
    picture = Image.fromarray(stacked(open_field(options.field), Pose(options.at)))
    buffer = io.BytesIO()
    picture.quantize(COLOURS, dither=Image.Dither.NONE).save(buffer, format="PNG", optimize=True)
    write_whole(options.out, buffer.getvalue())
    print(f"{options.out}: {len(buffer.getvalue()) / 1e3:.0f} kB")


if __name__ == "__main__":
    main()
