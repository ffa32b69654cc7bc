"""# Paths out of a measured channel

A channel sounder measures impulse responses between the elements of two arrays. Here a model of one "measures" five
paths, with noise and a limited vertical field of view, and writes a file as an instrument would. Reading the file and
running SAGE gives the paths back: gain, delay, arrival and departure.

    python examples/06_measured_cir.py
"""

import math

import torch

import rf3dgs
from rf3dgs.channel import Sounding
from rf3dgs.core.units import SPEED_OF_LIGHT, db_from_power, friis_gain
from rf3dgs.propagation import Sounder, read_sounding, sound, write_sounding
from rf3dgs.spectra.sage import estimate_paths

# The truth: a room of 8 x 6 x 3 m, the line of sight and four mirrors of it that lose 6 dB each.
tx, rx = rf3dgs.Pose.look_at((1.0, 2.0, 2.2), (7.0, 3.0, 1.5)), rf3dgs.Pose.look_at((7.0, 3.5, 1.5), (1.0, 2.0, 1.6))
names = ("line of sight", "wall y = 0", "wall y = 6", "floor", "ceiling")
planes = {"wall y = 0": (1, 0.0), "wall y = 6": (1, 6.0), "floor": (2, 0.0), "ceiling": (2, 3.0)}
arrival, departure, loss = [], [], []
for name in names:
    image, seen = tx.position.clone(), rx.position.clone()
    if name in planes:
        axis, at = planes[name]
        image[axis], seen[axis] = 2 * at - image[axis], 2 * at - seen[axis]
    arrival.append(image - rx.position)
    departure.append(seen - tx.position)
    loss.append(0.5 if name in planes else 1.0)
arrival, departure = torch.stack(arrival).double(), torch.stack(departure).double()
length = arrival.norm(dim=-1)
truth = rf3dgs.Paths(
    coeff=(friis_gain(length, 60e9).sqrt() * torch.tensor(loss)).to(torch.complex128),
    delay=length / SPEED_OF_LIGHT,
    aoa_zenith=torch.acos(arrival[:, 2] / length),
    aoa_azimuth=torch.atan2(arrival[:, 1], arrival[:, 0]),
    aod_zenith=torch.acos(departure[:, 2] / length),
    aod_azimuth=torch.atan2(departure[:, 1], departure[:, 0]),
    valid=torch.ones(len(names), dtype=torch.bool),
    frequency=60e9,
    tx=tx,
    rx=rx,
)

# The sounder sees 50 degrees about its horizon. Its impulse responses go into a file.
sounder = Sounder(
    bandwidth=1e9,
    points=64,
    array_rx=rf3dgs.planar_array(4, 4),
    array_tx=rf3dgs.planar_array(4, 4),
    tx_power_dbm=5.0,
    noise_figure_db=8.0,
    fov_rx_deg=50.0,
    fov_tx_deg=50.0,
)
measured = sound(truth, sounder)
taps, delays = measured.taps()
print(f"impulse responses [rx_ant, tx_ant, tap] {list(taps.shape)}, {1e9 * float(delays[1]):.1f} ns a tap")
known = {name: getattr(measured, name) for name in ("array_rx", "array_tx", "noise_power", "fov_rx", "fov_tx")}
write_sounding("site.h5", Sounding.from_taps(taps, float(delays[1]), 60e9, tx, rx, **known))

# From the file alone: the paths, and how sure they are.
found = estimate_paths(read_sounding("site.h5"))
paths, deviation = found.paths[0], found.deviation
print(f"{int(paths.count)} paths; the residual is {float(found.residual_power / found.noise_power):.2f} of the noise")
print("path            gain [dB]  delay [ns]     zenith, azimuth of arrival [deg]")
elevation = [
    torch.rad2deg(torch.asin(pose.to_device(way)[:, 2])).round() for pose, way in ((rx, truth.aoa), (tx, truth.aod))
]
for index, name in enumerate(names):
    gain, delay = truth.path_gain[index], truth.delay[index]
    nearest = int((paths.delay - delay).abs().argmin())
    if float((paths.delay[nearest] - delay).abs()) > 0.5e-9:
        heights = " and ".join(f"{float(height[index]):.0f}" for height in elevation)
        print(f"{name:14s}  not seen: {heights} deg above the horizons of receiver and transmitter")
        continue
    sure = [math.degrees(float(one[0, nearest])) for one in (deviation.aoa_zenith, deviation.aoa_azimuth)]
    print(
        f"{name:14s}  {float(db_from_power(paths.path_gain[nearest])):8.2f}  {1e9 * float(paths.delay[nearest]):9.4f}"
        f"      {math.degrees(float(paths.aoa_zenith[nearest])):7.2f} +- {sure[0]:.2f}"
        f"  {math.degrees(float(paths.aoa_azimuth[nearest])):8.2f} +- {sure[1]:.2f}"
    )
    assert abs(float(db_from_power(paths.path_gain[nearest]) - db_from_power(gain))) < 0.5
assert 3 <= int(paths.count) <= len(names)
