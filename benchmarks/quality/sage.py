"""How well SAGE reads paths off soundings: against the Cramer-Rao bound, and on traced channels of the lobby.

    python -m benchmarks.quality.sage [--trials 100] [--positions 20]

First table: scenes of three random paths at 20 dB SNR, each at least one and a half resolution cells apart in one
dimension; root mean square of error over bound, and how many trials found three paths. Second: the built-in lobby
traced to random receivers that look at the transmitter, sounded over 1 GHz between 8x8 and 4x4 patches at 20 dB SNR.
Mirror paths, the line of sight among them, are taken in the order in which the sounder hears them, leaving out those
within one resolution cell of a louder one. Found is a path with an estimate less than one cell away in delay and in all
direction cosines. Wanted are those that dominate: heard within 25 dB of everything that is heard, and at least 6 dB
above the diffuse power that a filter matched to the path lets through. The others are listed too.
"""

import argparse
import math
import time
from dataclasses import dataclass

import torch
from scipy.optimize import linear_sum_assignment
from torch import Tensor

from rf3dgs.channel.arrays import planar_array
from rf3dgs.channel.binning import DIFFUSE, bin_diffuse
from rf3dgs.channel.paths import Paths
from rf3dgs.channel.patterns import power_pattern
from rf3dgs.channel.sounding import Sounding, device_directions, seen
from rf3dgs.core.frames import Pose
from rf3dgs.core.units import db_from_power
from rf3dgs.propagation.config import TraceConfig
from rf3dgs.propagation.sounder import Sounder, sound
from rf3dgs.spectra.apertures import Aperture
from rf3dgs.spectra.crb import cramer_rao
from rf3dgs.spectra.sage import estimate_paths, sage

QUANTITIES = ("delay", "aoa_zenith", "aoa_azimuth", "aod_zenith", "aod_azimuth")
SMALL = Sounder(points=64, array_rx=planar_array(4, 4, "patch"), array_tx=planar_array(2, 4, "isotropic"), snr_db=20.0)
LARGE = Sounder(points=256, array_rx=planar_array(8, 8, "patch"), array_tx=planar_array(4, 4, "patch"), snr_db=20.0)
VIEWS = {"full": (180.0, 180.0), "receiver 45 deg": (45.0, 180.0), "both 45 deg": (45.0, 45.0)}
WEAKEST_DB, STANDS_OUT_DB = -25.0, 6.0  # of all power heard, over the diffuse power let through
LIMIT = 12  # paths that SAGE may report there
FAR = 99.0


def cells(paths: Paths, sounding: Sounding) -> Tensor:
    """Delay and direction cosines `[path, 5]` in resolution cells."""
    arrival, departure = device_directions(paths)
    theta = torch.cat((arrival[..., 1:], departure[..., 1:], paths.delay[..., None].double()), -1)
    return theta / Aperture.of(sounding).cell


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


@dataclass(frozen=True)
class Wanted:
    """A mirror path of the lobby, what is in its way, and how near the nearest estimate is."""

    position: int
    order: int
    share_db: float
    """Power heard over that of all paths, diffuse ones included [dB]."""
    over_db: float
    """Level over the diffuse power that a filter matched to the path lets through [dB]."""
    apart: float
    """Distance to the nearest louder mirror path [cells]."""
    away: float
    """Distance to the nearest estimate [cells]."""


def mirror_paths(paths: Paths, sounding: Sounding, found: Paths, position: int, most: int = 12) -> list[Wanted]:
    """The loudest resolvable mirror paths of one position `[path]`, line of sight included."""
    assert paths.kind is not None
    assert paths.order is not None
    array_rx, array_tx = sounding.array_rx, sounding.array_tx
    assert array_rx is not None
    assert array_tx is not None
    arrival, departure = device_directions(paths)
    in_view = seen(array_rx, sounding.fov_rx, arrival) & seen(array_tx, sounding.fov_tx, departure)
    element = power_pattern(array_rx.pattern, arrival) * power_pattern(array_tx.pattern, departure)
    heard, diffuse = paths.path_gain.double() * element, (paths.kind & DIFFUSE) != 0
    keep = in_view & ~diffuse
    place, estimate = cells(paths, sounding), cells(found, sounding)
    clutter = let_through(sounding, place[keep], place[diffuse], heard[diffuse])
    level, over = db_from_power(heard[keep]), db_from_power(heard[keep] / clutter)
    order, everything = paths.order[keep], db_from_power(heard[in_view].sum())
    apart, away = _distance(place[keep], place[keep]), _distance(place[keep], estimate)
    result = []
    for index in level.argsort(descending=True).tolist():
        louder = apart[index][level > level[index]]
        gap = float(louder.min()) if len(louder) else FAR
        if gap < 1.0:
            continue
        nearest = int(away[index].argmin())
        result.append(
            Wanted(
                position=position,
                order=int(order[index]),
                share_db=float(level[index] - everything),
                over_db=float(over[index]),
                apart=gap,
                away=float(away[index, nearest]),
            )
        )
        if len(result) == most:
            break
    return result


