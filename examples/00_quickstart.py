"""# Ask a radio radiance field

The package ships a field of its lobby, trained on 60 GHz spectra. This script loads it, renders what a receiver sees
towards the transmitter, lists the strongest paths, and makes the channel of an 8 x 8 array from them.

    python examples/00_quickstart.py
"""

import torch

import rf3dgs
from rf3dgs.cli.facts import ASSETS
from rf3dgs.core.units import db_from_power

field = rf3dgs.RadioField.load(ASSETS / "lobby.field")
here = rf3dgs.Pose.look_at(position=(7.0, 5.0, 1.5), target=field.tx.position)

# A spectrum holds linear power per direction; decibels are a view of it.
spectrum = field.render(here, rf3dgs.pinhole_grid(150, 100, fov_deg=90))
print(f"strongest direction: {float(spectrum.gain_db.max()):.1f} dB")

# Paths are what every application takes, from a ray tracer or from a field.
paths = field.paths(here, strongest=5)
for gain_db, delay in zip(db_from_power(paths.path_gain), paths.delay, strict=True):
    print(f"path: {float(gain_db):7.1f} dB after {1e9 * float(delay):5.1f} ns")

# The channel of an array: [receive element, transmit element, subcarrier].
array = rf3dgs.planar_array(rows=8, cols=8, pattern="patch")
channel = paths.cfr(array, subcarriers=rf3dgs.ofdm(400e6, 64), phase="carrier")
power = db_from_power(channel.abs().square().mean())
print(f"channel {list(channel.shape)}: mean power {float(power):.1f} dB")
assert bool(torch.isfinite(channel.abs()).all())
