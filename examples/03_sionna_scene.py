"""# Spectra in a scene of Sionna RT

Any scene that ships with Sionna RT, and any Sionna or Mitsuba XML file, can be traced. Here somebody walks along a
street, and the strongest direction and the delay spread are printed on the way. Needs `pip install "rf3dgs[trace]"`
and LLVM.

    python examples/03_sionna_scene.py
"""

import math

from rf3dgs import equirect_grid, propagation, spectrum_of
from rf3dgs.core.units import db_from_power
from rf3dgs.propagation import ReceiverConfig, TraceConfig, receivers_of

scene = propagation.scene_of("simple_street_canyon")  # or a file: scene_of("my-site.xml")
walk = ReceiverConfig(kind="route", route=((-20.0, 0.0), (20.0, 0.0), (20.0, 4.0)), speed=1.4, interval=8.0)
rx = receivers_of(scene, walk)

# Diffuse paths are merged by direction and delay; the line of sight and mirrors stay as they are.
paths = propagation.sionna.trace(scene, rx=rx, config=TraceConfig(rays=20_000, depth=2))
for index in range(len(rx)):
    spectrum = spectrum_of(paths[index], grid=equirect_grid(180, 90))
    row, col = divmod(int(spectrum.power.argmax()), spectrum.grid.width)
    x, y, _ = rx.position[index].tolist()
    gain = paths.path_gain[index]
    mean = float((gain * paths.delay[index]).sum() / gain.sum())
    spread = math.sqrt(float((gain * (paths.delay[index] - mean) ** 2).sum() / gain.sum()))
    print(
        f"({x:6.1f}, {y:4.1f}) m: {float(db_from_power(gain.sum())):7.1f} dB, strongest pixel ({col}, {row}), "
        f"delay spread {1e9 * spread:5.1f} ns"
    )