def wanted_of(row: list[Wanted]) -> list[Wanted]:
    """Those of one position that dominate."""
    return [path for path in row if path.share_db >= WEAKEST_DB and path.over_db >= STANDS_OUT_DB]


def let_through(sounding: Sounding, place: Tensor, sources: Tensor, power: Tensor) -> Tensor:
    """Mean power `[path]` of incoherent `sources` at the output of filters matched to the waves at `place` [cells]."""
    aperture = Aperture.of(sounding)
    mine, total = aperture.waves(place * aperture.cell), torch.zeros(len(place), dtype=torch.float64)
    for part in torch.arange(len(sources)).split(4096):
        theirs = aperture.waves(sources[part] * aperture.cell)
        shares = [(a.conj() @ b.mT / a.shape[1]).abs().square() for a, b in zip(mine, theirs, strict=True)]
        total += (shares[0] * shares[1] * shares[2]) @ power[part]
    return total.clamp_min(1e-300)


def lobby_positions(count: int, seed: int = 11):
    """Traced paths `[path]` of random positions of the lobby, looking at the transmitter."""
    from rf3dgs.propagation.lobby import lobby
    from rf3dgs.propagation.sionna import trace_each

    site = lobby()
    rx = Pose.look_at(site.receivers(count, seed=seed).position, site.tx.position)
    for row in trace_each(site, None, rx, TraceConfig(rays=50_000)):
        yield bin_diffuse(row[0], cell=math.radians(3.0), delay_step=0.5 / LARGE.bandwidth)


def _distance(first: Tensor, second: Tensor) -> Tensor:
    return (first[:, None] - second).abs().amax(-1) if len(second) else torch.full((len(first), 1), FAR)


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


def print_lobby(positions: int) -> None:
    print(f"\nlobby, {positions} positions, up to {LIMIT} paths each\n")
    everything, started = [], time.process_time()
    for position, paths in enumerate(lobby_positions(positions)):
        sounding = sound(paths, LARGE)
        estimate = estimate_paths(sounding, limit=LIMIT)
        everything.append(mirror_paths(paths, sounding, estimate.paths, position))
        left = float(estimate.residual_power / estimate.noise_power)
        print(
            f"position {position}: {len(paths.delay)} paths, {estimate.paths.coeff.shape[-1]} found, "
            f"{int(estimate.sweeps)} sweeps, residual {left:.1f} x noise",
            flush=True,
        )
    print(f"CPU time {time.process_time() - started:.0f} s, tracing included\n")
    rows = [wanted_of(row) for row in everything]
    rows = [row for row in rows if row]
    whole = sum(all(path.away < 1.0 for path in row) for row in rows)
    print(f"{len(rows)} of {positions} positions have mirror paths that dominate, {sum(map(len, rows))} in all;")
    print(f"all of them are found in {whole} of these positions ({100 * whole / max(len(rows), 1):.0f} %)\n")
    print("| of all power heard [dB] | over diffuse [dB] | order | paths | found | median error [cells] |")
    print("|---|---|---|---|---|---|")
    for shares in ((-10, 1), (-20, -10), (-25, -20), (-30, -25), (-40, -30), (-99, -40)):
        for overs in ((STANDS_OUT_DB, 999), (-999, STANDS_OUT_DB)):
            for order in range(4):
                group = [p for row in everything for p in row if shares[0] <= p.share_db < shares[1]]
                group = [p for p in group if overs[0] <= p.over_db < overs[1] and p.order == order]
                if group:
                    print(f"| {shares[0]} to {shares[1]} | {_over(overs)} | {order} | {_summary(group)} |")
    print("\nthe loudest missed\n")
    print("| position | order | of all [dB] | over diffuse [dB] | to louder mirror [cells] | to estimate [cells] |")
    print("|---|---|---|---|---|---|")
    missed = [path for row in everything for path in row if path.away >= 1.0]
    for path in sorted(missed, key=lambda path: -path.share_db)[:12]:
        print(
            f"| {path.position} | {path.order} | {path.share_db:.1f} | {path.over_db:.1f} | {path.apart:.1f} "
            f"| {path.away:.1f} |"
        )


def _over(overs: tuple[float, float]) -> str:
    return f"at least {overs[0]:.0f}" if overs[1] > 100 else f"below {overs[1]:.0f}"


def _summary(group: list[Wanted]) -> str:
    found = torch.tensor([path.away for path in group if path.away < 1.0])
    return f"{len(group)} | {len(found)} | " + (f"{float(found.median()):.3f}" if len(found) else "-")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--trials", type=int, default=100, help="scenes of three paths per view; 0 leaves them out")
    parser.add_argument("--positions", type=int, default=20, help="positions in the lobby; 0 leaves it out")
    chosen = parser.parse_args()
    if chosen.trials:
        print_trials(chosen.trials)
    if chosen.positions:
        print_lobby(chosen.positions)


if __name__ == "__main__":
    main()
