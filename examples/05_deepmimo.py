"""# A DeepMIMO folder becomes a dataset

DeepMIMO (deepmimo.net) publishes ray-traced sites. `read_deepmimo` reads a version 4 scenario folder without the
package deepmimo; what follows is the same as for paths of any other origin. This script first writes a folder of its
own, so that it runs without a download; name yours as the argument.

    python examples/05_deepmimo.py [SCENARIO_FOLDER]

On the command line: `rf3dgs import SCENARIO_FOLDER --out site.paths`, then `rf3dgs spectra site.paths --out site/`.
"""

import sys
from pathlib import Path

import rf3dgs
from rf3dgs.core.units import db_from_power
from rf3dgs.propagation import deepmimo_pairs, read_deepmimo, shoebox, write_deepmimo
from rf3dgs.spectra.spectrum import stack_spectra

folder = Path(sys.argv[1] if len(sys.argv) > 1 else "room_28")
if len(sys.argv) == 1:
    rx = rf3dgs.Pose.scatter(((1.0, 1.0, 1.0), (7.0, 5.0, 2.0)), count=24, seed=0)
    write_deepmimo(folder, shoebox((8.0, 6.0, 3.0), rf3dgs.Pose((0.5, 0.5, 2.6)), rx, 28e9, 3, "concrete"))

# A scenario has one matrix set for each transmitter and receiver set; here we take the first.
pairs = deepmimo_pairs(folder)
print("pairs:", ", ".join(f"{pair.code} with {pair.receivers} receivers" for pair in pairs))
paths = read_deepmimo(folder, pairs[0].code)
reached = [index for index in range(len(paths.rx)) if int(paths.count[index])]
print(f"{paths.frequency / 1e9:g} GHz, {len(reached)} receivers reached, up to {int(paths.count.max())} paths")
for index in reached[:3]:
    print(f"  receiver {index}: path gain {float(db_from_power(paths.total_gain[index])):.1f} dB")

# Spectra as an ideal narrow lobe would see them, split into training and held-out positions.
grid = rf3dgs.equirect_grid(72, 36)
spectra = stack_spectra([rf3dgs.spectrum_of(paths[index], grid=grid) for index in reached[:100]])
dataset = rf3dgs.Dataset(spectra=spectra, meta={"generator": f"DeepMIMO folder {folder.name}"}).split(seed=0)
dataset.save(f"{folder.name}_dataset")
print(f"{folder.name}_dataset: {len(reached[:100])} spectra of {grid.width}x{grid.height}")
