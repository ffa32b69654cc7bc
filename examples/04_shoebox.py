"""# A room without a ray tracer

`shoebox` solves a rectangular room exactly, by mirror images. It needs neither Sionna RT nor LLVM, so it is at hand for
trying arrays, spectra and estimators on paths that are known to the last digit.

    python examples/04_shoebox.py
"""

import math

import torch

import rf3dgs
from rf3dgs.core.units import db_from_power
from rf3dgs.propagation import Slab, shoebox
from rf3dgs.spectra import ArrayProcessing

# Six walls, in the order x low, x high, y low, y high, z low, z high: materials by name, one window, a metal ceiling.
walls = ["plasterboard", "concrete", "plasterboard", Slab(permittivity=6.3, conductivity=0.9, thickness=0.006)]
walls += ["wood", "metal"]
tx = rf3dgs.Pose((1.0, 1.5, 2.6))
rx = rf3dgs.Pose.look_at(((6.5, 4.2, 1.4), (3.0, 5.0, 1.2)), tx.position)
paths = shoebox((8.0, 6.0, 3.0), tx, rx, frequency=28e9, order=3, reflection=walls)
print(f"{int(paths.count[0])} paths to each of {len(rx)} receivers; the five strongest to the first:")
best = paths[0].strongest(5)
assert best.order is not None
for gain_db, delay, order in zip(db_from_power(best.path_gain), best.delay, best.order, strict=True):
    print(f"  {float(gain_db):7.1f} dB after {1e9 * float(delay):5.1f} ns, {int(order)} reflections")

# The paths go wherever traced paths go: here the picture of an 8 x 8 array that looks at the transmitter.
grid = rf3dgs.pinhole_grid(120, 80, fov_deg=90)
array = rf3dgs.planar_array(8, 8, pattern="patch")
uncorrelated = ArrayProcessing(snapshots=None, snr_db=30.0)
picture = rf3dgs.spectrum_of(paths[0], array, grid, method="capon", processing=uncorrelated)
row, col = divmod(int(picture.power.argmax()), grid.width)
off = math.degrees(float(torch.acos(grid.directions[row, col, 0].clamp(-1, 1))))
print(f"the array's main peak is {off:.1f} degrees off the line of sight")
assert off < 2.0, "two pixels"

# And a law: exchanging the two ends changes nothing.
one = shoebox((8.0, 6.0, 3.0), tx, rx[0], 28e9, 3, walls, dtype=torch.float64)
back = shoebox((8.0, 6.0, 3.0), rx[0], tx, 28e9, 3, walls, dtype=torch.float64)
assert math.isclose(float(one.total_gain), float(back.total_gain), rel_tol=1e-9)
print(f"path gain {float(db_from_power(one.total_gain)):.3f} dB both ways")
