"""How well SAGE reads paths off soundings: against the Cramer-Rao bound, and on traced channels of the lobby.

    python -m benchmarks.quality.sage [--trials 100] [--positions 40] [--presets diffuse realistic] [--seed 12]

First table: scenes of three random paths at 20 dB SNR, each at least one and a half resolution cells apart in one
dimension; root mean square of error over bound, and how many trials found three paths. The others: `sage_lobby`.
"""

import argparse
import math

import torch
from scipy.optimize import linear_sum_assignment
from torch import Tensor

from benchmarks.quality.sage_lobby import SEED, cells, print_lobby
from rf3dgs.channel.arrays import planar_array
from rf3dgs.channel.paths import Paths
from rf3dgs.channel.sounding import Sounding
from rf3dgs.core.frames import Pose
from rf3dgs.propagation.sounder import Sounder, sound
from rf3dgs.spectra.crb import cramer_rao
from rf3dgs.spectra.sage import sage

QUANTITIES = ("delay", "aoa_zenith", "aoa_azimuth", "aod_zenith", "aod_azimuth")
SMALL = Sounder(points=64, array_rx=planar_array(4, 4, "patch"), array_tx=planar_array(2, 4, "isotropic"), snr_db=20.0)
VIEWS = {"full": (180.0, 180.0), "receiver 45 deg": (45.0, 180.0), "both 45 deg": (45.0, 45.0)}


def three_paths(seed: int, fov_deg: tuple[float, float]) -> Paths:
    """Three random paths in view of two turned devices, pairwise 1.5 cells apart somewhere."""
    generator = torch.Generator().manual_seed(seed)

    def uniform(low: float, high: float) -> Tensor:
        return low + (high - low) * torch.rand(3, generator=generator, dtype=torch.float64)

    while True:
        rx = Pose.from_yaw((3.0, 4.0, 1.0), float(uniform(-3.0, 3.0)[0]))
        tx = Pose.from_yaw((0.0, 0.0, 2.0), float(uniform(-3.0, 3.0)[0]))
        ends = []
        for pose, fov in zip((rx, tx), fov_deg, strict=True):
            half = math.radians(0.5 * min(fov, 100.0))
            yaw = 2 * math.atan2(float(pose.orientation[3]), float(pose.orientation[0]))
            ends.append((0.5 * math.pi + uniform(-half, half), _wrapped(uniform(-1.0, 1.0) + yaw)))
        paths = Paths(
            coeff=1e-4 * torch.polar(uniform(0.5, 1.0), uniform(0.0, 2 * math.pi)),
            delay=uniform(2e-8, 5e-8),
            aoa_zenith=ends[0][0],
            aoa_azimuth=ends[0][1],
            aod_zenith=ends[1][0],
            aod_azimuth=ends[1][1],
            valid=torch.ones(3, dtype=torch.bool),
            frequency=60e9,
            tx=tx,
            rx=rx,
        )
        place = cells(paths, sound(paths, SMALL))
        apart = (place[:, None] - place).abs().amax(-1) + 2 * torch.eye(3)
        if bool((apart > 1.5).all()):
            return paths


def normalised_errors(seed: int, view: tuple[float, float], *, noise_known: bool = True) -> Tensor | None:
    """Errors over bounds `[5, 3]` of one trial; None where not three paths were found near the three."""
    paths = three_paths(seed, view)
    sounding = sound(paths, _seen_through(SMALL, view, seed))
    bound = cramer_rao(paths, sounding)
    asked = sounding if noise_known else _without_noise(sounding)
    found = sage(asked)
    if found.coeff.shape[-1] != 3:
        return None
    away = (cells(paths, sounding)[:, None] - cells(found, sounding)).abs().amax(-1)
    mine, theirs = linear_sum_assignment(away.numpy())
    if float(away[mine, theirs].max()) > 1.0:
        return None
    rows = []
    for name in QUANTITIES:
        error = getattr(found, name)[theirs] - getattr(paths, name)[mine]
        error = _wrapped(error) if name.endswith("azimuth") else error
        rows.append(error / getattr(bound, name)[mine])
    return torch.stack(rows)


def _wrapped(angle: Tensor) -> Tensor:
    return torch.remainder(angle + math.pi, 2 * math.pi) - math.pi


def _seen_through(sounder: Sounder, view: tuple[float, float], seed: int) -> Sounder:
    return Sounder(**{**vars(sounder), "fov_rx_deg": view[0], "fov_tx_deg": view[1], "seed": seed})


def _without_noise(sounding: Sounding) -> Sounding:
    return Sounding(**{**vars(sounding), "noise_power": None})


def print_trials(trials: int) -> None:
    print(f"{trials} scenes of three paths, RMSE over Cramer-Rao bound\n")
    print(f"| view | noise power | found three | {' | '.join(QUANTITIES)} |\n|---|---|---|{'---|' * len(QUANTITIES)}")
    for name, view in VIEWS.items():
        for known in (True, False):
            errors = [normalised_errors(seed, view, noise_known=known) for seed in range(trials)]
            good = torch.stack([error for error in errors if error is not None])
            ratio = good.square().mean((0, 2)).sqrt().tolist()
            figures = " | ".join(f"{value:.2f}" for value in ratio)
            print(f"| {name} | {'known' if known else 'unknown'} | {len(good)} of {trials} | {figures} |", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--trials", type=int, default=100, help="scenes of three paths per view; 0 leaves them out")
    parser.add_argument("--positions", type=int, default=40, help="positions in the lobby; 0 leaves it out")
    parser.add_argument("--presets", nargs="+", default=["diffuse", "realistic"], help="how the lobby scatters")
    parser.add_argument("--seed", type=int, default=SEED, help="decides the positions")
    chosen = parser.parse_args()
    if chosen.trials:
        print_trials(chosen.trials)
    for preset in chosen.presets if chosen.positions else ():
        print_lobby(chosen.positions, chosen.seed, preset)


if __name__ == "__main__":
    main()
